"""What ends every work on a warehouse by URL: others see it where they look."""

from __future__ import annotations

from pathlib import Path

from fieldcal.warehouse.remote.known import objects_of
from fieldcal.warehouse.remote.live import bring_up
from fieldcal.warehouse.remote.pages import upload_pages


def share(root: Path) -> None:
    """Bring the live copies and the pages at a warehouse's URL up to what was published; one on this machine has them.

    Raises
    ------
    RemoteError
        What is published is so all the same; the next night, or whoever publishes next, does the rest.
    """
    objects = objects_of(root)
    if objects is not None:
        bring_up(objects)
        upload_pages(root, objects)
