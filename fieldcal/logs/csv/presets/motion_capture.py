"""Poses by motion capture systems: Motive, Vicon Nexus and Tracker, Qualisys. Headers of several lines, one body each.

Where a file holds several bodies, none is chosen. Columns are called by body and quantity ("quad Rotation X"): under
these names the configuration may name those of one, beside `preset`.
"""

from __future__ import annotations

import math
import re

from fieldcal.config.values import Paths
from fieldcal.logs.csv.dialect import cells_of
from fieldcal.logs.csv.presets.layout import Layout, Meaning, Preset, axes, positive

UPPER, UPPER_XYZW = ("X", "Y", "Z"), ("X", "Y", "Z", "W")
METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
MILLIMETRE = 1e-3
ENU_FROM_Y_UP = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A quarter turn about x: y up becomes z up."""


def _one(bodies: list[str], key: str, columns: str) -> str | None:
    """What is told of a file that has not exactly one body."""
    if not bodies:
        return "it has no rigid body with an attitude"
    if len(bodies) > 1:
        return f"it holds several bodies, {', '.join(bodies)}: name the columns of one, csv.vps.{key} = [{columns}]"
    return None


def _read_motive(layout: Layout, *, y_up: bool) -> Meaning | str:
    if not layout.above or not layout.above[0].startswith("Format Version,"):
        return "its first line does not begin with 'Format Version,'"
    cells = cells_of(layout.above[0], layout.separator)
    told = dict(zip(cells[::2], cells[1::2], strict=False))
    if told.get("Rotation Type", "Quaternion") != "Quaternion":
        return f"its Rotation Type is {told['Rotation Type']}; export quaternions"
    metre = METRES.get(told.get("Length Units", "Meters").lower())
    if metre is None:
        return f"its Length Units are {told['Length Units']}"
    if told.get("Coordinate Space", "Global") != "Global":
        return f"its Coordinate Space is {told['Coordinate Space']}; export global poses"
    if len(layout.names) < 2 or layout.names[0] != "Frame" or not layout.names[1].startswith("Time"):
        return "its columns do not begin with Frame, Time (Seconds)"
    rows = [cells_of(line, layout.separator) for line in layout.above[1:]]
    kinds = next((row for row in rows if "Rigid Body" in row), None)
    quantities = layout.above_cells(1)
    if kinds is None or rows.index(kinds) + 1 >= len(rows):
        return "it holds no rigid body"
    owners = rows[rows.index(kinds) + 1]
    names = list(layout.names)
    bodies = []
    for place, axis in enumerate(layout.names):
        if place < min(len(kinds), len(owners)) and kinds[place] == "Rigid Body" and quantities[place] and axis:
            names[place] = f"{owners[place]} {quantities[place]} {axis}"
            if (quantities[place], axis) == ("Rotation", "W"):
                bodies.append(owners[place])
    vps: dict[str, Paths] = {"t": layout.names[1]}
    wrong = _one(bodies, "quaternion_xyzw", ", ".join(f'"BODY Rotation {axis}"' for axis in UPPER_XYZW))
    if not wrong:
        vps["quaternion_xyzw"] = axes(f"{bodies[0]} Rotation *", UPPER_XYZW)
        if set(axes(f"{bodies[0]} Position *", UPPER)) <= set(names):
            vps["position"] = axes(f"{bodies[0]} Position *", UPPER)
    return Meaning(
        vps=vps,
        names=tuple(names),
        time_unit="s",
        metre=metre,
        world_from_logged=ENU_FROM_Y_UP if y_up else None,
        world="enu",
        # Of several bodies the configuration chooses: that is only known once it asks for the preset.
        certain=y_up and not wrong,
        told=wrong
        or ("its world is taken for y up, as Motive has it; exported with z up it is motive_z_up" if y_up else ""),
    )


def _read_motive_y_up(layout: Layout) -> Meaning | str:
    return _read_motive(layout, y_up=True)


def _read_motive_z_up(layout: Layout) -> Meaning | str:
    return _read_motive(layout, y_up=False)


MOTIVE = Preset("motive", "OptiTrack Motive's", "vps", _read_motive_y_up)
"""Format versions 1.2x, whose first line gives units and rotation type. Times in s from the take's start. Quaternions
are scalar last, body to world, in Motive's right-handed world with y up; its axes may be chosen at export, which the
file does not say."""
MOTIVE_Z_UP = Preset("motive_z_up", "OptiTrack Motive's", "vps", _read_motive_z_up)
"""The same, exported with z up; never chosen by itself."""


def _read_vicon(layout: Layout) -> Meaning | str:
    if layout.names[:2] != ("Frame", "Sub Frame") or len(layout.above) < 2:
        return "its columns do not begin with Frame, Sub Frame below a line with the bodies' names"
    rates = [rate for rate in (positive(line.strip(",;\t ")) for line in layout.above) if rate is not None]
    if not rates:
        return "no line above its header gives the frame rate"
    owners = layout.above_cells(1)
    names, bodies, owner = list(layout.names), [], ""
    quaternion = "RW" in layout.names
    for place, name in enumerate(layout.names):
        owner = owners[place] or owner
        if name in ("RX", "RY", "RZ", "RW", "TX", "TY", "TZ"):
            names[place] = f"{owner} {name}".strip()
            if name == ("RW" if quaternion else "RZ"):
                bodies.append(owner)
    angles = {layout.units[place] for place, name in enumerate(layout.names) if name == "RX" and layout.units}
    if not quaternion and angles != {"rad"}:
        return "its RX, RY, RZ are not in rad: angles in degrees are of a sequence that the file does not tell"
    metres = {layout.units[place] for place, name in enumerate(layout.names) if name == "TX" and layout.units}
    if metres - {"mm"}:
        return f"its TX, TY, TZ are in {', '.join(sorted(metres))} instead of mm"
    key = "quaternion_xyzw" if quaternion else "rotation_vector"
    vps: dict[str, Paths] = {"t": "Frame"}
    wrong = _one(bodies, key, '"BODY RX", "BODY RY", "BODY RZ", "BODY RW"')
    if not wrong:
        stem = f"{bodies[0]} " if bodies[0] else ""
        vps[key] = axes(f"{stem}R*", UPPER_XYZW if quaternion else UPPER)
        if set(axes(f"{stem}T*", UPPER)) <= set(names):
            vps["position"] = axes(f"{stem}T*", UPPER)
    rotation = "" if quaternion else "RX, RY, RZ are taken for a rotation vector from body to world"
    return Meaning(
        vps=vps,
        names=tuple(names),
        rate_hz=rates[0],
        metre=MILLIMETRE,
        world="enu",
        certain=quaternion and not wrong,
        told=wrong or rotation,
    )


VICON_NEXUS = Preset("vicon_nexus", "Vicon Nexus' or Tracker's", "vps", _read_vicon)
"""Frames are counted at the rate in the second line, lengths are mm, the world has z up. Four components (RX … RW) are
a quaternion. Three in rad are read as a rotation vector (angle times axis, the systems' own representation) only where
the configuration asks, as the file does not say that they are no Euler angles."""

_ROTATIONS = tuple(f"Rot[{i}]" for i in range(9))
_BODY_X = re.compile(r"(?:(.*) )?X$")


def _read_qualisys(layout: Layout) -> Meaning | str:
    header = {cells[0]: cells[1:] for cells in (line.split("\t") for line in layout.above) if len(cells) > 1}
    if header.get("DATA_INCLUDED", [""])[0].strip() != "6D":
        return "no line 'DATA_INCLUDED 6D' stands above its header"
    names, bodies = list(layout.names), []
    for place in range(len(layout.names)):
        block = layout.names[place : place + 16]
        match = _BODY_X.match(block[0])
        if match and block[1:3] == ("Y", "Z") and block[7:] == _ROTATIONS:
            bodies.append(match[1] or "body")
            names[place : place + 3] = axes(f"{bodies[-1]} *", UPPER)
            names[place + 7 : place + 16] = [f"{bodies[-1]} {rotation}" for rotation in _ROTATIONS]
    if len(bodies) != 1:
        return f"it holds {len(bodies)} bodies with X, Y, Z, three angles, Residual and Rot[0] … Rot[8]; export one"
    vps: dict[str, Paths] = {}
    rate_hz = None
    if layout.has("Time"):
        vps["t"] = "Time"
    else:
        rate_hz = positive(header.get("FREQUENCY", [""])[0])
        if rate_hz is None:
            return "it has neither a column Time nor a FREQUENCY in Hz above the header"
        if layout.has("Frame"):
            vps["t"] = "Frame"
    vps["rotation_matrix"] = tuple(f"{bodies[0]} {name}" for name in _ROTATIONS)
    vps["position"] = axes(f"{bodies[0]} *", UPPER)
    return Meaning(
        vps=vps,
        names=tuple(names),
        time_unit=None if rate_hz else "s",
        rate_hz=rate_hz,
        metre=MILLIMETRE,
        world="enu",
    )


QUALISYS = Preset("qualisys", "Qualisys QTM's", "vps", _read_qualisys)
"""6DOF as TSV with its header. The attitude is the matrix from body to world, column by column: the sequence of Roll,
Pitch and Yaw may be chosen in QTM and is not in the file. Lengths are mm. Which axis is up was chosen when the volume
was calibrated: z, unless `world` says otherwise."""
