"""The picture of a calibration: likelihood over clock offset, innovations before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybrid_ins.calibration.calibrate import Calibration
from hybrid_ins.plotting.style import BLUE, VERMILLION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BEFORE, AFTER = VERMILLION, BLUE


def figure(calibration: Calibration) -> Figure:
    """Draw a calibration on one page."""
    from matplotlib.figure import Figure

    fitted = calibration.fitted
    page = Figure(figsize=(9.0, 6.5), layout="constrained")
    axes: dict[str, Axes] = page.subplot_mosaic([["offset", "offset"], ["innovations", "nis"]])
    top = axes["offset"]
    total = fitted.profile.sum(axis=0)
    for row in fitted.profile:
        if len(fitted.recordings) > 1:
            top.plot(fitted.grid, row - np.max(row), color="0.75", lw=0.8)
    top.plot(fitted.grid, total - np.max(total), color=AFTER, label="all recordings together")
    for k in range(len(fitted.recordings)):
        top.axvline(
            fitted.offset(k), color=AFTER, lw=0.8, ls=":", label="estimate" if k == 0 else None
        )
    top.set(
        xlabel="clock offset added to the fixes' stamps [s]",
        ylabel="log-likelihood - maximum",
    )
    top.legend()
    for passes, colour, name in (
        (calibration.before, BEFORE, "before"),
        (calibration.after, AFTER, "after"),
    ):
        first = passes[0]
        used = np.isfinite(first.nis)
        axes["innovations"].plot(
            fitted.recordings[0].aid_t[used],
            np.linalg.norm(first.z[used][:, :2], axis=1),
            color=colour,
            lw=0.9,
            label=name,
        )
        nis = np.concatenate([p.nis[np.isfinite(p.nis)] for p in passes])
        share = (np.arange(len(nis)) + 0.5) / len(nis)
        axes["nis"].plot(np.sort(nis), share, color=colour, label=name)
    axes["innovations"].set(
        xlabel=f"time in {fitted.recordings[0].name} [s]", ylabel="horizontal innovation [m]"
    )
    axes["innovations"].legend()
    from scipy.stats import chi2

    axis = np.geomspace(0.05, 100.0, 200)
    axes["nis"].plot(axis, chi2.cdf(axis, 3), color="0.4", ls="--", label="chi-square(3)")
    axes["nis"].set(
        xscale="log", xlim=(0.05, 1000.0), xlabel="NIS of a fix", ylabel="share of fixes below"
    )
    axes["nis"].legend()
    return page
