"""`fieldcal init`: a first fieldcal.toml at an archive's root."""

from __future__ import annotations

from pathlib import Path

from fieldcal.cli.options import AsJson, UnusedConfig, UnusedRoot

OK, LOSSES = 0, 3


def init(
    archive: Path, /, *, as_json: AsJson = False, config: UnusedConfig = None, warehouse: UnusedRoot = None
) -> int:
    """Write a commented fieldcal.toml for an archive from what lies in it; one that is there is left as it is.

    Parameters
    ----------
    archive
        Folder of logs.
    """
    import shlex

    from fieldcal.cli.show import print_json
    from fieldcal.flight.first_configuration import first_configuration, write_first_configuration
    from fieldcal.words.talk import say

    first = first_configuration(archive)
    if first.logs:
        write_first_configuration(first)
    if as_json:
        told = {"logs": first.logs, "vehicles": first.vehicles}
        print_json({"file": str(first.path) if first.logs else None, **told, "text": first.text})
    elif first.logs:
        print(first.text, end="")
    if not first.logs:
        say(
            f"fieldcal: {archive} holds nothing that is a log by its name (.mcap, .bag, .db3, .ulg, .bin, .csv); "
            f"nothing was written. fieldcal doctor --archive {shlex.quote(str(archive))} names what lies there."
        )
        return LOSSES
    say(
        f"Wrote {first.path}: logs found: {first.logs}, vehicles: {first.vehicles}. Fill in what stands in comments, "
        f"then: fieldcal nightly {shlex.quote(str(archive))} --dry-run"
    )
    return OK
