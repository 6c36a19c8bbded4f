"""Reports from the history: what they say, what they leave out and say so, and that no text of a log becomes markup."""

from __future__ import annotations

import datetime as dt
import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from history_rows import lead, rows
from outside_ci import outside_ci
from report_rows import publish_fleet

from fieldcal.batch.jobs import find_jobs
from fieldcal.batch.steps import STEPS, FlightWork
from fieldcal.cli.main import run
from fieldcal.config.find import configuration_of, find_source
from fieldcal.errors import FieldcalError
from fieldcal.flight.calibrate import identify, read, run_stages
from fieldcal.flight.rows import flight_row, published_tables, rows_frame, run_rows
from fieldcal.flight.rows import lead as lead_of
from fieldcal.flight.units import units_of
from fieldcal.report import (
    log_report,
    write_fleet_report,
    write_flight_report,
    write_night_reports,
    write_vehicle_report,
)
from fieldcal.report.plot import INK, thinned, with_gaps, without_wraps
from fieldcal.report.trend import predicted
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.stages.pipeline import PUBLISHED
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.stage_store import StageStore

HOSTILE = '<script>alert("x")</script>&\'"><img src=x onerror=alert(1)>$^{$'
LARGEST_BYTES = 3_000_000
VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """A parsed page: its tags with their attributes, its text, and tags that are not closed in order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.ill_formed: list[str] = []
        self._open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.ill_formed += self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open.pop() != tag:
            self.ill_formed.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def sound(path: Path) -> Page:
    """The page, after what holds for every page: one offline file, well formed, ids once, references there."""
    assert path.stat().st_size <= LARGEST_BYTES
    page = Page(path)
    assert not page.ill_formed
    assert not {tag for tag, _ in page.tags} & {"script", "iframe", "object", "img"}
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    for _, attributes in page.tags:
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("href", "src"):
            target = attributes.get(name)
            assert target is None or re.match(r"#|data:,$|[\w%~.-]+\.html$", target), target
            if target is not None and target.startswith("#"):
                assert target[1:] in ids, target
        for name in ("aria-labelledby", "clip-path"):
            for target in re.findall(r"#?([\w-]+)\)?", (attributes.get(name) or "").replace("url(", "")):
                assert target in ids, target
    assert not [colour for colour in INK.values() if colour in path.read_text(encoding="utf-8")]
    assert "://" not in re.sub(r'xmlns="http://www.w3.org/2000/svg"', "", path.read_text(encoding="utf-8"))
    assert [a.get("role") for a in page.named("svg")] == ["img"] * len(page.named("svg"))
    return page


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A warehouse with trends, a vehicle of each status and one with a hostile name."""
    root = tmp_path_factory.mktemp("fleet")
    names = ("stable", "step", "drifting", "outlier", "insufficient")
    publish_fleet(root, {**{f"{name}-1": name for name in names}, HOSTILE: "stable"})
    return root


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A warehouse with one simulated flight, its readings and its stages."""
    base = tmp_path_factory.mktemp("flown")
    archive, root = base / "archive", base / "data"
    write_flights(archive, Experiment(seed=4, dip_rad=np.radians(60.0), translation_rms_mps2=0.03))
    configuration = configuration_of(find_source(None, archive))
    for job in find_jobs(archive, configuration):
        vehicle = configuration.vehicle(job.vehicle_id)
        work = FlightWork(root, job, vehicle)
        for step in STEPS:
            work.run(step)
        facts = work.records["ingest"]["facts"]
        leading = lead_of(job, job.vehicle_id, facts)
        tables = {
            f"{stage}.{name}": (StageStore(root).load(stage, job.flight_id, key, [name])[name], key)
            for stage, name in (source.split(".") for sources in PUBLISHED.values() for source in sources)
            for key in (work.records[stage]["run_key"],)
            if name in work.records[stage]["outputs"]
        }
        units = units_of(facts, vehicle, job.vehicle_id)
        history = published_tables([(leading, units[0], tables)])
        history["flight"] = rows_frame("flight", [flight_row(job, leading, facts)])
        history["run"] = rows_frame("run", run_rows(leading, units, work.records))
        publish(root, job.vehicle_id, history, [job.flight_id])
    return root


def flight_of(root: Path) -> str:
    from fieldcal.warehouse import Warehouse

    return str(Warehouse(root).scan("flight").collect()["flight_id"][0])


def test_fleet_names_what_is_not_steady_and_only_that(fleet: Path) -> None:
    page = sound(write_fleet_report(fleet))
    look = page.text[page.text.index("What needs a look", 200) : page.text.rindex("A row per vehicle")]
    assert {name for name in ("stable-1", "step-1", "drifting-1", "outlier-1", "insufficient-1") if name in look} == {
        "step-1",
        "drifting-1",
        "outlier-1",
    }
    assert "imu-4" in look  # too few flights to tell
    assert len(page.named("svg")) == 6


def test_fleet_ages_count_to_the_moment_it_states(fleet: Path, tmp_path: Path) -> None:
    page = sound(write_fleet_report(fleet))
    assert "2026-10-12 12:00 UTC, the start of the newest flight" in page.text
    assert "154 d" in page.text  # the vehicle with two flights: 11 May to 12 October
    later = write_fleet_report(fleet, as_of=dt.datetime(2026, 10, 22, 12, tzinfo=dt.UTC))
    assert "164 d" in sound(later).text
    write_fleet_report(fleet)


def test_vehicle_marks_its_step_and_says_what_to_fly_with(fleet: Path) -> None:
    path = write_vehicle_report(fleet, "step-1")
    page = sound(path)
    assert "2026-08-03 12:00" in page.text  # the flight after the step
    assert "Dashed vertical line: detected step" in page.text
    assert page.text.count("Trend of 24 flights") >= 3 * 4  # sensors and parameters
    assert "Trend of 24 flights, after the step of 2026-08-03." in page.text
    assert "every status is insufficient" not in page.text
    assert len(page.named("svg")) == 3 * 4 + 2


def test_vehicle_with_too_few_flights_says_so(fleet: Path) -> None:
    page = sound(write_vehicle_report(fleet, "insufficient-1"))
    assert (
        "Too few flights for a trend (2 usable flights): every status is insufficient. 2 sessions: a trend needs 5."
        in page.text
    )


def test_vehicle_shows_refused_values_and_why(fleet: Path) -> None:
    page = sound(write_vehicle_report(fleet, "stable-1"))
    assert "Crosses: refused, not used." in page.text
    assert "the residual is 4.1 % of the field: a magnet came near." in page.text


@outside_ci
def test_pages_do_not_depend_on_the_session(fleet: Path, tmp_path: Path) -> None:
    """Hash seed, time zone and the user's own matplotlib settings change no byte."""
    (tmp_path / "matplotlibrc").write_text(
        "lines.linewidth: 7\nfont.size: 30\ntimezone: Asia/Tokyo\n", encoding="utf-8"
    )
    command = [sys.executable, "-m", "fieldcal", "report", "--warehouse", str(fleet), "--vehicle", "step-1", "-o"]
    for name, changes in (("a", {"PYTHONHASHSEED": "1"}), ("b", {"PYTHONHASHSEED": "2", "TZ": "Asia/Tokyo"})):
        own = {"MATPLOTLIBRC": str(tmp_path)} if name == "b" else {}
        subprocess.run([*command, str(tmp_path / f"{name}.html")], check=True, env={**os.environ, **changes, **own})
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_hostile_names_are_text(fleet: Path) -> None:
    path = write_vehicle_report(fleet, HOSTILE)
    assert path.parent == fleet / "reports"
    page = sound(path)
    assert f"Vehicle {HOSTILE}" in page.text
    page = sound(write_fleet_report(fleet))
    assert HOSTILE in page.text
    linked = [a["href"] for a in page.named("a") if a.get("href", "").startswith("vehicle-%25")]
    assert len(linked) == 1


