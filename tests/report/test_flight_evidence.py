"""What an estimate rests on, drawn: the pictures say what the arrays say."""

from __future__ import annotations

import numpy as np
import pytest

import fieldcal
from fieldcal.flight.calibrate import identify, read, run_stages
from fieldcal.names import Sensor
from fieldcal.report.figures.flight_evidence import Evidence, _by_block, _turn_error, _vector_angle, evidence, methods
from fieldcal.report.figures.flight_figures import spheres
from fieldcal.report.flight_curves import counting
from fieldcal.report.flight_data import FlightData, of_log
from fieldcal.report.page import Plot


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> FlightData:
    archive = tmp_path_factory.mktemp("evidence") / "archive"
    log = fieldcal.write_flights(archive, fieldcal.Experiment(seed=5, duration_s=25.0))[0]
    return of_log(run_stages(read(*identify(log))))


def test_readings_along_the_attitude_leave_the_noise(data: FlightData) -> None:
    assert data.settings is not None
    found = evidence(data.tables["smoothing.samples"], data.tables["joint.trajectory"], data.calibration, data.settings)
    assert found is not None
    assert set(found.calibrated) == set(Sensor)
    angle = _vector_angle(found, found.calibrated[Sensor.MAGNETOMETER])
    assert 0.2 < np.sqrt(np.mean(angle**2)) < 1.0  # 0.0058 of noise on each of two axes across the field: 0.47°
    turn = _turn_error(found, found.calibrated[Sensor.GYROSCOPE])
    assert np.sqrt(np.mean(turn**2)) < 1.0


def test_an_attitude_that_jumps_is_seen_in_its_second() -> None:
    t = np.arange(1000) / 100.0
    q = np.tile([0.0, 0.0, 0.0, 1.0], (1000, 1))
    still = Evidence(t, np.zeros(1000, dtype=int), q, {})
    assert np.abs(_turn_error(still, np.zeros((1000, 3)))).max() < 1e-9
    turned = q.copy()
    turned[550:] = [0.0, 0.0, np.sin(np.radians(5.0)), np.cos(np.radians(5.0))]
    at, block = _by_block(t, _turn_error(Evidence(t, still.segment, turned, {}), np.zeros((1000, 3))))
    assert at[np.argmax(block)] == pytest.approx(5.5)
    assert block.max() == pytest.approx(10.0 * np.sqrt(0.5), rel=1e-6)
    assert np.sort(block)[-2] < 1e-6
    down = np.tile([0.0, 0.0, 9.81], (1000, 1))
    assert np.abs(_vector_angle(still, down)).max() < 1e-5


def test_the_page_has_them(data: FlightData) -> None:
    from fieldcal.report.flight import _evidence

    parts = _evidence(data)
    assert [part.anchor for part in parts if isinstance(part, Plot)] == [
        "evidence-methods",
        "evidence-residuals",
        "evidence-information",
    ]
    assert methods(data.calibration.clear()) is None


def test_the_method_that_counts_is_what_figures_show(data: FlightData) -> None:
    assert set(counting(data.calibration, Sensor.ACCELEROMETER)["method"]) == {"joint"}
    assert data.settings is not None
    balls = spheres(data.tables["smoothing.samples"], data.calibration, data.settings)
    assert "refused" not in balls[0].caption
