"""A fleet's history in, a fleet's trends out, a vehicle at a time: what did not change is neither read nor written."""
