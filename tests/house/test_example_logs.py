"""Where recordings are promised they are there: a missing folder must not skip its tests silently."""

from __future__ import annotations

import pytest
from example_logs import FOLDERS, PARENT, VARIABLE, needs_examples


@needs_examples
@pytest.mark.parametrize("folder", FOLDERS)
def test_every_listed_folder_of_recordings_is_there(folder: str) -> None:
    assert (PARENT / folder).is_dir(), (
        f"{VARIABLE} is {PARENT}, which has no folder {folder}: it names the folder that holds {', '.join(FOLDERS)}."
    )
    assert any((PARENT / folder).iterdir()), f"{PARENT / folder} is empty."
