"""Which code a result comes from: what a function reaches, read from the source without importing it."""
