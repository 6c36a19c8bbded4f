"""Numbers that columns and views are defined by: said once here, for the code and for SQL."""

from __future__ import annotations

REFERENCE_DEGC = 25.0
"""Temperature, °C, of `value_at_25degc` and of the slopes and bends beside it."""

UNCONFIRMED_SD = 5.0
"""Distance of the latest flight from its trend, in sd, beyond which it may be the first after a step: it stands alone
until another session confirms it."""

ENOUGH_SESSIONS = 5
"""Fewer sessions than this are no trend: level, two slopes, and something left to judge them by."""

PLAUSIBLE_DEGC = (-60.0, 150.0)
"""What an inertial sensor's own temperature can be, °C."""

SAME_VALUE = 1e-5
"""Share by which a number that went through an autopilot's float32 and a ground station's text may differ."""
