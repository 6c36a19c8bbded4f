"""The flows as `fieldcal serve` runs them: what serve was given holds, whatever Prefect's server has been told since.

Those who may talk to the server can change a deployment and choose the parameters of a run. So a served flow is bound
to its archives, warehouse and configuration before the server hears of it, and refuses to run with others; a session's
folder is all that it takes. Its code is handed over by `serve` itself and never fetched as a deployment says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect import Flow, flow
from prefect.settings import PREFECT_API_URL

from fieldcal.batch.documents import NightDocument
from fieldcal.batch.night import plan_night
from fieldcal.batch.session_folder import archive_of
from fieldcal.errors import FieldcalError
from fieldcal.flight.processes import end_with_parent
from fieldcal.flows.nightly import carry_out, told_apart
from fieldcal.flows.runners import Parallel
from fieldcal.flows.trigger import trigger
from fieldcal.reason_codes import ReasonCode


@dataclass(frozen=True)
class Served:
    """What `fieldcal serve` was given.

    Parameters
    ----------
    archive, watched
        Archive of the nights, and the one whose sessions start by themselves; sessions may lie in either.
    warehouse, config
        Data root, `fieldcal.toml` if not the archive's own.
    workers
        Processes that calibrate.
    """

    archive: Path
    watched: Path | None
    warehouse: Path
    config: Path | None
    workers: int

    @property
    def archives(self) -> list[Path]:
        """All archives, absolute."""
        return [path.absolute() for path in (self.archive, self.watched) if path is not None]

    def parameters(self) -> dict[str, Any]:
        """As the deployments show them. Absolute paths, so that they hold wherever a run starts on this machine."""
        return {
            "archives": [str(path) for path in self.archives],
            "warehouse": str(self.warehouse.absolute()),
            "config": str(self.config.absolute()) if self.config else None,
            "workers": self.workers,
        }

    def need(self, given: dict[str, Any]) -> None:
        """Refuse a run that was given anything else.

        Raises
        ------
        FieldcalError
            `wrong_option`.
        """
        for name, own in self.parameters().items():
            if given[name] != own:
                what = f"fieldcal serve was started with {name} {own}; a run cannot change it to {given[name]}."
                raise FieldcalError(ReasonCode.WRONG_OPTION, what)


def served_nightly(served: Served) -> Flow[..., NightDocument]:
    """The night over the archive that is served."""

    @flow(name="nightly", persist_result=False, validate_parameters=False)
    def nightly(archives: list[str], warehouse: str, config: str | None, workers: int) -> NightDocument:
        """Calibrate every log of the archive that is new or changed, and publish."""
        end_with_parent()
        served.need({"archives": archives, "warehouse": warehouse, "config": config, "workers": workers})
        night = plan_night(served.archives[0], served.warehouse, served.config)
        return told_apart(carry_out(night, Parallel(served.workers)))

    return nightly


def served_session(served: Served) -> Flow[..., NightDocument]:
    """The same for one session folder inside the archives."""

    @flow(name="session", persist_result=False, validate_parameters=False)
    def session(folder: str, archives: list[str], warehouse: str, config: str | None, workers: int) -> NightDocument:
        """Calibrate and publish the one session folder `<archive>/<vehicle>/<session>`."""
        end_with_parent()
        served.need({"archives": archives, "warehouse": warehouse, "config": config, "workers": workers})
        archive, place = archive_of(Path(folder), served.archives)
        night = plan_night(archive, served.warehouse, served.config, place)
        return told_apart(carry_out(night, Parallel(served.workers)))

    return session


def served_landed(served: Served) -> Flow[..., str]:
    """What the automation on `fieldcal.session.landed` runs."""

    @flow(name="session-landed", persist_result=False, validate_parameters=False)
    def session_landed(folder: str) -> str:
        """Ask for the session as `fieldcal trigger` does, so that an event that comes twice runs it once."""
        end_with_parent()
        url = PREFECT_API_URL.value()
        assert url is not None, "a run is started by a server"
        archive_of(Path(folder), served.archives)
        return str(trigger(url, Path(folder).absolute())["flow_run_id"])

    return session_landed
