"""A flight's page: verdict, refusals, the paper's Tables 2–4 and Figures 5–10, spectra, coverage and gates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime

import polars as pl

from fieldcal.names import PREFERRED_METHODS, Json, Status, exactness
from fieldcal.report.figures import flight_evidence
from fieldcal.report.figures import flight_figures as draw
from fieldcal.report.figures.flight_quality import spectra, trust
from fieldcal.report.flight_curves import Curves, curves
from fieldcal.report.flight_data import FlightData
from fieldcal.report.links import Links, vehicle_name
from fieldcal.report.page import Column, Folded, Notice, Page, Part, Section, Table, Text, badge
from fieldcal.report.words import count, day, measured, plain_name, scientific
from fieldcal.schemas.rows import CalibrationRow, FitRow, UnfoldedFlight, UnfoldedRun
from fieldcal.stages.beside.warm_up import METHOD as WARM_UP
from fieldcal.stages.composition import ORIGIN
from fieldcal.stages.tables import AXES
from fieldcal.words.flights import QUANTITIES, advised, decision_sentence, is_consequence, sync_sentence
from fieldcal.words.measures import rows_written
from fieldcal.words.numbers import cell
from fieldcal.words.rows import BESIDE, standing, typed

PAPER_TIC = {
    ("attitude", "quest", "vps"): 0.0352,
    ("quaternion_rate", "equation_error", "quest"): 0.1617,
    ("attitude_propagated", "output_error", "quest"): 0.1459,
    ("body_rate", "equation_error", "vps"): 0.2111,
    ("body_rate", "output_error", "vps"): 0.2042,
}
"""Eq. 16 as the paper prints it, by quantity, method and reference."""

PAPER_TABLES = (("magnetometer", "Table 2", "h"), ("accelerometer", "Table 3", "a"), ("gyroscope", "Table 4", "ω"))
PRINTED = ("scale", "bias")
"""Parameters of the paper's tables; the others say the same in other words."""

SYMBOLS = {"scale": "λ", "bias": "b", "zero": "zero", "zero_bias": "zero_bias"}


def flight_page(data: FlightData, links: Links, figures: Callable[[FlightData], list[Section]] | None = None) -> Page:
    """The page of one flight; its `figures` are the paper's, or others."""
    flight = data.flight
    sections = [
        Section("refused", "Refusals and findings", _refusals(data)),
        Section("constants", "Constants (Tables 2–4)", _constants(data.calibration)),
        *([] if data.further.is_empty() else [Section("units", "Further units on board", _further(data.further))]),
        Section("agreement", "Agreement (Eq. 16)", _agreement(data)),
        *(figures or _figures)(data),
        Section("stages", "Stages", _stages(data)),
    ]
    facts = [
        ("verdict", badge(flight["verdict"])),
        ("vehicle", links.to(vehicle_name(flight["vehicle_id"]), flight["vehicle_id"])),
        ("IMU", str(flight["imu_id"])),
        ("session", str(flight["session_id"])),
        ("started (UTC)", day(_moment(flight["started_at"]))),
        ("duration", _or_dash(flight["duration_s"], "{:.1f} s")),
        ("IMU rate", _or_dash(flight["imu_rate_hz"], "{:.0f} Hz")),
        ("VPS rate", _or_dash(flight["vps_rate_hz"], "{:.0f} Hz")),
        ("temperature", _temperature(flight)),
        ("samples", _or_dash(flight["n_samples"], "{:d}")),
    ]
    checked = {True: "its checksums were checked", False: "it has no checksums: unverifiable"}
    lead = [f"Log {flight['log_uri']}, {flight['log_format']}, sha256 {flight['log_sha256'] or 'unknown'}."]
    if flight["verifiable"] is not None:
        lead[0] = lead[0][:-1] + f"; {checked[flight['verifiable']]}."
    return Page(
        f"Flight {flight['flight_id']} of {flight['vehicle_id']}",
        lead,
        facts,
        sections,
        "Written by fieldcal; equal results give an equal page.",
        links.up(),
    )


