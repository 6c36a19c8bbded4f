"""MCAP logs."""
