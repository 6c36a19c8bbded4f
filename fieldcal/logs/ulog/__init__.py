"""PX4 ULog files, read and written."""
