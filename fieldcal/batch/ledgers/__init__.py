"""What nights remember of logs and flights, so that the next need not look."""
