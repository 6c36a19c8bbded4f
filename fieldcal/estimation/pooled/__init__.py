"""Many flights of a unit together: what each knows, smoothed over sessions."""
