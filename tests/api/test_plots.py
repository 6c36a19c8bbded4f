"""A picture of any result in one call: axes with units, nothing shown that was refused without saying so."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import polars as pl
import pytest

import fieldcal
from fieldcal.schemas.frames import empty_frame
from fieldcal.trends.drift_table import update_drift
from fieldcal.warehouse.publish import publish

matplotlib.use("agg")
SESSIONS = 4


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    from matplotlib import pyplot

    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    experiment = fieldcal.Experiment(seed=2, duration_s=20.0, temperature_degc=(20.0, 28.0))
    return fieldcal.write_flights(tmp_path_factory.mktemp("plots") / "archive", experiment, sessions=SESSIONS)


@pytest.fixture(scope="module")
def calibrations(logs: list[Path]) -> list[fieldcal.Calibration]:
    return [fieldcal.calibrate(log) for log in logs]


@pytest.fixture(scope="module")
def warehouse(calibrations: list[fieldcal.Calibration], tmp_path_factory: pytest.TempPathFactory) -> fieldcal.Warehouse:
    root = tmp_path_factory.mktemp("plots") / "warehouse"
    sync = pl.DataFrame([c.document["sync"] for c in calibrations], schema=empty_frame("sync").schema, strict=False)
    tables = {
        "calibration": pl.concat([c.rows for c in calibrations]),
        "fit": pl.concat([c.fits for c in calibrations]),
        "sync": sync,
    }
    publish(root, "sim-1", tables, [c.recording.flight_id for c in calibrations])
    update_drift(root)
    return fieldcal.Warehouse(root)


def labels(axes: list[Any]) -> str:
    """All that is written in a picture, after it was drawn."""
    axes[0].figure.canvas.draw()
    own = [axis.get_xlabel() + axis.get_ylabel() + axis.get_title() for axis in axes]
    own += [text.get_text() for axis in axes for text in axis.texts]
    legends = [axis.get_legend() for axis in axes]
    own += [text.get_text() for legend in legends if legend is not None for text in legend.get_texts()]
    return "\n".join(own)


def test_a_recording(logs: list[Path]) -> None:
    axes = fieldcal.read_log(logs[0]).plot()
    told = labels(axes)
    assert len(axes) == 5
    for word in ("gyroscope\n(counts)", "temperature\n(°C)", "VPS quaternion", "time from the first IMU sample (s)"):
        assert word in told
    assert len(axes[0].lines) == 3


def test_a_calibration(calibrations: list[fieldcal.Calibration]) -> None:
    axes = calibrations[0].plot()
    told = labels(axes)
    assert len(axes) == 6
    for word in ("(norm)", "(m/s²)", "(rad/s)", "equation error", "VPS", "± sd (%)"):
        assert word in told
    assert "refused" not in told
    assert "ellipsoid robust (not chosen)" in told
    radius = axes[0].lines[0].get_ydata()
    assert np.abs(np.asarray(radius, dtype=float) - 1.0).max() < 0.1


def test_a_refused_calibration_says_so(tmp_path: Path) -> None:
    experiment = fieldcal.Experiment(seed=0, duration_s=20.0, turned=(1.0, 1.0, 0.0))
    told = labels(fieldcal.calibrate(fieldcal.write_flights(tmp_path, experiment)[0], method="serial").plot())
    assert "refused: not to be used" in told
    assert "ellipsoid robust (refused)" in told
    assert "Refused: Magnetometer:" in told


def test_the_clock(calibrations: list[fieldcal.Calibration]) -> None:
    clock = calibrations[0].sync
    assert clock is not None
    axes = clock.plot()
    assert "time, IMU clock (s)" in labels(axes)
    gyroscope, vps = (np.asarray(line.get_ydata(), dtype=float) for line in axes[1].lines)
    assert np.nanmax(gyroscope) == pytest.approx(np.nanmax(vps), rel=0.3)


def test_fits_on_arrays() -> None:
    flight = fieldcal.simulate(seed=1, duration_s=20.0)
    counts, signs = flight.counts, {"magnetometer": (1, 1, -1), "accelerometer": (1, 1, -1)}
    shown = {
        "(%)": fieldcal.fit_ellipsoid(counts["magnetometer"], 1.0, polarity=(1, 1, -1)),
        "attitude error (°)": fieldcal.fit_output_error(flight.t, flight.q, counts["gyroscope"]),
        "length (m/s²)": fieldcal.fit_joint(flight.t, **counts, polarity=signs, gravity_mps2=9.81),
        "(as given)": fieldcal.synchronise(flight.t, counts["gyroscope"], flight.vps_t, flight.vps_q),
    }
    for word, fit in shown.items():
        assert word in labels(fieldcal.plot(fit))


def test_the_history(warehouse: fieldcal.Warehouse) -> None:
    rows = warehouse.history(sensor="gyroscope", parameter="scale")
    axes = fieldcal.plot(rows)
    assert "x (rad/s/counts)" in labels(axes)
    wanted = rows.filter(method="joint", axis="x").sort("started_at")["value"].to_list()
    assert axes[0].containers[0].lines[0].get_ydata().tolist() == wanted


def test_a_refused_value_does_not_set_the_limits(warehouse: fieldcal.Warehouse) -> None:
    rows = warehouse.history(sensor="magnetometer", parameter="scale")
    flights = rows["flight_id"].unique(maintain_order=True)
    far = rows.with_columns(
        status=pl.when(pl.col("flight_id") == flights[0]).then(pl.lit("refused")).otherwise("status"),
        value=pl.when(pl.col("flight_id") == flights[0]).then(1e6).otherwise("value"),
    )
    axes = fieldcal.plot(far)
    assert axes[0].get_ylim()[1] < 1.0
    assert axes[0].lines[-1].get_ydata().tolist() == [1e6]


def test_the_drift(warehouse: fieldcal.Warehouse) -> None:
    drift = warehouse.drift()
    told = labels(fieldcal.plot(drift, sensor="magnetometer", parameter="zero_bias"))
    for word in ("x at 25 °C (norm)", "temperature (°C)", "sim-1: "):
        assert word in told


def test_fit_and_sync_rows(warehouse: fieldcal.Warehouse, calibrations: list[fieldcal.Calibration]) -> None:
    assert "rms attitude error (°)" in labels(fieldcal.plot(warehouse.scan("fit").collect()))
    one = fieldcal.plot(calibrations[0].fits)
    assert len(one[0].patches) == calibrations[0].fits["tic"].count()
    assert "lag at mid-flight (ms)" in labels(fieldcal.plot(warehouse.scan("sync").collect()))


def test_what_cannot_be_drawn_is_told(warehouse: fieldcal.Warehouse) -> None:
    with pytest.raises(ValueError, match="this has a"):
        fieldcal.plot(pl.DataFrame({"a": [1]}))
    with pytest.raises(ValueError, match="no rows"):
        fieldcal.plot(warehouse.history(sensor="magnetometer").clear())
    with pytest.raises(ValueError, match="it has sensors"):
        fieldcal.plot(warehouse.history(), sensor="barometer")


def test_the_warehouse_answers(warehouse: fieldcal.Warehouse) -> None:
    assert warehouse.history(since="2026-01-20")["session_id"].n_unique() == SESSIONS - 2
    assert warehouse.sql("SELECT count(DISTINCT flight_id) AS n FROM calibration")["n"].to_list() == [SESSIONS]
    constants = warehouse.calibration_at("sim-1", 22.0)
    assert constants.triads["gyroscope"].temperature_degc == 22.0
    with pytest.raises(fieldcal.FieldcalError, match="there is: sim-1"):
        warehouse.calibration_at("sim-9")
    with pytest.raises(fieldcal.WarehouseError, match="no warehouse"):
        fieldcal.Warehouse("nowhere").drift()
