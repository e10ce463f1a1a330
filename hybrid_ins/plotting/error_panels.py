"""How large the errors are, within the standard deviations that the filter states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.plotting.style import (
    AXIS_COLOURS,
    BLUE,
    MUTED,
    SKY,
    legend_above,
    mark_missing,
    rounded,
    thin,
    thin_band,
)
from hybrid_ins.plotting.view import RunView
from hybrid_ins.ros.messages.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LINEAR_SHARE = 1.5  # decades, width of the linear part of a symmetric logarithmic axis


def draw_error(
    axes: Axes,
    view: RunView,
    quantity: str,
    columns: Sequence[int],
    title: str,
    unit: str,
    names: Sequence[str] = ("",),
) -> None:
    """
    Draw components of an error over time with the filter's own 3-sigma band.

    Parameters
    ----------
    axes : Axes
    view : RunView
    quantity : str
        ``position`` (m, map), ``velocity`` (m/s, base_link) or ``attitude`` (drawn in degrees).
    columns : sequence of int
        The components.
    title, unit : str
    names : sequence of str
        Of the components, where there are several.
    """
    axes.set(ylabel=unit, title=title)
    at, error, sigma = view.error(quantity, list(columns))
    if quantity == "attitude":
        error, sigma = (None if rows is None else np.degrees(rows) for rows in (error, sigma))
    if error is None and sigma is None:
        mark_missing(axes, "not known")
        return
    single = len(names) == 1
    colours = (BLUE,) if single else AXIS_COLOURS
    for i, (name, colour) in enumerate(zip(names, colours, strict=False)):
        if sigma is not None:
            t, low, high = thin_band(at, np.zeros(len(at)), 3 * sigma[:, i])
            if single:
                axes.fill_between(t, low, high, color=SKY, alpha=0.3, lw=0)
            for edge in (low, high):
                axes.plot(t, edge, color=SKY if single else colour, lw=0.5 if single else 0.9,
                          ls="-" if single else ":",
                          label=name if error is None and edge is low else None)  # fmt: skip
        if error is not None:
            axes.plot(*thin(at, error[:, i]), color=colour, label=name or None)
    axes.axhline(0.0, color=MUTED, lw=0.6)
    if error is None or view.scored is None:
        axes.set_title(f"{title.removesuffix(' error')} ±3σ")
    else:
        axes.set_title(title + _caption(error, sigma, view.scored, unit))
    _zoom(axes, error, sigma)
    if not single:
        legend_above(axes)


def _caption(error: Array, sigma: Array | None, scored: NDArray[np.bool_], unit: str) -> str:
    rows = error[scored]
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return ": no truth"
    text = f": RMS {rounded(math.sqrt(np.mean(np.sum(rows**2, axis=1))), 2)} {unit}"
    if sigma is not None:
        known = np.isfinite(sigma[scored]) & np.isfinite(error[scored])
        inside = np.abs(error[scored][known]) <= 3 * sigma[scored][known]
        if len(inside):
            text += f", {100 * np.mean(inside):.3g} % in ±3σ"
    return text


def _zoom(axes: Axes, error: Array | None, sigma: Array | None) -> None:
    """Set the limits; logarithmic beyond a linear part where outages would flatten the rest."""
    shown = [np.abs(rows) for rows in (error, None if sigma is None else 3.0 * sigma)
             if rows is not None]  # fmt: skip
    sizes = [np.max(rows[np.isfinite(rows).all(axis=1)], axis=1) for rows in shown]
    sizes = [size for size in sizes if len(size)]
    if not sizes:
        return
    usual = max(float(np.median(size)) for size in sizes)
    largest = 1.1 * max(float(np.quantile(size, 0.985)) for size in sizes)
    if error is not None:
        largest = max(largest, 1.1 * float(np.max(sizes[0])))
    if largest > 8.0 * usual > 0.0:
        linear = 2.0 * _round_up(usual)
        axes.set_yscale("symlog", linthresh=linear, linscale=_LINEAR_SHARE)
        decades = _decades(linear, largest)  # where none has room, the end of the axis tells
        ticks = [0.0, 0.5 * linear, *([linear, *decades] if decades else [_round_down(largest)])]
        axes.set_yticks(sorted({sign * tick + 0.0 for tick in ticks for sign in (-1.0, 1.0)}))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_title(f"{axes.get_title(loc='left')}, log > {linear:g}", loc="left")
    if largest > 0.0:
        axes.set_ylim(-largest, largest)


def _round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, ... above `value`."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(decade * step for step in (1, 2, 5, 10) if decade * step >= value)


def _round_down(value: float) -> float:
    """Return the last of 1, 2, 5, 10, ... up to `value`."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(decade * step for step in (5, 2, 1) if decade * step <= value)


def _decades(above: float, largest: float) -> list[float]:
    """Return the powers of ten with room for a label on an axis logarithmic from `above` on."""
    decades = _LINEAR_SHARE + math.log10(largest / above)  # from zero to the edge
    powers = range(math.floor(math.log10(above)) + 1, math.floor(math.log10(largest)) + 1)
    return [10.0**p for p in powers if math.log10(10.0**p / above) > 0.17 * decades]
