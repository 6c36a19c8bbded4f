"""The clock of the visual positioning system against that of the IMU."""
