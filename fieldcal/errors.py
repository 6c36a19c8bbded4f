"""What can go wrong, by who must act.

`ValueError` stays Python's own for a caller's mistake in the numerics (wrong shape, non-finite input).
Everything below carries a `reason_code` for tables and a sentence for people.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode


class FieldcalError(Exception):
    """Base of every error fieldcal raises on purpose.

    Parameters
    ----------
    reason_code : ReasonCode
        Short stable identifier, stored in tables (`too_little_motion`, `format_not_supported`, ...).
    sentence : str
        What happened and what to do next.
    measured : mapping, optional
        The numbers that decided it.

    Examples
    --------
    >>> import fieldcal
    >>> try:
    ...     fieldcal.read_log("nowhere.mcap")
    ... except fieldcal.FieldcalError as error:
    ...     print(error.reason_code)
    not_found
    """

    def __init__(self, reason_code: ReasonCode, sentence: str, measured: Mapping[str, Json] | None = None) -> None:
        super().__init__(sentence)
        self.reason_code = reason_code
        self.sentence = sentence
        self.measured: dict[str, Json] = dict(measured or {})

    def __reduce__(self) -> tuple[type[Self], tuple[ReasonCode, str, dict[str, Json]]]:
        """Copies whole, also between processes."""
        return type(self), (self.reason_code, self.sentence, self.measured)


class ConfigurationError(FieldcalError):
    """The configuration is wrong: nothing runs until it is mended.

    Examples
    --------
    >>> import fieldcal
    >>> try:
    ...     fieldcal.read_log("flight.mcap", config="nowhere.toml")
    ... except fieldcal.ConfigurationError as error:
    ...     print(error)
    nowhere.toml: there is no such file.
    """

    @property
    def mistakes(self) -> list[str]:
        """Every mistake that was found, each a sentence."""
        told = self.measured.get("mistakes")
        return [str(one) for one in told] if isinstance(told, list) else [self.sentence]


class UnreadableLog(FieldcalError):
    """This log cannot be read, or holds nothing usable. Other logs are not concerned.

    Streaming a log raises it; `fieldcal.read_log` gives a recording with verdict "rejected" instead.

    Examples
    --------
    >>> import fieldcal
    >>> raise fieldcal.UnreadableLog("empty_file", "flight.mcap is empty.")
    Traceback (most recent call last):
    ...
    fieldcal.errors.UnreadableLog: flight.mcap is empty.
    """


class UnusableFlight(FieldcalError):
    """The recording does not determine what was asked of it (planar motion, no excitation, flat peak).

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> try:
    ...     fieldcal.fit_ellipsoid(np.ones((20, 3)), 1.0)
    ... except fieldcal.UnusableFlight as error:
    ...     print(error.reason_code)
    ellipsoid_degenerate
    """


class EstimationError(FieldcalError):
    """Enough information, yet the estimator reached no minimum.

    Examples
    --------
    >>> import fieldcal
    >>> error = fieldcal.EstimationError("joint_diverged", "No minimum was found.", {"iterations": 50})
    >>> error.reason_code, error.measured
    ('joint_diverged', {'iterations': 50})
    """


class Refused(FieldcalError):
    """A value was asked for that fieldcal refused; the sentence says why.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     never_turned_about_z = fieldcal.Experiment(duration_s=20.0, turned=(1.0, 1.0, 0.0))
    ...     log = fieldcal.write_flights(folder, never_turned_about_z)[0]
    ...     calibration = fieldcal.calibrate(log, method="serial")
    >>> calibration.magnetometer.scale.value
    Traceback (most recent call last):
    ...
    fieldcal.errors.Refused: The magnetometer's scale by ellipsoid_robust was refused. Magnetometer: ...
    >>> calibration.magnetometer.scale.refused_value().shape
    (3,)
    """


def unforeseen(log_uri: str, error: Exception) -> str:
    """What an unforeseen error says to people."""
    told = " ".join(str(error).split())
    what = f"{type(error).__name__}: {told[:300]}"
    return f"an error of fieldcal's own stopped it on {log_uri} ({what}). Please report it."
