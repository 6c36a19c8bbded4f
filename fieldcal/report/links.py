"""Names of the report files, and links between them: only to files that are there or about to be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from fieldcal.report.page import link
from fieldcal.warehouse.layout import SITE, encode_id

FLEET = "fleet.html"


def vehicle_name(vehicle_id: str) -> str:
    """File name of a vehicle's report."""
    return f"vehicle-{encode_id(vehicle_id)}.html"


def flight_name(flight_id: str) -> str:
    """File name of a flight's report."""
    return f"flight-{encode_id(flight_id)}.html"


@dataclass(frozen=True)
class Links:
    """Links from a report in `folder`; `expected` names files that will be written there too, `fleet` the fleet's, and
    `on_site` pages of the site beside the folder: they are of now, a report that lies there may be of long ago."""

    folder: Path
    expected: frozenset[str] = frozenset()
    fleet: str = FLEET
    on_site: frozenset[str] = frozenset()

    def to(self, name: str, text: str) -> str | Markup:
        """`text` as a link to the report `name`, or the plain text where there is none."""
        if name in self.on_site - self.expected:
            return link(f"../{SITE}/{quote(name)}", text)
        return link(quote(name), text) if self._there(name) else text

    def up(self) -> tuple[str, str] | None:
        """The fleet page, as a page's `up`."""
        return (quote(self.fleet), "Fleet") if self._there(self.fleet) else None

    def _there(self, name: str) -> bool:
        return name in self.expected or (self.folder / name).is_file()
