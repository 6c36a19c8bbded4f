"""All three triads and the attitude in one likelihood (method `joint`)."""
