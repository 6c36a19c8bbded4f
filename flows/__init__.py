"""When, and in what order: the night, one session, the command line. The only package that knows Prefect."""
