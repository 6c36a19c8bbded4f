"""The command line: `fieldcal`. What each command does lies in the modules that it imports when it runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

import fieldcal
from fieldcal.cli.config import config_app
from fieldcal.cli.decide import accept, withdraw
from fieldcal.cli.drift import drift
from fieldcal.cli.fly import apply, compare, export
from fieldcal.cli.interrupt import interruptible
from fieldcal.cli.look import init, inspect
from fieldcal.cli.onboard import onboard, refit
from fieldcal.cli.options import (
    AsCsv,
    AsJson,
    Config,
    DryRun,
    Place,
    Root,
    Runner,
    Scheduler,
    SessionFolder,
    Wide,
    Workers,
)
from fieldcal.cli.pooled import plan, pooled
from fieldcal.cli.report import report as report_command
from fieldcal.cli.report import site
from fieldcal.cli.serve import alerts_app, serve, trigger
from fieldcal.cli.simulate import simulate
from fieldcal.cli.upkeep import export_warehouse, prune, schemas
from fieldcal.names import Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.words.printable import printable

OK, FAILED, USAGE, LOSSES, BUSY, INTERRUPTED = 0, 1, 2, 3, 75, 130
USAGE_CODES = (
    ReasonCode.NOT_FOUND,
    ReasonCode.NO_ARCHIVE,
    ReasonCode.NO_SESSION,
    ReasonCode.OUTSIDE_ARCHIVES,
    ReasonCode.NOT_LOADABLE,
    ReasonCode.SQL_REFUSED,
    ReasonCode.SQL_WRONG,
    ReasonCode.WRONG_OPTION,
)

app = App(
    name="fieldcal",
    help="Field calibration of inertial sensors from flight logs.",
    version=fieldcal.__version__,
    result_action="return_value",
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
    default_parameter=Parameter(negative=""),
)


@app.command
def demo(folder: Path = Path("fieldcal-demo"), /, *, warehouse: Root = None, config: Config = None) -> int:
    """Simulate a small fleet flying the paper's manoeuvre, run the night, show the result.

    Parameters
    ----------
    folder
        Where logs and results go.
    """
    from fieldcal.cli.present.demo import run_demo

    return LOSSES if run_demo(folder, _root(warehouse or str(folder / "fieldcal-data")), config) else OK


@app.command
def calibrate(
    log: Place,
    /,
    *,
    vehicle: str | None = None,
    method: Literal["auto", "serial", "joint"] | None = None,
    profile: Literal["full", "onboard", "paper"] | None = None,
    unit: str = "imu",
    set_: Annotated[list[str] | None, Parameter(name="--set")] = None,
    report: Annotated[Path | None, Parameter(help="Write the flight's report to this HTML file too.")] = None,
    wide: Wide = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Calibrate one log: parameters with their standard deviations, agreement, verdict. Nothing is stored.

    Parameters
    ----------
    log
        A log: MCAP, ROS bag (file or folder), PX4 ULog, ArduPilot .bin or CSV, or a folder with imu.csv.
    vehicle
        The vehicle in fieldcal.toml; else the folder two levels above the log.
    method
        "serial", one step after the other, or "joint", all in one likelihood; else what fieldcal.toml says.
    profile
        Presets of the stages.
    unit
        Of a log with several: "imu" the primary ones, "imu.1", "magnetometer.1", … a further one.
    set_
        Overrule a stage parameter: --set smoothing_cutoff_hz=6.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.flight.calibrate import configuration_file
    from fieldcal.remote.url import is_url
    from fieldcal.words.talk import say

    changes = _assignments(set_ or [])
    result = fieldcal.calibrate(
        log, method=method, profile=profile, parameters=changes, config=config, vehicle=vehicle, unit=unit
    )
    if config is None and not is_url(log) and (file := configuration_file(Path(log))) is not None:
        say(f"Configuration: {file}")
    if report is not None:
        say(f"Report: {result.report(report)}")
    if as_json:
        print_json(result.document)
    else:
        from fieldcal.cli.present.flight import print_flight
        from fieldcal.cli.present.screen import console

        print_flight(console(wide=wide), result.document, result.nominal_scale, wide=wide)
    return OK if result.verdict == Verdict.OK else LOSSES


@app.command
def nightly(
    archive: Place,
    /,
    *,
    workers: Workers = 1,
    runner: Runner = "process",
    scheduler: Scheduler = None,
    dry_run: DryRun = False,
    wide: Wide = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Calibrate every new or changed log of an archive and publish the results.

    Parameters
    ----------
    archive
        Folder of logs: ARCHIVE/<vehicle>/<session>/<log>; or its URL in an object store (s3://, gs://, az://).
    """
    from fieldcal.remote.places import archive_at

    where = {"runner": runner, "scheduler": scheduler}
    return _night(archive_at(archive), None, workers, where, (dry_run, as_json, wide), warehouse, config)


