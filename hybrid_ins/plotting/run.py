"""
Pictures of a run. The only module that imports matplotlib, and only when a picture is asked for.

`overview` answers at a glance: where did it go, how wrong was it and did it know (error within its
own 3 sigma), which fixes were refused and why, when did the biases settle, what did the process
noise do. Colours are Okabe and Ito's, told apart by every kind of colour vision.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.errors import InputError
from hybrid_ins.ros.trajectory import Array, Stamps, Trajectory, enu_from_lla

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hybrid_ins.evaluation.result import Result
    from hybrid_ins.evaluation.run_reader import Recording, Series, Verdicts

SUFFIXES = (".png", ".svg")

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
_AXIS_COLOURS = (BLUE, ORANGE, GREEN)
_REFUSED = ((VERMILLION, "x"), (PURPLE, "^"), (ORANGE, "s"), (GREEN, "D"), (BLACK, "v"))
_SHADE = "#ECECEC"
_MUTED = "#8A8A8A"
_TEXT = "#333333"

_SIZE = (16.0, 10.0)  # inches; at _DPI the picture has 1600 x 1000 pixels
_DPI = 100
_MARGINS = {
    "left": 0.043, "right": 0.99, "bottom": 0.048, "top": 0.93, "wspace": 0.16, "hspace": 0.3,
}  # fmt: skip
_LINEAR_SHARE = 1.5  # decades' room for the linear part of an axis that is logarithmic outside
_POINTS = 1500  # per line: what a panel of this width can show
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": _TEXT,
    "axes.labelcolor": _TEXT,
    "axes.edgecolor": "#B0B0B0",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E2E2E2",
    "grid.linewidth": 0.6,
    "xtick.color": _TEXT,
    "ytick.color": _TEXT,
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


def check(path: Path) -> None:
    """
    Find out before the work whether a picture can be written to `path`.

    Raises
    ------
    InputError
        Unknown suffix, no such folder, or matplotlib is not installed.

    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a picture's name ends in {' or '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder")
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError('pictures need matplotlib: pip install "hybrid_ins[plot]"')


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, by the suffix of `path`."""
    check(path)
    with path.open("wb") as file:
        write(figure, file, path.suffix.lower().removeprefix("."))


def write(figure: Figure, file: BinaryIO, kind: str) -> None:
    """Write a figure to an open file; `kind` is ``png`` or ``svg``."""
    from matplotlib import rc_context

    dated = {"Date": None} if kind == "svg" else {"Software": None}
    with rc_context(_STYLE):
        figure.savefig(file, format=kind, dpi=_DPI, metadata=dated)


def overview(recording: Recording, result: Result) -> Figure:
    """
    Draw one run on one page.

    Parameters
    ----------
    recording : Recording
        What was recorded; panels without data say so.
    result : Result
        Its evaluation; without truth the error panels show the filter's own sigma.

    Returns
    -------
    matplotlib.figure.Figure
        To be given to `save`.

    """
    check(Path("overview.svg"))
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=_SIZE, dpi=_DPI)
        figure.suptitle(
            _headline(recording, result), x=_MARGINS["left"], y=0.985, ha="left", fontsize=11.5
        )
        grid = figure.add_gridspec(5, 3, **_MARGINS)
        track = figure.add_subplot(grid[0:3, 0])
        box = track.get_position()  # leaves room for its x label above the next panel's title
        track.set_position((box.x0, box.y0 + 0.02, box.width, box.height - 0.02))
        height = figure.add_subplot(grid[3, 0])
        timed = [height, figure.add_subplot(grid[4, 0], sharex=height)]
        timed += [figure.add_subplot(grid[i, j], sharex=height) for j in (1, 2) for i in range(5)]
        page = _Page(recording, result)
        page.track(track)
        page.height(timed[0])
        page.velocity_error(timed[1])
        for axis, name in enumerate(("east", "north", "up")):
            page.position_error(timed[2 + axis], axis, name)
        page.heading_error(timed[5])
        page.tilt_error(timed[6])
        page.nis(timed[7])
        page.bias(timed[8], "accelerometer", 1.0, "m/s²")
        page.bias(timed[9], "gyroscope", math.degrees(1.0), "deg/s")
        page.noise(timed[10], "accelerometer", "(m/s²)²")
        page.noise(timed[11], "gyroscope", "(rad/s)²")
        page.finish(timed, bottom=(timed[1], timed[6], timed[11]))
    return figure


def _headline(recording: Recording, result: Result) -> str:
    parts = [recording.name]
    if result.prmse is not None and result.pmae is not None:
        parts += [f"PRMSE {result.prmse:.3g} m", f"PMAE {result.pmae:.3g} m"]
    if result.heading_rmse is not None:
        parts.append(f"heading RMSE {math.degrees(result.heading_rmse):.2g}°")
    for name, consistency in (
        ("position NEES", result.nees_position),
        ("NIS", result.nis_position),
    ):
        if consistency is not None:
            parts.append(f"{name} {consistency.per_dof:.3g} per dof ({consistency.verdict})")
    if result.outage_error(50) is not None:
        parts.append(f"outage end {result.outage_error(50):.2g} m (median)")
    return "   ·   ".join(parts)


class _Page:
    """The panels of one run; every method fills one set of axes."""

    def __init__(self, recording: Recording, result: Result) -> None:
        self.recording = recording
        self.result = result
        self.estimate = recording.estimate
        self.seconds = self._since(self.estimate.stamp_ns)
        errors = result.errors
        self.error_seconds = None if errors is None else self._since(errors.stamp_ns)
        self.truth: Trajectory | None = recording.truth
        datum_lla = self.estimate.datum_lla
        if self.truth is not None and self.truth.datum_lla is not None and datum_lla is not None:
            self.truth = self.truth.in_map_of(datum_lla)

    def _since(self, stamp_ns: Stamps) -> Array:
        return np.asarray((stamp_ns - self.result.origin_ns) * 1e-9, float)

    def track(self, axes: Axes) -> None:
        """Draw the way from above: truth, estimate, fixes, refused fixes, outages."""
        p = self.estimate.position_enu
        for index, (start, stop) in enumerate(self._outages()):
            out = (self.seconds >= start) & (self.seconds <= stop)
            axes.plot(
                *_thin_path(p[out]), color="#D9D9D9", lw=7, solid_capstyle="butt", zorder=1,
                label="no fix" if index == 0 else None,
            )  # fmt: skip
        fixes, accepted = self._fix_positions()
        if len(fixes):
            axes.plot(
                *fixes[accepted, :2].T, ".", ms=3, color=_MUTED, zorder=2, label="fix", alpha=0.7
            )
        if self.truth is not None:
            axes.plot(
                *_thin_path(self.truth.position_enu), color=BLACK, lw=2.2, zorder=3, label="truth"
            )
        axes.plot(*_thin_path(p), color=SKY, lw=1.1, zorder=4, label="estimate")
        if len(fixes) and not np.all(accepted):
            axes.plot(
                *fixes[~accepted, :2].T, "x", ms=6, mew=1.5, color=VERMILLION, zorder=5,
                label="refused fix",
            )  # fmt: skip
        axes.plot(*p[0, :2], "o", ms=8, mfc="white", mec=BLACK, zorder=6, label="start")
        axes.plot(*p[-1, :2], "s", ms=7, mfc=BLACK, mec=BLACK, zorder=6, label="end")
        axes.set(xlabel="east [m]", ylabel="north [m]", title="track, map frame")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(loc="best")

    def height(self, axes: Axes) -> None:
        """Draw the height over time."""
        fixes, accepted = self._fix_positions()
        if len(fixes):
            at = self._since(self._to_imu(self.recording.fixes.stamp_ns))
            axes.plot(at[accepted], fixes[accepted, 2], ".", ms=3, color=_MUTED, label="fix")
        if self.truth is not None:
            at = self._since(self._to_imu(self.truth.stamp_ns))
            up = self.truth.position_enu[:, 2]
            axes.plot(*_thin(at, up), color=BLACK, lw=2.2, label="truth")
        axes.plot(
            *_thin(self.seconds, self.estimate.position_enu[:, 2]), color=SKY, label="estimate"
        )
        axes.set(ylabel="m", title="height above the datum")
        _legend_above(axes)

    def position_error(self, axes: Axes, axis: int, name: str) -> None:
        """Draw one axis of the position error within the filter's own 3 sigma."""
        self._error(axes, f"{name} error", "m", *self._parts("position", [axis]))

    def velocity_error(self, axes: Axes) -> None:
        """Draw the velocity error along the vehicle's axes, as its covariance is given."""
        names = ("x", "y", "z")
        self._error(axes, "body velocity error", "m/s", *self._parts("velocity", [0, 1, 2]), names)

    def heading_error(self, axes: Axes) -> None:
        """Draw the attitude error about the vertical."""
        self._error(axes, "heading error", "deg", *self._parts("attitude", [2]))

    def tilt_error(self, axes: Axes) -> None:
        """Draw the attitude error about the horizontal axes."""
        names = ("E", "N")
        self._error(axes, "tilt error", "deg", *self._parts("attitude", [0, 1]), names)

    def nis(self, axes: Axes) -> None:
        """Draw what the filter made of each fix: NIS, threshold, and why it was refused."""
        v = self.recording.verdicts
        axes.set(title="NIS of each fix", ylabel="NIS")
        if not len(v):
            _nothing(axes, "no verdicts recorded")
            return
        at = self._since(self._to_imu(v.stamp_ns))
        position = v.kind == "position"
        tested = np.isfinite(v.nis) & (v.nis > 0.0)
        fused = tested & v.accepted & position
        limited = np.isfinite(v.threshold) & position
        sizes = np.concatenate((v.nis[tested], v.threshold[limited], [10.0]))
        axes.set(yscale="log", ylim=(0.05, 150.0 * float(np.max(sizes))))
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
            axes.plot(*_thin(middle, mean), color=BLACK, lw=1.3, label=f"mean of {running}")
        if np.any(fused):
            dof = float(np.median(v.dof[fused]))
            axes.axhline(dof, color=_MUTED, lw=1.0, ls=":", label=f"expected {dof:g}")
        if np.any(limited):
            axes.plot(
                at[limited], v.threshold[limited], color=VERMILLION, lw=1.0, ls="--",
                drawstyle="steps-post", label="threshold",
            )  # fmt: skip
        for (colour, marker), (reason, shown) in zip(_REFUSED, _refusals(v), strict=False):
            # What was refused before it had a NIS lies at the lower edge.
            height = np.where(tested[shown], v.nis[shown], 1.6 * axes.get_ylim()[0])
            axes.plot(
                at[shown], height, marker, ms=5, mew=1.4, color=colour,
                label=f"refused: {_shortened(reason)} ({np.sum(shown)})",
            )  # fmt: skip
        axes.legend(ncols=3, loc="upper right", fontsize=7.5)

    def bias(self, axes: Axes, sensor: str, scale: float, unit: str) -> None:
        """Draw a sensor's three biases within their 3 sigma, and the true ones where known."""
        axes.set(title=f"{sensor} bias ±3σ", ylabel=unit)
        series, true = self._sensor_errors(f"{sensor}_bias")
        if series is None:
            _nothing(axes, "not recorded")
            return
        at, values = self._since(series.stamp_ns), scale * series.values
        for axis, colour in enumerate(_AXIS_COLOURS):
            if series.sigma is not None:
                t, low, high = _thin_band(at, values[:, axis], 3 * scale * series.sigma[:, axis])
                axes.fill_between(t, low, high, color=colour, alpha=0.13, lw=0)
            axes.plot(*_thin(at, values[:, axis]), color=colour, label="xyz"[axis])
        self._true_lines(axes, true, scale)
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) and np.ptp(values) > 0.0:
            # The first sigma is often so large that it would flatten all the rest.
            sigma = 0.0 if series.sigma is None else scale * float(np.median(series.sigma))
            margin = 0.1 * float(np.ptp(values)) + (3.5 * sigma if math.isfinite(sigma) else 0.0)
            axes.set_ylim(np.min(values) - margin, np.max(values) + margin)
        _legend_above(axes)

    def noise(self, axes: Axes, sensor: str, unit: str) -> None:
        """Draw a sensor's noise variances in force, where they come from, and the true ones."""
        axes.set(title=f"{sensor} q (noise variance in force)", ylabel=unit)
        series, true = self._sensor_errors(f"{sensor}_noise")
        if series is None:
            _nothing(axes, "not recorded")
            return
        axes.set_yscale("log")
        shown = [series.values, *([true.values] if true is not None else [])]
        positive = np.concatenate([rows[np.isfinite(rows) & (rows > 0.0)] for rows in shown])
        if len(positive):  # room above for the source; a constant must not be drawn as rounding
            axes.set_ylim(np.min(positive) / 5.0, np.max(positive) * 20.0)
        at = self._since(series.stamp_ns)
        for axis, colour in enumerate(_AXIS_COLOURS):
            variance = np.where(series.values[:, axis] > 0.0, series.values[:, axis], np.nan)
            axes.plot(*_thin(at, variance), color=colour, label="xyz"[axis])
        self._true_lines(axes, true, 1.0)
        for index, (stamp_ns, source) in enumerate(self.recording.noise_source):
            start = max(float(self._since(np.array(stamp_ns))), self.seconds[0])
            axes.axvline(start, color=_MUTED, lw=0.8, ls=":")
            axes.annotate(
                source, (start, 0.9 - 0.12 * (index % 2)), xycoords=("data", "axes fraction"),
                xytext=(3, 0), textcoords="offset points", fontsize=8, color=_TEXT,
                va="center", bbox={"fc": "white", "ec": "none", "pad": 0.5, "alpha": 0.8},
            )  # fmt: skip
        axes.minorticks_off()
        _legend_above(axes)

    def _sensor_errors(self, name: str) -> tuple[Series | None, Series | None]:
        true: Series | None = getattr(self.recording.true_sensor_errors, name)
        return getattr(self.recording.sensor_errors, name), true

    def _true_lines(self, axes: Axes, true: Series | None, scale: float) -> None:
        if true is None:
            return
        at = self._since(true.stamp_ns)
        for axis in range(3):
            axes.plot(
                *_thin(at, scale * true.values[:, axis]), color=BLACK, lw=0.9, ls="--",
                label="truth" if axis == 0 else None,
            )  # fmt: skip

    def finish(self, timed: Sequence[Axes], bottom: Sequence[Axes]) -> None:
        """Shade outages, mark the start of scoring, and label the time axes."""
        for axes in timed:
            for start, stop in self._outages():
                axes.axvspan(start, stop, color=_SHADE, zorder=0, lw=0)
            if self.result.scoring.skip > 0.0:
                axes.axvline(
                    self._scoring_starts(), color=_MUTED, lw=0.8, ls="--", label="_scored from here"
                )
            axes.tick_params(labelbottom=axes in bottom)
        first, last = min(0.0, self.seconds[0]), self.seconds[-1]
        if self.error_seconds is not None:
            last = max(last, self.error_seconds[-1])
        timed[0].set_xlim(first - 0.01 * (last - first), last + 0.01 * (last - first))
        for axes in bottom:
            axes.set_xlabel(
                "time [s]"
                + ("; shaded: no accepted fix" if self.result.outages else "")
                + ("; dashed: scoring begins" if self.result.scoring.skip > 0.0 else "")
            )

    def _scoring_starts(self) -> float:
        errors = self.result.errors
        if errors is None:
            return float(self.seconds[0]) + self.result.scoring.skip
        return float(self._since(errors.stamp_ns[errors.scored][:1])[0])

    def _outages(self) -> Iterator[tuple[float, float]]:
        for outage in self.result.outages:
            yield outage.start, outage.start + outage.duration

    def _to_imu(self, stamp_ns: Stamps) -> Stamps:
        return stamp_ns + round(1e9 * self.result.time_offset.mean)

    def _fix_positions(self) -> tuple[Array, NDArray[np.bool_]]:
        """Fixes on the map, and which of them were accepted (all, where no verdict says no)."""
        fixes, verdicts = self.recording.fixes, self.recording.verdicts
        datum = self.estimate.datum_lla
        if datum is None and self.recording.truth is not None:
            datum = self.recording.truth.datum_lla
        if datum is None or not len(fixes):
            return np.empty((0, 3)), np.empty(0, bool)
        # Before the first estimate nothing could be fused: no judgement on the fix.
        running = self._since(self._to_imu(verdicts.stamp_ns)) >= self.seconds[0]
        refused = verdicts.stamp_ns[(verdicts.kind == "position") & ~verdicts.accepted & running]
        lla = fixes.lla.copy()
        no_height = np.isnan(lla[:, 2])
        lla[no_height, 2] = datum[2]
        position = enu_from_lla(lla, datum)
        position[no_height, 2] = np.nan
        return position, ~np.isin(fixes.stamp_ns, refused)

    def _parts(self, quantity: str, columns: list[int]) -> tuple[Array, Array | None, Array | None]:
        """Time, error (N, len(columns)) and its claimed sigma, in the units drawn."""
        scale = math.degrees(1.0) if quantity == "attitude" else 1.0
        errors = self.result.errors
        source = self.estimate if errors is None else errors.estimate
        covariance = getattr(source, f"{quantity}_cov")
        sigma = None
        if covariance is not None:
            variance = np.diagonal(covariance, axis1=1, axis2=2)[:, columns]
            known = np.isfinite(variance) & (variance > 0.0)
            sigma = scale * np.sqrt(np.where(known, variance, np.nan))
        if errors is None or self.error_seconds is None:
            return self.seconds, None, sigma
        name = {"attitude": "rotation_enu", "velocity": "velocity_base"}.get(
            quantity, "position_enu"
        )
        error = getattr(errors, name)
        return self.error_seconds, None if error is None else scale * error[:, columns], sigma

    def _error(
        self,
        axes: Axes,
        title: str,
        unit: str,
        at: Array,
        error: Array | None,
        sigma: Array | None,
        names: Sequence[str] = ("",),
    ) -> None:
        axes.set(ylabel=unit, title=title)
        if error is None and sigma is None:
            _nothing(axes, "not known")
            return
        single = len(names) == 1
        colours = (BLUE,) if single else _AXIS_COLOURS
        for i, (name, colour) in enumerate(zip(names, colours, strict=False)):
            if sigma is not None:
                t, low, high = _thin_band(at, np.zeros(len(at)), 3 * sigma[:, i])
                if single:
                    axes.fill_between(t, low, high, color=SKY, alpha=0.3, lw=0)
                for edge in (low, high):
                    axes.plot(t, edge, color=SKY if single else colour, lw=0.5 if single else 0.9,
                              ls="-" if single else ":",
                              label=name if error is None and edge is low else None)  # fmt: skip
            if error is not None:
                axes.plot(*_thin(at, error[:, i]), color=colour, label=name or None)
        axes.axhline(0.0, color=_MUTED, lw=0.6)
        axes.set_title(title + _caption(error, sigma, self._scored(), unit))
        _zoom(axes, error, sigma)
        if not single:
            _legend_above(axes)

    def _scored(self) -> NDArray[np.bool_] | None:
        return None if self.result.errors is None else self.result.errors.scored