def test_hostile_rows_of_a_flight_are_text(tmp_path: Path) -> None:
    first = lead(HOSTILE, HOSTILE[:20])
    flight = {**first, "log_uri": HOSTILE, "log_format": HOSTILE, "verdict": "rejected", "reason_code": HOSTILE}
    flight |= {"reason": HOSTILE, "findings": json.dumps([{"code": "x", "count": 1, "sentence": f"{HOSTILE}2"}])}
    calibration = {**first, "sensor": HOSTILE, "method": HOSTILE, "parameter": HOSTILE, "axis": "x", "value": 1.0}
    calibration |= {"unit": HOSTILE, "status": "refused", "reason_code": HOSTILE}
    run_row = {**first, "stage": HOSTILE, "status": "refused", "reason_code": HOSTILE, "run_key": "../../etc"}
    run_row |= {
        "measured": json.dumps({"reason": HOSTILE, HOSTILE: HOSTILE}),
        "versions": json.dumps({HOSTILE: HOSTILE}),
    }
    tables = {
        "flight": rows("flight", flight),
        "calibration": rows("calibration", calibration),
        "run": rows("run", run_row),
    }
    publish(tmp_path, HOSTILE, tables, [HOSTILE[:20]])
    for path in (
        write_flight_report(tmp_path, HOSTILE[:20]),
        write_vehicle_report(tmp_path, HOSTILE),
        write_fleet_report(tmp_path),
    ):
        assert path.resolve().is_relative_to(tmp_path.resolve() / "reports")
        assert HOSTILE in sound(path).text