def _refusals(data: FlightData) -> list[Part]:
    flight = data.flight
    parts: list[Part] = [Notice(decision_sentence(row)) for row in data.decisions]
    if flight["reason"]:
        parts.append(Notice(f"{flight['verdict']} ({flight['reason_code']}): {flight['reason']}"))
    findings = [f for f in flight["findings"] or [] if f["sentence"] != flight["reason"]]
    parts += [Text(str(finding["sentence"])) for finding in findings]
    stopped = [row for row in data.run if row["status"] in (Status.REFUSED, Status.FAILED) and row["stage"] != "ingest"]
    told: dict[str, list[UnfoldedRun]] = {}
    for row in stopped:
        if not is_consequence(row):
            told.setdefault(str(row["measured"].get("reason") or row["reason_code"]), []).append(row)
    if told:
        columns = (Column("stage"), Column("status"), Column("why", "wide"), Column("measured", "wide"))
        lines = [
            [", ".join(row["stage"] for row in rows), badge(rows[-1]["status"]), reason, _numbers(rows[-1]["measured"])]
            for reason, rows in told.items()
        ]
        parts.append(Table("What was refused, and the numbers that decided", columns, lines))
    follow = [row["stage"] for row in stopped if is_consequence(row)]
    if follow:
        parts.append(Text(f"Not run for want of their input: {', '.join(follow)}."))
    noted: dict[str, list[str]] = {}
    for row in data.run:
        if row["status"] == Status.OK and row["reason_code"] and row["measured"].get("reason") != flight["reason"]:
            noted.setdefault(str(row["measured"].get("reason") or row["reason_code"]), []).append(row["stage"])
    parts += [Text(f"{', '.join(stages)}: {reason}") for reason, stages in noted.items()]
    parts += [Text(sentence) for sentence in advised(data.run) if not any(sentence in reason for reason in noted)]
    return parts or [Text("Nothing was refused, and the log was read whole.")]


def _constants(calibration: pl.DataFrame) -> list[Part]:
    parts: list[Part] = [
        Text(
            "z = λ · logged + b, axis by axis in sensor axes as logged, polarity in λ's sign; ± one standard deviation."
        )
    ]
    rows = typed(rows_written(calibration, ("value", "sd")).iter_rows(named=True), CalibrationRow)
    for sensor, name, letter in PAPER_TABLES:
        own = [row for row in rows if row["sensor"] == sensor and row["method"] != WARM_UP]
        printed = [row for row in own if row["parameter"] in PRINTED]
        if printed:
            parts.append(_paper_table(printed, f"{name}. {sensor.capitalize()} calibration", letter))
        else:
            parts.append(Text(f"{name}: there are no constants of the {sensor}."))
        others = [row for row in own if row["parameter"] not in (*PRINTED, *BESIDE)]
        if others:
            names = " and ".join(dict.fromkeys(row["parameter"] for row in others))
            folded = _paper_table(others, f"{sensor.capitalize()}: the same as {names}", letter)
            parts.append(Folded(f"{sensor.capitalize()}: {names}", [folded]))
    warm = [row for row in rows if row["method"] == WARM_UP]
    found = [row for row in rows if row["parameter"] in BESIDE]
    if found:
        columns = (Column("sensor"), Column("what"), Column("axis"), Column("value ± sd", "n"), Column("unit"))
        lines = [
            [r["sensor"], BESIDE[r["parameter"]], r["axis"], scientific(r["value"], r["sd"]), r["unit"]] for r in found
        ]
        parts.append(Table("Found beside scale and zero", columns, lines))
    if warm:
        parts.append(_paper_table(warm, "Warm-up of the gyroscope at rest: its zero against temperature", "ω"))
    return parts