def _caption(
    error: Array | None, sigma: Array | None, scored: NDArray[np.bool_] | None, unit: str
) -> str:
    if error is None or scored is None:
        return ": no truth, the filter's own ±3σ"
    rows = error[scored]
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return ": no truth"
    text = f": RMS {math.sqrt(np.mean(np.sum(rows**2, axis=1))):.2g} {unit}"
    if sigma is not None:
        known = np.isfinite(sigma[scored]) & np.isfinite(error[scored])
        inside = np.abs(error[scored][known]) <= 3 * sigma[scored][known]
        if len(inside):
            text += f", {100 * np.mean(inside):.3g} % in ±3σ"
    return text


def _zoom(axes: Axes, error: Array | None, sigma: Array | None) -> None:
    """Limit an error panel to what matters; logarithmic outside where outages flatten the rest."""
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
        ticks = [0.0, 0.5 * linear, linear, *_decades(linear, largest)]
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


def _decades(above: float, largest: float) -> list[float]:
    """Return the powers of ten that have room for a label on an axis logarithmic from `above`."""
    decades = _LINEAR_SHARE + math.log10(largest / above)  # from zero to the edge
    powers = range(math.floor(math.log10(above)) + 1, math.floor(math.log10(largest)) + 1)
    return [10.0**p for p in powers if math.log10(10.0**p / above) > 0.17 * decades]


