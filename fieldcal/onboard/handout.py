"""The C sources, written out with a vehicle's configuration: what a flight controller compiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldcal.onboard.board import BoardSettings
from fieldcal.onboard.noise import readings_in_mean

SOURCES = ("fieldcal_onboard.h", "fieldcal_onboard.c")
CONFIG = "fieldcal_onboard_config.h"
FOLDER = Path(__file__).parent / "c"


def write_sources(folder: Path | str, settings: BoardSettings, *, told: str = "") -> list[Path]:
    """Write header, source and the configuration's header into a folder, which is made where it is missing.

    Parameters
    ----------
    folder : Path or str
    settings : BoardSettings
    told : str
        Whose configuration it is, for the first line.

    Returns
    -------
    list of Path
        What was written.

    Examples
    --------
    >>> import tempfile
    >>> from fieldcal.onboard import BoardSettings, write_sources
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in write_sources(folder, BoardSettings(imu_rate_hz=400.0))]
    ['fieldcal_onboard.h', 'fieldcal_onboard.c', 'fieldcal_onboard_config.h']
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for name in SOURCES:
        (place / name).write_bytes((FOLDER / name).read_bytes())
    (place / CONFIG).write_text(config_header(settings, told), encoding="ascii")
    return [place / name for name in (*SOURCES, CONFIG)]


def config_header(settings: BoardSettings, told: str = "") -> str:
    """The configuration's header."""
    s = settings
    lines = [
        ("FULL_MATRIX", str(int(s.full)), "1: room for symmetric scale matrices"),
        ("FIELD_NORM", _float(s.field_norm), f"{s.field_unit}: length of the local field"),
        ("FIELD_NED", _array(s.field_ned), "its direction"),
        ("GRAVITY", _float(s.gravity_mps2), "m/s^2"),
        ("GRAVITY_SIGN", _float(s.gravity_sign), "of the accelerometer on the down axis at rest"),
        ("MAGNETOMETER_POLARITY", _array(s.magnetometer_polarity), ""),
        ("ACCELEROMETER_POLARITY", _array(s.accelerometer_polarity), ""),
        ("GYROSCOPE_POLARITY", _array(s.gyroscope_polarity), ""),
        ("DIRECTION_SD", _array(s.direction_sd), "rad, of field and gravity: weights of the attitude"),
        ("MAX_CONDITION", _float(s.max_condition), ""),
        ("MAX_SCALE_SD", _float(s.max_scale_sd), "relative"),
        ("MAX_RESIDUAL", _float(s.max_residual), "rms of length / magnitude - 1"),
        ("MAX_LENGTH_EXCESS", _float(s.max_length_excess), "relative: a sample further off makes no attitude"),
        ("GYROSCOPE_MAX_SCALE_SD", _float(s.gyroscope_max_scale_sd), "relative"),
        (
            "MAGNETOMETER_CORRELATED",
            _float(s.limits("magnetometer").correlated_samples),
            "samples over which a disturbance stays alike",
        ),
        ("ACCELEROMETER_CORRELATED", _float(s.limits("accelerometer").correlated_samples), ""),
        ("MAGNETOMETER_IN_MEAN", f"{readings_in_mean(s.magnetometer_rate_hz)}u", "readings averaged to tell noise"),
        ("ACCELEROMETER_IN_MEAN", f"{readings_in_mean(s.imu_rate_hz)}u", ""),
        ("BLOCK_SAMPLES", str(s.block_samples), "attitudes a derivative"),
        ("FORGETTING", _float(s.forgetting), "factor a block; 1: nothing is forgotten"),
        ("MAX_GAP_US", f"{s.max_gap_us}u", "after so long a new block begins"),
    ]
    whose = _comment(told) or "defaults"
    defines = [f"#define FIELDCAL_{name} {value}" + (f" /* {why} */" if why else "") for name, value, why in lines]
    guard = "FIELDCAL_ONBOARD_CONFIG_H"
    head = [f"/* fieldcal on board: configuration, {whose}. */", f"#ifndef {guard}", f"#define {guard}", ""]
    return "\n".join([*head, *defines, "", "#endif", ""])


def _float(value: float) -> str:
    return f"{float(value)!r}f"


def _array(values: Sequence[float]) -> str:
    return "{" + ", ".join(_float(v) for v in values) + "}"


def _comment(text: str) -> str:
    """Text that cannot end the comment it stands in, in ASCII."""
    return text.encode("ascii", "backslashreplace").decode().replace("*/", "* /").replace("\n", " ")
