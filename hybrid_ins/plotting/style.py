"""
What all pictures share: files, colours (Okabe and Ito's, safe for colour-blind readers), lines.

This package is the only one that imports matplotlib, and only when a picture is requested.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from hybrid_ins.errors import InputError
from hybrid_ins.output_file import check_output, replacing
from hybrid_ins.ros.messages.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

SUFFIXES = (".png", ".svg")

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
AXIS_COLOURS = (BLUE, ORANGE, GREEN)
SHADE = "#ECECEC"
MUTED = "#8A8A8A"
TEXT = "#333333"

DPI = 100
SMALLEST = 6.0  # points, of a text that is to be read
_TITLE_SPACE = 4.0  # pixels, between a title and the legend beside it
_POINTS = 1500  # per line: what a panel of this width can show
STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": TEXT,
    "axes.labelcolor": TEXT,
    "axes.edgecolor": "#B0B0B0",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E2E2E2",
    "grid.linewidth": 0.6,
    "xtick.color": TEXT,
    "ytick.color": TEXT,
    "legend.frameon": True,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
    "legend.borderpad": 0.2,
    "lines.linewidth": 1.1,
    "svg.hashsalt": "hybrid_ins",  # the same run gives the same file
}


def check(path: Path, inputs: Sequence[Path] = (), overwrite: bool = False) -> None:
    """
    Check, before the work, that a picture can be written to `path`.

    Raises
    ------
    InputError
        Unknown suffix, or matplotlib is not installed; for the rest see `output_file.check_output`.

    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a picture's name ends in {' or '.join(SUFFIXES)}")
    check_output(path, inputs, overwrite)
    require_matplotlib()


def require_matplotlib() -> None:
    """Raise `InputError` where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError('pictures need matplotlib: pip install "hybrid_ins[plot]"')


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, by the suffix of `path`, also in place of another."""
    check(path, overwrite=True)
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        write(figure, file, path.suffix.lower().removeprefix("."))


def write(figure: Figure, file: BinaryIO, kind: str) -> None:
    """Write a figure to an open file; `kind` is ``png`` or ``svg``."""
    from matplotlib import rc_context

    dated = {"Date": None} if kind == "svg" else {"Software": None}
    with rc_context(STYLE):
        figure.savefig(file, format=kind, dpi=DPI, metadata=dated)


def legend_above(axes: Axes) -> None:
    """Put the legend beside the title, outside the panel; a long title becomes smaller."""
    legend = axes.legend(
        ncols=4,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.99),
        borderaxespad=0.0,
        frameon=False,
        handlelength=0.9,
        columnspacing=0.7,
        handletextpad=0.4,
    )
    title = axes.set_title(axes.get_title(loc="left"), loc="left")
    fit_width(title, legend.get_window_extent().x0 - _TITLE_SPACE)


def legend_inside(axes: Axes) -> float:
    """Put the legend at the top of the panel, within its width; returns its share of the height."""
    panel = axes.get_window_extent()
    for columns in (4, 3, 2, 1):
        legend = axes.legend(ncols=columns, loc="upper right", fontsize=7.5)
        box = legend.get_window_extent()
        if box.width < 0.98 * panel.width:
            break
    return float(box.height / panel.height)


def fit_width(text: Text, right: float) -> None:
    """Make a text smaller until it ends before ``right`` [pixels from the left]."""
    size = float(text.get_fontsize())
    while text.get_window_extent().x1 > right and size > SMALLEST:
        size *= 0.97
        text.set_fontsize(size)


def rounded(value: float, digits: int) -> str:
    """Return a number as text, rounded to so many digits: 180, where ``.2g`` writes 1.8e+02."""
    return f"{float(f'{value:.{digits}g}'):g}"


def mark_missing(axes: Axes, why: str) -> None:
    """Write into an empty panel why it is empty."""
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center", color=MUTED)
    axes.set_yticks([])


def thin(at: Array, values: Array) -> tuple[Array, Array]:
    """
    Thin a long line to the minimum and maximum of every short interval.

    The line is broken where a longer time is missing and where a value is not finite.
    """
    values = np.where(np.isfinite(values), values, np.nan)
    if len(at) > 2 * _POINTS:
        length = -(-len(at) // _POINTS)
        pad = (0, length * _POINTS - len(at))
        table = np.pad(values, pad, mode="edge").reshape(_POINTS, length)
        first = np.arange(_POINTS) * length
        finite = np.isfinite(table)
        least = np.argmin(np.where(finite, table, np.inf), axis=1) + first
        most = np.argmax(np.where(finite, table, -np.inf), axis=1) + first
        keep = np.unique(np.minimum(np.concatenate((least, most)), len(at) - 1))
        at, values = at[keep], values[keep]
    steps = np.diff(at)
    longest = max(1.0, 10.0 * float(np.median(steps))) if len(steps) else 1.0
    gaps = np.flatnonzero(steps > longest) + 1
    return np.insert(at, gaps, np.nan), np.insert(values, gaps, np.nan)


def thin_band(at: Array, centre: Array, half: Array) -> tuple[Array, Array, Array]:
    """Thin a band around a line; returns time, lower and upper edge."""
    t, width = thin(at, half)
    return t, np.interp(t, at, centre) - width, np.interp(t, at, centre) + width


def thin_path(position: Array) -> tuple[Any, Any]:
    """Thin a path to its first two coordinates at every n-th point."""
    step = max(1, len(position) // (4 * _POINTS))
    return position[::step, 0], position[::step, 1]
