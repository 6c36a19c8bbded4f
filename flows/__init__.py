"""When, and in what order: the night, one session, the command line. The only package that knows Prefect."""

if __name__ != "fieldcal.flows":  # a checkout has this folder at its root too: two copies of every flow and enum
    raise ImportError("This package is fieldcal.flows.")
