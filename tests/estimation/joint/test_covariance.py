"""The joint covariance: by its definition written out, and what it advises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_record import small

from fieldcal.estimation.joint.covariance import advice, inverse_information, noise_of, sums_of_rows
from fieldcal.estimation.joint.measurement_model import Rows
from fieldcal.estimation.joint.problem import Model
from fieldcal.estimation.statistics import coloured_information, variance_by_blocks
from fieldcal.geometry.rotation import Array


def test_an_information_is_inverted_whatever_its_units() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 5))
    units = np.array([1.0, 1e6, 1e-6, 10.0, 1e3])
    information = (root.T @ root) * np.outer(units, units)
    expected = np.linalg.inv(root.T @ root) / np.outer(units, units)
    np.testing.assert_allclose(inverse_information(information), expected, rtol=1e-8)


class Given:
    """Numbers of the right shapes: two chunks of rows, six residuals each, with poses and without."""

    def __init__(self, *, strong: float = 1.0) -> None:
        rng = np.random.default_rng(2)
        self.model: Model = small(missing=False).model
        knots = self.model.knots
        self.k, self.m, self.r, self.p = len(knots.index), len(self.model.at), 6, 4
        half = 7
        edge = int(knots.index[half])
        self.spans = [(slice(0, half), slice(0, edge)), (slice(half, self.k), slice(edge, self.m))]
        self.by_knot, self.by_parameter = (rng.normal(size=(self.m, self.r, c)) for c in (6, self.p))
        self.residual = strong * rng.normal(size=(self.m, self.r))
        self.ends = rng.normal(size=(self.k, 3, self.p))
        self.response = rng.normal(size=(self.k, 12, self.p))
        self.whitening = rng.uniform(0.5, 2.0, size=(self.m, self.r)) * (rng.uniform(size=(self.m, self.r)) > 0.1)
        self.jumps = strong * rng.normal(size=(self.k - 1, 3)), rng.uniform(0.5, 2.0, size=self.k - 1)
        self.process = rng.normal(size=(self.k, 9, self.p)), strong * rng.normal(size=(self.k, 9))
        self.poses = rng.normal(size=(self.k, 3, self.p)), strong * rng.normal(size=(self.k, 3))
        for x in self.poses:
            x[::5] = 0.0  # poses that are not used
        root = rng.normal(size=(self.p, self.p))
        self.information = 1e3 * (root.T @ root + np.eye(self.p))

    def rows(self) -> list[tuple[slice, Rows, Array]]:
        return [
            (
                knots,
                Rows(rows, self.residual[rows], self.by_knot[rows], self.by_parameter[rows], np.zeros(0)),
                self.ends[knots],
            )
            for knots, rows in self.spans
        ]

    def found(self, *, poses: bool) -> Array:
        noise = noise_of(
            self.model, sums_of_rows(self.model, iter(self.rows()), self.response, self.whitening), self.response,
            self.jumps, self.process, self.poses if poses else None,
        )  # fmt: skip
        inverse = inverse_information(self.information)
        larger = noise.enlargement(inverse, np.diagonal(inverse))
        return inverse * np.outer(larger, larger)

    def by_loops(self, *, poses: bool) -> tuple[Array, Array]:
        """Diagonals of the inverse enlarged by colour, and of the variance by blocks."""
        knots, root = self.model.knots, np.sqrt(self.whitening)
        states = [0, 1, 2, 6, 7, 8]
        sums, left, count = np.zeros((self.k, 6, self.p)), np.zeros((self.k, 6)), np.zeros((self.k, 6))
        score = np.zeros((self.k, self.p))
        for i in range(self.m):
            knot, share = int(knots.of_sample[i]), float(knots.share[i])
            after = min(knot + 1, self.k - 1)
            of_knots = (1.0 - share) * self.response[knot][states] + share * self.response[after][states]
            seen = (self.by_parameter[i] - self.by_knot[i] @ of_knots) * root[i][:, None]
            sums[knot] += seen
            left[knot] += self.residual[i] * root[i]
            count[knot] += root[i] > 0.0
            score[knot] += (self.residual[i] * root[i]) @ seen
        per = np.sqrt(np.maximum(count, 1.0))
        groups = [(sums[:, j] / per[:, j, None], left[:, j] / per[:, j]) for j in range(6)]
        jumped, jump = np.zeros((self.k, 3, self.p)), np.zeros((self.k, 3))
        for k in range(self.k - 1):
            by = self.response[k + 1, :3] - self.response[k, :3] + self.ends[k]
            jumped[k], jump[k] = by * self.jumps[1][k], self.jumps[0][k] * self.jumps[1][k]
            score[k] += jump[k] @ jumped[k]
        jumped[-1] = self.ends[-1] * 0.0
        groups += [(jumped[:, j], jump[:, j]) for j in range(3)]
        for k in range(self.k):
            score[k] += self.process[1][k] @ self.process[0][k]
            if poses:
                score[k] += self.poses[1][k] @ self.poses[0][k]
        excess = np.zeros((self.p, self.p))
        for s, e in groups:
            excess += coloured_information(s[:, None, :], e[:, None]) / np.mean(e**2) - s.T @ s
        if poses:
            s, e = self.poses
            excess += coloured_information(s, e) / np.mean(e[e[:, 0] != 0.0] ** 2) - np.einsum("kcp,kcq->pq", s, s)
        inverse = np.linalg.inv(self.information)
        elapsed = np.concatenate([[0.0], np.cumsum(np.where(knots.joined, knots.interval_s, 0.0))])
        return np.diagonal(inverse + inverse @ excess @ inverse), variance_by_blocks(score @ inverse, elapsed)


@pytest.mark.parametrize("poses", [False, True])
def test_colour_and_scores_by_blocks_enlarge_it_as_defined(poses: bool) -> None:
    """Sums over intervals by loops over rows; of each parameter the larger variance, correlations kept."""
    given = Given()
    given.ends[-1] = 0.0
    coloured, _ = given.by_loops(poses=poses)
    inverse = np.linalg.inv(given.information)
    enlarged = np.sqrt(np.maximum(1.0, coloured / np.diagonal(inverse)))
    assert (enlarged > 1.0).any()
    np.testing.assert_allclose(given.found(poses=poses), inverse * np.outer(enlarged, enlarged), rtol=1e-8)


def test_blocks_of_a_long_record_enlarge_it_too() -> None:
    """The same numbers as of a record of half a minute, whose scores are far larger than its information says."""
    for poses in (False, True):
        given = Given(strong=100.0)
        given.ends[-1] = 0.0
        knots = replace(given.model.knots, interval_s=np.full(given.k - 1, 3.0))
        given.model = replace(given.model, knots=knots)
        coloured, by_blocks = given.by_loops(poses=poses)
        inverse = np.linalg.inv(given.information)
        assert (by_blocks > coloured).all()
        enlarged = np.sqrt(by_blocks / np.diagonal(inverse))
        np.testing.assert_allclose(given.found(poses=poses), inverse * np.outer(enlarged, enlarged), rtol=1e-8)


def test_no_residual_enlarges_nothing() -> None:
    given = Given(strong=0.0)
    expected = np.linalg.inv(given.information)
    np.testing.assert_allclose(given.found(poses=True), expected, rtol=1e-8)


LAYOUT = {"gyroscope": slice(0, 6), "accelerometer": slice(6, 12), "magnetometer": slice(12, 18), "dip": slice(18, 19)}
TURNED = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # x up, y astern, z to starboard


def told(weak: dict[tuple[str, int], float], *, dip: float = 1.1, axes: Array | None = None) -> str:
    flight = small()
    sd = np.full(19, 0.5)
    for name, columns in LAYOUT.items():
        if name in flight.model.triads:
            sd[columns][:3] = 0.0099 * np.abs(flight.state.values[name][:3])
    for (name, axis), relative in weak.items():
        sd[LAYOUT[name].start + axis] = relative * abs(flight.state.values[name][axis])
    state = replace(flight.state, values={**flight.state.values, "dip": np.array([dip])})
    return advice(flight.model, state, LAYOUT, np.diag(sd**2), np.eye(3) if axes is None else axes)


def test_scales_known_to_one_per_cent_need_no_advice() -> None:
    assert told({}) == ""
    assert "(sd 1.1 %)" in told({("gyroscope", 0): 0.0105})


@pytest.mark.parametrize(
    ("name", "axis", "dip", "turn"),
    [
        ("gyroscope", 0, 1.1, "roll"),
        ("gyroscope", 1, 1.1, "pitch"),
        ("gyroscope", 2, 1.1, "yaw"),
        ("accelerometer", 0, 0.1, "pitch"),
        ("accelerometer", 1, 0.1, "roll"),
        ("accelerometer", 2, 0.1, "roll and of pitch"),
        ("magnetometer", 0, 1.1, "pitch"),
        ("magnetometer", 1, -1.1, "roll"),
        ("magnetometer", 2, 1.1, "roll and of pitch"),
        ("magnetometer", 0, 0.75, "yaw"),
        ("magnetometer", 0, 0.82, "pitch"),
        ("magnetometer", 1, -0.75, "yaw"),
        ("magnetometer", 2, 0.1, "roll and of pitch"),
    ],
)
def test_the_weakest_scale_s_turn_is_named(name: str, axis: int, dip: float, turn: str) -> None:
    """In the vehicle's axes: a rotation of the sensor's."""
    text = told({(name, axis): 0.05}, dip=dip)
    expected = (
        f"The {name}'s {'xyz'[axis]} scale is the weakest (sd 5.0 %): add 60° of {turn} either way, several times."
    )
    assert text == expected
    sensor = {2: 0, 0: 1, 1: 2}[axis]  # which lies along the vehicle's axis there
    turned = told({(name, sensor): 0.05}, dip=dip, axes=TURNED)
    assert turned.split("add ")[1] == expected.split("add ")[1]


def test_other_weak_scales_are_told_too_the_weakest_first() -> None:
    text = told({("gyroscope", 0): 0.02, ("magnetometer", 2): 0.031, ("accelerometer", 1): 0.025})
    assert text.startswith("The magnetometer's z scale is the weakest (sd 3.1 %)")
    assert text.endswith(" Above 1 % too: accelerometer y 2.5 %, gyroscope x 2.0 %.")
