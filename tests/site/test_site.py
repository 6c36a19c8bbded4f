"""The site from the history: every vehicle and flight, only what changed, and no text of a log that becomes markup."""

from __future__ import annotations

import base64
import datetime as dt
import hashlib
import io
import json
import os
import re
import shutil
import zlib
from concurrent.futures import Future, ProcessPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import polars as pl
import pytest
from history_rows import flight, lead, rows
from report_rows import publish_fleet

import fieldcal
from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import one_flight
from fieldcal.batch.night import plan_night, publishings
from fieldcal.config.configuration import Alerts
from fieldcal.exports import FORMATS, export_to
from fieldcal.exports.calibration_at import constants_of
from fieldcal.names import Standing
from fieldcal.report.fitness import Criteria, fleet_fitness
from fieldcal.report.links import flight_name, vehicle_name
from fieldcal.report.trend import change_sentence
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.site import drawing, write_site
from fieldcal.site.charts import numbers
from fieldcal.site.downloads import ENDINGS
from fieldcal.site.drawing import Drawing
from fieldcal.site.flight_charts import SHARES, STEPS_OF_A_RANGE, envelope, rounded
from fieldcal.site.pages import ASSETS, asset
from fieldcal.site.snapshot import Snapshot
from fieldcal.site.write import draw_ahead, write_pages
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.upkeep.verify import verify

NOW = dt.datetime(2026, 11, 2, tzinfo=dt.UTC)
HOSTILE = "</script><script>alert(1)</script>&'\"\u202e\x1b[2J\u2028/../%2e%2e#?"
UPLOT = {
    "uplot/uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "uplot/uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    "uplot/LICENSE": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
}
"""Of uplot 1.6.32 as its package has them."""
VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """A page: tags with their attributes, its text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def references(self) -> list[str]:
        """Addresses of everything that it loads or links to."""
        return [str(value) for _, own in self.tags for name, value in own.items() if name in ("href", "src")]


def given(path: Path) -> Any:
    """What a script of data hands over."""
    text = path.read_text(encoding="ascii")
    found = re.fullmatch(r"fieldcal(Data|Packed)\((\".*?\"),(.*)\);\n", text, re.S)
    assert found
    assert path.stem == json.loads(found[2])
    value = json.loads(found[3])
    return value if found[1] == "Data" else json.loads(zlib.decompress(base64.b64decode(value)))


def stamps(root: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every file of the site: another where it was written again."""
    site = root / "site"
    return {
        path.relative_to(site).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in site.rglob("*")
        if path.is_file()
    }


