"""Drawings of a flight's page."""
