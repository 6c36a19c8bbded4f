"""Nights that nobody starts: `serve`, the schedule; `trigger`, the ground station's call; `alerts`, who hears."""

from __future__ import annotations

import os
from pathlib import Path

from cyclopts import App

from fieldcal.cli.options import AsJson, Config, Place, Root, SessionFolder, UnusedRoot, Whole
from fieldcal.reason_codes import ReasonCode

alerts_app = App(name="alerts", help="Whom nights tell what is new ([alerts] to in fieldcal.toml).")
EVERY_NIGHT = "0 3 * * *"


def serve(
    archive: Place | None = None,
    /,
    *,
    cron: str = EVERY_NIGHT,
    timezone: str | None = None,
    watch: Place | None = None,
    quiet: float = 60.0,
    workers: Whole = 1,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Host the nightly schedule and the session trigger, until interrupted.

    Parameters
    ----------
    archive
        Archive of the nightly runs; else the watched one, else the folder of --config, else this folder.
    cron
        When the night runs: minute hour day month weekday.
    timezone
        Time zone of --cron, such as Europe/Berlin; else this machine's.
    watch
        Trigger the sessions of this archive by themselves when their files have stopped growing.
    quiet
        Seconds without change after which a watched session has landed.
    workers
        Processes that calibrate.
    """
    from fieldcal.config.find import find_source
    from fieldcal.errors import FieldcalError
    from fieldcal.flows.connection import SECRET_FILE
    from fieldcal.flows.server import running_server
    from fieldcal.remote.places import folder_at
    from fieldcal.warehouse import Warehouse
    from fieldcal.warehouse.layout import prepare
    from fieldcal.words.talk import say

    watched = folder_at(watch, "serve --watch") if watch else None
    place = folder_at(archive, "serve") if archive else watched or (config.parent if config else Path())
    for what, folder in (("archive", place), ("archive to watch", watched)):
        if folder is not None and not folder.is_dir():
            raise FieldcalError(ReasonCode.NO_ARCHIVE, f"There is no {what} at {folder}.")
    find_source(config, place)
    root = Warehouse(warehouse).root.absolute()
    prepare(root)
    os.environ.setdefault("PREFECT_RUNNER_POLL_FREQUENCY", "2")
    with running_server(root, serving=True) as server:
        from fieldcal.flows.deploy import host, local_timezone, register
        from fieldcal.flows.farewell import end_with_server
        from fieldcal.flows.housekeeping import keep_tidy, tidy_prefect
        from fieldcal.flows.served import Served

        url = server.wait()
        with server.explained():
            tidy_prefect(root, url, own_server=server.own)
        try:
            runner = register(Served(place, watched, root, config, workers), cron, timezone)
        except ValueError as error:
            raise FieldcalError(ReasonCode.WRONG_OPTION, f'--cron "{cron}", --timezone: {_last_line(error)}') from error
        when = f'"{cron}" ({timezone or local_timezone()})'
        say(f"Serving at {url}: nightly over {place.absolute()} at {when}, into {root}")
        say("Sessions: fieldcal trigger SESSION_DIR" + (f", and by themselves in {watch}" if watch else ""))
        if server.own:
            keep_tidy(root, url)
            end_with_server(server.lives, _lost(server.home))
            say(f"The server's secret, for those who emit events or open its pages: {server.home / SECRET_FILE}")
        host(runner, url, watched.absolute() if watched else None, quiet)
    return 0


def trigger(
    folder: SessionFolder,
    /,
    *,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Start the session flow on the server for a finished field session; asking twice runs it once.

    Parameters
    ----------
    folder
        Folder of the session: ARCHIVE/<vehicle>/<session>.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.errors import FieldcalError
    from fieldcal.flows.trigger import server_address
    from fieldcal.flows.trigger import trigger as ask
    from fieldcal.remote.places import folder_at
    from fieldcal.warehouse import Warehouse

    own = folder_at(folder, "trigger")
    if not own.is_dir():
        raise FieldcalError(ReasonCode.NO_SESSION, f"There is no session folder at {folder}.")
    root = Warehouse(warehouse).root
    url = server_address(root)
    changes = {"warehouse": str(root.absolute()) if warehouse else None, "config": config and str(config.absolute())}
    asked = ask(url, own.absolute(), **{name: path for name, path in changes.items() if path})
    if as_json:
        print_json(asked)
    else:
        known = "is scheduled" if asked["created"] else f"was asked for before; it is {asked['state'].lower()}"
        print(f"{folder}: flow run {asked['name']} {known}")
    return 0


@alerts_app.command(name="test")
def send_test(
    archive: Path = Path(), /, *, as_json: AsJson = False, config: Config = None, warehouse: UnusedRoot = None
) -> int:
    """Send a message to everybody whom a night tells, and say who took it.

    Parameters
    ----------
    archive
        Whose fieldcal.toml counts, unless --config names one.
    """
    from dataclasses import asdict

    from fieldcal.batch.telling.message import Message
    from fieldcal.batch.telling.send import send
    from fieldcal.cli.show import print_json
    from fieldcal.config.find import configuration_of, find_source
    from fieldcal.errors import FieldcalError
    from fieldcal.words.printable import printable

    to = configuration_of(find_source(config, archive)).alerts.to
    if not to:
        told = 'Nobody is to be told: [alerts] of fieldcal.toml has no `to`, a list of URLs as "ntfy://topic".'
        raise FieldcalError(ReasonCode.WRONG_OPTION, told)
    title = printable(f"fieldcal, {archive.resolve().name}: a test")
    sent = send(Message(title, "A night that has news will tell them here.\n"), to, os.environ)
    if as_json:
        print_json([asdict(one) for one in sent])
    else:
        for one in sent:
            print(printable(f"{one.place}: {one.problem or 'took the message'}"))
    return 1 if any(one.problem for one in sent) else 0


def _lost(home: Path) -> str:
    return (
        f"The Prefect server ended ({home / 'server.log'} may say why), so that no run would start any more; serve "
        "ends too. Start it again: what is done is kept, and the next night goes on from there."
    )


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = [line for line in lines if "error" in line.lower() or "invalid" in line.lower()]
    return (telling or lines or [""])[0]
