"""Vector triads from a known trajectory: attitude and position by the VPS, so that nothing but constants is unknown."""
