"""All triads by a satellite receiver's velocity: between its epochs the readings are integrated."""
