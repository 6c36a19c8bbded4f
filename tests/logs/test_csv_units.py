"""Units as CSV files write them, held to the SI's own factors and to what a reader of the header sees."""

from __future__ import annotations

import pytest

from fieldcal.logs.csv.units import (
    TO_DEGC,
    angle_unit,
    is_units_row,
    prefixed_unit,
    sensor_unit,
    temperature_unit,
    time_unit,
    token,
    without_unit,
)


@pytest.mark.parametrize(
    ("sensor", "unit", "of", "milli"),
    [
        *(("gyroscope", unit, "rad/s", True) for unit in ("mrad/s", "mradps", "mrad·s⁻¹", "mrad s^-1")),
        *(("gyroscope", unit, "deg/s", True) for unit in ("mdps", "mdeg/s", "m°/s")),
        *(("accelerometer", unit, "g", True) for unit in ("mg", "Milli-g", "millig")),
        *(("accelerometer", unit, "m/s^2", True) for unit in ("mm/s²", "mm/s2", "mm s⁻²")),
        *(("magnetometer", unit, "T", True) for unit in ("mT", "millitesla")),
        *(("magnetometer", unit, "uT", True) for unit in ("nT", "nanotesla")),
        *(("magnetometer", unit, "G", True) for unit in ("mGauss", "mGa", "milligauss")),
        *(("gyroscope", unit, None, False) for unit in ("rad/s", "deg/s", "mg", "m", "")),
        *(("accelerometer", unit, None, False) for unit in ("g", "m/s^2", "mT", "mgauss")),
        *(("magnetometer", unit, None, False) for unit in ("T", "uT", "G", "mg", "1")),
    ],
)
def test_a_thousandth_of_a_unit_is_converted(sensor: str, unit: str, of: str | None, milli: bool) -> None:
    assert prefixed_unit(sensor, unit) == ((of, 0.001) if milli else None)
    if milli:
        assert sensor_unit(sensor, "x", unit) == unit


@pytest.mark.parametrize(
    ("unit", "reading", "celsius"),
    [("degC", 21.5, 21.5), ("K", 273.15, 0.0), ("K", 0.0, -273.15), ("degF", 32.0, 0.0), ("degF", 212.0, 100.0)],
)
def test_fixed_points_of_temperature(unit: str, reading: float, celsius: float) -> None:
    factor, offset = TO_DEGC[unit]
    assert factor * reading + offset == pytest.approx(celsius, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (" [ m/s² ] ", "m/s^2"),
        ("(µT)", "ut"),
        ("(μT)", "ut"),
        ("{°/s}", "deg/s"),
        ("m·s⁻²", "ms^-2"),
        ("m ⋅ s⁻¹", "ms^-1"),
        ("", ""),
    ],
)
def test_one_spelling(text: str, expected: str) -> None:
    assert token(text) == expected


@pytest.mark.parametrize(
    ("cells", "units"),
    [
        (["s", "rad/s", "m/s^2", "G"], True),
        (["s", "", "-", "1"], True),
        (["", "-", "1"], False),
        ([""], False),
        (["1", "1"], False),
        (["1", "deg"], True),
        (["s", "rad/s", "0.5"], False),
        (["s", "rad/s", "banana"], False),
        (["2", "s"], False),
        (["K", "hPa", "%", "mm/s2", "iso8601", "counts"], True),
    ],
)
def test_rows_of_units(cells: list[str], units: bool) -> None:
    assert is_units_row(cells) == units


@pytest.mark.parametrize(
    ("column", "cell", "unit"),
    [
        ("gx", None, None),
        ("gx", "", None),
        ("gx", "-", None),
        ("gx", "deg/s", "deg/s"),
        ("gx", " banana ", "banana"),
        ("gx [rad/s]", "deg/s", "deg/s"),
        ("gx [rad/s]", "", "rad/s"),
        ("gx [rad/s]", "-", "rad/s"),
        ("gx [rad/s]", None, "rad/s"),
        ("gx ( mdps ) ", None, "mdps"),
        ("gx (m/s^2)", None, "m/s^2"),
        ("gyro[0]", None, None),
        ("gyro(x)", None, None),
        ("gyro()", None, None),
        ("gyro(-)", None, None),
        ("gyro_dps", None, "deg/s"),
        ("gyro_dps[0]", None, "deg/s"),
        ("Gyro_DPS (x)", None, "deg/s"),
        ("gyro_rad_s", None, "rad/s"),
        ("gyro_mdps", None, "mdps"),
        ("g_dps", None, "deg/s"),
        ("_dps", None, None),
        ("gyrodps", None, None),
    ],
)
def test_the_unit_of_a_gyroscope(column: str, cell: str | None, unit: str | None) -> None:
    assert sensor_unit("gyroscope", column, cell) == unit


def test_the_row_goes_before_the_name_and_what_is_neither_says_nothing() -> None:
    assert [time_unit(*given) for given in (("t", None), ("t", "ms"), ("t [us]", "ms"), ("t [us]", "x"))] == [
        None, "ms", "ms", "us",
    ]  # fmt: skip
    assert [time_unit(name, None) for name in ("t_ns", "time_s", "_s", "ts", "t (sec)", "stamp_USEC")] == [
        "ns", "s", None, None, "s", "us",
    ]  # fmt: skip
    assert [temperature_unit(name, None) for name in ("T", "T [K]", "T_degF", "T (°C)", "T_k")] == [
        "degC", "K", "degF", "degC", "K",
    ]  # fmt: skip
    assert [angle_unit(name, cell) for name, cell in (("roll", None), ("roll_deg", None), ("roll (°)", "rad"))] == [
        None, "deg", "rad",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("column", "name"),
    [
        ("gx [rad/s]", "gx"),
        ("gx", "gx"),
        ("gyro[0]", "gyro[0]"),
        ("gyro(x)", "gyro(x)"),
        ("p [-]", "p [-]"),
        ("p []", "p []"),
        ("t (s) ", "t"),
        ("p (hPa)", "p"),
        ("a (g) [0]", "a (g) [0]"),
        ("m (norm)", "m"),
    ],
)
def test_names_without_their_unit(column: str, name: str) -> None:
    assert without_unit(column) == name
