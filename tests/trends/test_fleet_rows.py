"""Rows that trends are of are read once, and are the same as read all at once, whoever flew on what."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest
from history_rows import lead, rows
from polars.testing import assert_frame_equal

from fieldcal.trends.fleet import rows as fleet_rows
from fieldcal.trends.fleet.groups import groups
from fieldcal.trends.fleet.publishing import publish_where_other
from fieldcal.trends.fleet.rows import ORDER, PLACE, _read, _stays, history_in_groups
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.publish import publish

FLOWN = {"a": ("imu-1", "imu-9"), "b": ("imu-2",), "c": ("imu-2", "imu-1"), "d": ("imu-9",)}
"""Units by vehicle, in order of their flights: two are carried by two vehicles."""


def fly(root: Path, vehicle: str, units: tuple[str, ...], first_day: int | None = 0, unit: str = "1") -> None:
    for number, imu in enumerate(units):
        day = None if first_day is None else first_day + number
        flight_id = f"{vehicle}-{first_day}-{number}"
        own = {**lead(vehicle, flight_id, day), "imu_id": imu, "unit_id": imu}
        of_sensor = {"sensor": "gyroscope", "method": "joint", "parameter": "scale", "unit": unit, "status": "ok"}
        calibration = [{**own, **of_sensor, "axis": axis, "value": 1.0 + number, "sd": 0.1} for axis in "zyx"]
        tables = {
            "flight": rows("flight", {**own, "log_uri": flight_id}),
            "calibration": rows("calibration", *calibration),
        }
        publish(root, vehicle, tables, {flight_id})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for number, (vehicle, units) in enumerate(FLOWN.items()):
        fly(tmp_path, vehicle, units, 10 * number)
    fly(tmp_path, "c", ("imu-2",), None)
    fly(tmp_path, "d", ("imu-9",), 50, unit="counts")
    return tmp_path


def everything(root: Path, *, remember: bool = True) -> pl.DataFrame:
    return pl.concat(history_in_groups(root, remember=remember))


def all_at_once(root: Path) -> pl.DataFrame:
    return _read(root, None, counting(root)).sort(ORDER, nulls_last=False).filter(_stays())


def test_rows_are_those_read_all_at_once(root: Path) -> None:
    expected = all_at_once(root)
    assert expected.height < _read(root, None, counting(root)).height  # some have another unit, or no time
    for _ in range(2):
        assert_frame_equal(everything(root), expected)
    assert_frame_equal(everything(root, remember=False), expected)
    assert list(history_in_groups(root / "nothing")) == []


def test_vehicles_that_share_units_are_of_one_group(root: Path) -> None:
    """c joins b to a, and a shares another with d; e and f have units of their own."""
    fly(root, "f", ("imu-6",), 60)
    fly(root, "e", ("imu-5",), 70)
    assert list(groups(root, ["calibration"], 1)) == [["a", "b", "c", "d"], ["e"], ["f"]]
    assert list(groups(root, ["calibration"])) == [["a", "b", "c", "d", "e", "f"]]


def test_only_vehicles_that_flew_are_read_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str | None] = []
    own = fleet_rows._read
    monkeypatch.setattr(fleet_rows, "source_digest", lambda *functions: "code")
    monkeypatch.setattr(fleet_rows, "_read", lambda *given: (read.append(given[1]), own(*given))[1])
    everything(root)
    assert read == ["a", "b", "c", "d"]
    everything(root)
    assert len(read) == 4
    fly(root, "b", ("imu-2",), 90)
    assert_frame_equal(everything(root), all_at_once(root))
    assert read[4:] == ["b"]
    place = root / PLACE / "a.bin"
    place.write_bytes(place.read_bytes()[:-3])
    everything(root)
    assert read[5:] == ["a"]
    monkeypatch.setattr(fleet_rows, "source_digest", lambda *functions: "other code")
    everything(root)
    assert read[6:] == ["a", "b", "c", "d"]


def test_what_is_remembered_of_a_vehicle_goes_with_it(root: Path) -> None:
    everything(root)
    for path in root.glob("tables/*/vehicle=b/part.parquet"):
        path.unlink()
    everything(root)
    assert sorted(path.stem for path in (root / PLACE).iterdir()) == ["a", "c", "d"]


def test_vehicles_whose_rows_are_the_same_are_not_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    published: list[str] = []

    def noted(root: Path, vehicle_id: str, *rest: object) -> tuple[str, ...]:
        published.append(vehicle_id)
        return publish(root, vehicle_id, *rest)

    monkeypatch.setattr("fieldcal.trends.fleet.publishing.publish", noted)
    axis = {
        "sensor": "gyroscope",
        "method": "joint",
        "parameter": "scale",
        "axis": "x",
        "unit": "1",
        "status": "stable",
    }
    own = [{"vehicle_id": v, "imu_id": v, "unit_id": v, "n_flights": 3, "n_sessions": 1, **axis} for v in "abc"]
    table = rows("drift", *own)
    assert publish_where_other(tmp_path, "drift", table) == {"a", "b", "c"}
    assert publish_where_other(tmp_path, "drift", table) == set()
    assert published == ["a", "b", "c"]
    other = table.with_columns(n_flights=pl.when(pl.col("vehicle_id") == "b").then(4).otherwise("n_flights"))
    assert publish_where_other(tmp_path, "drift", other.filter(pl.col("vehicle_id") != "c")) == {"b", "c"}
    assert published[3:] == ["b", "c"]