def _paper_table(rows: Sequence[CalibrationRow], caption: str, letter: str) -> Table:
    """Rows as the paper has them, a parameter and axis a line, a method a column, equation error first."""
    methods = sorted({r["method"] for r in rows}, key=lambda m: -exactness(m) if m in PREFERRED_METHODS else 0)
    by_place = {(r["parameter"], r["axis"], r["method"]): r for r in rows}
    places = sorted(
        {(r["parameter"], r["axis"]) for r in rows},
        key=lambda p: (list(SYMBOLS).index(p[0]) if p[0] in SYMBOLS else 9, p),
    )
    lines = []
    for parameter, axis in places:
        own = [by_place.get((parameter, axis, method)) for method in methods]
        known = next(r for r in own if r is not None)
        refused = [
            f"{plain_name(r['method'])} {standing(r['status'], r['reason_code'])}"
            for r in own
            if r and r["status"] != Status.OK
        ]
        state = "; ".join(refused) or badge("ok")
        symbol = f"{SYMBOLS.get(parameter, parameter)} {letter}{axis}"
        values = ["–" if r is None else scientific(r["value"], r["sd"]) for r in own]
        lines.append([symbol, *values, known["unit"], state])
    columns = [
        Column("parameter"),
        *(Column(m.replace("_", " "), "n") for m in methods),
        Column("unit"),
        Column("status"),
    ]
    degc = next((r["temperature_degc"] for r in rows if r["temperature_degc"] is not None), None)
    return Table(caption + ("" if degc is None else f", at {degc:.1f} °C"), columns, lines)


def _further(calibration: pl.DataFrame) -> list[Part]:
    """The constants that count of each unit beside the primary ones."""
    rows = typed(rows_written(calibration, ("value", "sd")).iter_rows(named=True), CalibrationRow)
    by_place: dict[tuple[str, str, str], dict[str, CalibrationRow]] = {}
    for row in rows:
        if row["parameter"] in ("scale", "zero") and row["axis"] in AXES and row["method"] != WARM_UP:
            place = by_place.setdefault((row["unit_id"], row["sensor"], row["parameter"]), {})
            kept = place.get(row["axis"])
            if kept is None or _rank(row) < _rank(kept):
                place[row["axis"]] = row
    columns = [Column("on board", "id"), Column("parameter"), *(Column(axis, "n") for axis in AXES), Column("unit")]
    lines = [
        [
            unit_id,
            f"{sensor} {parameter}",
            *(_told(own[axis]) if axis in own else "–" for axis in AXES),
            next(iter(own.values()))["unit"],
        ]
        for (unit_id, sensor, parameter), own in by_place.items()
    ]
    return [
        Text("Each IMU was calibrated with the primary magnetometer, each magnetometer with the primary IMU."),
        Table("Scale and zero, ± one standard deviation", columns, lines),
    ]


def _rank(row: CalibrationRow) -> tuple[bool, int]:
    return row["status"] != Status.OK, exactness(row["method"])


def _told(row: CalibrationRow) -> str:
    if row["status"] == Status.OK:
        return scientific(row["value"], row["sd"])
    return standing(row["status"], row["reason_code"])


def _agreement(data: FlightData) -> list[Part]:
    if not data.fit:
        return [Text("Nothing could be compared."), *_sync(data)]
    by_place = {(r["quantity"], r["method"], r["reference"], r["sample"], r["signal"]): r for r in data.fit}
    order = list(QUANTITIES)
    keys = sorted({key[:4] for key in by_place}, key=lambda key: (order.index(key[0]) if key[0] in order else 9, key))
    lines = []
    for key in keys:
        own = [by_place.get((*key, signal)) for signal in ("raw", "smoothed")]
        printed = PAPER_TIC.get(key[:3]) if key[3] == "all" else None
        cells = [text for row in own for text in _fit_cells(row)]
        quantity = str(QUANTITIES.get(key[0], key[0])) + ("" if key[3] == "all" else ", held out")
        names = [quantity, plain_name(key[1]), plain_name(key[2])]
        lines.append([*names, "–" if printed is None else f"{printed:.4f}", *cells])
    columns = (
        Column("quantity"),
        Column("method"),
        Column("against"),
        Column("paper's TIC", "n"),
        Column("TIC raw", "n"),
        Column("rms raw", "n"),
        Column("TIC smoothed", "n"),
        Column("rms smoothed", "n"),
    )
    return [
        Table("Theil inequality coefficients, the paper's own flight beside this one", columns, lines),
        *_sync(data),
    ]


