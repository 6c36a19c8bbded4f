"""ArduPilot DataFlash logs (`.bin`)."""
