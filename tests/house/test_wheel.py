"""What is installed: one package, and a night that nothing in the current folder breaks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import textwrap
import zipfile
from pathlib import Path

import pytest
from outside_ci import outside_ci

from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

REPOSITORY = Path(__file__).parents[2]
LEFT_BEHIND = shutil.ignore_patterns(
    ".*", "*.egg-info", "build", "dist", "__pycache__", "tests", "benchmarks", "docs", "*.so"
)
SITE = ("site/templates/site.html", "site/assets/charts.js", "site/assets/uplot/LICENSE")
HOSTILE = ("flows", "schemas", "warehouse", "fieldcal", "polars")


def run(*command: str | Path, cwd: Path | None = None, timeout_s: float = 240.0) -> str:
    """Standard output of a command, away from the environment of these tests."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PREFECT_", "PYTHON"))}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=kept, capture_output=True, text=True, timeout=timeout_s
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from the source distribution of a copy of this checkout."""
    folder = tmp_path_factory.mktemp("distribution")
    source = Path(shutil.copytree(REPOSITORY, folder / "source", symlinks=True, ignore=LEFT_BEHIND))
    run(sys.executable, "-m", "build", "--outdir", folder / "dist", source)
    (found,) = (folder / "dist").glob("*.whl")
    return found


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the programs of an environment that has the wheel, and the packages it needs from this one."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    programs = folder / "bin"
    run(sys.executable, "-m", "pip", "--python", programs / "python", "install", "--quiet", "--no-deps", wheel)
    site = Path(run(programs / "python", "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])").strip())
    (site / "needed.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
    return programs


def test_the_wheel_holds_one_package_and_its_data(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert "fieldcal" in tops
    assert {top for top in tops if top != "fieldcal"} == {f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"}
    files = ("py.typed", "warehouse/views/history.sql", "report/templates/style.css", "onboard/c/fieldcal_onboard.h")
    for needed in (*files, *SITE, "flows/nightly.py"):
        assert f"fieldcal/{needed}" in names
    modules = {str(path.relative_to(REPOSITORY)) for path in (REPOSITORY / "fieldcal").rglob("*.py")}
    assert modules <= set(names)


@outside_ci
def test_without_a_compiler_it_is_installed_and_computes(tmp_path: Path) -> None:
    source = Path(shutil.copytree(REPOSITORY, tmp_path / "source", symlinks=True, ignore=LEFT_BEHIND))
    build = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, source)
    run("env", "CC=false", *build)
    (found,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(found) as archive:
        assert not any(name.endswith(".so") for name in archive.namelist())
        archive.extractall(tmp_path / "installed")
    program = f"""
        import sys; sys.path.insert(0, {str(tmp_path / "installed")!r})
        import fieldcal
        from fieldcal import compiled
        from fieldcal.simulation.archive import settings, signals
        from fieldcal.simulation.experiment import Experiment, simulate
        from fieldcal.stages.pipeline import run_flight
        assert fieldcal.__file__.startswith({str(tmp_path)!r})
        flown = Experiment()
        print(run_flight(signals(simulate(flown, seed=1)), settings(flown, method="joint"))["joint"].status)
        print(compiled.DESCRIPTION)
    """
    found_by = run(sys.executable, "-P", "-c", textwrap.dedent(program))
    assert found_by.split("\n")[:2] == ["ok", "NumPy: none was compiled when fieldcal was installed"]


def test_what_is_installed_has_no_generic_name(environment: Path) -> None:
    program = "import importlib.metadata as m; print(sorted({f.parts[0] for f in m.files('fieldcal')}))"
    found = run(environment / "python", "-P", "-c", program)
    assert "'fieldcal'" in found
    assert not any(f"'{name}'" in found for name in ("flows", "schemas", "warehouse"))


@outside_ci
def test_a_night_in_a_folder_with_hostile_names(environment: Path, tmp_path: Path) -> None:
    here = tmp_path / "here"
    for name in HOSTILE:
        (here / name).mkdir(parents=True)
        (here / name / "__init__.py").write_text(f"raise SystemExit('the {name} of the current folder was imported')\n")
    (here / "numpy.py").write_text("raise SystemExit('the numpy of the current folder was imported')\n")
    write_flights(here / "archive", Experiment(seed=5, duration_s=20.0), vehicles=3, sessions=1, flights=1)
    root = here / "root"
    told = run(
        environment / "fieldcal", "nightly", "archive", "--warehouse", root, "--workers", "2", "--json", cwd=here
    )
    night = json.loads(told)
    assert (night["ok"], len(night["logs"])) == (3, 3)
    assert json.loads(run(environment / "fieldcal", "verify", "--warehouse", root, "--json", cwd=here))["ok"]
