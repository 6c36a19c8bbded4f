"""Headers of motion capture systems cut short: each is told what it lacks."""

from __future__ import annotations

import pytest

from fieldcal.logs.csv.presets.layout import Layout, Meaning
from fieldcal.logs.csv.presets.motion_capture import MOTIVE, VICON_NEXUS


@pytest.mark.parametrize(
    ("columns", "above", "lacking"),
    [
        (("Frame",), (), "its columns do not begin with Frame, Time (Seconds)"),
        (("Frame", "Time (Seconds)"), (), "it holds no rigid body"),
        (("Frame", "Time (Seconds)"), (",,Type,Marker",), "it holds no rigid body"),
        (("Frame", "Time (Seconds)", "X"), (",,Rigid Body",), "it holds no rigid body"),
    ],
)
def test_a_header_of_motive_that_ends_too_early(columns: tuple[str, ...], above: tuple[str, ...], lacking: str) -> None:
    assert MOTIVE.read(Layout(columns, (), ("Format Version,1.23", *above), (), ",")) == lacking


def test_a_header_of_vicon_needs_a_rate_and_a_line_with_bodies_above_it() -> None:
    turned = ("RX", "RY", "RZ", "RW")
    columns = ("Frame", "Sub Frame", *turned)
    meaning = VICON_NEXUS.read(Layout(columns, (), ("100", ",,quad"), (), ","))
    assert isinstance(meaning, Meaning)
    assert (meaning.rate_hz, meaning.vps["quaternion_xyzw"]) == (100.0, tuple(f"quad {name}" for name in turned))
    for above in ((), ("100",)):
        assert str(VICON_NEXUS.read(Layout(columns, (), above, (), ","))).endswith("a line with the bodies' names")
    for above in (("0", ",,quad"), ("-1", ",,quad"), ("Trajectories", ",,quad")):
        assert VICON_NEXUS.read(Layout(columns, (), above, (), ",")) == "no line above its header gives the frame rate"
