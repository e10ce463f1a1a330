"""Where the vehicle was: a map of the track and the height over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybrid_ins.plotting.style import (
    BLACK,
    MUTED,
    SKY,
    TEXT,
    VERMILLION,
    legend_above,
    thin,
    thin_path,
)
from hybrid_ins.plotting.view import RunView
from hybrid_ins.ros.messages.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.offsetbox import OffsetBox

_SCALE_BAR = 0.25  # of the width of the map, at most
SMALLEST_SPAN = 1.0  # m, of a map
_CORNERS = {
    "upper right": (1, 1),
    "upper left": (0, 1),
    "lower right": (1, 0),
    "lower left": (0, 0),
}
_CORNER_SIZE = 0.4, 0.3  # of the map, that a legend or scale bar may cover


def draw_map(axes: Axes, view: RunView) -> None:
    """Draw the horizontal track: truth, estimate, fixes, rejected fixes, outages."""
    p = view.estimate.position_enu
    for index, (start, stop) in enumerate(view.outages()):
        out = (view.seconds >= start) & (view.seconds <= stop)
        axes.plot(
            *thin_path(p[out]), color="#D9D9D9", lw=7, solid_capstyle="butt", zorder=1,
            label="no fix" if index == 0 else None,
        )  # fmt: skip
    fixes, accepted = view.fix_positions()
    if len(fixes):
        axes.plot(*fixes[accepted, :2].T, ".", ms=3, color=MUTED, zorder=2, label="fix", alpha=0.7)
    if view.truth is not None:
        axes.plot(*thin_path(view.truth.position_enu), color=BLACK, lw=2.2, zorder=3, label="truth")
    axes.plot(*thin_path(p), color=SKY, lw=1.1, zorder=4, label="estimate")
    if len(fixes) and not np.all(accepted):
        axes.plot(
            *fixes[~accepted, :2].T, "x", ms=6, mew=1.5, color=VERMILLION, zorder=5,
            label="rejected fix",
        )  # fmt: skip
    origin = view.start_position()
    axes.plot(*origin[:2], "o", ms=8, mfc="white", mec=BLACK, zorder=6, label="start")
    if np.linalg.norm(p[0, :2] - origin[:2]) > 0.0:
        axes.plot(*p[0, :2], "D", ms=5, mfc=SKY, mec=BLACK, zorder=6, label="first estimate")
    axes.plot(*p[-1, :2], "s", ms=7, mfc=BLACK, mec=BLACK, zorder=6, label="end")
    finish_map(axes, [p, fixes, *([] if view.truth is None else [view.truth.position_enu])])


def finish_map(axes: Axes, positions: Sequence[Array]) -> None:
    """
    Add equal axes, a scale bar, north, and the legend in the emptiest corners of a map.

    Parameters
    ----------
    axes : Axes
        With everything drawn.
    positions : sequence of ndarray, shape (N, 2 or 3)
        What is drawn, east and north [m].
    """
    from matplotlib.offsetbox import AnchoredOffsetbox

    axes.set(xlabel="east [m]", ylabel="north [m]", title="track, map frame")
    axes.set_aspect("equal", adjustable="datalim")
    _widen(axes)
    axes.apply_aspect()
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    shown = np.vstack([p[:: max(1, len(p) // 2000), :2] for p in positions])
    x, y = (shown[:, 0] - left) / (right - left), (shown[:, 1] - bottom) / (top - bottom)
    width, height = _CORNER_SIZE

    def covered(corner: str) -> int:
        east, north = _CORNERS[corner]
        return int(
            np.sum(
                ((x > 1.0 - width) if east else (x < width))
                & ((y > 1.0 - height) if north else (y < height))
            )
        )

    first, second = sorted(_CORNERS, key=covered)[:2]
    axes.legend(loc=first)
    box = AnchoredOffsetbox(second, child=_scale_and_north(axes, right - left), pad=0.3)
    box.patch.set(alpha=0.8, edgecolor="none")
    axes.add_artist(box)


def _widen(axes: Axes) -> None:
    """Show ``SMALLEST_SPAN`` at least: what lies within a vehicle that stands is no track."""
    low, high = axes.dataLim.get_points()
    if np.max(high - low) < SMALLEST_SPAN:
        centre = 0.5 * (low + high)
        axes.update_datalim([centre - 0.5 * SMALLEST_SPAN, centre + 0.5 * SMALLEST_SPAN])
        axes.autoscale_view()


def _scale_and_north(axes: Axes, width: float) -> OffsetBox:
    """Return a scale bar [m] that suits a map of some width, with an arrow to the north."""
    from matplotlib.offsetbox import AuxTransformBox, DrawingArea, HPacker, TextArea, VPacker
    from matplotlib.patches import Polygon, Rectangle

    length = _round_down(_SCALE_BAR * width)
    bar = AuxTransformBox(axes.transData)
    bar.add_artist(Rectangle((0.0, 0.0), length, 0.0, ec=TEXT, fc="none", lw=2.0))
    name = f"{length:g} m" if length < 1000.0 else f"{length / 1000.0:g} km"
    arrow = DrawingArea(10.0, 18.0)
    arrow.add_artist(Polygon([(5, 18), (0, 0), (5, 4), (10, 0)], closed=True, fc=TEXT, ec="none"))
    style = {"fontsize": 8.0, "color": TEXT}
    return HPacker(
        children=[
            VPacker(children=[bar, TextArea(name, textprops=style)], align="center", pad=0, sep=3),
            VPacker(children=[TextArea("N", textprops=style), arrow], align="center", pad=0, sep=1),
        ],
        align="bottom",
        pad=0,
        sep=8,
    )


def _round_down(value: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... that does not exceed `value`."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(decade * step for step in (5, 2, 1) if decade * step <= value)


def draw_height(axes: Axes, view: RunView) -> None:
    """Draw the height over time."""
    fixes, accepted = view.fix_positions()
    if len(fixes):
        at = view.since(view.to_imu(view.run.fixes.stamp_ns))
        axes.plot(at[accepted], fixes[accepted, 2], ".", ms=3, color=MUTED, label="fix")
    if view.truth is not None:
        at = view.since(view.truth_stamp_ns(view.truth))
        up = view.truth.position_enu[:, 2]
        axes.plot(*thin(at, up), color=BLACK, lw=2.2, label="truth")
    axes.plot(*thin(view.seconds, view.estimate.position_enu[:, 2]), color=SKY, label="estimate")
    axes.set(ylabel="m", title="height above the datum")
    legend_above(axes)
