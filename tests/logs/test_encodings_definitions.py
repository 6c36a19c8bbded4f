"""Message definitions: what the text form allows, and where following it ends."""

from __future__ import annotations

import pytest

from fieldcal.logs.encodings import ros2_definitions as definitions
from fieldcal.logs.encodings.ros2_definitions import (
    DefinitionError,
    Numbers,
    NumberSequence,
    Opaque,
    Text,
    flatten,
    full_text,
    short_name,
)

LINE = "=" * 80


def leaves(text: str) -> list[object]:
    return list(flatten("my_msgs/msg/Any", text))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("float64 x", [Numbers("x", "f8")]),
        ("float32[9] x", [Numbers("x", "f4", 9, True)]),
        ("int16[1] x", [Numbers("x", "i2", 1, True)]),
        ("uint8[] x", [NumberSequence("x", "u1")]),
        ("int64[<=5] x", [NumberSequence("x", "i8")]),
        ("string x", [Text("x")]),
        ("string<=20 x", [Text("x")]),
        ("string[2] x", [Text("x"), Text("x")]),
        ("string[] x", [Opaque("x")]),
        ("wstring x", [Opaque("x")]),
        ("wstring[2] x", [Opaque("x")]),
        ("string[20000] x", [Opaque("x")]),
        ("bool x  # a comment", [Numbers("x", "u1")]),
        ("uint16 x 7", [Numbers("x", "u2")]),
        ("uint16 X=7", [Numbers("structure_needs_at_least_one_member", "u1")]),
        ("# nothing", [Numbers("structure_needs_at_least_one_member", "u1")]),
        ("builtin_interfaces/Duration x", [Numbers("x.sec", "i4"), Numbers("x.nanosec", "u4")]),
    ],
)
def test_a_line_of_a_definition(line: str, expected: list[object]) -> None:
    assert leaves(line) == expected


def test_nested_definitions_are_found_by_full_name_by_package_and_by_name() -> None:
    text = "\n".join(
        [
            "other_msgs/Pair a", "Pair b", "Far c", "Pair[2] d", LINE, "MSG: other_msgs/Pair",
            "int8 x", LINE, "MSG: my_msgs/Pair", "int16 x", "====  ", "MSG: far_msgs/msg/Far", "int32 x",
        ]
    )  # fmt: skip
    assert leaves(text) == [
        Numbers("a.x", "i1"), Numbers("b.x", "i2"), Numbers("c.x", "i4"), Numbers("d[0].x", "i2"),
        Numbers("d[1].x", "i2"),
    ]  # fmt: skip
    assert leaves("Pair[] x\n===\nMSG: my_msgs/Pair\nint8 y") == [Opaque("x")]


@pytest.mark.parametrize("text", ["float64", "float64 ?", "[3] x", "float64[ x"])
def test_a_line_that_is_none_is_quoted(text: str) -> None:
    with pytest.raises(DefinitionError, match="is not understood"):
        leaves(text)


def test_of_a_long_line_the_beginning_is_quoted() -> None:
    with pytest.raises(DefinitionError, match=r"line '\?{80}' is not understood"):
        leaves("?" * 200)


def test_a_missing_definition_is_named_with_its_owner() -> None:
    with pytest.raises(DefinitionError, match="my_msgs/Any contains a Thing"):
        leaves("Thing x")


def chain(depth: int) -> str:
    """A definition nested so many times below the outermost."""
    parts = [f"N{i + 1} x\n" if i < depth else "int8 x\n" for i in range(depth + 1)]
    return "".join(part if i == 0 else f"{LINE}\nMSG: my_msgs/N{i}\n{part}" for i, part in enumerate(parts))


def test_nesting_is_followed_as_deep_as_the_cap() -> None:
    assert leaves(chain(definitions.DEPTH_CAP)) == [Numbers(".".join("x" * 33), "i1")]
    with pytest.raises(DefinitionError, match="without end"):
        leaves(chain(definitions.DEPTH_CAP + 1))


def test_so_many_values_are_followed_and_no_more() -> None:
    wide = "Wide[{}] many\n===\nMSG: my_msgs/Wide\nint8 a"
    assert len(leaves(wide.format(definitions.LEAVES_CAP + 1))) == definitions.LEAVES_CAP + 1
    for more in ("Wide[20001] many\nWide more", "Wide[20002] many", f"Wide[{'9' * 40}] many"):
        with pytest.raises(DefinitionError, match="without end"):
            leaves(more + "\n===\nMSG: my_msgs/Wide\nint8 a")


@pytest.mark.parametrize("name", ["sensor_msgs/msg/Imu", "sensor_msgs.msg.Imu", "sensor_msgs/Imu", "/sensor_msgs//Imu"])
def test_names_have_one_short_form(name: str) -> None:
    assert short_name(name) == "sensor_msgs/Imu"


def test_a_full_text_holds_everything_nested_once_and_reads_back() -> None:
    text = full_text("sensor_msgs/msg/Imu")
    parts = text.split("\n" + LINE + "\n")
    assert [part.splitlines()[0] for part in parts[1:]] == [
        "MSG: std_msgs/Header", "MSG: geometry_msgs/Quaternion", "MSG: geometry_msgs/Vector3",
        "MSG: builtin_interfaces/Time",
    ]  # fmt: skip
    paths = [leaf.path for leaf in flatten("sensor_msgs/Imu", text)]
    assert paths[:4] == ["header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "orientation.x"]
    assert paths[-1] == "linear_acceleration_covariance"
    own = full_text("my_msgs/Own", {"my_msgs/Own": "geometry_msgs/Point p"})
    assert [leaf.path for leaf in flatten("my_msgs/Own", own)] == ["p.x", "p.y", "p.z"]
