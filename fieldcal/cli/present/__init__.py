"""What a flight, a night and its progress look like on a terminal."""