@outside_ci
def test_night_reports_are_linked_and_written_once(fleet: Path) -> None:
    paths = write_night_reports(fleet, ["step-1", "drifting-1"])
    page = sound(paths[0])
    linked = {a["href"] for a in page.named("a") if str(a.get("href")).endswith(".html")}
    assert {path.name for path in paths[1:]} <= linked
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in paths]
    assert write_night_reports(fleet, ["drifting-1", "step-1"]) != []
    assert [(path.read_bytes(), path.stat().st_mtime_ns) for path in paths] == before


def test_flight_has_the_papers_figures_and_tables(flown: Path) -> None:
    path = write_flight_report(flown, flight_of(flown))
    page = sound(path)
    anchors = {a["id"] for a in page.named("figure")}
    evidence = {f"evidence-{name}" for name in ("methods", "residuals", "information")}
    others = {"figure-coverage", "figure-spectra", "figure-gates", *evidence}
    assert anchors == {*(f"figure-{n}" for n in range(5, 11)), *others}
    assert all(f"Table {n}. " in page.text for n in (2, 3, 4))
    for printed in ("0.0352", "0.1617", "0.1459", "0.2111", "0.2042"):
        assert printed in page.text
    assert "Nothing was refused" in page.text
    again = path.read_bytes()
    path.unlink()
    assert write_flight_report(flown, flight_of(flown)[:6]).read_bytes() == again


