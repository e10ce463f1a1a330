"""Where the vehicle was: the horizontal track and the height over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybrid_ins.plotting.style import (
    BLACK,
    MUTED,
    SKY,
    VERMILLION,
    legend_above,
    thin,
    thin_path,
)
from hybrid_ins.plotting.view import RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_map(axes: Axes, view: RunView) -> None:
    """Draw the horizontal track: truth, estimate, fixes, rejected fixes, outages."""
    p = view.run.estimate.position_enu
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
    axes.plot(*p[0, :2], "o", ms=8, mfc="white", mec=BLACK, zorder=6, label="start")
    axes.plot(*p[-1, :2], "s", ms=7, mfc=BLACK, mec=BLACK, zorder=6, label="end")
    axes.set(xlabel="east [m]", ylabel="north [m]", title="track, map frame")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best")


def draw_height(axes: Axes, view: RunView) -> None:
    """Draw the height over time."""
    fixes, accepted = view.fix_positions()
    if len(fixes):
        at = view.since(view.to_imu(view.run.fixes.stamp_ns))
        axes.plot(at[accepted], fixes[accepted, 2], ".", ms=3, color=MUTED, label="fix")
    if view.truth is not None:
        at = view.since(view.to_imu(view.truth.stamp_ns))
        up = view.truth.position_enu[:, 2]
        axes.plot(*thin(at, up), color=BLACK, lw=2.2, label="truth")
    axes.plot(
        *thin(view.seconds, view.run.estimate.position_enu[:, 2]), color=SKY, label="estimate"
    )
    axes.set(ylabel="m", title="height above the datum")
    legend_above(axes)