@app.command
def session(
    folder: SessionFolder,
    /,
    *,
    workers: Workers = 1,
    runner: Runner = "process",
    scheduler: Scheduler = None,
    dry_run: DryRun = False,
    wide: Wide = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """The same as the night for one field session, now.

    Parameters
    ----------
    folder
        Folder of the session: ARCHIVE/<vehicle>/<session>, or its URL.
    """
    from fieldcal.remote.places import session_at

    archive, own = session_at(folder)
    where = {"runner": runner, "scheduler": scheduler}
    return _night(archive, own, workers, where, (dry_run, as_json, wide), warehouse, config)


@app.command
def history(
    *,
    vehicle: str | None = None,
    sensor: Literal["magnetometer", "accelerometer", "gyroscope"] | None = None,
    parameter: str | None = None,
    since: str | None = None,
    wide: Wide = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Calibrated parameters, flight by flight.

    Parameters
    ----------
    vehicle, sensor
        Only these.
    parameter
        scale, bias, zero or zero_bias.
    since
        Only flights that started then or later: 2026-05-04 or 2026-05-04T12:00.
    """
    from fieldcal.cli.present.history import as_written, print_history
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_frame

    rows = fieldcal.Warehouse(warehouse).history(vehicle=vehicle, sensor=sensor, parameter=parameter, since=since)
    if wide or as_json or as_csv:
        print_frame(as_written(rows) if not (as_json or as_csv) else rows, as_json=as_json, as_csv=as_csv, wide=True)
    else:
        print_history(console(), rows)
    return OK


@app.command
def sql(
    query: str,
    /,
    *,
    wide: Wide = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Answer one SELECT over the tables and views; it can only read.

    Parameters
    ----------
    query
        "SELECT …"
    """
    from fieldcal.cli.show import print_frame

    print_frame(fieldcal.Warehouse(warehouse).sql(query), as_json=as_json, as_csv=as_csv, wide=wide)
    return OK


@app.command
def verify(
    *,
    archive: Place | None = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Check every stored file against its recorded sha256.

    Parameters
    ----------
    archive
        Check the logs of this archive too.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.logs import log_sha256
    from fieldcal.remote.content import here
    from fieldcal.remote.places import archive_at
    from fieldcal.warehouse.upkeep.verify import verify as check
    from fieldcal.words.talk import say

    def sha256_of(log: Path) -> str:
        with here(log):
            return log_sha256(log)

    result = check(_root(warehouse), None if archive is None else archive_at(archive), sha256_of)
    if as_json:
        print_json(result)
    else:
        for damage in result["damaged"]:
            print(printable(f"{damage['path']}: {damage['reason']}"))
        say(f"{result['files']} files checked, {len(result['damaged'])} damaged")
        print(f"content_sha256 {result['content_sha256'] or 'unknown: tables are damaged'}")
    return OK if result["ok"] else FAILED


@app.command
def upgrade(*, dry_run: DryRun = False, as_json: AsJson = False, warehouse: Root = None, config: Config = None) -> int:
    """Bring a history that an older fieldcal wrote to the form of today; rows and values stay.

    May be interrupted and repeated. A file that cannot be upgraded is named and left as it is (exit code 3).
    """
    from fieldcal.cli.show import print_json
    from fieldcal.warehouse.upkeep.upgrade import upgrade as bring
    from fieldcal.words.talk import say

    result = bring(_root(warehouse), dry_run=dry_run)
    if as_json:
        print_json(result)
        return OK if result["ok"] else LOSSES
    for file in result["upgraded"]:
        what = f"version {file['from_version']} to {file['to_version']}, {file['rows']} rows"
        said = {"upgraded": what, "due": f"would go from {what}", "left": f"left as it is: {file['reason']}"}
        print(printable(f"{file['table']} of {file['vehicle_id']}: {said[file['status']]}"))
    left = sum(file["status"] == "left" for file in result["upgraded"])
    done = "would be upgraded" if dry_run else "upgraded"
    say(f"{result['files']} files: {len(result['upgraded']) - left} {done}, {left} left as they are")
    return OK if result["ok"] else LOSSES


@app.command
def doctor(
    *,
    archive: Place | None = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Check versions, disk, permissions, locks and server, and say what to do.

    Parameters
    ----------
    archive
        Check that the logs of this archive can be read too, and name what is no log.
    """
    from dataclasses import asdict

    from fieldcal.cli.doctor import examine, lines
    from fieldcal.cli.show import print_json
    from fieldcal.remote.places import folder_at

    result = examine(_root(warehouse), folder_at(archive, "doctor --archive") if archive else None, config)
    if as_json:
        print_json(asdict(result))
    else:
        for line in lines(result):
            print(printable(line))
    return OK if result.ok else FAILED


@app.command
def completion(shell: Literal["bash", "zsh", "fish"], /) -> int:
    """Print what makes a shell complete commands, options and their values.

    Parameters
    ----------
    shell
        Whose: fieldcal completion bash > ~/.local/share/bash-completion/completions/fieldcal
    """
    print(app.generate_completion(shell=shell))
    return OK


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    from fieldcal.cli.present.characters import settle

    settle(sys.stdout)
    # Processes started from here must not take what lies in the current folder for a module.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    sys.exit(run(sys.argv[1:] if tokens is None else tokens))


def run(tokens: Sequence[str]) -> int:
    """Run one command; its exit code. Errors are one sentence on stderr, unless FIELDCAL_DEBUG=1."""
    try:
        with interruptible():
            code: int | None = app(list(tokens), exit_on_error=False, print_error=False)
        sys.stdout.flush()
        return OK if code is None else code
    except CycloptsError as error:
        return _told(f"{' '.join(str(error).split())} (fieldcal --help)", USAGE)
    except KeyboardInterrupt:
        return _told("Interrupted; what is done is kept, the next run goes on from there.", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except Exception as error:
        if os.environ.get("FIELDCAL_DEBUG") == "1":
            raise
        return _explained(error)


def _explained(error: Exception) -> int:
    from fieldcal.errors import ConfigurationError, FieldcalError

    if isinstance(error, ConfigurationError):
        return _told(error.sentence, USAGE)
    if isinstance(error, FieldcalError):
        code = BUSY if error.reason_code == ReasonCode.BUSY else USAGE if error.reason_code in USAGE_CODES else FAILED
        return _told(error.sentence, code)
    if isinstance(error, OSError) and error.filename is not None:
        return _told(f"{error.filename}: {error.strerror}.", FAILED)
    told = " ".join(str(error).split())
    return _told(f"{type(error).__name__}: {told} (FIELDCAL_DEBUG=1 shows where).", FAILED)


def _told(sentence: str, code: int) -> int:
    print(f"fieldcal: {printable(' '.join(sentence.split()))}", file=sys.stderr)
    return code


def _night(
    archive: Path,
    folder: Path | None,
    workers: int,
    where: dict[str, str | None],
    how: tuple[bool, bool, bool],
    warehouse: str | None,
    config: Path | None,
) -> int:
    from fieldcal.cli.show import print_json
    from fieldcal.flows.run import dry_run as plan_only
    from fieldcal.flows.run import run_night

    dry, as_json, wide = how
    if workers < 1:
        raise _usage(ReasonCode.WRONG_OPTION, "--workers must be 1 or more.")
    root = _root(warehouse)
    if dry:
        plan = plan_only(archive, root, config, folder)
        if as_json:
            print_json(plan)
        else:
            from fieldcal.cli.present.night import print_plan
            from fieldcal.cli.present.screen import console

            print_plan(console(wide=wide), plan)
        return OK if plan["logs"] else _nothing(archive, folder)
    from fieldcal.cli.present.progress import NightProgress

    with NightProgress() as progress:
        result = run_night(archive, root, config, folder, workers, progress, **where)
    if as_json:
        print_json(result)
    else:
        from fieldcal.cli.present.night import print_night
        from fieldcal.cli.present.screen import console

        print_night(console(wide=wide), result, root)
    if not result["logs"]:
        return _nothing(archive, folder)
    return OK if result["ok"] == len(result["logs"]) else LOSSES


def _nothing(archive: Path, folder: Path | None) -> int:
    import shlex

    return _told(
        f"{folder or archive} holds nothing that is a log: logs lie as <vehicle>/<session>/<log>, others are named in "
        f"archive.logs. fieldcal doctor --archive {shlex.quote(str(archive))} names what lies there; fieldcal init "
        "writes archive.logs for logs that lie elsewhere.",
        LOSSES,
    )


def _root(warehouse: str | None) -> Path:
    from fieldcal.warehouse import Warehouse

    return Warehouse(warehouse).root


def _usage(reason_code: ReasonCode, sentence: str) -> Exception:
    from fieldcal.errors import FieldcalError

    return FieldcalError(reason_code, sentence)


def _assignments(texts: list[str]) -> dict[str, str]:
    """["name=value", …] as a dictionary."""
    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not equals or not name:
            raise _usage(ReasonCode.WRONG_OPTION, f'--set needs name=value, not "{name}".')
    return {name.strip(): value.strip() for name, _, value in pairs}


app.command(inspect)
app.command(init)
app.command(config_app)
app.command(report_command, name="report")
app.command(site)
app.command(serve)
app.command(trigger)
app.command(alerts_app)
app.command(prune)
app.command(schemas)
app.command(export_warehouse)
app.command(simulate)
app.command(drift)
app.command(pooled)
app.command(plan)
app.command(export)
app.command(compare)
app.command(withdraw)
app.command(accept)
app.command(apply)
app.command(onboard)
app.command(refit)
