"""Numbers, rows and flights as people read them: the same words on the terminal, in reports and in the history."""
