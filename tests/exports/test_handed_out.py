"""An export is remembered, and the parameters of the next logs tell what became of it."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from autopilot_rows import PARAMETERS, composition, gyroscope, history, origin
from history_rows import START, lead

import fieldcal
from fieldcal.cli.main import run
from fieldcal.exports.calibration import Constants, Export, Written
from fieldcal.exports.handed_out import Fate, HandedOut, handed_out, record_export
from fieldcal.report import write_vehicle_report
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.content import content_sha256

EXPORTED = START + dt.timedelta(days=1, hours=6)


def put(root: Path, number: int, parameters: dict[str, float], *, dated: bool = True) -> None:
    """Flight `number`, on its day, with these parameters loaded; its gyroscope's zero is .03 rad/s."""
    first = lead("v", f"f{number}", number if dated else None) | {"unit_id": "b/12", "sequence": f"{number:04d}"}
    first["dated_by"] = "log" if dated else "name"
    history(root, (gyroscope(first, 0.03), [composition(first, origin(12, parameters))]))


def exported(root: Path, now: dt.datetime = EXPORTED) -> dict[str, float]:
    """Export, remember, and what the autopilot then has: float32, and no digits beyond the seventh in its file."""
    constants = fieldcal.Warehouse(root).calibration_at("v")
    export = fieldcal.export(constants, "px4")
    assert record_export(root, constants, "px4", export, author="ann", at_degc=25.0, now=now)
    return PARAMETERS | {one.name: float(f"{np.float32(one.value):.7g}") for one in export.written}


def became(root: Path) -> HandedOut:
    (one,) = handed_out(root, "v")
    return one


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for number in range(2):
        put(tmp_path, number, PARAMETERS)
    return tmp_path


def test_what_was_exported_is_remembered(root: Path) -> None:
    parameters = exported(root)
    rows = Warehouse(root).scan("export").collect()
    assert set(rows["name"]) == {f"CAL_GYRO1_{axis}OFF" for axis in "XYZ"}
    assert set(rows.select("unit_id", "sensor", "format", "author", "latest_flight_id").rows()) == {
        ("b/12", "gyroscope", "px4", "ann", "f1")
    }
    for name, value in rows.select("name", "set_to").iter_rows():
        assert value == pytest.approx(parameters[name], rel=1e-6)
    assert set(rows["exported_at"]) == {EXPORTED}
    assert became(root).fate == Fate.NOT_KNOWN
    assert became(root).sentence == (
        "gyroscope: exported for px4 on 2026-05-05; no log since then tells whether it was loaded."
    )


def test_the_same_export_again_is_none(root: Path) -> None:
    exported(root)
    constants = fieldcal.Warehouse(root).calibration_at("v")
    asked = fieldcal.Warehouse(root)
    assert not asked.record_export(constants, "px4", fieldcal.export(constants, "px4"))
    assert asked.record_export(constants, "json", fieldcal.export(constants, "json"), author="ben")
    other = Warehouse(root).scan("export").filter(format="json").collect()
    assert set(other["name"]) == {f"{what}_{axis}" for what in ("zero", "scale") for axis in "xyz"}
    assert other.filter(name="zero_x")["set_to"].item() == pytest.approx(0.03)
    assert became(root).format == "px4"  # of others no log tells


@pytest.mark.parametrize(
    ("to", "held"),
    [
        ("json", {"gyroscope": {"zero", "scale"}}),
        ("c", {"gyroscope": {"zero", "scale"}}),
        ("ros", {"gyroscope": {"zero", "scale"}}),
        ("kalibr", {"gyroscope": {"scale"}}),
        ("imu_pipeline", {}),
    ],
)
def test_what_a_format_cannot_hold_was_not_handed_out(root: Path, to: str, held: dict[str, set[str]]) -> None:
    found: dict[str, set[str]] = {}
    for one in fieldcal.export(fieldcal.Warehouse(root).calibration_at("v"), to).written:
        found.setdefault(one.sensor, set()).add(one.name.partition("_")[0])
    assert found == held


def one_number(root: Path, *numbers: Written, at: dt.datetime = EXPORTED) -> bool:
    """Remember an export whose text is its numbers."""
    export = Export(" ".join(f"{one.name}={one.value}" for one in numbers), (), numbers)
    constants = Constants("v", "i", {}, "")
    return record_export(root, constants, "px4", export, author="ann", at_degc=25.0, now=at)


