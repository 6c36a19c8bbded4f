"""`fieldcal.toml`: what the logs cannot say themselves, and the parameters of the stages."""
