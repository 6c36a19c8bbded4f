"""`python -m fieldcal` is the command `fieldcal`."""

from fieldcal.cli.main import main

main()
