"""The picture of a calibration: likelihood over clock offset, innovations before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybrid_ins.calibration.calibrate import Calibration
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.plotting.style import BLUE, DPI, MUTED, STYLE, VERMILLION, legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER = VERMILLION, BLUE
SIZE = (9.0, 6.5)  # inches


def figure(calibration: Calibration) -> Figure:
    """Draw a calibration on one page."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        page = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        panels: dict[str, Axes] = page.subplot_mosaic(
            [["offset", "offset"], ["innovations", "nis"]]
        )
        _draw_offset(panels["offset"], calibration.fitted)
        _draw_innovations(panels["innovations"], calibration)
        _draw_nis(panels["nis"], calibration)
        page.draw_without_rendering()  # places the panels, which legends are fitted to
        for axes in panels.values():
            legend_above(axes)
        return page


def _draw_offset(axes: Axes, fitted: Fit) -> None:
    total = fitted.profile.sum(axis=0)
    if len(fitted.recordings) > 1:
        for row in fitted.profile:
            axes.plot(fitted.grid, row - np.max(row), color=MUTED, lw=0.8)
    axes.plot(fitted.grid, total - np.max(total), color=AFTER, label="all recordings together")
    for k in range(len(fitted.recordings)):
        label = "estimate" if k == 0 else None
        axes.axvline(fitted.offset(k), color=AFTER, lw=0.8, ls=":", label=label)
    axes.set(
        title="log-likelihood of a clock offset",
        xlabel="clock offset added to the fixes' stamps [s]",
        ylabel="log-likelihood - maximum",
    )


def _draw_innovations(axes: Axes, calibration: Calibration) -> None:
    recording = calibration.fitted.recordings[0]
    for passes, colour, name in _both(calibration):
        used = np.isfinite(passes[0].nis)
        size = np.linalg.norm(passes[0].z[used][:, :2], axis=1)
        axes.plot(recording.aid_t[used], size, color=colour, lw=0.9, label=name)
    axes.set(title="horizontal innovation", xlabel=f"time in {recording.name} [s]", ylabel="m")


def _draw_nis(axes: Axes, calibration: Calibration) -> None:
    from scipy.stats import chi2

    for passes, colour, name in _both(calibration):
        nis = np.concatenate([one.nis[np.isfinite(one.nis)] for one in passes])
        axes.plot(np.sort(nis), (np.arange(len(nis)) + 0.5) / len(nis), color=colour, label=name)
    axis = np.geomspace(0.05, 100.0, 200)
    axes.plot(axis, chi2.cdf(axis, 3), color=MUTED, ls="--", label="chi-square(3)")
    axes.set(
        title="NIS of fixes",
        xscale="log",
        xlim=(0.05, 1000.0),
        xlabel="NIS of a fix",
        ylabel="share of fixes below",
    )


def _both(calibration: Calibration) -> tuple[tuple[Sequence[FilterPass], str, str], ...]:
    """Return the passes before and after the calibration, with colour and name."""
    return (calibration.before, BEFORE, "before"), (calibration.after, AFTER, "after")
