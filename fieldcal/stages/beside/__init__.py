"""What is found beside the constants: a zero that warms up, the field of the motors."""
