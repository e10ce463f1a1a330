"""
Several runs on one page.

It shows their tracks on one map and their errors over one time axis, each with the three-sigma
bound that the filter states; without truth, the bounds alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybrid_ins.evaluation.result import Result
from hybrid_ins.evaluation.run import Run
from hybrid_ins.plotting.map_view import finish_map
from hybrid_ins.plotting.style import (
    BLACK,
    BLUE,
    DPI,
    GREEN,
    ORANGE,
    PURPLE,
    SHADE,
    SKY,
    STYLE,
    VERMILLION,
    mark_missing,
    require_matplotlib,
    rounded,
    thin,
    thin_path,
)
from hybrid_ins.plotting.view import RunView
from hybrid_ins.ros.messages.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
MOST_RUNS = len(COLOURS)
_SIZE = (16.0, 9.0)  # inches
_MARGINS = {"left": 0.045, "right": 0.99, "bottom": 0.055, "wspace": 0.14, "hspace": 0.28}
_LEGEND_COLUMNS = 2
_LONGEST_GAP_NS = 500_000_000  # between estimates that are interpolated


def comparison(runs: Sequence[tuple[str, Run, Result]]) -> Figure:
    """
    Draw several runs on one page.

    Parameters
    ----------
    runs : sequence of (str, Run, Result)
        Name, run and evaluation of each, at most ``MOST_RUNS``.

    Returns
    -------
    matplotlib.figure.Figure
        For `style.save`.
    """
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    views = _views(runs)
    with rc_context(STYLE):
        figure = Figure(figsize=_SIZE, dpi=DPI)
        rows = -(-len(views) // _LEGEND_COLUMNS)
        panels = 5 if len(views) == 2 else 4  # two runs also have a separation
        top = 0.95 - 0.025 * rows
        grid = figure.add_gridspec(panels, 2, width_ratios=(2, 3), top=top, **_MARGINS)
        track = figure.add_subplot(grid[:-1, 0])
        box = track.get_position()  # leaves room for its x label above the next panel's title
        track.set_position((box.x0, box.y0 + 0.02, box.width, box.height - 0.02))
        height = figure.add_subplot(grid[-1, 0])
        timed = [height, *(figure.add_subplot(grid[i, 1], sharex=height) for i in range(panels))]
        _draw_tracks(track, views)
        _draw_heights(height, views)
        _draw_errors(timed[1], views, "position", slice(0, 3), "position error", "m")
        _draw_errors(timed[2], views, "velocity", slice(0, 3), "body velocity error", "m/s")
        _draw_errors(timed[3], views, "attitude", slice(2, 3), "heading error", "deg")
        _draw_errors(timed[4], views, "attitude", slice(0, 2), "tilt error", "deg")
        if panels == 5:
            _draw_separation(timed[5], *views)
        for axes in timed:
            for start, stop in views[0].outages():
                axes.axvspan(start, stop, color=SHADE, zorder=0, lw=0)
            axes.tick_params(labelbottom=axes in (timed[0], timed[-1]))
        shaded = f"; shaded: no accepted fix in {runs[0][0]}" if runs[0][2].outages else ""
        for axes in (timed[0], timed[-1]):
            axes.set_xlabel("time [s]" + shaded)
        figure.legend(
            handles=[track.lines[k] for k in range(len(views))],
            labels=[_label(name, result) for name, _, result in runs],
            loc="upper left",
            bbox_to_anchor=(_MARGINS["left"] - 0.005, 0.995),
            ncols=_LEGEND_COLUMNS,
            fontsize=9.5,
            frameon=False,
        )
    return figure


def _views(runs: Sequence[tuple[str, Run, Result]]) -> list[RunView]:
    """Prepare all runs in the map and with the time origin of the first."""
    _, first, first_result = runs[0]
    views = [RunView(run, result) for _, run, result in runs]
    for view in views:
        view.set_origin(first_result.origin_ns)
        view.set_map(first.estimate.datum_lla)
    return views


def _label(name: str, result: Result) -> str:
    parts = [name]
    if result.prmse is not None:
        parts.append(f"PRMSE {rounded(result.prmse, 3)} m")
    for title, consistency in (("NEES", result.nees_position), ("NIS", result.nis_position)):
        if consistency is not None:
            parts.append(f"{title}/dof {rounded(consistency.per_dof, 3)}")
    if result.largest_outage_error is not None:
        parts.append(f"outages: largest {rounded(result.largest_outage_error, 3)} m")
    return " · ".join(parts)


def _draw_tracks(axes: Axes, views: Sequence[RunView]) -> None:
    widths = np.linspace(1.3, 3.2, len(views))[::-1]  # the runs below those above show beside them
    for view, colour, width in zip(views, COLOURS, widths, strict=False):
        axes.plot(*thin_path(view.estimate.position_enu), color=colour, lw=width, zorder=4)
    positions = [view.estimate.position_enu for view in views]
    if views[0].truth is not None:
        truth = views[0].truth.position_enu
        axes.plot(*thin_path(truth), color=BLACK, lw=4.5, alpha=0.5, zorder=3, label="truth")
        positions.append(truth)
    axes.plot(*views[0].start_position()[:2], "o", ms=8, mfc="white", mec=BLACK, label="start")
    finish_map(axes, positions)


def _draw_heights(axes: Axes, views: Sequence[RunView]) -> None:
    truth = views[0].truth
    if truth is not None:
        at = views[0].since(views[0].truth_stamp_ns(truth))
        axes.plot(*thin(at, truth.position_enu[:, 2]), color=BLACK, lw=2.4, alpha=0.5)
    for view, colour in zip(views, COLOURS, strict=False):
        axes.plot(*thin(view.seconds, view.estimate.position_enu[:, 2]), color=colour)
    axes.set(ylabel="m", title="height above the datum")


def _draw_errors(
    axes: Axes, views: Sequence[RunView], quantity: str, part: slice, title: str, unit: str
) -> None:
    """Draw the length of an error, and three times its standard deviation, of every run."""
    scale = math.degrees(1.0) if quantity == "attitude" else 1.0
    drawn = []
    for view, colour in zip(views, COLOURS, strict=False):
        at, error, sigma = view.error(quantity, part)
        if sigma is not None:
            axes.plot(*thin(at, 3.0 * scale * _length(sigma)), color=colour, lw=0.9, ls=":")
            drawn.append(3.0 * scale * _length(sigma))
        if error is not None:
            axes.plot(*thin(at, scale * _length(error)), color=colour)
            drawn.append(scale * _length(error))
    known = any(view.result.errors is not None for view in views)
    text = f"{title} (dotted: 3 × stated standard deviation)"
    if not known:
        text = f"{title.removesuffix(' error')}: 3 × stated standard deviation, no truth"
    axes.set(ylabel=unit, title=text)
    if not drawn:
        mark_missing(axes, "not known")
        return
    top = max((float(np.nanquantile(values, 0.99)) for values in drawn), default=0.0)
    usual = max(float(np.nanmedian(values)) for values in drawn)
    if top > 8.0 * usual > 0.0:  # outages would flatten the rest
        axes.set_yscale("log")
    elif top > 0.0:
        axes.set_ylim(0.0, 1.2 * top)


def _draw_separation(axes: Axes, first: RunView, second: RunView) -> None:
    """
    Draw how far two runs are apart, with the bound that holds for a filter and its smoother.

    Their difference has the covariance P - P_s: beyond three deviations of it, what the filter
    knew and what came later contradict each other.
    """
    bound = "dotted: 3σ that it has where one is the other smoothed"
    axes.set(ylabel="m", title=f"separation of the two ({bound})")
    one, other = first.estimate, second.estimate
    gap_ns = one.bracket_ns(other.stamp_ns)
    other = other.rows((gap_ns >= 0) & (gap_ns <= _LONGEST_GAP_NS))
    if not len(other):
        mark_missing(axes, "no common time")
        return
    one = one.at(other.stamp_ns)
    at = second.since(other.stamp_ns)
    apart = _length(other.position_enu - one.position_enu)
    axes.plot(*thin(at, apart), color=BLACK)
    if one.position_cov is not None and other.position_cov is not None:
        difference = one.position_cov - other.position_cov
        most = 3.0 * np.sqrt(np.abs(np.trace(difference, axis1=1, axis2=2)))
        axes.plot(*thin(at, most), color=BLACK, lw=0.9, ls=":")
    if np.nanmax(apart) > 8.0 * np.nanmedian(apart) > 0.0:  # outages would flatten the rest
        axes.set_yscale("log")


def _length(rows: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(rows**2, axis=1)), float)
