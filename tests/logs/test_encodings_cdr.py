"""Bulk CDR against messages written and read one value at a time, by OMG's rules: random definitions and lengths."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic

from fieldcal.logs.encodings.decoded import Decoded, MissingField, UnsupportedSchema, Want
from fieldcal.logs.encodings.ros2_cdr import CdrDecoder, Pick

CODES = {
    "bool": "B", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ENCAPSULATIONS = {b"\0\0": (">", 8), b"\0\1": ("<", 8), b"\0\6": (">", 4), b"\0\7": ("<", 4)}
"""Byte order and largest alignment of CDR (XTypes 1.3, 7.6.3.1.2): PLAIN_CDR and PLAIN_CDR2, big and little endian."""

Value = float | bytes | list[float]


@dataclass
class Serialised:
    """A message's body that grows value by value; places are counted from behind the encapsulation."""

    encapsulation: bytes
    body: bytearray = field(default_factory=bytearray)

    def number(self, code: str, value: float) -> None:
        order, largest = ENCAPSULATIONS[self.encapsulation]
        size = struct.calcsize(code)
        self.body += bytes(-len(self.body) % min(size, largest))
        self.body += struct.pack(order + code, value)

    def value(self, type_name: str, value: Value) -> None:
        if type_name == "string":
            assert isinstance(value, bytes)
            self.number("I", len(value) + 1)
            self.body += value + b"\0"
        elif type_name.endswith("[]"):
            assert isinstance(value, list)
            self.number("I", len(value))
            for each in value:
                self.number(CODES[type_name[:-2]], each)
        else:
            for each in value if isinstance(value, list) else [value]:
                self.number(CODES[type_name.partition("[")[0]], each)

    def message(self) -> bytes:
        return self.encapsulation + b"\0\0" + bytes(self.body)


def random_value(rng: np.random.Generator, type_name: str) -> Value:
    if type_name == "string":
        return rng.bytes(int(rng.integers(0, 9)))
    base, _, count = type_name.partition("[")
    n = int(rng.integers(0, 5)) if count == "]" else int(count[:-1] or 0) if count else 1
    if base.startswith("float"):
        numbers = rng.normal(size=n).astype(np.float32).tolist()
    else:
        numbers = rng.integers(0, 100, n).tolist()
    return numbers if count else numbers[0]


def decode(messages: list[bytes], definition: str, wants: dict[str, Want], gap: int = 3) -> Decoded:
    """The messages in one buffer, `gap` bytes of something else between them."""
    starts, content = [], bytearray()
    for message in messages:
        content += b"\xee" * gap
        starts.append(len(content))
        content += message
    content += b"\xee" * gap
    sizes = np.array([len(message) for message in messages], np.int64)
    data = np.frombuffer(bytes(content), np.uint8)
    return CdrDecoder("my_msgs/msg/Any", definition, wants).decode(data, np.array(starts, np.int64), sizes)


TYPES = [*CODES, *(f"{name}[3]" for name in CODES), "string", "string", "int16[]", "uint8[]", "float64[]", "float32[]"]


@pytest.mark.parametrize("encapsulation", list(ENCAPSULATIONS))
@pytest.mark.parametrize("seed", range(12))
def test_every_number_behind_anything_is_where_it_was_written(encapsulation: bytes, seed: int) -> None:
    rng = np.random.default_rng(seed)
    types = [TYPES[i] for i in rng.integers(0, len(TYPES), 14)]
    definition = "\n".join(f"{type_name} f{i}" for i, type_name in enumerate(types))
    rows = [[random_value(rng, type_name) for type_name in types] for _ in range(20)]
    messages = []
    for row in rows:
        serialised = Serialised(encapsulation)
        for type_name, value in zip(types, row, strict=True):
            serialised.value(type_name, value)
        messages.append(serialised.message())
    fixed = [i for i, name in enumerate(types) if name != "string" and not name.endswith("[]")]
    wants = {f"v{i}": Want.of(f"f{i}", 3 if types[i].endswith("[3]") else 1) for i in fixed}
    decoded = decode(messages, definition, wants)
    assert decoded.kept.tolist() == list(range(20))
    assert decoded.stamp_ns is None
    for i in fixed:
        np.testing.assert_array_equal(decoded.values[f"v{i}"], np.array([row[i] for row in rows], float))
        alone = decode(messages, definition, {f"v{i}": wants[f"v{i}"]})
        np.testing.assert_array_equal(alone.values[f"v{i}"], decoded.values[f"v{i}"])