def changed(before: dict[str, tuple[int, int]], after: dict[str, tuple[int, int]]) -> set[str]:
    return {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fleet")
    kinds = {"alpha": "stable", "bravo": "step", "charlie": "drifting", "echo": "insufficient"}
    publish_fleet(root, kinds, n_flights=8)
    write_site(root, Criteria(Alerts(expires_days=1e5)), now=NOW)
    return root


def test_every_vehicle_and_flight_has_a_page_and_every_link_leads_somewhere(fleet: Path) -> None:
    site = fleet / "site"
    flights = Warehouse(fleet).scan("flight").collect()
    expected = {vehicle_name(v) for v in flights["vehicle_id"]} | {flight_name(f) for f in flights["flight_id"]}
    pages = {path.name for path in site.glob("*.html")}
    assert pages == expected | {"index.html", "flights.html", "compare.html"}
    for path in site.glob("*.html"):
        for address in Page(path).references():
            name = unquote(re.split(r"[?#]", address)[0])
            assert address == "data:," or not name or (site / name).is_file(), (path.name, address)


def test_nothing_outside_is_named_and_nothing_inline_runs(fleet: Path) -> None:
    for path in (fleet / "site").glob("*.html"):
        page = Page(path)
        assert not [one for one in page.references() if re.match(r"(?!data:,)\w+:|//", one)]
        policy = next(own["content"] for tag, own in page.tags if own.get("http-equiv") == "Content-Security-Policy")
        assert policy is not None
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        for tag, own in page.tags:
            assert tag != "script" or own.get("src")
            assert tag != "style"
            assert not [name for name in own if name.startswith("on") or name == "style"]


def test_first_page_says_who_is_fine_to_fly_and_why_not(fleet: Path) -> None:
    page = Page(fleet / "site" / "index.html")
    fitness = fleet_fitness(Warehouse(fleet), Criteria(Alerts(expires_days=1e5)), NOW)
    assert "Fleet: 1 of 4 vehicles fine to fly" in page.text
    assert {v: one.standing for v, one in fitness.items()} == {
        "alpha": Standing.FINE,
        "bravo": Standing.LOOK,
        "charlie": Standing.LOOK,
        "echo": Standing.LOOK,  # its latest log is partial
    }
    order = re.findall(r"vehicle-(\w+)\.html", (fleet / "site" / "index.html").read_text())
    assert order == ["bravo", "charlie", "echo", "alpha"]
    drift = Warehouse(fleet).scan("drift").filter(vehicle_id="bravo", status="step").collect()
    for reason in fitness["bravo"].reasons:
        assert reason in page.text
        assert reason in Page(fleet / "site" / "vehicle-bravo.html").text
    assert change_sentence(drift.row(0, named=True), []) in fitness["bravo"].reasons[0]


def test_a_constant_that_is_too_old_is_looked_at(fleet: Path) -> None:
    old = fleet_fitness(Warehouse(fleet), Criteria(Alerts(expires_days=100.0)), NOW)["alpha"]
    assert old.standing == Standing.LOOK
    assert old.reasons == (
        "Expired: magnetometer, accelerometer, gyroscope last calibrated on 2026-06-22; that counts for 100 days.",
    )


def test_figures_show_what_the_history_holds(fleet: Path) -> None:
    told = given(fleet / "site" / "data" / "vehicle-alpha.js")
    chart = next(one for one in told["charts"] if one["title"] == "gyroscope zero_bias")
    (curve,) = (c for c in chart["views"][1]["panels"][0]["curves"] if c["name"] == "flights")
    assert chart["views"][1]["name"] == "against temperature"
    own = Warehouse(fleet).scan("calibration", vehicle_id="alpha")
    own = own.filter(sensor="gyroscope", parameter="zero_bias", axis="x")
    known = {row["flight_id"]: row for row in own.collect().iter_rows(named=True)}
    assert set(curve["of"]) == set(known)
    for flight_id, degc, sd in zip(curve["of"], chart["xs"][curve["x"]], curve["sd"], strict=True):
        assert degc == pytest.approx(known[flight_id]["temperature_degc"], rel=1e-6)
        assert sd == pytest.approx(np.degrees(known[flight_id]["sd"]), rel=1e-6)
    frame = pl.read_parquet(fleet / "site" / "data" / "vehicle-alpha.parquet")
    same = frame.filter(figure="gyroscope zero_bias", view="against temperature", panel="x", curve="flights")
    assert same["flight_id"].to_list() == curve["of"]
    assert np.allclose(same["y"].to_numpy(), curve["y"], rtol=1e-6)
    assert same["unit"].unique().to_list() == ["°/s"]


def test_every_format_is_there_or_says_why_not(fleet: Path) -> None:
    constants = constants_of(fleet, "alpha")
    text = Page(fleet / "site" / "vehicle-alpha.html").text
    assert set(ENDINGS) == set(FORMATS)
    given_away = 0
    for name in FORMATS:
        file = fleet / "site" / "constants" / f"vehicle-alpha-{name}.{ENDINGS[name]}"
        expected, refused = None, None
        try:
            expected = export_to(name, constants).text
        except fieldcal.FieldcalError as error:
            refused = error.sentence
        assert (file.read_text(encoding="utf-8") if file.exists() else None) == expected
        assert refused is None or refused in text
        given_away += expected is not None
    assert given_away >= 4


def test_names_from_logs_never_become_markup(tmp_path: Path) -> None:
    named = f"{HOSTILE}1", "0123", "plain"
    publish(tmp_path, named[0], flight(named[0], named[1]), [named[1]])
    first = {**lead(HOSTILE, HOSTILE, 3), "imu_id": HOSTILE, "session_id": HOSTILE}
    published = flight(HOSTILE, HOSTILE, 3)
    published["flight"] = rows(
        "flight",
        {**first, "log_uri": HOSTILE, "verdict": "partial", "reason": HOSTILE, "reason_code": "lost_samples"},
    )
    published["calibration"] = published["calibration"].with_columns(unit_id=pl.lit(HOSTILE), imu_id=pl.lit(HOSTILE))
    publish(tmp_path, HOSTILE, published, [HOSTILE])
    site = write_site(tmp_path, now=NOW).parent
    scripts = set()
    for path in site.glob("*.html"):
        page = Page(path)
        text = path.read_text(encoding="utf-8")
        scripts |= {str(own.get("src")) for tag, own in page.tags if tag == "script"}
        assert "alert(1)</script>" not in text
        assert not set(text) & {"\u202e", "\x1b", "\u2028"}
        assert sum(tag == "img" for tag, _ in page.tags) == 0
        for address in page.references():
            name = unquote(re.split(r"[?#]", address)[0])
            assert address == "data:," or not name or (site / name).is_file(), address
    assert all(re.match(r"(assets|data)/", one) for one in scripts)
    for path in (site / "data").glob("*.js"):
        data = path.read_bytes()
        assert not set(b"<>&'") & set(data)
        assert data.isascii()
        assert b"\x1b" not in data
        given(path)
    told = given(site / "data" / "fleet.js")
    shown = {one["id"] for one in told["vehicles"]}
    assert "</script><script>alert(1)</script>&'\"\\u202e\\x1b[2J\\u2028/../%2e%2e#?" in shown
    assert {path.name for path in site.parent.iterdir() if path.is_dir()} <= {
        *("site", "tables", "night", "checksums", "stages", "signals"),
    }


def test_only_what_changed_is_written_and_what_is_gone_goes(tmp_path: Path) -> None:
    for vehicle in ("alpha", "bravo"):
        for day in range(2):
            publish(tmp_path, vehicle, flight(vehicle, f"{vehicle}{day}", day), [f"{vehicle}{day}"])
    write_site(tmp_path, now=NOW)
    first = stamps(tmp_path)
    write_site(tmp_path, now=NOW)
    assert changed(first, stamps(tmp_path)) == set()

    publish(tmp_path, "alpha", flight("alpha", "alpha2", 2), ["alpha2"])
    write_site(tmp_path, now=NOW)
    second = stamps(tmp_path)
    of_fleet = {"index.html", "flights.html", "compare.html", "data/fleet.js"}
    own = {"vehicle-alpha.html", "data/vehicle-alpha.js", "data/vehicle-alpha.parquet"}
    new = {"flight-alpha2.html", "data/flight-alpha2.js"}
    assert changed(first, second) == of_fleet | own | new

    publish(tmp_path, "bravo", {}, ["bravo0", "bravo1"])
    write_site(tmp_path, now=NOW)
    third = stamps(tmp_path)
    assert not [name for name in third if "bravo" in name]
    assert changed(second, third) == of_fleet | {name for name in second if "bravo" in name}
    assert not list((tmp_path / "night" / "site").glob("bravo*"))


def test_a_page_that_was_removed_or_cut_short_is_made_again(fleet: Path) -> None:
    site = fleet / "site"
    whole = {name: (site / name).read_bytes() for name in ("vehicle-alpha.html", "data/vehicle-bravo.js")}
    (site / "vehicle-alpha.html").unlink()
    (site / "data" / "vehicle-bravo.js").write_bytes(b"fieldcal")
    write_site(fleet, Criteria(Alerts(expires_days=1e5)), now=NOW)
    assert {name: (site / name).read_bytes() for name in whole} == whole


def test_a_changed_byte_is_found(fleet: Path) -> None:
    assert verify(fleet)["ok"]
    page = fleet / "site" / "vehicle-alpha.html"
    before = page.read_bytes()
    page.write_bytes(before.replace(b"alpha", b"alphb", 1))
    damaged = verify(fleet)["damaged"]
    page.write_bytes(before)
    assert [one["path"] for one in damaged] == ["site/vehicle-alpha.html"]


def test_a_decision_is_on_the_site_at_once(tmp_path: Path) -> None:
    publish_fleet(tmp_path, {"alpha": "stable"}, n_flights=3)
    write_site(tmp_path, now=NOW)
    (flight_id,) = Warehouse(tmp_path).scan("flight").head(1).collect()["flight_id"]
    assert "Withdrawn" not in Page(tmp_path / "site" / flight_name(flight_id)).text
    fieldcal.Warehouse(tmp_path).withdraw(flight_id, reason="A magnet lay beside it.", author="ann")
    for name in (flight_name(flight_id), "vehicle-alpha.html"):
        assert "A magnet lay beside it. (ann" in Page(tmp_path / "site" / name).text


def test_a_night_writes_it_and_the_next_nothing(tmp_path: Path) -> None:
    """Through logs, stages and publishing, as a night does without Prefect; then with one log more."""

    def night() -> None:
        planned = plan_night(tmp_path / "archive", tmp_path / "data")
        outcomes = [*planned.unchanged()]
        outcomes += [one_flight(tmp_path / "data", job, planned.configuration) for job in planned.missing()]
        for publishing in publishings(planned, outcomes):
            publishing.publish()
        planned.remember(outcomes)
        closing = close_night(tmp_path / "data", Criteria(Alerts(expires_days=1e5, idle_days=1e5)))
        assert closing.site == tmp_path / "data" / "site" / "index.html"

    flown = Experiment(seed=3, duration_s=6.0)
    write_flights(tmp_path / "archive", flown, vehicles=2)
    night()
    first = stamps(tmp_path / "data")
    flights = Warehouse(tmp_path / "data").scan("flight").collect()
    sim_1 = flights.filter(vehicle_id="sim-1")["flight_id"][0]
    told = given(tmp_path / "data" / "site" / "data" / f"flight-{sim_1}.js")
    assert [chart["title"] for chart in told["charts"]][:4] == [
        *("Gyroscope", "Accelerometer", "Magnetometer", "Temperature"),
    ]
    logged = Warehouse(tmp_path / "data").scan("imu", vehicle_id="sim-1", flight_id=sim_1).collect()
    as_logged = next(view for view in told["charts"][0]["views"] if view["name"] == "as logged")
    for curve in as_logged["panels"][0]["curves"]:
        values = [v for v in curve["y"] if v is not None]
        readings = logged[f"gyroscope_{curve['name']}"]
        fine = (readings.max() - readings.min()) / STEPS_OF_A_RANGE
        assert (min(values), max(values)) == pytest.approx((readings.min(), readings.max()), abs=fine)
    night()
    assert changed(first, stamps(tmp_path / "data")) == set()

    write_flights(tmp_path / "more", Experiment(seed=4, duration_s=6.0), vehicles=1)
    (log,) = (tmp_path / "more").rglob("*.mcap")
    place = tmp_path / "archive" / "sim-1" / "2026-02-02"
    place.mkdir()
    log.rename(place / "flight-01.mcap")
    night()
    second = stamps(tmp_path / "data")
    (new,) = set(Warehouse(tmp_path / "data").scan("flight").collect()["flight_id"]) - set(flights["flight_id"])
    written = changed(first, second)
    assert {f"flight-{new}.html", f"data/flight-{new}.js", "vehicle-sim-1.html", "index.html"} <= written
    assert not [name for name in written if "sim-2" in name or any(one in name for one in flights["flight_id"])]


def test_the_charting_library_is_as_its_package_has_it() -> None:
    for name, sha256 in UPLOT.items():
        assert name in ASSETS
        assert hashlib.sha256(asset(name)).hexdigest() == sha256


def test_envelope_keeps_every_peak_and_gap() -> None:
    rng = np.random.default_rng(1)
    t = np.concatenate([np.arange(5000) * 0.004, 25.0 + np.arange(5000) * 0.004])
    x = rng.standard_normal((10_000, 3))
    x[1234, 1], x[8765, 2] = 50.0, -70.0
    s, y = envelope(t, x)
    assert np.all(np.diff(s) >= 0)
    assert len(s) <= 2 * SHARES + 2
    fine = (x.max(axis=0) - x.min(axis=0)) / STEPS_OF_A_RANGE
    assert np.all(np.abs(np.nanmax(y, axis=0) - x.max(axis=0)) <= fine / 2)
    assert np.all(np.abs(np.nanmin(y, axis=0) - x.min(axis=0)) <= fine / 2)
    share = (t[-1] - t[0]) / SHARES
    assert abs(s[np.nanargmax(y[:, 1])] - t[1234]) <= share
    assert abs(s[np.nanargmin(y[:, 2])] - t[8765]) <= share
    gap = s[np.flatnonzero(np.isnan(y[:, 0]))]
    assert len(gap) == 1
    assert abs(gap[0] - t[4999]) <= share
    few, same = envelope(t[:100], x[:100])
    assert np.array_equal(few, t[:100])
    assert np.array_equal(same, x[:100])


@pytest.mark.parametrize("size", [1e-9, 0.03, 1.0, 4e7])
def test_thinned_values_are_rounded_by_what_they_span(size: float) -> None:
    x = np.random.default_rng(2).uniform(-size, size, (500, 2)) + np.array([0.0, 7.0 * size])
    x[3, 0] = np.nan
    step = np.nanmax(np.abs(rounded(x) - x), axis=0)
    assert np.all(step <= 2.0 * size / STEPS_OF_A_RANGE / 2.0)
    assert np.all(step >= 0.04 * 2.0 * size / STEPS_OF_A_RANGE), "as coarse as it may be"
    assert np.array_equal(np.isnan(rounded(x)), np.isnan(x))


def test_values_that_span_nothing_stay() -> None:
    assert np.all(rounded(np.full((4, 1), 25.03)) == 25.03)
    assert rounded(np.zeros((0, 3))).shape == (0, 3)
    assert np.all(np.isnan(rounded(np.full(3, np.nan))))


def test_processes_that_share_the_vehicles_write_the_same_site(fleet: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """Also where one of them is killed: what is left is drawn here."""

    def content(root: Path) -> dict[str, bytes]:
        return {one.name: one.read_bytes() for one in sorted((root / "site").rglob("*")) if one.is_file()}

    class Killed(ProcessPoolExecutor):
        def submit(self, *_: Any, **__: Any) -> Future[Any]:
            return super().submit(os._exit, 1)

    monkeypatch.setattr(drawing, "FLIGHTS_WORTH_A_PROCESS", 1)
    alone = content(fleet)
    assert len(alone) > 30
    for name in ("shared", "ahead", "killed"):
        root = tmp_path / name
        shutil.copytree(fleet, root, ignore=shutil.ignore_patterns("site"))
        if name == "killed":
            monkeypatch.setattr(drawing, "ProcessPoolExecutor", Killed)
        snapshot = Snapshot(root)
        with Drawing(root, 2) as own:
            if name != "shared":
                draw_ahead(root, own)
            write_pages(snapshot, fleet_fitness(snapshot, Criteria(Alerts(expires_days=1e5)), NOW), own)
        assert content(root) == alone


def test_pages_of_flights_that_were_drawn_ahead_are_not_drawn_again(
    fleet: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    """Nor are they looked at one by one where only the vehicle's page has become another."""
    shutil.copytree(fleet, tmp_path / "data", ignore=shutil.ignore_patterns("site"))
    snapshot = Snapshot(tmp_path / "data")
    fitness = fleet_fitness(snapshot, Criteria(Alerts(expires_days=1e5)), NOW)
    monkeypatch.setattr(drawing, "FLIGHTS_WORTH_A_PROCESS", 1)
    with Drawing(tmp_path / "data", 2) as own:
        draw_ahead(tmp_path / "data", own)
    first = stamps(tmp_path / "data")
    flights = snapshot.scan("flight").collect()["flight_id"].to_list()
    assert {name for name in first if name.endswith(".html")} == {flight_name(one) for one in flights}
    monkeypatch.setattr(drawing, "flight_digest", None)
    monkeypatch.setattr(drawing, "flight_files", None)
    with Drawing(tmp_path / "data", 1) as own:
        draw_ahead(tmp_path / "data", own)
        write_pages(snapshot, fitness, own)
    later = changed(first, stamps(tmp_path / "data"))
    assert {"index.html", *(vehicle_name(one) for one in fitness)} <= later
    assert not {name for name in later if "flight-" in name}


def test_numbers_have_seven_digits_and_no_infinity() -> None:
    told = numbers(np.array([0.1 + 0.2, 123456.789012, np.nan, np.inf, 0.0, -1.23456789e-12, 9.87654321e20]))
    assert told == [0.3, 123456.8, None, None, 0.0, pytest.approx(-1.234568e-12), pytest.approx(9.876543e20, rel=1e-7)]
    json.dump(told, io.StringIO(), allow_nan=False)
