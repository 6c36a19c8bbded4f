"""What people decide about flights, and what that makes of the history."""
