"""What is said of a vehicle before it flies: when its constants are due, and what of it is news."""