def _fit_cells(row: FitRow | None) -> tuple[str, str]:
    if row is None or row["tic"] is None:
        return "–", "–"
    return (f"{row['tic']:.4f}", measured(row["rms"], row["rms_unit"]))


def _sync(data: FlightData) -> list[Part]:
    return [Text("The log has no VPS.")] if data.sync is None else [Text(f"{sync_sentence(data.sync)}.")]


def _figures(data: FlightData) -> list[Section]:
    parts: list[Part] = []
    if data.gone:
        parts.append(
            Notice(
                f"The stored tables of {', '.join(data.gone)} are gone (stages/ may be deleted at any time), so some"
                " figures are missing. Run fieldcal nightly ARCHIVE again to make them anew; the constants above do"
                " not change."
            )
        )
    raw = draw.unprocessed(data.tables, data.units)
    parts.append(Text("The readings are not stored: Figure 5 is missing.") if raw is None else raw)
    samples, attitude = (data.tables.get(name) for name in ("smoothing.samples", "attitude_pass2.attitude"))
    quality: list[Part] = []
    if samples is not None and not samples.is_empty() and data.settings is not None:
        balls = draw.spheres(samples, data.calibration, data.settings)
        parts += balls or [Text("Figure 6 is missing: neither the magnetometer nor the accelerometer has constants.")]
        if attitude is None or attitude.is_empty() or attitude.height != samples.height:
            parts.append(Text(f"Figures 7–10 are missing: {_why_no_attitude(data)}"))
        else:
            c = curves(samples, attitude, data.calibration, data.tables.get("vps_sync.vps_aligned"), data.settings)
            parts += _fits(c, data.fit)
            spectrum = spectra(c, samples, data.calibration, data.settings)
            quality += [spectrum] if spectrum is not None else []
            quality.append(trust(attitude, data.tables.get("manoeuvre.segments"), data.settings))
    else:
        parts.append(Text(f"Figures 6–10 are missing: {_why_no_samples(data)}"))
    gates = [row for row in data.run if row["stage"] in ("manoeuvre", "accelerometer_pass2", "attitude_pass2")]
    if gates:
        lines = [[row["stage"], badge(row["status"]), _numbers(row["measured"])] for row in gates]
        quality.append(
            Table("What the gates measured", (Column("stage"), Column("status"), Column("measured", "wide")), lines)
        )
    sections = [Section("figures", "Figures 5–10", parts)]
    rests_on = _evidence(data)
    sections += [Section("evidence", "What the estimate rests on", rests_on)] if rests_on else []
    return [*sections, Section("quality", "Residuals and gates", quality)] if quality else sections


def _evidence(data: FlightData) -> list[Part]:
    """Along the joint estimate's attitude, else the two vectors'."""
    parts: list[Part | None] = [
        flight_evidence.methods(data.calibration),
        flight_evidence.prior_and_posterior(data.calibration, data.parameters),
    ]
    samples = data.tables.get("smoothing.samples")
    attitudes = (data.tables.get(name) for name in ("joint.trajectory", "attitude_pass2.attitude"))
    attitude = next((table for table in attitudes if table is not None and not table.is_empty()), None)
    if samples is not None and attitude is not None and attitude.height == samples.height and data.settings is not None:
        found = flight_evidence.evidence(samples, attitude, data.calibration, data.settings)
        if found is not None:
            parts += [flight_evidence.residuals(found), flight_evidence.information(found)]
    return [part for part in parts if part is not None]


