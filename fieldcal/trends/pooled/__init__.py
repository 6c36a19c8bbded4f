"""Constants of a unit from what all its flights know together."""
