"""Poses among transforms, in both serialisations, as the package rosbags writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import STEP_NS, TRANSFORMS, Row, Truth, write_rosbag1, write_rosbag2
from logs_support import vehicle

from fieldcal.config.configuration import McapMap
from fieldcal.logs import read_log
from fieldcal.logs.encodings import transforms

N = 60
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Tree:
    """A vehicle in the world, a camera on it, another vehicle: frames of names of many lengths, by turns."""

    def __init__(self, *, ros1: bool) -> None:
        generator = np.random.default_rng(2)
        self.truth = Truth(N, ros1=ros1)
        self.position, self.quaternion = generator.normal(size=(N, 3)), generator.normal(size=(N, 4))
        self.rows: list[Row] = list(self.truth.rows)

    def add(self, parents: list[str], topic: str = "/tf") -> None:
        for i, t in enumerate((self.truth.t_ns + 5).tolist()):
            own = (t, parents[i % len(parents)], "quad", self.position[i].tolist(), self.quaternion[i].tolist())
            camera = (t + 1, "quad", "camera" + "x" * (i % 7), (9.0, 9.0, 9.0), IDENTITY)
            other = (t + 2, parents[0], "quad2", (8.0, 8.0, 8.0), IDENTITY)
            given = [camera, own, other] if i % 2 else [own]
            self.rows.append((topic, TRANSFORMS, t + STEP_NS // 2, self.truth.messages.transforms(given)))

    def write(self, tmp_path: Path) -> Path:
        self.rows.sort(key=lambda row: row[2])
        if self.truth.messages.ros1:
            return write_rosbag1(tmp_path / "a.bag", self.truth.messages, self.rows)
        return write_rosbag2(tmp_path / "bag", self.truth.messages, self.rows)


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize(
    "mapping",
    [
        McapMap(vps_frame="quad"),
        McapMap(vps_frame="/quad", vps_parent_frame="map"),
        McapMap(vps="/tf", vps_frame="quad"),
    ],
)
def test_poses_of_the_configured_frame_are_the_vps(tmp_path: Path, ros1: bool, mapping: McapMap) -> None:
    tree = Tree(ros1=ros1)
    tree.add(["map"])
    frames, summary = read_log(tree.write(tmp_path), vehicle(mcap=mapping))
    tree.truth.check(frames)
    vps = frames["vps"]
    assert vps["t_ns"].to_list() == (tree.truth.t_ns + 5).tolist()
    np.testing.assert_array_equal(vps.select("qx", "qy", "qz", "qw").to_numpy(), tree.quaternion)
    np.testing.assert_array_equal(vps.select("px_m", "py_m", "pz_m").to_numpy(), tree.position)
    assert summary.findings == []


def test_of_a_configured_frame_every_message_is_read_of_none_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transforms, "LOOKED_AT", 7)
    tree = Tree(ros1=False)
    tree.add(["map"])
    frames, _ = read_log(tree.write(tmp_path), vehicle(mcap=McapMap(vps_frame="quad")))
    assert len(frames["vps"]) == N
    message = tree.truth.messages.transforms([(5, "map", "quad", (1.0, 2.0, 3.0), IDENTITY)])
    payload = np.frombuffer(tree.truth.messages.payload(message, TRANSFORMS), np.uint8)
    starts, sizes = np.arange(20) * len(payload), np.full(20, len(payload))
    nobody = transforms.TransformDecoder(None, None)
    nobody.decode(np.tile(payload, 20), starts, sizes)
    assert nobody.seen.total() == 7


def test_a_frame_in_two_parents_is_read_in_one_of_them(tmp_path: Path) -> None:
    tree = Tree(ros1=False)
    tree.add(["map", "odom", "odom"])
    path = tree.write(tmp_path)
    frames, summary = read_log(path, vehicle(mcap=McapMap(vps_frame="quad")))
    assert len(frames["vps"]) == N // 3
    (finding,) = summary.findings
    assert (finding.code, finding.count) == ("ambiguous_topic", N - N // 3)
    frames, _ = read_log(path, vehicle(mcap=McapMap(vps_frame="quad", vps_parent_frame="odom")))
    np.testing.assert_array_equal(frames["vps"]["qx"].to_numpy(), tree.quaternion[np.arange(N) % 3 > 0, 0])


@pytest.mark.parametrize("mapping", [McapMap(), McapMap(vps="/tf")])
def test_without_a_frame_the_frames_are_told(tmp_path: Path, mapping: McapMap) -> None:
    tree = Tree(ros1=False)
    tree.add(["map"])
    frames, summary = read_log(tree.write(tmp_path), vehicle(mcap=mapping))
    tree.truth.check(frames)
    assert "vps" not in frames
    (finding,) = summary.findings
    assert finding.code == "unsupported_schema"
    assert "map → quad, map → quad2" in finding.sentence
    assert "mcap.vps_frame" in finding.sentence


@pytest.mark.parametrize("mapping", [McapMap(vps_frame="helicopter"), McapMap(vps_frame="quad", vps_parent_frame="x")])
def test_a_frame_that_is_not_there_is_told_with_those_that_are(tmp_path: Path, mapping: McapMap) -> None:
    tree = Tree(ros1=True)
    tree.add(["map"])
    frames, summary = read_log(tree.write(tmp_path), vehicle(mcap=mapping))
    tree.truth.check(frames)
    assert "vps" not in frames
    (finding,) = summary.findings
    assert finding.code == "missing_topic"
    assert "map → quad" in finding.sentence


def test_a_log_without_transforms_says_so(tmp_path: Path) -> None:
    tree = Tree(ros1=False)
    frames, summary = read_log(tree.write(tmp_path), vehicle(mcap=McapMap(vps_frame="quad")))
    tree.truth.check(frames)
    assert [finding.code for finding in summary.findings] == ["missing_topic"]


def test_static_transforms_are_no_vps(tmp_path: Path) -> None:
    tree = Tree(ros1=False)
    tree.add(["map"], "/tf_static")
    _, summary = read_log(tree.write(tmp_path), vehicle())
    assert summary.findings == []


def test_messages_that_are_cut_are_left_out_and_told(tmp_path: Path) -> None:
    """Of every length that a message can be cut to."""
    tree = Tree(ros1=False)
    tree.add(["map"])
    whole = tree.truth.messages.payload(tree.rows[-1][3], TRANSFORMS)
    from fieldcal.logs.encodings.transforms import TransformDecoder

    decoder = TransformDecoder("quad", None)
    cut = [whole[:size] for size in range(len(whole))]
    sizes = np.array([len(part) for part in [*cut, whole]], np.int64)
    data = np.frombuffer(b"".join([*cut, whole]), np.uint8)
    decoded = decoder.decode(data, np.cumsum(sizes) - sizes, sizes)
    assert decoded.malformed == len(cut)
    assert decoded.kept.tolist() == [len(cut)]
