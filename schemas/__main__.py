"""`python -m schemas`: print the data dictionary."""

from schemas.dictionary import data_dictionary

print(data_dictionary())
