"""What a night tells: what is new, once, an axis at a time."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow.parquet as pq
import pytest
from drift_history import publish_fleet
from history_rows import START, rows
from older_history import rewrite

from fieldcal.batch.closing import close_night
from fieldcal.config.configuration import Alerts
from fieldcal.schemas import TABLES
from fieldcal.trends.changes import changes, last_usable
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.layout import history_files

NOW = START + dt.timedelta(days=100)
NOBODY = pl.DataFrame(
    schema={
        "vehicle_id": pl.String,
        "imu_id": pl.String,
        "unit_id": pl.String,
        "sensor": pl.String,
        "last_at": pl.Datetime("us", "UTC"),
    }
)


def drift(*statuses: tuple[str, str], **more: Any) -> pl.DataFrame:
    first = {"vehicle_id": "v", "imu_id": "i", "sensor": "gyroscope", "parameter": "zero_bias", "unit": "rad/s"}
    return rows(
        "drift",
        *(
            {**first, "method": method, "axis": axis, "status": status, "reason": "Why.", **more}
            for axis, status in statuses
            for method in ("equation_error", "output_error")
        ),
    )


def test_a_new_status_is_told_once_for_all_methods() -> None:
    former, table = drift(("x", "stable"), ("y", "step")), drift(("x", "drifting"), ("y", "step"))
    (change,) = changes(former, table, NOBODY, now=NOW)
    assert (change.kind, change.sensor, change.axis) == ("drifting", "gyroscope", "x")
    assert change.parameters == ("zero_bias",)
    assert change.sentence == "v, i, gyroscope x, zero_bias: Why."
    assert change.row()["parameters"] == ["zero_bias"]
    assert changes(table, table, NOBODY, now=NOW) == []
    assert [c.kind for c in changes(former.clear(), table, NOBODY, now=NOW)] == ["step", "drifting"]
    assert [c.kind for c in changes(table, former, NOBODY, now=NOW)] == ["recovered"]


def test_another_step_is_new() -> None:
    before, after = (drift(("x", "step"), change_at=START + dt.timedelta(days=d)) for d in (7, 70))
    assert [c.kind for c in changes(before, after, NOBODY, now=NOW)] == ["step"]


def test_a_flight_off_the_line_is_told() -> None:
    before, after = (drift(("x", "stable"), last_z=z) for z in (1.0, -7.0))
    assert [c.kind for c in changes(before, after, NOBODY, now=NOW)] == ["last_flight"]
    assert changes(after, after, NOBODY, now=NOW) == []


def test_age_is_told_when_it_passes_the_limit(tmp_path: Path) -> None:
    publish_fleet(tmp_path, units=1, sessions=3)  # the last two weeks after START
    latest, none = last_usable(tmp_path), drift().clear()
    assert latest["last_at"].to_list() == [START + dt.timedelta(days=14)] * 2

    def kinds(day: float, since: float | None) -> list[str]:
        before = None if since is None else START + dt.timedelta(days=since)
        return [c.kind for c in changes(none, none, latest, now=START + dt.timedelta(days=day), since=before)]

    assert kinds(43.0, 42.0) == []
    assert kinds(44.5, 43.5) == ["idle"]
    assert kinds(45.5, 44.5) == []
    assert kinds(104.5, 103.5) == ["expired", "expired"]
    assert kinds(104.5, None) == ["expired", "expired", "idle"]
    told = changes(none, none, latest, now=START + dt.timedelta(days=104.5))
    assert told[0].sentence.startswith("v00, imu-00, accelerometer: last calibrated 90 days ago")
    assert told[-1].sentence.startswith("v00: no usable flight for 90 days")
    sooner = changes(
        none, none, latest, now=START + dt.timedelta(days=20), alerts=Alerts(expires_days=5.0, idle_days=60.0)
    )
    assert [c.kind for c in sooner] == ["expired", "expired"]
    assert "it counts for 5 days" in sooner[0].sentence


def test_trends_of_an_older_release_are_made_anew_and_those_of_a_newer_refused(tmp_path: Path) -> None:
    publish_fleet(tmp_path, units=2, sessions=6)
    close_night(tmp_path, Alerts(expires_days=1e5, idle_days=1e5))
    made = Warehouse(tmp_path).scan("drift").collect()
    (path, *_) = history_files(tmp_path, "drift")
    rewrite(tmp_path, path, pq.read_table(path, partitioning=None).drop_columns(["best_known_at"]), 2)
    close_night(tmp_path, Alerts(expires_days=1e5, idle_days=1e5))
    assert Warehouse(tmp_path).scan("drift").collect().equals(made)
    rewrite(tmp_path, path, pq.read_table(path, partitioning=None), TABLES["drift"].version + 1)
    newer = path.read_bytes()
    with pytest.raises(WarehouseError, match="A newer fieldcal wrote it") as caught:
        close_night(tmp_path, Alerts(expires_days=1e5, idle_days=1e5))
    assert caught.value.reason_code == "schema_mismatch"
    assert path.read_bytes() == newer


def test_limits_of_the_configuration_reach_the_night(tmp_path: Path) -> None:
    """Whoever shortens a limit is told at once of what that makes old, and once only."""
    publish_fleet(tmp_path, units=1, sessions=3)
    far = Alerts(expires_days=1e5, idle_days=1e5)
    assert close_night(tmp_path, far).changes == []
    near = Alerts(expires_days=1e5, idle_days=1e-3)
    assert [c.kind for c in close_night(tmp_path, near).changes] == ["idle"]
    assert close_night(tmp_path, near).changes == []
