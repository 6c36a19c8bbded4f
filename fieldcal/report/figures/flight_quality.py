"""What a flight's residuals look like, and which samples were trusted."""

from __future__ import annotations

from itertools import chain

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor
from fieldcal.report.flight_curves import Curves, amplitude_spectrum, lengths
from fieldcal.report.flight_data import FigureSettings
from fieldcal.report.page import Plot
from fieldcal.report.plot import INK, curve, headed, legend, panels, svg
from fieldcal.report.words import plain_name
from fieldcal.stages.tables import seconds


def spectra(c: Curves, samples: pl.DataFrame, calibration: pl.DataFrame, settings: FigureSettings) -> Plot | None:
    """Amplitude spectra of the residuals of every step, log-log."""
    wanted: list[tuple[str, str, list[tuple[str, tuple[Array, Array] | None]]]] = []
    radii = {
        Sensor.MAGNETOMETER: float(np.linalg.norm(settings.field_ned)),
        Sensor.ACCELEROMETER: settings.gravity_mps2,
    }
    vectors: list[tuple[str, tuple[Array, Array] | None]] = []
    for sensor, radius in radii.items():
        own = lengths(samples, calibration, sensor)
        if own is not None and len(own) == len(c.t):
            relative = (np.linalg.norm(own, axis=1) / radius - 1.0)[:, None]
            vectors.append((str(sensor), amplitude_spectrum(c.t, relative, c.segment)))
    wanted.append(("length of the vectors, relative", "1/√Hz", vectors))
    if c.attitude_error_deg is not None and c.t_vps is not None and c.near is not None:
        t = c.t_vps[c.near]
        wanted.append(
            (
                "attitude, QUEST less VPS",
                "°/√Hz",
                [("QUEST", amplitude_spectrum(t, c.attitude_error_deg, np.zeros(len(t))))],
            )
        )
    equations = []
    if c.q_dot is not None and c.q_dot_model is not None:
        equations.append(("equation error", amplitude_spectrum(c.t, c.q_dot - c.q_dot_model, c.segment)))
    wanted.append(("quaternion rate, data less model", "1/s/√Hz", equations))
    rates = []
    if c.t_vps is not None and c.vps_rate is not None and c.near is not None and c.near.any():
        t = c.t_vps[c.near]
        for method, rate in c.body_rate.items():
            own = np.column_stack([np.interp(t, c.t, column) for column in rate.T])
            spectrum = amplitude_spectrum(t, own - c.vps_rate[c.near], np.zeros(len(t)))
            rates.append((plain_name(method), spectrum))
    wanted.append(("body rate, gyroscope less VPS", "rad/s/√Hz", rates))
    shown = [(title, per, [(n, s) for n, s in lines if s is not None]) for title, per, lines in wanted]
    shown = [entry for entry in shown if entry[2]]
    if not shown:
        return None
    figure, axes = panels((len(shown) + 1) // 2, 2, height_in=2.5 * ((len(shown) + 1) // 2) + 0.3)
    for axis in list(chain.from_iterable(axes))[len(shown) :]:
        axis.set_visible(False)
    for axis, (title, per, lines) in zip(chain.from_iterable(axes), shown, strict=False):
        for (name, spectrum), colour in zip(lines, (INK["c1"], INK["c2"], INK["c3"]), strict=False):
            assert spectrum is not None
            axis.loglog(*_by_octave_shares(*spectrum), color=colour, linewidth=1.0, label=name)
        headed(axis, f"{title} ({per})")
        legend(axis, 1, inside="lower left")
    for axis in list(chain.from_iterable(axes))[max(0, len(shown) - 2) : len(shown)]:
        axis.set_xlabel("frequency (Hz)")
    caption = (
        "Residual spectra: amplitude spectral density of each step's residual (Welch, longest stretch without a gap;"
        " channels summed). A rise at the manoeuvre's frequencies, below a few hertz, is a model error; what is"
        " flat is noise."
    )
    return Plot("figure-spectra", svg(figure, "figure-spectra", "Residual spectra", caption), caption)


def _by_octave_shares(f: Array, x: Array, shares: int = 24) -> tuple[Array, Array]:
    """A spectrum thinned evenly in log frequency: root mean square within each 1/24 octave."""
    index = np.floor(shares * np.log2(f / f[0]) + 1e-9).astype(int)
    _, start = np.unique(index, return_index=True)
    size = np.diff(np.r_[start, len(f)])
    power = np.add.reduceat(x * x, start) / size
    return np.exp(np.add.reduceat(np.log(f), start) / size), np.sqrt(power)


def trust(attitude: pl.DataFrame, segments: pl.DataFrame | None, settings: FigureSettings) -> Plot:
    """Which samples the attitude trusts: excess lengths of both vectors, weight, and the excited segments."""
    origin = int(attitude["t_ns"][0])
    t = seconds(attitude["t_ns"], origin)
    figure, axes = panels(3, 1, height_in=4.6, sharex=True)
    for row, (column, title) in enumerate(
        (
            ("acceleration_excess_mps2", "accelerometer length less gravity (m/s²)"),
            ("field_excess", "magnetometer length over the local field, less 1"),
            ("weight", "weight of the attitude, 0 to 1"),
        )
    ):
        curve(axes[row][0], t, attitude[column].to_numpy(), INK["c1"], width=0.8)
        headed(axes[row][0], title)
    gate = settings.gate_norm
    if gate is not None:
        for side in (-1, 1):
            axes[0][0].axhline(side * gate * settings.gravity_mps2, color=INK["warn"], linewidth=0.8, linestyle="--")
    axes[2][0].set_ylim(-0.05, 1.1)
    if segments is not None:
        for start, end, used in segments.select("start_ns", "end_ns", "used").iter_rows():
            shade = INK["c3"] if used else INK["muted"]
            for axis in chain.from_iterable(axes):
                axis.axvspan((start - origin) * 1e-9, (end - origin) * 1e-9, color=shade, alpha=0.08, linewidth=0)
    axes[2][0].set_xlabel("time (s)")
    caption = "Gates. Smoothed readings; shaded: excited segments (green used, grey not)."
    if gate is not None:
        caption += f" Dashed: the accelerometer's gate, {100 * gate:.3g} % of gravity."
    return Plot("figure-gates", svg(figure, "figure-gates", "Gates", "Excess lengths and weight against time"), caption)
