"""The paper's experiment with known truth: arrays, and archives of logs."""
