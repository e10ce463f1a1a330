"""
One run on one page.

It shows the track, the errors within the filter's own 3 sigma, the normalised innovations and the
reasons of rejected fixes, the biases and the process noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.result import Result
from hybrid_ins.evaluation.run import Run
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.plotting.error_panels import draw_error
from hybrid_ins.plotting.map_view import draw_height, draw_map
from hybrid_ins.plotting.sensor_panels import draw_bias, draw_nis, draw_noise
from hybrid_ins.plotting.style import (
    DPI,
    MUTED,
    SHADE,
    STYLE,
    fit_width,
    require_matplotlib,
    rounded,
    save,
)
from hybrid_ins.plotting.view import RunView
from hybrid_ins.resources import shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE = (16.0, 10.0)  # inches; at _DPI the picture has 1600 x 1000 pixels
_MARGINS = {
    "left": 0.043, "right": 0.99, "bottom": 0.048, "top": 0.93, "wspace": 0.16, "hspace": 0.3,
}  # fmt: skip


def overview(run: Run, result: Result) -> Figure:
    """
    Draw one run on one page.

    Parameters
    ----------
    run : Run
        As recorded; panels without data say so.
    result : Result
        Its evaluation; without truth the error panels show the filter's sigma alone.

    Returns
    -------
    matplotlib.figure.Figure
        For `style.save`.

    """
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=_SIZE, dpi=DPI)
        headline = figure.suptitle(
            _headline(run, result), x=_MARGINS["left"], y=0.985, ha="left", fontsize=11.5
        )
        fit_width(headline, _MARGINS["right"] * _SIZE[0] * DPI)
        grid = figure.add_gridspec(5, 3, **_MARGINS)
        track = figure.add_subplot(grid[0:3, 0])
        box = track.get_position()  # leaves room for its x label above the next panel's title
        track.set_position((box.x0, box.y0 + 0.02, box.width, box.height - 0.02))
        height = figure.add_subplot(grid[3, 0])
        timed = [height, figure.add_subplot(grid[4, 0], sharex=height)]
        timed += [figure.add_subplot(grid[i, j], sharex=height) for j in (1, 2) for i in range(5)]
        view = RunView(run, result)
        draw_map(track, view)
        draw_height(timed[0], view)
        body = "body velocity error"
        draw_error(timed[1], view, "velocity", (0, 1, 2), body, "m/s", ("x", "y", "z"))
        for axis, name in enumerate(("east", "north", "up")):
            draw_error(timed[2 + axis], view, "position", [axis], f"{name} error", "m")
        draw_error(timed[5], view, "attitude", [2], "heading error", "deg")
        draw_error(timed[6], view, "attitude", (0, 1), "tilt error", "deg", ("E", "N"))
        draw_nis(timed[7], view)
        draw_bias(timed[8], view, "accelerometer", 1.0, "m/s²")
        draw_bias(timed[9], view, "gyroscope", math.degrees(1.0), "deg/s")
        draw_noise(timed[10], view, "accelerometer", "(m/s²)²")
        draw_noise(timed[11], view, "gyroscope", "(rad/s)²")
        _finish(view, timed, bottom=(timed[1], timed[6], timed[11]))
    return figure


def _headline(run: Run, result: Result) -> str:
    parts = [shortened(run.name, 60)]
    if result.prmse is not None and result.pmae is not None:
        parts += [
            f"PRMSE {rounded(result.prmse, 3)} m",
            f"PMAE {rounded(result.pmae, 3)} m",
        ]
    if result.heading_rmse is not None:
        parts.append(f"heading RMSE {rounded(math.degrees(result.heading_rmse), 2)}°")
    elif not result.heading_known:
        parts.append("heading never known")
    for name, consistency in (
        ("position NEES", result.nees_position),
        ("NIS", result.nis_position),
    ):
        if consistency is not None:
            parts.append(
                f"{name} {rounded(consistency.per_dof, 3)} per dof ({consistency.verdict})"
            )
    outage_error = result.outage_error(50)
    if outage_error is not None:
        parts.append(f"outage end {rounded(outage_error, 2)} m (median)")
    return "   ·   ".join(parts)


def _finish(view: RunView, timed: Sequence[Axes], bottom: Sequence[Axes]) -> None:
    """Shade outages, mark the start of scoring, and label the time axes."""
    for axes in timed:
        for start, stop in view.outages():
            axes.axvspan(start, stop, color=SHADE, zorder=0, lw=0)
        if view.result.scoring.skip > 0.0:
            axes.axvline(
                view.scoring_start(), color=MUTED, lw=0.8, ls="--", label="_scored from here"
            )
        axes.tick_params(labelbottom=axes in bottom)
    timed[0].set_xlim(*view.span())
    for axes in bottom:
        axes.set_xlabel(
            "time [s]"
            + ("; shaded: no accepted fix" if view.result.outages else "")
            + ("; dashed: scoring begins" if view.result.scoring.skip > 0.0 else "")
        )


def plot_bag(path: Path, picture: Path) -> None:
    """
    Draw the run in a bag, against its truth where that can be scored.

    Raises
    ------
    InputError
        The bag holds no estimate, or the picture cannot be written.

    """
    run = read_run(path)
    try:
        result = evaluate_run(run)
    except InputError:  # no epoch to score: the picture shows the estimate alone
        run = replace(run, truth=None)
        result = evaluate_run(run)
    save(overview(run, result), picture)
