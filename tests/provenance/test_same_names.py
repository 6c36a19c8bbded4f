"""A package that offers a function under the name of the module it lies in."""

from __future__ import annotations

from pathlib import Path

from fieldcal.provenance.reached_code import reach
from fieldcal.provenance.source_tree import SourceTree


def test_a_function_named_as_its_module_is_found_and_ends(tmp_path: Path) -> None:
    package = tmp_path / "house"
    (package / "rooms").mkdir(parents=True)
    (package / "__init__.py").write_text("from house.rooms import walk\n")
    (package / "rooms" / "__init__.py").write_text("from house.rooms.walk import walk\n")
    (package / "rooms" / "walk.py").write_text("STEP = 2\n\n\ndef walk(x):\n    return STEP * x\n")
    (package / "use.py").write_text(
        "from house import rooms\nfrom house.rooms.walk import STEP\n\n\n"
        "def far(x):\n    return rooms.walk(x)\n\n\ndef near(x):\n    return x + STEP\n"
    )
    tree = SourceTree("house", package)
    assert ("house.rooms.walk", "walk") in reach(tree, ["house.use.far"]).definitions
    assert ("house.rooms.walk", "STEP") in reach(tree, ["house.use.near"]).definitions
