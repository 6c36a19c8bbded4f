"""Gyroscope constants from attitude: equation error and output error."""
