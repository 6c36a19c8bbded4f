"""Generated histories with known trends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numerics_support import Array

from fieldcal.trends.series import Histories

TAU, SD = 1.0, 0.4
VALUE, PER_DEGC, PER_DAY = 100.0, 0.2, 0.0


@dataclass(frozen=True)
class Fleet:
    """Histories of equal length as (g, n) arrays, ready to be spoiled."""

    time_day: Array
    temperature_degc: Array
    session: np.ndarray
    value: Array
    sd: Array

    def histories(self, **changes: Array | None) -> Histories:
        g, n = self.value.shape
        flat = Histories(
            row=np.repeat(np.arange(g), n),
            session=self.session.ravel(),
            time_day=self.time_day.ravel(),
            temperature_degc=self.temperature_degc.ravel(),
            value=self.value.ravel(),
            sd=self.sd.ravel(),
        )
        return replace(flat, **changes)  # type: ignore[arg-type]


def fleet(
    seed: int,
    rows: int = 400,
    sessions: int = 24,
    flights: int = 1,
    *,
    tau: float = TAU,
    sd: float = SD,
    phi: float = 0.0,
    per_day: float = PER_DAY,
) -> Fleet:
    """Stable units: sessions a week apart at −10 to 45 °C, session scatter tau, claimed sd spread about sd, flights
    scattering phi beyond it."""
    rng = np.random.default_rng(seed)
    n = sessions * flights
    session = np.tile(np.repeat(np.arange(sessions), flights), (rows, 1))
    time = 7.0 * session + np.tile(np.arange(flights) / 48.0, sessions)
    warm = np.repeat(rng.uniform(-10.0, 45.0, (rows, sessions)), flights, axis=1)
    warm = warm + rng.uniform(0.0, 8.0, (rows, n)) * (flights > 1)
    own = sd * rng.uniform(0.5, 2.0, (rows, n))
    value = (
        VALUE
        + PER_DEGC * (warm - 25.0)
        + per_day * (time - time[:, -1:])
        + np.repeat(tau * rng.normal(size=(rows, sessions)), flights, axis=1)
        + np.hypot(own, phi) * rng.normal(size=(rows, n))
    )
    return Fleet(time, warm, session, value, own)