def test_flight_without_its_stages_keeps_what_the_history_has(flown: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(flown, root)
    shutil.rmtree(root / "stages")
    page = sound(write_flight_report(root, flight_of(root)))
    assert {a["id"] for a in page.named("figure")} == {"figure-5", "evidence-methods"}
    assert "are gone (stages/ may be deleted at any time)" in page.text
    assert "Figures 6–10 are missing" in page.text
    assert all(f"Table {n}. " in page.text for n in (2, 3, 4))
    shutil.rmtree(root / "signals")
    page = sound(write_flight_report(root, flight_of(root)))
    assert {a["id"] for a in page.named("figure")} == {"evidence-methods"}
    assert "Figure 5 is missing" in page.text


def test_flight_without_vps_compares_with_nothing(tmp_path: Path) -> None:
    (log,) = write_flights(tmp_path / "archive", Experiment(seed=6, vps=False))
    assert run(["calibrate", str(log), "--report", str(tmp_path / "flight.html")]) == 0
    page = sound(tmp_path / "flight.html")
    assert "The log has no VPS." in page.text
    assert "There is no VPS to compare with." in page.text
    assert {f"figure-{n}" for n in range(5, 11)} <= {a["id"] for a in page.named("figure")}


def test_refused_flight_says_why_in_place_of_figures(tmp_path: Path) -> None:
    (log,) = write_flights(tmp_path / "archive", Experiment(seed=6, translation_rms_mps2=3.0))
    result = run_stages(read(*identify(log)))
    refused = [row for row in result.document["run"] if row["status"] == "refused"]
    assert refused
    page = sound(log_report(result, tmp_path / "flight.html"))
    assert "What was refused, and the numbers that decided" in page.text
    assert "Figures 7–10 are missing" in page.text


def test_unknown_flight_and_vehicle_are_told(fleet: Path) -> None:
    with pytest.raises(FieldcalError, match="there is step-1"):
        write_vehicle_report(fleet, "step1")
    with pytest.raises(FieldcalError, match='No flight "nope"'):
        write_flight_report(fleet, "nope")
    with pytest.raises(FieldcalError, match="start of 24 flight ids"):
        write_flight_report(fleet, "0001")


def test_empty_warehouse_says_so(tmp_path: Path) -> None:
    assert "no flights yet" in sound(write_fleet_report(tmp_path)).text


def test_command_prints_the_path(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["report", "--warehouse", str(fleet)]) == 0
    assert capsys.readouterr().out.strip() == str(fleet / "reports" / "fleet.html")
    out = tmp_path / "elsewhere" / "page.html"
    assert run(["report", "--warehouse", str(fleet), "--vehicle", "step-1", "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"path": str(out)}
    assert not [a for a in sound(out).named("a") if str(a.get("href")).endswith(".html")]
    assert run(["report", "--warehouse", str(fleet), "--vehicle", "a", "--flight", "b"]) == 2
    assert run(["report", "--warehouse", str(fleet), "--vehicle", "nobody"]) == 2
    assert run(["report", "--warehouse", str(fleet), "--as-of", "soon"]) == 2


def test_a_long_history_stays_within_the_limit(tmp_path: Path) -> None:
    publish_fleet(tmp_path, {"old": "step"}, n_flights=600)
    page = sound(write_vehicle_report(tmp_path, "old"))
    assert "the latest 250 of 600 flights" in page.text
    assert "400 earlier flights are not shown" in page.text


def test_thinning_keeps_every_extreme_and_gap() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(100_000) * 0.005
    x = rng.standard_normal(len(t))
    x[12_345], x[77_777] = 40.0, -50.0
    few_t, few = thinned(t, x, 500)
    assert len(few) <= 1000
    assert few.max() == 40.0
    assert few.min() == -50.0
    assert np.all(np.diff(few_t) > 0)
    gap_t, gap = with_gaps(np.delete(t, slice(30_000, 30_400)), np.delete(x, slice(30_000, 30_400)))
    assert np.isnan(gap).sum() == 1
    assert np.isnan(thinned(gap_t, gap, 500)[1]).sum() == 1
    short = np.array([1.0, 2.0, 3.0])
    assert thinned(short, short)[1] is short


def test_a_wrapped_angle_is_broken_not_drawn_across() -> None:
    angle = np.array([3.0, 3.1, -3.1, -3.0])
    assert np.isnan(without_wraps(angle)).tolist() == [False, False, True, False]


NOON = dt.datetime(2026, 5, 11, 12, tzinfo=dt.UTC)


def test_band_is_the_regressions_own_standard_deviation() -> None:
    row = {"value_at_25degc": 2.0, "sd": 0.3, "slope_per_degc": 0.1, "slope_per_degc_sd": 0.02, "best_known_degc": None}
    row |= {"curve_per_degc2": None, "curve_per_degc3": None}
    row |= {"slope_per_day": -0.5, "slope_per_day_sd": 0.4, "best_known_at": None, "as_of": NOON}
    value, sd = predicted(row, 35.0, -1.0)
    assert value == pytest.approx(2.0 + 1.0 + 0.5)
    assert sd == pytest.approx(np.sqrt(0.3**2 + 0.2**2 + 0.4**2))
    # value and slope independent at 5 °C: as far below it as 25 °C is above, the sd is the same
    apart = {**row, "slope_per_degc_sd": 0.01, "best_known_degc": 5.0}
    for degc, variance in ((25.0, 0.3**2), (5.0, 0.3**2 - 0.2**2), (-15.0, 0.3**2)):
        assert predicted(apart, degc, 0.0)[1] == pytest.approx(np.sqrt(variance))
    # … and independent of the slope in time ten days before the last flight, where the sd is least
    timely = {**row, "slope_per_day_sd": 0.02, "best_known_at": NOON - dt.timedelta(days=10)}
    for days, variance in ((0.0, 0.3**2), (-10.0, 0.3**2 - 0.2**2), (-20.0, 0.3**2)):
        assert predicted(timely, 25.0, days)[1] == pytest.approx(np.sqrt(variance))
    value, sd = predicted({**row, "slope_per_day": None, "slope_per_day_sd": None}, 25.0, 9.0)
    assert (float(value), float(sd)) == (2.0, 0.3)
