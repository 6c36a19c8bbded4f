"""What a night runs again after an edit of the code: nothing for a comment, for a constant the stages that reach it.

    python benchmarks/what_reruns.py

Works on a copy of the package and on one simulated flight, in a temporary folder; a minute. The constant is the
smallest sine of `rotation.to_rotation_vector`, which moves no result here: what merely reads from the stages that run
again finds its inputs unchanged, and does not.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import fieldcal
from fieldcal.provenance.reached_code import reach
from fieldcal.provenance.run_key import dotted_name
from fieldcal.provenance.source_tree import SourceTree
from fieldcal.stages.pipeline import PIPELINE

EDITED = ("fieldcal.geometry.rotation", "to_rotation_vector")
FORMER, LATTER = "where=sine > 1e-12", "where=sine > 2e-12"


def copy_package(folder: Path) -> Path:
    """A copy of the package that runs this, below `folder`."""
    package = Path(str(fieldcal.__file__)).parent
    return Path(shutil.copytree(package, folder / "fieldcal", ignore=shutil.ignore_patterns("__pycache__")))


def add_comments(package: Path) -> int:
    """Put a comment at both ends of every module; how many there are."""
    modules = sorted(package.rglob("*.py"))
    for module in modules:
        module.write_text(f"# A comment.\n{module.read_text()}# Another one.\n")
    return len(modules)


def change_constant(package: Path) -> None:
    """Change one constant in `geometry/rotation.py`."""
    module = package / "geometry" / "rotation.py"
    text = module.read_text()
    if text.count(FORMER) != 1:
        raise SystemExit(f"{module} holds {FORMER!r} {text.count(FORMER)} times, not once: name another constant here.")
    module.write_text(text.replace(FORMER, LATTER))


def reaching(package: Path) -> list[str]:
    """The stages that reach what is edited, by the source."""
    tree = SourceTree("fieldcal", package)
    return [s.name for s in PIPELINE if EDITED in reach(tree, [dotted_name(s.function)]).definitions]


def night(package: Path, archive: Path, root: Path) -> dict[str, str]:
    """Run `fieldcal nightly` with a copy of the package; the steps that ran, each with why."""
    command = ["nightly", str(archive), "--warehouse", str(root), "--workers", "1", "--json"]
    told = subprocess.run(
        [sys.executable, "-m", "fieldcal", *command],
        cwd=package.parent,
        env={**os.environ, "PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return {step: why or "" for log in json.loads(told.stdout)["logs"] for step, why in log["ran"].items()}


def main() -> None:
    """Three nights: all stages, none, and those that reach the constant."""
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment

    with tempfile.TemporaryDirectory() as folder:
        archive, root = Path(folder) / "archive", Path(folder) / "warehouse"
        write_flights(archive, Experiment(seed=1, duration_s=30.0))
        package = copy_package(Path(folder))
        first = night(package, archive, root)
        print(f"first night: {len(first)} steps run")
        modules = add_comments(package)
        commented = night(package, archive, root)
        print(f"two comments in each of {modules} modules: {len(commented)} steps run")
        change_constant(package)
        changed = night(package, archive, root)
        expected = reaching(package)
        print(f"{'.'.join(EDITED)}, {FORMER} → {LATTER}: {len(changed)} steps run")
        for step, why in changed.items():
            print(f"  {step}: {why}")
        right = len(first) == len(PIPELINE) + 1 and not commented and sorted(changed) == sorted(expected)
        print("as the source says" if right else f"NOT as the source says: {', '.join(expected)}")
        sys.exit(0 if right else 1)


if __name__ == "__main__":
    main()
