"""Numerics: arrays in, arrays out. No tables, no files."""