def _legend_above(axes: Axes) -> None:
    """Put the legend beside the title, where it hides nothing."""
    axes.legend(
        ncols=4,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.99),
        borderaxespad=0.0,
        frameon=False,
        handlelength=0.9,
        columnspacing=0.7,
        handletextpad=0.4,
    )


def _shortened(text: str, length: int = 28) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _nothing(axes: Axes, why: str) -> None:
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center", color=_MUTED)
    axes.set_yticks([])


def _refusals(verdicts: Verdicts) -> list[tuple[str, NDArray[np.bool_]]]:
    """Reasons of refusal with the fixes they hit, frequent ones first, rare ones together."""
    refused = ~verdicts.accepted
    reasons, counts = np.unique(verdicts.reason[refused], return_counts=True)
    ranked = [str(reason) for reason in reasons[np.argsort(-counts, kind="stable")]]
    named, rest = ranked[: len(_REFUSED) - 1], ranked[len(_REFUSED) - 1 :]
    groups = [(reason, refused & (verdicts.reason == reason)) for reason in named]
    if rest:
        groups.append(("other", refused & np.isin(verdicts.reason, rest)))
    return groups


def _thin(at: Array, values: Array) -> tuple[Array, Array]:
    """
    Fewer points of a line that look the same: the least and the largest of every short stretch.

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


def _thin_band(at: Array, centre: Array, half: Array) -> tuple[Array, Array, Array]:
    t, width = _thin(at, half)
    return t, np.interp(t, at, centre) - width, np.interp(t, at, centre) + width


def _thin_path(position: Array) -> tuple[Any, Any]:
    step = max(1, len(position) // (4 * _POINTS))
    return position[::step, 0], position[::step, 1]
