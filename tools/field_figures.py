"""The figures of the field experiment: a path, the levels in force on it, errors of all runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from field_flights import Fixes, Flight, Flown
from matplotlib import pyplot as plt
from paper_figures import _axes, _save

from hybrid_ins.offline import plots
from hybrid_ins.offline.tracks import enu_from_lla

COLOURS = (plots.BLUE, plots.ORANGE)


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
    axes[0].plot(errors.truth.position_enu[:, 0], errors.truth.position_enu[:, 1], "k--",
                 linewidth=0.8, label="reference")
    axes[0].set(xlabel="east [m]", ylabel="north [m]", aspect="equal",
                title=f"{flight.name}, IMU {flight.imu}")
    axes[1].set(xlabel="time [s]", ylabel="position error [m]", ylim=(0.0, None))
    axes[0].legend(loc="best")
    _save(figure, path_file)

    figure, axes = _axes(2, sharex=True)
    for (name, run), colour in zip(flown.items(), COLOURS, strict=False):
        t, q = np.array(run.estimator.levels_t), np.array(run.estimator.levels)
        for axis, channel, title in ((axes[0], 0, "accelerometer x: q [(m/s²)²]"),
                                     (axes[1], 3, "gyroscope x: q [(rad/s)²]")):
            axis.semilogy(t, q[:, channel], color=colour, label=name)
            axis.set(title=title, xlabel="time [s]")
    axes[0].legend(loc="best")
    _save(figure, levels_file)


def distributions(file: Path, prmse: Mapping[str, np.ndarray]) -> None:
    """Draw the share of runs with at most an error, for each method."""
    figure, axes = _axes(1)
    axis = np.atleast_1d(axes)[0]
    colours = plt.get_cmap("tab20").colors
    for k, (name, values) in enumerate(prmse.items()):
        values = np.sort(values)
        axis.step(values, (np.arange(len(values)) + 1) / len(values), where="post", label=name,
                  color=colours[k % len(colours)], linewidth=2.4 if k == 0 else 1.2)
    axis.set(xscale="log", xlabel="PRMSE of a run [m]", ylabel="share of runs")
    figure.legend(loc="outside right center")
    _save(figure, file)
