"""What many flights say: drift over temperature and time, steps, odd siblings."""
