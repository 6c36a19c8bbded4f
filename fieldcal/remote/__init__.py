"""Logs and warehouses by URL: an object store, asked in few words, and local copies of what is needed of it."""
