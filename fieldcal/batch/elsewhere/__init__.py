"""Batches on machines that share nothing with this one but an object store."""
