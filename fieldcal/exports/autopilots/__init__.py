"""Constants as parameters of PX4 and ArduPilot: for the slot of the sensor's device, in its axes and units."""
