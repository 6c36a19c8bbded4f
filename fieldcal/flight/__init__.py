"""One flight: the identity of its log, its calibration in memory, its rows of the history."""
