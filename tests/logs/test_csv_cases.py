"""CSV logs as they were met, each with what its README calls right. Needs FIELDCAL_EXAMPLE_LOGS."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
from example_logs import PARENT, needs_examples

import fieldcal
from fieldcal.schemas.rows import FlightDocument

pytestmark = needs_examples
CASES = PARENT / "cases" / "logs"
TRUE_LAG_S = -0.3659
BASE = (1.0195, 0.9672, 1.0067)
"""Gyroscope scales of the flight behind most cases, by output error."""
WITHIN = 0.002


@cache
def calibrated(case: str, log: str = "log", config: str | None = "fieldcal.toml") -> FlightDocument:
    """What `fieldcal calibrate --json` prints of a case."""
    folder = CASES / case
    return fieldcal.calibrate(folder / log, method="serial", config=folder / config if config else None).document


def findings(document: FlightDocument) -> dict[str, str]:
    return {finding["code"]: finding["sentence"] for finding in document["flight"]["findings"] or []}


def scales(document: FlightDocument, sensor: str = "gyroscope", method: str = "output_error") -> list[float | None]:
    rows = [r for r in document["calibration"] if (r["sensor"], r["parameter"], r["status"]) == (sensor, "scale", "ok")]
    return [row["value"] for row in rows if row["method"] == method]


def as_in_base(document: FlightDocument, within: float = WITHIN) -> None:
    assert document["flight"]["duration_s"] == pytest.approx(40.0, abs=0.05)
    assert scales(document) == pytest.approx(BASE, abs=within)


def lag(document: FlightDocument, start_s: float = 0.0) -> None:
    """The VPS's lag, three of its standard deviations wide; the IMU's clock begins at `start_s`."""
    sync = document["sync"]
    assert sync is not None
    assert sync["status"] == "ok"
    assert sync["lag_mid_s"] is not None
    assert sync["lag_sd_s"] is not None
    assert abs(sync["lag_mid_s"] - start_s - TRUE_LAG_S) < 3 * sync["lag_sd_s"] + 0.5e-4
    assert sync["lag_sd_s"] < 5e-4


def betaflight(document: FlightDocument) -> None:
    assert "line 8 is taken for the header" in findings(document)["preamble"]
    assert document["flight"]["imu_rate_hz"] == pytest.approx(185.12, abs=0.02)


def counter16(document: FlightDocument) -> None:
    as_in_base(document)
    # The configured rate is not quite the IMU's: half the recording differs by 2 ms.
    lag(document, 62000 / 185.02 + 0.5 * (7399 / 185.02 - 39.9945984))


def crazyflie(document: FlightDocument) -> None:
    as_in_base(document)
    # Whole milliseconds: their rounding is no noise of the lag.
    sync = document["sync"]
    assert sync is not None
    assert sync["lag_mid_s"] == pytest.approx(16757.216 + TRUE_LAG_S, abs=5e-4)


def decimal_comma(document: FlightDocument) -> None:
    assert document["flight"]["n_samples"] == 40


def euroc(document: FlightDocument) -> None:
    assert findings(document) == {}
    lag(document)


def gravity_removed(document: FlightDocument) -> None:
    assert "Gravity has been taken off" in findings(document)["gravity_removed"]
    assert "wrong_unit" not in findings(document)
    assert scales(document, "accelerometer", "ellipsoid_robust") == []


def vps_in_seconds(document: FlightDocument) -> None:
    as_in_base(document)
    lag(document)


def index_is_no_unit(document: FlightDocument) -> None:
    as_in_base(document)
    units = {row["unit"] for row in document["calibration"] if row["sensor"] == "magnetometer"}
    assert not any("norm" in unit for unit in units)


def two_imus(document: FlightDocument) -> None:
    assert document["flight"]["reason_code"] == "several_units"
    assert "csv.instance" in str(document["flight"]["reason"])


def midnight(document: FlightDocument) -> None:
    as_in_base(document)
    lag(document)
    assert set(findings(document)) == {"clock_wrapped"}


def duplicate_names(document: FlightDocument) -> None:
    as_in_base(document)
    assert "2 columns named 'X'" in findings(document)["vps_unreadable"]


def milliseconds(document: FlightDocument) -> None:
    assert (document["flight"]["verdict"], document["flight"]["reason_code"]) == ("quarantined", "implausible_rate")
    assert "ms instead of s" in str(document["flight"]["reason"])


def rounded(document: FlightDocument) -> None:
    assert (document["flight"]["verdict"], document["flight"]["reason_code"]) == ("partial", "repeated_stamps")
    lag(document)


def sparse(document: FlightDocument) -> None:
    assert "sensors_joined" in findings(document)
    as_in_base(document)


def kelvin(document: FlightDocument) -> None:
    assert document["flight"]["temperature_mean_degc"] == pytest.approx(25.0, abs=1e-9)
    as_in_base(document)


def nothing_told(document: FlightDocument) -> None:
    assert findings(document) == {}
    as_in_base(document)


def vps_not_understood(document: FlightDocument) -> None:
    told = findings(document)["vps_unreadable"]
    assert "no known quaternion columns; it has" in told
    assert "csv.vps.quaternion_xyzw" in told


def imu_beside_it(document: FlightDocument) -> None:
    vps_not_understood(document)
    as_in_base(document)


def xsens(document: FlightDocument) -> None:
    assert set(findings(document)) == {"clock_wrapped"}
    as_in_base(document)


CHECKS: list[tuple[str, Callable[[FlightDocument], None]]] = [
    ("betaflight_bbe_csv", betaflight),
    ("counter16_wrap_vps", counter16),
    ("crazyflie_24bit_ms", crazyflie),
    ("csv_decimal_comma_crash_minimal", decimal_comma),
    ("euroc", euroc),
    ("gravity_removed", gravity_removed),
    ("imu_us_vps_named_s", vps_in_seconds),
    ("index_1_read_as_norm", index_is_no_unit),
    ("mavlogdump_2imu_2ms_apart", two_imus),
    ("midnight_seconds_of_day", midnight),
    ("motive_csv_header_stripped", duplicate_names),
    ("ms_1khz_no_unit", milliseconds),
    ("rounded_2_decimals", rounded),
    ("sparse_rows_one_sensor_each", sparse),
    ("temp_kelvin_units", kelvin),
    ("time_of_day_strings", nothing_told),
    ("ulog2csv", nothing_told),
    ("vicon_nexus_csv", imu_beside_it),
    ("vps_euler_degrees", imu_beside_it),
    ("xsens_mt_txt", xsens),
]


@pytest.mark.parametrize(("case", "check"), CHECKS, ids=[case for case, _ in CHECKS])
def test_what_is_right_of_a_case(case: str, check: Callable[[FlightDocument], None]) -> None:
    check(calibrated(case))


def test_gravity_removed_in_g() -> None:
    gravity_removed(calibrated("gravity_removed", config="fieldcal_g.toml"))


def test_a_vps_of_unknown_columns_without_a_configuration() -> None:
    document = calibrated("vps_unknown_columns_minimal", log=".", config=None)
    vps_not_understood(document)
    assert document["flight"]["n_samples"] == 40


@pytest.mark.parametrize(("instance", "scale"), [("0", (1.02, 0.985, 1.01)), ("1", (0.990, 0.956, 0.981))])
def test_one_of_two_imus_is_chosen(tmp_path_factory: pytest.TempPathFactory, instance: str, scale: list[float]) -> None:
    folder = CASES / "mavlogdump_2imu_2ms_apart"
    config = tmp_path_factory.mktemp("config") / "fieldcal.toml"
    text = (folder / "fieldcal.toml").read_text()
    config.write_text(text.replace("[defaults.csv]", f'[defaults.csv]\ninstance = "{instance}"'))
    document = fieldcal.calibrate(folder / "log", method="serial", config=config).document
    assert document["flight"]["imu_rate_hz"] == pytest.approx(185.12, abs=0.02)
    assert scales(document) == pytest.approx(scale, rel=0.025)
    other = fieldcal.calibrate(folder / "log", method="serial", config=config, unit="imu.1").document
    left_out, others_scale = {"0": ("1", (0.990, 0.956, 0.981)), "1": ("0", (1.02, 0.985, 1.01))}[instance]
    assert {row["unit_id"].rpartition("/")[2] for row in other["calibration"]} == {left_out}
    assert scales(other) == pytest.approx(others_scale, rel=0.025)
