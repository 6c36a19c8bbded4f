"""Rotations, the sensor model, the earth's magnetic field."""
