"""The figures of the field experiment: a path, the levels in force on it, errors of all runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import ticker
from scipy import signal

from hybrid_ins.plotting.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from hybrid_ins.ros.messages.trajectory import enu_from_lla
from tools.field.flights import Fixes, Flight, Flown
from tools.paper.figures import _axes, _save

COLOURS = (BLUE, ORANGE)
SPECTRUM_WINDOW = 240  # samples
GROUPS = {  # title of a panel: how the names of its methods begin
    "learned noise": "HB-AEKF",
    "noise adapted to the innovations": "MB-EKF-AQ",
    "constant noise": "",
}
OTHERS = (VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)


def path_and_levels(
    path_file: Path, levels_file: Path, flight: Flight, aid: Fixes, flown: Mapping[str, Flown]
) -> None:
    """Draw one flight from above with its errors, and the levels in force on it."""
    figure, axes = _axes(2)
    seen = enu_from_lla(aid.lla, aid.lla[0])
    axes[0].plot(seen[:, 0], seen[:, 1], ".", color="#9A9A9A", markersize=3, label="fixes")
    for (name, run), colour in zip(flown.items(), COLOURS, strict=False):
        errors = run.result.errors
        assert errors is not None
        track = errors.estimate.position_enu
        axes[0].plot(track[:, 0], track[:, 1], color=colour, linewidth=1.0, label=name)
        t = (errors.stamp_ns - errors.stamp_ns[0]) * 1e-9
        axes[1].plot(t, np.linalg.norm(errors.position_enu, axis=1), color=colour, label=name)
    axes[0].plot(
        errors.truth.position_enu[:, 0],
        errors.truth.position_enu[:, 1],
        "k--",
        linewidth=0.8,
        label="reference",
    )
    axes[0].set(
        xlabel="east [m]",
        ylabel="north [m]",
        aspect="equal",
        title=f"{flight.name}, IMU {flight.imu}",
    )
    axes[1].set(xlabel="time [s]", ylabel="position error [m]", ylim=(0.0, None))
    axes[0].legend(loc="best")
    _save(figure, path_file)

    figure, axes = _axes(2, sharex=True)
    for (name, run), colour in zip(flown.items(), COLOURS, strict=False):
        t, q = np.array(run.estimator.levels_t), np.array(run.estimator.levels)
        for axis, channel, title in (
            (axes[0], 0, "accelerometer x: q [(m/s²)²]"),
            (axes[1], 3, "gyroscope x: q [(rad/s)²]"),
        ):
            axis.semilogy(t, q[:, channel], color=colour, label=name)
            axis.set(title=title, xlabel="time [s]")
    axes[0].legend(loc="best")
    _save(figure, levels_file)


def spectra(
    file: Path, flights: Sequence[Flight], needed: tuple[float, float]
) -> list[tuple[float, float]]:
    """
    Draw what the IMU shows over frequency, as the variance of white noise of that density.

    Parameters
    ----------
    file : Path
    flights : sequence of Flight
    needed : (float, float)
        What navigation takes for noise: (m/s²)², (rad/s)².

    Returns
    -------
    list of (float, float)
        For each sensor the lowest of all frequencies' 5 % quantiles, and of their medians.
    """
    figure, axes = _axes(2)
    found = []
    for axis, sensor, q, unit in (
        (axes[0], "force", needed[0], "(m/s²)²"),
        (axes[1], "rate", needed[1], "(rad/s)²"),
    ):
        densities = []
        for flight in flights:
            rate = 1e9 / float(np.median(np.diff(flight.stamp_ns)))
            readings = getattr(flight, sensor)
            for start in range(0, len(readings) - SPECTRUM_WINDOW, SPECTRUM_WINDOW // 2):
                f, density = signal.periodogram(
                    readings[start : start + SPECTRUM_WINDOW],
                    rate,
                    "hann",
                    detrend="linear",
                    axis=0,
                )
                densities.extend(density.T[:, 1:] * rate / 2.0)
        low, middle, high = np.percentile(densities, [5, 50, 95], axis=0)
        axis.fill_between(
            f[1:],
            low,
            high,
            color=BLUE,
            alpha=0.25,
            linewidth=0,
            label="5 to 95 % of all windows and axes",
        )
        axis.plot(f[1:], middle, color=BLUE, label="median")
        axis.axhline(q, color=ORANGE, label="noise that navigation needs")
        axis.set(
            xscale="log",
            yscale="log",
            xlabel="frequency [Hz]",
            title={"force": "accelerometer", "rate": "gyroscope"}[sensor] + f" [{unit}]",
        )
        found.append((float(low.min()), float(middle.min())))
    axes[0].legend(loc="best")
    _save(figure, file)
    return found


def distributions(file: Path, prmse: Mapping[str, np.ndarray]) -> None:
    """
    Draw the share of runs with at most an error, for each method.

    A panel each for learned, adaptive and constant noise; the first method is in all of them.
    """
    first = next(iter(prmse))
    figure, axes = _axes(len(GROUPS), sharex=True, sharey=True)
    grouped: set[str] = set()
    for axis, (title, prefix) in zip(np.atleast_1d(axes), GROUPS.items(), strict=True):
        names = [name for name in prmse if name.startswith(prefix) and name not in grouped]
        grouped.update(names)
        others = [name for name in names if name != first]
        for name, colour in zip((first, *others), (BLUE, *OTHERS, *OTHERS), strict=False):
            values = np.sort(prmse[name])
            share = (np.arange(len(values)) + 1) / len(values)
            width = 2.4 if name == first else 1.2
            axis.step(values, share, where="post", label=name, color=colour, linewidth=width)
        axis.set(xscale="log", xlabel="PRMSE of a run [m]", title=title, ylim=(0.0, 1.0))
        axis.xaxis.set_major_locator(ticker.LogLocator(subs=(0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(ticker.NullFormatter())
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.24), fontsize=7, frameon=False)
    axes[0].set(ylabel="share of runs")
    _save(figure, file)
