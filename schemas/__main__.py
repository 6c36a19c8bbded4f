"""`python -m fieldcal.schemas [NAME] [--json | --markdown]`: as `fieldcal schemas`."""

import sys
from importlib import import_module

if __name__ == "__main__":
    # By name: the command line knows this room, which knows nothing above it.
    sys.exit(import_module("fieldcal.cli.main").run(["schemas", *(sys.argv[1:] or ["--markdown"])]))
