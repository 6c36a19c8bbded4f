"""`fieldcal.read_log`: a log in memory, tidy, with what was found wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from fieldcal.flight.calibrate import LogRead, identify, read
from fieldcal.geometry.rotation import Array
from fieldcal.logs.facts import Facts
from fieldcal.logs.ingest import started_at
from fieldcal.names import SENSORS
from fieldcal.remote.places import log_at
from fieldcal.stages.tables import matrix, seconds, triad

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TABLE_OF = {"gyroscope": "imu", "accelerometer": "imu", "magnetometer": "magnetometer"}


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing about a log.

    Attributes
    ----------
    code : str
        Short stable identifier.
    count : int
        How often it was met.
    sentence : str
        What was found, with the numbers.

    Examples
    --------
    >>> Finding("lost_samples", 3, "flight-01.mcap: 3 samples are missing.").code
    'lost_samples'
    """

    code: str
    count: int
    sentence: str


@dataclass(frozen=True)
class Recording:
    """A log in memory: tidy signals, and a verdict on it.

    Attributes
    ----------
    tables : dict of str to DataFrame
        Signal → rows in order of time, one a stamp: imu, magnetometer, temperature, vps, position, power, those that
        the log has. Readings stand as logged, sensor axes; a sensor that the log lacks is null. Columns and units are
        those of `fieldcal.schemas`. Empty when nothing could be read.
    verdict : {"ok", "partial", "quarantined", "rejected"}
        "partial": some of the recording is missing. "quarantined": it contradicts itself. "rejected": nothing is
        usable. Only "ok" and "partial" logs are calibrated.
    facts : dict
        What is known of the flight, plain values: duration_s, imu_rate_hz, vps_rate_hz, n_samples,
        temperature_min_degc, temperature_mean_degc, temperature_max_degc, world, body, gravity_sign, position
        (latitude °, longitude °, altitude m), verifiable, …; unknown ones are None.
    source : LogRead
        What the pipeline is given: the log, its vehicle's configuration, signals and facts.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     recording = fieldcal.read_log(log)
    >>> recording.verdict == "ok", recording.vehicle_id, recording.units["gyroscope"]
    (True, 'sim-1', 'counts')
    >>> t, readings = recording.readings("gyroscope")
    >>> t.shape, readings.shape
    ((3700,), (3700, 3))
    """

    source: LogRead = field(repr=False)
    path: Path
    vehicle_id: str
    session_id: str
    flight_id: str
    verdict: str
    reason: str | None

    @classmethod
    def of(cls, log: LogRead) -> Recording:
        """What `fieldcal.flight` read, as a recording."""
        job, facts = log.job, log.facts
        return cls(
            log, Path(job.path), job.vehicle_id, job.session_id, job.flight_id, facts["verdict"], facts["reason"]
        )

    @property
    def tables(self) -> dict[str, pl.DataFrame]:
        """Signal → rows in order of time."""
        return dict(self.source.signals)

    @property
    def facts(self) -> Facts:
        """What is known of the flight, plain values."""
        return self.source.facts.copy()

    @property
    def reason_code(self) -> str | None:
        """Identifier of the reason; None for an "ok" log."""
        return self.source.facts["reason_code"]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All that was found, also where it cost nothing."""
        return tuple(Finding(f["code"], f["count"], f["sentence"]) for f in self.source.facts["findings"])

    @property
    def units(self) -> dict[str, str]:
        """Sensor → unit of its readings; "unknown" where neither log nor configuration says."""
        return dict(self.source.facts["units"])

    @property
    def started_at(self) -> datetime | None:
        """Time of the first IMU sample, UTC; None when the log's clock has no known epoch."""
        return started_at(self.source.facts)

    def readings(self, sensor: str) -> tuple[Array, Array]:
        """Stamps (n,), s from the log's first IMU sample, and readings (n, 3) as logged, sensor axes.

        Raises
        ------
        ValueError
            There is no such sensor, or the log has no readings of it.
        """
        if sensor not in SENSORS:
            raise ValueError(f"sensor is one of {', '.join(SENSORS)}, not {sensor!r}")
        table = self.source.signals.get(TABLE_OF[sensor])
        if table is None or table[f"{sensor}_x"].null_count() == table.height:
            raise ValueError(f"{self.path.name} has no {sensor} readings")
        return seconds(table["t_ns"], int(self.source.signals["imu"]["t_ns"][0])), matrix(table, triad(sensor))

    def plot(self) -> list[Axes]:
        """Readings against time, a panel a signal, as logged.

        Raises
        ------
        FieldcalError
            `not_usable`: nothing could be read.
        """
        from fieldcal.plots.signals import plot_signals

        return plot_signals(self.source.signals, self.units, f"{self.path.name}: {self.verdict}", self.reason)


def read_log(path: Path | str, *, config: Path | str | None = None, vehicle: str | None = None) -> Recording:
    """Read a flight log into memory.

    The log is only ever read. What is wrong with it is no exception: the recording's `verdict`, `reason` and `findings`
    say it, and `tables` holds what is sound.

    Parameters
    ----------
    path : Path or str
        An MCAP, ROS bag (file or folder), ULog, DataFlash or CSV file, or a folder with imu.csv; its vehicle and
        session are the folders it lies in, ``<vehicle>/<session>/<log>``. Or its URL (``s3://``, ``gs://``, ``az://``):
        it is fetched.
    config : Path or str, optional
        A fieldcal.toml: topics, columns, units. Otherwise the one in the folder above the vehicle's, beside
        the log or in the current directory.
    vehicle : str, optional
        Another vehicle of the configuration than the folder says.

    Returns
    -------
    Recording

    Raises
    ------
    FieldcalError
        `not_found`, `not_readable`: there is no such log.
    ConfigurationError
        The configuration is wrong.

    See Also
    --------
    calibrate : takes a path as well.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     recording = fieldcal.read_log(log)
    >>> sorted(recording.tables)
    ['imu', 'magnetometer', 'temperature', 'vps']
    >>> recording.findings
    ()
    """
    job, own = identify(log_at(path), None if config is None else Path(config), vehicle_id=vehicle)
    return Recording.of(read(job, own))


def as_recording(log: Recording | Path | str, config: Path | str | None, vehicle: str | None) -> Recording:
    """The recording that was given, or the log at a path. A recording has its configuration already: ValueError where
    another is given too."""
    if not isinstance(log, Recording):
        return read_log(log, config=config, vehicle=vehicle)
    if config is not None or vehicle is not None:
        raise ValueError("config and vehicle belong to read_log: this recording was read with its own")
    return log