def _fits(c: Curves, fit: Sequence[FitRow]) -> list[Part]:
    """Figures 7–10, each with its coefficient; a sentence where one cannot be."""
    told = {quantity: _coefficients(fit, quantity) for quantity in QUANTITIES}
    parts: list[Part] = [draw.attitude(c, told["attitude"] or "There is no VPS to compare with.")]
    for missing, plot in (
        (
            "Figure 8 is missing: there are no equation-error constants.",
            draw.equation_error(c, told["quaternion_rate"]),
        ),
        (
            "Figure 9 is missing: there are no output-error constants.",
            draw.output_error(c, told["attitude_propagated"]),
        ),
        ("Figure 10 is missing: the gyroscope has no constants.", draw.body_rates(c, told["body_rate"])),
    ):
        parts.append(Text(missing) if plot is None else plot)
    return parts


def _coefficients(fit: Sequence[FitRow], quantity: str) -> str:
    """Eq. 16 of a quantity in words, smoothed readings as the figures show them."""
    own = [r for r in fit if r["quantity"] == quantity and r["signal"] == "smoothed" and r["tic"] is not None]
    if not own:
        return ""
    each = [
        f"{plain_name(r['method'])} against {plain_name(r['reference'])} {r['tic']:.4f}"
        f" ({measured(r['rms'], r['rms_unit'])} rms)"
        for r in own
    ]
    return f"TIC (smoothed): {'; '.join(each)}."


def _why_no_attitude(data: FlightData) -> str:
    row = next((r for r in data.run if r["stage"] == "attitude_pass2"), None)
    if row is not None and row["status"] in (Status.REFUSED, Status.FAILED):
        return str(row["measured"].get("reason") or row["reason_code"])
    return "the attitude's stored table is gone." if "attitude_pass2" in data.gone else "there is no attitude."


def _why_no_samples(data: FlightData) -> str:
    for stage in ("manoeuvre", "smoothing"):
        row = next((r for r in data.run if r["stage"] == stage), None)
        if row is not None and row["status"] in (Status.REFUSED, Status.FAILED):
            return str(row["measured"].get("reason") or row["reason_code"])
    return "the stages' stored tables are gone." if data.gone else "no stage ran."


def _stages(data: FlightData) -> list[Part]:
    columns = (Column("stage"), Column("status"), Column("code"), Column("measured", "wide"), Column("run key"))
    lines = [
        [
            row["stage"],
            badge(row["status"]),
            row["reason_code"] or "",
            _numbers(row["measured"]),
            (row["run_key"] or "–")[:12],
        ]
        for row in data.run
    ]
    settings = [[name, _plain(value)] for name, value in sorted(data.parameters.items())]
    versions = next((row["versions"] for row in data.run if row["versions"]), None) or {}
    parts: list[Part] = [
        Folded(
            f"{count(len(lines), 'stage')} with what each measured",
            [Table("Stages in the order they ran", columns, lines)],
        )
    ]
    if settings:
        table = Table("Parameters of the stages", (Column("parameter"), Column("value", "wide")), settings)
        parts.append(Folded(f"{count(len(settings), 'parameter')} of the stages", [table]))
    if versions:
        parts.append(
            Text("Made with " + ", ".join(f"{name} {version}" for name, version in sorted(versions.items())) + ".")
        )
    return parts


def _numbers(measured: Mapping[str, Json] | None) -> str:
    """What a stage measured, in a line."""
    return ", ".join(f"{k} = {_plain(v)}" for k, v in (measured or {}).items() if k not in ("reason", ORIGIN))


def _plain(value: Json) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {_plain(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_plain(v) for v in value) + "]"
    return cell(value)


def _temperature(flight: UnfoldedFlight) -> str:
    low, mean, high = flight["temperature_min_degc"], flight["temperature_mean_degc"], flight["temperature_max_degc"]
    if mean is None:
        return "not logged"
    return f"mean {mean:.1f} °C" if low is None or high is None else f"{low:.1f} … {high:.1f} °C, mean {mean:.1f}"


def _or_dash(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def _moment(value: datetime | str | None) -> datetime | None:
    return datetime.fromisoformat(value) if isinstance(value, str) else value
