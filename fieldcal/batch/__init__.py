"""A night's logic, importable without Prefect: what is due, what was done, what it leaves in the history."""
