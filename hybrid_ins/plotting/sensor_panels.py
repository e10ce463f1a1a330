"""The fixes' normalised innovations, and the sensors' biases and noise variances over time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.evaluation.run import Series, Verdicts
from hybrid_ins.plotting.style import (
    AXIS_COLOURS,
    BLACK,
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    SKY,
    TEXT,
    VERMILLION,
    legend_above,
    legend_inside,
    mark_missing,
    thin,
    thin_band,
)
from hybrid_ins.plotting.view import RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_REJECTED = ((VERMILLION, "x"), (PURPLE, "^"), (ORANGE, "s"), (GREEN, "D"), (BLACK, "v"))
_LOWEST_NIS = 0.05  # of the panel
_LARGEST_LEGEND = 0.6  # of the height of its panel
_MOST_DECADES = 14.0  # of an axis


def draw_nis(axes: Axes, view: RunView) -> None:
    """Draw the NIS of each fix, the threshold, and the reasons of rejections."""
    v = view.run.verdicts
    axes.set(title="NIS of each fix", ylabel="NIS")
    if not len(v):
        mark_missing(axes, "no verdicts recorded")
        return
    at = view.since(view.to_imu(v.stamp_ns))
    first, last = view.span()
    within = (at >= first) & (at <= last)
    v, at = v.rows(within), at[within]
    if not len(v):
        mark_missing(axes, "no verdicts in this time")
        return
    position = v.kind == "position"
    tested = np.isfinite(v.nis) & (v.nis > 0.0)
    fused = tested & v.accepted & position
    limited = np.isfinite(v.threshold) & position
    axes.set(yscale="log", ylim=(_LOWEST_NIS, 100.0))  # for now: no autoscaling
    size = 4.0 if len(v) < 1000 else 2.0
    for kind, marker, colour, name in (
        (position, ".", BLUE, "accepted"),
        (~position, "+", SKY, "velocity accepted"),
    ):
        shown = tested & v.accepted & kind
        if np.any(shown):
            axes.plot(at[shown], v.nis[shown], marker, ms=size, color=colour, label=name)
    running = max(11, int(np.sum(fused)) // 40)  # fixes: some forty independent means
    if np.sum(fused) >= 2 * running:
        mean = np.convolve(v.nis[fused], np.ones(running) / running, mode="valid")
        middle = at[fused][running // 2 :][: len(mean)]
        axes.plot(*thin(middle, mean), color=BLACK, lw=1.3, label=f"mean of {running}")
    if np.any(fused):
        dof = float(np.median(v.dof[fused]))
        axes.axhline(dof, color=MUTED, lw=1.0, ls=":", label=f"expected {dof:g}")
    if np.any(limited):
        axes.plot(
            at[limited], v.threshold[limited], color=VERMILLION, lw=1.0, ls="--",
            drawstyle="steps-post", label="threshold",
        )  # fmt: skip
    rejections = _rejections(v)
    length = 32 if len(rejections) <= 2 else 24  # characters that leave room for the points
    for (colour, marker), (reason, shown) in zip(_REJECTED, rejections, strict=False):
        # Fixes that were rejected before the test have no NIS: they are at the lower edge.
        height = np.where(tested[shown], v.nis[shown], 1.6 * _LOWEST_NIS)
        axes.plot(
            at[shown], height, marker, ms=5, mew=1.4, color=colour,
            label=f"rejected: {_shortened(reason, length)} ({np.sum(shown)})",
        )  # fmt: skip
    sizes = np.concatenate((v.nis[tested], v.threshold[limited], [10.0]))
    decades = math.log10(2.0 * float(np.max(sizes)) / _LOWEST_NIS)
    room = min(legend_inside(axes) + 0.05, _LARGEST_LEGEND)
    axes.set_ylim(_LOWEST_NIS, _LOWEST_NIS * 10.0 ** min(decades / (1.0 - room), _MOST_DECADES))


def draw_bias(axes: Axes, view: RunView, sensor: str, scale: float, unit: str) -> None:
    """Draw the three biases of a sensor with 3 sigma, and the true ones where known."""
    axes.set(title=f"{sensor} bias ±3σ", ylabel=unit)
    series, true = _sensor_errors(view, f"{sensor}_bias")
    if series is None:
        mark_missing(axes, "not recorded")
        return
    at, values = view.since(series.stamp_ns), scale * series.values
    for axis, colour in enumerate(AXIS_COLOURS):
        if series.sigma is not None:
            t, low, high = thin_band(at, values[:, axis], 3 * scale * series.sigma[:, axis])
            axes.fill_between(t, low, high, color=colour, alpha=0.13, lw=0)
        axes.plot(*thin(at, values[:, axis]), color=colour, label="xyz"[axis])
    _true_lines(axes, view, true, scale)
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) and np.ptp(values) > 0.0:
        # The first sigma is often so large that it would flatten the rest.
        sigma = 0.0 if series.sigma is None else scale * float(np.median(series.sigma))
        margin = 0.1 * float(np.ptp(values)) + (3.5 * sigma if math.isfinite(sigma) else 0.0)
        axes.set_ylim(np.min(values) - margin, np.max(values) + margin)
    legend_above(axes)


def draw_noise(axes: Axes, view: RunView, sensor: str, unit: str) -> None:
    """Draw the noise variances of a sensor in use, their source, and the true ones."""
    axes.set(title=f"{sensor} q (noise variance in use)", ylabel=unit)
    series, true = _sensor_errors(view, f"{sensor}_noise")
    if series is None:
        mark_missing(axes, "not recorded")
        return
    axes.set_yscale("log")
    shown = [series.values, *([true.values] if true is not None else [])]
    positive = np.concatenate([rows[np.isfinite(rows) & (rows > 0.0)] for rows in shown])
    if len(positive):  # room for the source above, and for a constant
        axes.set_ylim(np.min(positive) / 5.0, np.max(positive) * 20.0)
    at = view.since(series.stamp_ns)
    for axis, colour in enumerate(AXIS_COLOURS):
        variance = np.where(series.values[:, axis] > 0.0, series.values[:, axis], np.nan)
        axes.plot(*thin(at, variance), color=colour, label="xyz"[axis])
    _true_lines(axes, view, true, 1.0)
    for index, (stamp_ns, source) in enumerate(view.run.noise_source):
        start = max(float(view.since(np.array(stamp_ns))), view.seconds[0])
        axes.axvline(start, color=MUTED, lw=0.8, ls=":")
        axes.annotate(
            source, (start, 0.9 - 0.12 * (index % 2)), xycoords=("data", "axes fraction"),
            xytext=(3, 0), textcoords="offset points", fontsize=8, color=TEXT,
            va="center", bbox={"fc": "white", "ec": "none", "pad": 0.5, "alpha": 0.8},
        )  # fmt: skip
    axes.minorticks_off()
    legend_above(axes)


def _sensor_errors(view: RunView, name: str) -> tuple[Series | None, Series | None]:
    true: Series | None = getattr(view.run.true_sensor_errors, name)
    return getattr(view.run.sensor_errors, name), true


def _true_lines(axes: Axes, view: RunView, true: Series | None, scale: float) -> None:
    if true is None:
        return
    at = view.since(true.stamp_ns)
    for axis in range(3):
        axes.plot(
            *thin(at, scale * true.values[:, axis]), color=BLACK, lw=0.9, ls="--",
            label="truth" if axis == 0 else None,
        )  # fmt: skip


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _rejections(verdicts: Verdicts) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return the reasons of rejections and their fixes, by frequency, rare ones together."""
    rejected = ~verdicts.accepted
    reasons, counts = np.unique(verdicts.reason[rejected], return_counts=True)
    ranked = [str(reason) for reason in reasons[np.argsort(-counts, kind="stable")]]
    named, rest = ranked[: len(_REJECTED) - 1], ranked[len(_REJECTED) - 1 :]
    groups = [(reason, rejected & (verdicts.reason == reason)) for reason in named]
    if rest:
        groups.append(("other", rejected & np.isin(verdicts.reason, rest)))
    return groups
