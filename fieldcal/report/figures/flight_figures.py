"""The paper's Figures 5–10 for one flight."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array, continuous, euler_angles
from fieldcal.names import Sensor, Status
from fieldcal.report.flight_curves import Curves, counting, covered_cells, lengths
from fieldcal.report.flight_data import FigureSettings
from fieldcal.report.page import Plot
from fieldcal.report.plot import INK, XYZ, backdrop, curve, headed, legend, panels, solid_panels, svg, without_wraps
from fieldcal.report.words import logged_unit, plain_name
from fieldcal.stages.tables import QUATERNION, matrix, seconds, triad

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPHERE_POINTS = 1500
QUEST_HZ = 9.0
"""Rate at which the paper's Figure 7 shows QUEST."""

QUATERNION_NAMES = ("ε₁", "ε₂", "ε₃", "δ")
RATE_NAMES = ("ε̇₁", "ε̇₂", "ε̇₃", "δ̇")


def unprocessed(tables: Mapping[str, pl.DataFrame], units: Mapping[str, str]) -> Plot | None:
    """Figure 5: readings as logged, and the orientation of the VPS."""
    signals = [
        (name, table)
        for name, table in (("magnetometer", "magnetometer"), ("accelerometer", "imu"), ("gyroscope", "imu"))
        if f"ingest.{table}" in tables and not np.isnan(matrix(tables[f"ingest.{table}"], triad(name))).all()
    ]
    aligned, logged = tables.get("vps_sync.vps_aligned"), tables.get("ingest.vps")
    if not signals and logged is None:
        return None
    origin = _origin(tables)
    shown = [*signals, ("vps", "")] if aligned is not None or logged is not None else signals
    figure, axes = panels((len(shown) + 1) // 2, 2, height_in=2.45 * ((len(shown) + 1) // 2) + 0.3)
    for axis in list(chain.from_iterable(axes))[len(shown) :]:
        axis.set_visible(False)
    for axis, (name, table) in zip(chain.from_iterable(axes), signals, strict=False):
        frame = tables[f"ingest.{table}"]
        t, values = seconds(frame["t_ns"], origin), matrix(frame, triad(name))
        for i, colour in enumerate(XYZ):
            curve(axis, t, values[:, i], colour, label="xyz"[i], width=0.8)
        headed(axis, f"{name} ({logged_unit(units.get(name)) or 'as logged'})")
        legend(axis)
    orientation = ""
    if len(shown) > len(signals):
        axis = list(chain.from_iterable(axes))[len(signals)]
        orientation = _orientation(axis, aligned, logged, origin)
        if signals and aligned is not None:
            axis.set_xlim(axes[0][0].get_xlim())
    for axis in axes[-1]:
        axis.set_xlabel("time (s)")
    caption = f"Figure 5. Unprocessed readings.{orientation}"
    return Plot(
        "figure-5", svg(figure, "figure-5", "Figure 5, unprocessed data", "Readings as logged against time"), caption
    )


def _orientation(axis: Axes, aligned: pl.DataFrame | None, logged: pl.DataFrame | None, origin: int) -> str:
    """Euler angles of the synchronised VPS; else its quaternion as logged, on its own clock."""
    if aligned is not None and not aligned.is_empty():
        t, angles = seconds(aligned["t_ns"], origin), euler_angles(continuous(matrix(aligned, QUATERNION)))
        for i, (name, colour) in enumerate(zip(("φ", "θ", "ψ"), XYZ, strict=True)):
            curve(axis, t, without_wraps(angles[:, i]), colour, label=name, width=0.8)
        headed(axis, "VPS orientation (rad)")
        legend(axis)
        return " Orientation: the VPS, put on the IMU's clock."
    assert logged is not None
    t, q = seconds(logged["t_ns"], int(logged["t_ns"][0])), matrix(logged, QUATERNION)
    for i, (name, colour) in enumerate(zip(QUATERNION_NAMES, (*XYZ, INK["c4"]), strict=True)):
        curve(axis, t, q[:, i], colour, label=name, width=0.8)
    headed(axis, "VPS quaternion as logged")
    legend(axis)
    return " The VPS is not synchronised: its quaternion as logged, on its own clock."


def _origin(tables: Mapping[str, pl.DataFrame]) -> int:
    """The stamp that time counts from: the first used sample where there is one, as in the other figures."""
    for name in ("smoothing.samples", "ingest.imu", "ingest.magnetometer", "ingest.vps"):
        if name in tables and not tables[name].is_empty():
            return int(tables[name]["t_ns"][0])
    return 0


def spheres(samples: pl.DataFrame, calibration: pl.DataFrame, settings: FigureSettings) -> list[Plot]:
    """Figure 6: calibrated readings on their spheres; and how much of each sphere they cover."""
    radii = {
        Sensor.MAGNETOMETER: (float(np.linalg.norm(settings.field_ned)), logged_unit(settings.field_unit)),
        Sensor.ACCELEROMETER: (settings.gravity_mps2, "m/s²"),
    }
    found = {name: vectors for name in radii if (vectors := lengths(samples, calibration, name)) is not None}
    if not found:
        return []
    figure, axes = solid_panels(2, height_in=4.4)
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    for axis in axes[len(found) :]:
        axis.set_visible(False)
    for axis, (name, vectors) in zip(axes, found.items(), strict=False):
        radius, own_unit = radii[name]
        if own_unit == "T":
            radius, own_unit, vectors = 1e6 * radius, "µT", 1e6 * vectors
        ball = radius * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
        axis.plot_wireframe(*ball, color=INK["muted"], linewidth=0.3, alpha=0.6)
        thin = vectors[:: -(-len(vectors) // SPHERE_POINTS)]
        axis.plot(*thin.T, ".", markersize=2, color=XYZ[0], linestyle="none")
        axis.set_box_aspect((1, 1, 1))
        headed(axis, f"{name}, radius {radius:.4g} {own_unit}")
        for label, setter in zip("xyz", (axis.set_xlabel, axis.set_ylabel, axis.set_zlabel), strict=True):
            setter(label, fontsize=8)
        axis.tick_params(labelsize=7, pad=-1)
    refused = [name for name in found if (counting(calibration, name)["status"] != Status.OK).any()]
    caption = "Figure 6. Calibrated readings (unsmoothed, sensor axes) on the sphere of the local field and of gravity"
    caption += f"; every {-(-max(map(len, found.values())) // SPHERE_POINTS)}th sample."
    if refused:
        caption += f" The fit of the {' and '.join(refused)} was refused: shown as fitted, not to be used."
    drawn = Plot(
        "figure-6",
        svg(figure, "figure-6", "Figure 6, spheres", "Calibrated readings on spheres in three dimensions"),
        caption,
    )
    return [drawn, _coverage(found)]


def _coverage(found: Mapping[Sensor, Array]) -> Plot:
    figure, axes = panels(1, 2, height_in=2.9)
    told = []
    for axis in axes[0][len(found) :]:
        axis.set_visible(False)
    for axis, (name, vectors) in zip(axes[0], found.items(), strict=False):
        cells = covered_cells(vectors)
        rows, columns = cells.shape
        share = float((cells > 0).mean())
        told.append(f"{name} {100 * share:.0f} %")
        strength = np.log1p(cells) / np.log1p(cells.max())
        for level in (0.25, 0.5, 0.75, 1.0):
            for i, j in np.argwhere((strength > level - 0.25) & (strength <= level)):
                left, bottom = -180 + 360 * j / columns, -1 + 2 * i / rows
                axis.fill(
                    (left, left + 360 / columns, left + 360 / columns, left),
                    (bottom, bottom, bottom + 2 / rows, bottom + 2 / rows),
                    color=INK["c1"],
                    alpha=0.15 + 0.8 * level,
                    linewidth=0,
                )
        axis.set(xlim=(-180, 180), ylim=(-1, 1), xticks=range(-180, 181, 90))
        axis.set_xlabel("azimuth about sensor z (°)")
        axis.set_ylabel("sine of elevation")
        headed(axis, f"{name}: {100 * share:.0f} % of directions")
    caption = (
        "Coverage of the spheres: directions sensed, in sensor axes. Every cell has the same solid angle; the stronger"
        f" its colour, the more samples (logarithmic). Covered: {', '.join(told)}."
    )
    return Plot("figure-coverage", svg(figure, "figure-coverage", "Coverage of the spheres", caption), caption)


def attitude(c: Curves, told: str) -> Plot:
    """Figure 7: the VPS and QUEST."""
    thin = slice(None, None, max(1, round(1.0 / (QUEST_HZ * float(np.median(np.diff(c.t)))))))
    vps = None if c.t_vps is None or c.q_vps is None else (c.t_vps, c.q_vps, "VPS")
    caption = f"Figure 7. Attitude estimates, QUEST thinned to about {QUEST_HZ:.0f} Hz as in the paper. {told}"
    return _four("figure-7", "Figure 7, attitude", vps, (c.t[thin], c.q[thin], "QUEST"), QUATERNION_NAMES, caption)


def equation_error(c: Curves, told: str) -> Plot | None:
    """Figure 8: the equation-error fit to the quaternion rates."""
    if c.q_dot is None or c.q_dot_model is None:
        return None
    caption = f"Figure 8. Equation-error fit to QUEST's quaternion rates (1/s, sensor axes). {told}"
    return _four(
        "figure-8",
        "Figure 8, equation error",
        (c.t, c.q_dot, "data"),
        (c.t, c.q_dot_model, "model"),
        RATE_NAMES,
        caption,
    )


def output_error(c: Curves, told: str) -> Plot | None:
    """Figure 9: the output-error fit to the attitude."""
    if c.propagated is None:
        return None
    caption = f"Figure 9. Output-error fit: the calibrated gyroscope integrated, beside QUEST (sensor axes). {told}"
    return _four(
        "figure-9",
        "Figure 9, output error",
        (c.t, c.q_sensor, "data"),
        (c.t, c.propagated, "model"),
        QUATERNION_NAMES,
        caption,
    )


def body_rates(c: Curves, told: str) -> Plot | None:
    """Figure 10: body rates of the VPS and of the calibrated gyroscope."""
    if not c.body_rate:
        return None
    figure, axes = panels(3, 1, height_in=5.4, sharex=True)
    for i in range(3):
        axis = axes[i][0]
        if c.t_vps is not None and c.vps_rate is not None:
            backdrop(axis, c.t_vps, c.vps_rate[:, i], "VPS")
        for (method, rate), colour in zip(c.body_rate.items(), (INK["c3"], INK["c2"], INK["c4"]), strict=False):
            dashes = "-" if method != "output_error" else "--"
            curve(axis, c.t, rate[:, i], colour, label=plain_name(method), width=0.9, dashes=dashes)
        axis.set_ylabel(f"ω{'xyz'[i]} (rad/s)")
    legend(axes[0][0])
    axes[2][0].set_xlabel("time (s)")
    missing = "" if c.t_vps is not None else " There is no VPS to compare with."
    caption = f"Figure 10. Body rates (FRD) from the calibrated, smoothed gyroscope and from the VPS.{missing} {told}"
    return Plot(
        "figure-10",
        svg(figure, "figure-10", "Figure 10, body rates", "Angular rate about each body axis against time"),
        caption,
    )


def _four(
    anchor: str,
    title: str,
    data: tuple[Array, Array, str] | None,
    model: tuple[Array, Array, str],
    names: tuple[str, ...],
    caption: str,
) -> Plot:
    """Four quaternion components, two curves each."""
    figure, axes = panels(2, 2, height_in=4.6, sharex=True)
    for i, (axis, name) in enumerate(zip(chain.from_iterable(axes), names, strict=True)):
        if data is not None:
            backdrop(axis, data[0], data[1][:, i], data[2])
        curve(axis, model[0], model[1][:, i], INK["c2"], label=model[2], width=0.9)
        headed(axis, name)
    legend(axes[0][0])
    for axis in axes[1]:
        axis.set_xlabel("time (s)")
    description = f"{title}: {' and '.join(part[2] for part in (data, model) if part is not None)} against time"
    return Plot(anchor, svg(figure, anchor, title, description), caption)
