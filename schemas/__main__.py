"""`python -m schemas`: print the data dictionary."""

import os
import sys

from fieldcal.schemas.dictionary import data_dictionary

try:
    print(data_dictionary(), flush=True)
except BrokenPipeError:  # `| head` has seen enough
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