def test_only_a_repetition_of_the_last_export_is_none(root: Path) -> None:
    exports = [Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", value) for value in (0.1, 0.2, 0.1, 0.1)]
    told = [one_number(root, one, at=EXPORTED + dt.timedelta(hours=i)) for i, one in enumerate(exports)]
    assert told == [True, True, True, False]


def test_the_latest_flight_is_the_last_one_whose_clock_is_known(root: Path) -> None:
    put(root, 7, PARAMETERS, dated=False)
    one_number(root, Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", 0.03))
    assert set(Warehouse(root).scan("export").collect()["latest_flight_id"]) == {"f1"}


def test_what_became_is_told_by_sensor_and_unit(root: Path) -> None:
    own = [("gyroscope", f"b/{unit}") for unit in range(10, 20)] + [("accelerometer", f"b/{unit}") for unit in (11, 10)]
    one_number(root, *(Written(unit, sensor, f"P{i}", 1.0) for i, (sensor, unit) in enumerate(reversed(own))))
    assert [(one.sensor, one.unit_id) for one in handed_out(root, "v")] == sorted(own)


@pytest.mark.parametrize("value", [0.03, 0.0])
@pytest.mark.parametrize(("share", "fate"), [(0.9, Fate.FLIES), (1.1, Fate.NOT_LOADED)])
def test_a_hundred_thousandth_is_the_same_number(root: Path, value: float, share: float, fate: Fate) -> None:
    """Float32 has seven digits, and a ground station may write six; zero is zero to a hundred thousandth of that."""
    one_number(root, Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", value))
    off = share * 1e-5 * (value or 1e-5)
    put(root, 2, PARAMETERS | {"CAL_GYRO1_XOFF": value + off})
    assert became(root).fate == fate


def test_loaded_since_and_still_flies(root: Path) -> None:
    parameters = exported(root)
    put(root, 2, PARAMETERS)
    put(root, 3, parameters)
    put(root, 4, parameters)
    one = became(root)
    assert (one.fate, one.since, one.until) == (Fate.FLIES, "f3", "f4")
    assert one.sentence == (
        "gyroscope: exported for px4 on 2026-05-05; loaded since flight f3 of 2026-05-07, and still flies."
    )


def test_replaced_by_something_else(root: Path) -> None:
    parameters = exported(root)
    put(root, 2, parameters)
    put(root, 3, parameters | {"CAL_GYRO1_YOFF": 0.25})
    put(root, 4, parameters | {"CAL_GYRO1_YOFF": 0.25})
    one = became(root)
    assert (one.fate, one.since, one.until) == (Fate.REPLACED, "f2", "f2")
    assert one.sentence.endswith("flew in flight f2 of 2026-05-06, and was replaced: CAL_GYRO1_YOFF is 0.25, not 0.03.")


def test_loaded_again_after_something_else(root: Path) -> None:
    parameters = exported(root)
    put(root, 2, parameters)
    put(root, 3, PARAMETERS)
    put(root, 4, parameters)
    assert (became(root).fate, became(root).since) == (Fate.FLIES, "f4")


def test_flights_since_without_it(root: Path) -> None:
    exported(root)
    put(root, 2, PARAMETERS)
    one = became(root)
    assert (one.fate, one.since) == (Fate.NOT_LOADED, None)
    assert one.differs == "CAL_GYRO1_XOFF is 0.5, not 0.03"


def test_what_flew_before_it_was_exported_flies_since_the_first_flight(root: Path) -> None:
    one_number(root, Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", PARAMETERS["CAL_GYRO1_XOFF"]))
    one = became(root)
    assert (one.fate, one.since, one.until) == (Fate.FLIES, "f0", "f1")


@pytest.mark.parametrize("hours", [1, 0])
def test_a_flight_of_before_that_comes_late_says_nothing(root: Path, hours: int) -> None:
    exported(root)
    first = lead("v", "late", 0) | {"unit_id": "b/12", "started_at": EXPORTED - dt.timedelta(hours=hours)}
    history(root, (gyroscope(first, 0.03), [composition(first, origin(12, PARAMETERS))]))
    assert became(root).fate == Fate.NOT_KNOWN


def test_without_a_clock_flights_are_known_by_their_order(tmp_path: Path) -> None:
    for number in range(2):
        put(tmp_path, number, PARAMETERS, dated=False)
    parameters = exported(tmp_path)
    assert became(tmp_path).fate == Fate.NOT_KNOWN
    put(tmp_path, 2, PARAMETERS, dated=False)
    assert became(tmp_path).fate == Fate.NOT_LOADED
    put(tmp_path, 3, parameters, dated=False)
    assert (became(tmp_path).fate, became(tmp_path).sentence) == (
        Fate.FLIES,
        "gyroscope: exported for px4 on 2026-05-05; loaded since flight f3, and still flies.",
    )


def test_a_flight_whose_clock_is_unknown_is_not_the_latest_one(root: Path) -> None:
    one_number(root, Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", 0.03))
    put(root, 2, PARAMETERS | {"CAL_GYRO1_XOFF": 0.03}, dated=False)
    assert (became(root).fate, became(root).since) == (Fate.REPLACED, "f2")


def test_flights_count_where_the_one_before_the_export_tells_nothing(tmp_path: Path) -> None:
    first = lead("v", "f0", None) | {"unit_id": "b/12", "sequence": "0000", "dated_by": "name"}
    history(tmp_path, (gyroscope(first, 0.03), [composition(first, None)]))
    one_number(tmp_path, Written("b/12", "gyroscope", "CAL_GYRO1_XOFF", 0.03))
    assert became(tmp_path).fate == Fate.NOT_KNOWN
    put(tmp_path, 1, PARAMETERS, dated=False)
    assert (became(tmp_path).fate, became(tmp_path).differs) == (Fate.NOT_LOADED, "CAL_GYRO1_XOFF is 0.5, not 0.03")


def test_the_latest_export_is_what_is_told(root: Path) -> None:
    parameters = exported(root)
    put(root, 2, parameters)
    first = lead("v", "f3", 3) | {"unit_id": "b/12"}
    history(root, (gyroscope(first, 0.04), [composition(first, origin(12, parameters))]))
    exported(root, START + dt.timedelta(days=9))
    assert (became(root).fate, became(root).exported_at.day) == (Fate.NOT_KNOWN, 13)


def test_sql_tells_what_was_loaded_when_and_by_which_export(root: Path) -> None:
    parameters = exported(root)
    put(root, 2, parameters)
    rows = Warehouse(root).sql("SELECT * FROM active WHERE name LIKE 'CAL_GYRO1%OFF' ORDER BY flight_id, name")
    assert rows.filter(flight_id="f1").select("name", "set_to", "exported_at").rows() == [("CAL_GYRO1_XOFF", 0.5, None)]
    loaded = rows.filter(flight_id="f2")
    assert loaded["name"].to_list() == [f"CAL_GYRO1_{axis}OFF" for axis in "XYZ"]
    assert set(loaded["exported_at"]) == {EXPORTED}
    assert set(loaded.select("vehicle_id", "unit_id", "sensor", "autopilot", "device_id", "is_primary").rows()) == {
        ("v", "b/12", "gyroscope", "px4", 12, True)
    }
    assert Warehouse(root).sql("SELECT count(DISTINCT name) AS n FROM export")["n"].item() == 3


def test_sql_goes_by_the_value_where_a_flight_has_no_clock(tmp_path: Path) -> None:
    put(tmp_path, 0, PARAMETERS, dated=False)
    parameters = exported(tmp_path)
    put(tmp_path, 1, parameters, dated=False)
    put(tmp_path, 2, parameters)
    rows = Warehouse(tmp_path).sql("SELECT flight_id FROM active WHERE exported_at IS NOT NULL ORDER BY ALL")
    assert set(rows["flight_id"]) == {"f1", "f2"}
    put(tmp_path, -3, parameters)  # of before the export, by its clock
    assert set(Warehouse(tmp_path).sql("SELECT flight_id FROM active WHERE exported_at IS NOT NULL")["flight_id"]) == {
        "f1",
        "f2",
    }


def test_what_was_exported_is_no_result(root: Path) -> None:
    before = content_sha256(root)
    exported(root)
    assert content_sha256(root) == before


def test_the_command_line_remembers_and_compares(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", "v", "-f", "px4", "--author", "ann", "--warehouse", str(root)]) == 0
    text = capsys.readouterr().out
    assert set(Warehouse(root).scan("export").collect()["author"]) == {"ann"}
    moment = Warehouse(root).scan("export").collect()["exported_at"][0]
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    first = lead("v", "f9", 9) | {"unit_id": "b/12", "started_at": moment + dt.timedelta(days=1)}
    loaded = PARAMETERS | {row[2]: float(row[3]) for row in rows}
    history(root, (gyroscope(first, 0.03), [composition(first, origin(12, loaded))]))
    assert run(["compare", "v", "--warehouse", str(root)]) == 0
    assert "loaded since flight f9" in capsys.readouterr().out
    assert run(["compare", "v", "--json", "--warehouse", str(root)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {(row["exported"]["fate"], row["exported"]["since"]) for row in told} == {("flies", "f9")}
    assert "loaded since flight f9" in write_vehicle_report(root, "v").read_text()


def test_what_cannot_be_remembered_is_told_and_the_text_given(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "tables" / "export").write_text("a file where a folder should be")
    assert run(["export", "v", "-f", "px4", "--warehouse", str(root)]) == 0
    given = capsys.readouterr()
    assert "CAL_GYRO1_XOFF" in given.out
    assert "not remembered" in given.err


def test_a_vehicle_without_exports_has_none(root: Path) -> None:
    assert handed_out(root, "v") == []
    assert pl.DataFrame(handed_out(root, "nobody")).is_empty()