@pytest.mark.parametrize("seed", range(6))
def test_it_is_what_mcap_ros2_reads_one_by_one(seed: int) -> None:
    """Strings of changing length before nested messages, arrays of them and three paths to single numbers."""
    definition = "\n".join(
        [
            "std_msgs/Header header", "string unit", "Triple[2] pair", "uint8 kind", "float32 ax", "int16 ay",
            "float64 az", "string[2] names", "Triple one", "bool armed", "float64[3] mag", "=" * 80,
            "MSG: my_msgs/Triple", "int16 x", "float64 y", "int8 z", "=" * 80, "MSG: std_msgs/Header",
            "builtin_interfaces/Time stamp", "string frame_id",
        ]
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    layout = "int32 uint32 string string int16 float64 int8 int16 float64 int8 uint8 float32 int16 float64 string"
    layout += " string int16 float64 int8 bool float64[3]"
    messages = []
    for row in range(15):
        serialised = Serialised(b"\0\1")
        for type_name in layout.split():
            value = random_value(rng, type_name)
            serialised.value(type_name, b"abcdefgh"[: row % 5] if type_name == "string" else value)
        messages.append(serialised.message())
    read = generate_dynamic("my_msgs/msg/Any", definition)["my_msgs/msg/Any"]
    expected = [read(message) for message in messages]
    wants = {
        "second": Want.of("pair[1]", 3),
        "single": Want.of(("ax", "ay", "az"), 3),
        "mixed": Want.of(("one.z", "pair[0].x", "kind"), 3),
        "one": Want.of("one", 3),
        "mag": Want.of("mag", 3),
        "y": Want.of("one.y", 1),
    }
    decoded = decode(messages, definition, wants)
    stamps = [message.header.stamp for message in expected]
    np.testing.assert_array_equal(decoded.stamp_ns, [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps])
    rows = {
        "second": [[m.pair[1].x, m.pair[1].y, m.pair[1].z] for m in expected],
        "single": [[m.ax, m.ay, m.az] for m in expected],
        "mixed": [[m.one.z, m.pair[0].x, m.kind] for m in expected],
        "one": [[m.one.x, m.one.y, m.one.z] for m in expected],
        "mag": [list(m.mag) for m in expected],
        "y": [m.one.y for m in expected],
    }
    assert decoded.values.keys() == rows.keys()
    for name, values in rows.items():
        np.testing.assert_array_equal(decoded.values[name], values)


DEFINITION = "builtin_interfaces/Time stamp\nstring frame_id\nint8 kind\nfloat64[3] rate\nfloat64[] mag\nint8 last"
FIELDS = ("sec", "nanosec", "frame_id", "kind", "rate", "mag", "last")


def imu(
    row: int, mag: list[float], encapsulation: bytes = b"\0\1", frame: bytes = b"", *, up_to: str = "last"
) -> bytes:
    """A message of `DEFINITION`, or its beginning up to the end of a field."""
    types = ("int32", "uint32", "string", "int8", "float64[3]", "float64[]", "int8")
    values: tuple[Value, ...] = (5, row, frame, 1, [row + 0.25, row, -row], mag, 3)
    serialised = Serialised(encapsulation)
    for name, type_name, value in zip(FIELDS, types, values, strict=True):
        serialised.value(type_name, value)
        if name == up_to:
            break
    return serialised.message()


def test_a_chunk_of_every_encapsulation_comes_back_in_the_order_of_the_file() -> None:
    kinds = [*ENCAPSULATIONS] * 3
    frames = [b"", b"abc", b"abcdefgh"]
    messages = [imu(row, [1.0, row, 3.0], kind, frames[row % 3]) for row, kind in enumerate(kinds)]
    messages.insert(4, b"\0\3\0\0" + messages[0][4:])  # parameter list: not read
    wants = {"rate": Want.of("rate", 3), "mag": Want.of("mag", 3), "last": Want.of("last", 1)}
    decoded = decode(messages, DEFINITION, wants)
    assert decoded.kept.tolist() == [0, 1, 2, 3, *range(5, 13)]
    np.testing.assert_array_equal(decoded.stamp_ns, 5 * 10**9 + np.arange(12))
    np.testing.assert_array_equal(decoded.values["rate"], [[row + 0.25, row, -row] for row in range(12)])
    np.testing.assert_array_equal(decoded.values["mag"], [[1.0, row, 3.0] for row in range(12)])
    np.testing.assert_array_equal(decoded.values["last"], np.full(12, 3.0))


@pytest.mark.parametrize("stamped", [True, False])
def test_nothing_readable_gives_empty_arrays_of_the_right_shape(stamped: bool) -> None:
    definition = DEFINITION if stamped else "float64[3] rate\nfloat64 last"
    wants = {"rate": Want.of("rate", 3), "last": Want.of("last", 1)}
    for messages in ([b"\0\3\0\0" + bytes(60)], [b"\0\1", b""], [b"\0\1\0"], []):
        decoded = decode(messages, definition, wants)
        assert decoded.kept.size == 0
        assert {name: values.shape for name, values in decoded.values.items()} == {"rate": (0, 3), "last": (0,)}
        assert (decoded.stamp_ns is not None) == stamped
        assert decoded.stamp_ns is None or decoded.stamp_ns.shape == (0,)


def test_a_sequence_of_another_length_than_wanted_costs_its_message() -> None:
    lengths = [3, 0, 2, 4, 3, 1]
    messages = [imu(row, [float(row)] * n) for row, n in enumerate(lengths)]
    decoded = decode(messages, DEFINITION, {"mag": Want.of("mag", 3), "last": Want.of("last", 1)})
    assert decoded.kept.tolist() == [0, 4]
    np.testing.assert_array_equal(decoded.values["mag"], [[0.0] * 3, [4.0] * 3])
    passed = decode(messages, DEFINITION, {"last": Want.of("last", 1)})  # one that is passed over may be of any length
    np.testing.assert_array_equal(passed.values["last"], np.full(6, 3.0))


@pytest.mark.parametrize("frame", [[b""], [b"", b"abcd", b"abcdefghi"]])
@pytest.mark.parametrize("wanted", ["rate", "mag", "last"])
def test_a_message_is_read_exactly_where_it_holds_what_is_wanted(frame: list[bytes], wanted: str) -> None:
    """Cut at every length: kept from the byte on at which the wanted field is whole."""
    messages, whole = [], []
    for text in frame:
        sound, needed = imu(7, [1.0, 2.0, 3.0], frame=text), len(imu(7, [1.0, 2.0, 3.0], frame=text, up_to=wanted))
        messages += [sound[:size] for size in range(len(sound) + 1)]
        whole += [size >= needed for size in range(len(sound) + 1)]
    width = 1 if wanted == "last" else 3
    decoded = decode(messages, DEFINITION, {"wanted": Want.of(wanted, width)})
    assert decoded.kept.tolist() == np.flatnonzero(whole).tolist()
    truth = {"rate": [7.25, 7.0, -7.0], "mag": [1.0, 2.0, 3.0], "last": 3.0}[wanted]
    np.testing.assert_array_equal(decoded.values["wanted"], [truth] * sum(whole))


def test_messages_at_the_end_of_the_buffer_are_not_read_beyond_it() -> None:
    sound = imu(7, [1.0, 2.0, 3.0], frame=b"abc")
    for size in range(len(sound)):
        decoded = decode([sound, sound[:size]], DEFINITION, {"last": Want.of("last", 1)}, gap=0)
        assert decoded.kept.tolist() == [0]


def test_two_encapsulations_come_back_in_order() -> None:
    messages = [imu(row, [], kind) for row, kind in enumerate([b"\0\7", b"\0\1", b"\0\7"])]
    decoded = decode(messages, DEFINITION, {"rate": Want.of("rate", 3)})
    assert decoded.kept.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(decoded.values["rate"][:, 1], [0.0, 1.0, 2.0])


def test_the_longest_want_of_a_sequence_says_how_long_it_is() -> None:
    messages = [imu(0, [1.0, 2.0, 3.0]), imu(1, [4.0, 5.0, 6.0, 7.0])]
    decoded = decode(messages, DEFINITION, {"three": Want.of("mag", 3), "four": Want.of("mag", 4)})
    assert decoded.kept.tolist() == [1]
    np.testing.assert_array_equal(decoded.values["three"], [[4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(decoded.values["four"], [[4.0, 5.0, 6.0, 7.0]])


def test_neighbouring_numbers_are_gathered_at_once() -> None:
    """The fast path: one gather for each stretch of a value's numbers that lie side by side."""
    definition = "float64 w\nfloat64 x\nfloat64 y\nfloat64 z\nint8 k\nfloat64[3] v"
    wants = {
        "apart": Want.of(("z", "x", "y"), 3),
        "next": Want.of(("x", "y", "z"), 3),
        "split": Want.of(("y", "z", "k"), 3),
        "w": Want.of("w", 1),
        "own_x": Want.of("x", 1),
        "v": Want.of("v", 3),
    }
    assert CdrDecoder("my_msgs/msg/Any", definition, wants)._picks == [
        Pick(0, 3, 1, "apart", 0),
        Pick(0, 1, 2, "apart", 1),
        Pick(0, 1, 3, "next", 0),
        Pick(0, 2, 2, "split", 0),
        Pick(1, 0, 1, "split", 2),
        Pick(0, 0, 1, "w", 0),
        Pick(0, 1, 1, "own_x", 0),
        Pick(2, 0, 3, "v", 0),
    ]


def test_half_a_stamp_is_none() -> None:
    definition = "Clock stamp\nint8 x\n===\nMSG: my_msgs/Clock\nint32 sec"
    decoded = decode([b"\0\1\0\0" + struct.pack("<ib", 3, 7)], definition, {"x": Want.of("x", 1)})
    assert decoded.stamp_ns is None
    assert decoded.values["x"].tolist() == [7.0]


def test_lengths_that_lie_cost_their_own_message() -> None:
    sound = imu(7, [1.0, 2.0, 3.0], frame=b"abc")
    lying = bytearray(sound)
    lying[4 + 8 : 4 + 12] = (1 << 31).to_bytes(4, "little")
    decoded = decode([sound, bytes(lying), sound], DEFINITION, {"rate": Want.of("rate", 3)})
    assert decoded.kept.tolist() == [0, 2]


@pytest.mark.parametrize(("seconds", "nanoseconds"), [("sec", "nanosec"), ("seconds", "nsec")])
def test_stamps_before_1970_and_of_either_spelling(seconds: str, nanoseconds: str) -> None:
    definition = f"Clock stamp\nint8 x\n===\nMSG: my_msgs/Clock\nint32 {seconds}\nuint32 {nanoseconds}"
    message = b"\0\1\0\0" + struct.pack("<iIb", -3, 999_999_999, 7)
    decoded = decode([message], definition, {"x": Want.of("x", 1)})
    np.testing.assert_array_equal(decoded.stamp_ns, [-3 * 10**9 + 999_999_999])
    np.testing.assert_array_equal(decoded.values["x"], [7.0])


def test_a_field_must_have_the_numbers_that_are_wanted() -> None:
    definition = (
        "float64[2] two\nfloat64 x\nfloat64[3] three\nPair pair\n===\nMSG: my_msgs/Pair\nfloat64 x\nfloat64[2] y"
    )
    for path, width in (("two", 3), ("two", 1), ("three", 4), ("x", 3), ("pair", 3), ("none", 1), ("three", 1)):
        with pytest.raises(MissingField) as missing:
            decode([], definition, {"v": Want.of(path, width)})
        assert missing.value.path == path
        assert missing.value.available == ("two", "x", "three", "pair.x", "pair.y")
    with pytest.raises(MissingField, match=r"^pair\.y$"):
        decode([], definition, {"v": Want.of(("x", "pair.y", "x"), 3)})
    with pytest.raises(MissingField, match="x and x"):
        decode([], definition, {"v": Want.of(("x", "x"), 3)})


def test_what_stands_behind_the_wanted_fields_need_not_be_followed() -> None:
    definition = "float64 x\nwstring word\nfloat64 y"
    message = b"\0\1\0\0" + struct.pack("<d", 4.5)
    assert decode([message], definition, {"x": Want.of("x", 1)}).values["x"].tolist() == [4.5]
    with pytest.raises(UnsupportedSchema, match="word has a variable layout"):
        decode([message], definition, {"y": Want.of("y", 1)})
