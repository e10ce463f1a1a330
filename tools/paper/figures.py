"""The figures of the paper's evaluation, in colours told apart by every kind of colour vision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib import ticker

from hybrid_ins.plotting.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, save
from tools.paper.montecarlo import Flight
from tools.paper.runs import T0_NS, Run

LINES = {
    "ours": (BLUE, "-"),
    "oracle": (BLACK, "--"),
    "paper's network": (ORANGE, "-"),
    "tuned constant": (GREEN, "-"),
    "CQ1": (VERMILLION, ":"),
    "CQ2": (VERMILLION, "--"),
    "CQ3": (VERMILLION, "-"),
    "AQ1": (PURPLE, ":"),
    "AQ2": (PURPLE, "--"),
    "AQ3": (PURPLE, "-"),
    "spectral": (SKY, "-"),
}
MARKERS = {"ours": "o", "paper's network": "s", "spectral": "^"}
WIDTH, HEIGHT = 10.0, 4.4  # inches, of a row


def _axes(columns: int, rows: int = 1, **options: object) -> tuple[plt.Figure, Any]:
    figure, axes = plt.subplots(
        rows, columns, figsize=(WIDTH, rows * HEIGHT), layout="constrained", **options
    )
    for axis in np.atleast_1d(axes).flat:
        axis.grid(True, color="#E2E2E2", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: plt.Figure, path: Path) -> None:
    save(figure, path)
    plt.close(figure)


def rmse_against_length(path: Path, curves: Mapping[str, Mapping[int, float]], rms: float) -> None:
    """Draw q RMSE by window length for each estimator, and the bound for levels of that rms."""
    figure, axis = _axes(1)
    n = np.arange(50, 401)
    axis.plot(n, rms * np.sqrt(2.0 / n), "k--", label="Cramér–Rao bound")
    for name, curve in curves.items():
        axis.plot(
            list(curve),
            list(curve.values()),
            marker=MARKERS[name],
            color=LINES[name][0],
            linestyle="-",
            label=name,
        )
    axis.plot([200], [0.0032], "kx", markersize=8, label="reported in the paper")
    axis.set(xlabel="window length N [samples]", ylabel="q RMSE on the paper's set", ylim=(0, None))
    figure.legend(loc="outside right center")
    _save(figure, path)


def predicted_against_true(
    path: Path, true: np.ndarray, estimates: Mapping[str, np.ndarray]
) -> None:
    """Draw predictions against true levels, one panel for each estimator."""
    figure, axes = _axes(len(estimates), sharex=True, sharey=True)
    rng = np.random.default_rng(0)
    levels = np.unique(true)
    step = np.diff(levels).min()
    shown = rng.permutation(len(true))[:6000]
    for axis, (name, estimate) in zip(axes, estimates.items(), strict=True):
        spread = true[shown] + step * rng.uniform(-0.25, 0.25, len(shown))
        axis.plot(spread, estimate[shown], ".", color="#9A9A9A", markersize=1.5, alpha=0.5)
        limits = np.array([0.0, 1.05 * levels[-1]])
        axis.plot(limits, limits, "--", color=VERMILLION, label="predicted = true")
        mean = [estimate[true == level].mean() for level in levels]
        axis.plot(levels, mean, MARKERS[name], color=BLUE, label="mean")
        rmse = np.sqrt(np.mean((estimate - true) ** 2))
        axis.set(title=f"{name}: RMSE {rmse:.5f}", xlabel="true q", ylim=(0.0, 1.6 * levels[-1]))
        axis.legend(loc="upper left")
    axes[0].set_ylabel("predicted q")
    _save(figure, path)


def levels_over_time(path: Path, run: Run, flights: Mapping[str, Flight]) -> None:
    """Draw true levels and those in force on a flight, accelerometer and gyroscope x."""
    figure, axes = _axes(2, sharex=True)
    t = (run.samples["t_ns"] - T0_NS) * 1e-9
    shown = t >= next(iter(flights.values())).t[0]
    panels = ((0, "accelerometer x: q [(m/s²)²]"), (3, "gyroscope x: q [(rad/s)²]"))
    for axis, (channel, title) in zip(axes, panels, strict=True):
        axis.semilogy(
            t[shown], run.q[shown, channel], color=BLACK, linewidth=2.5, alpha=0.5, label="true"
        )
        for name, flight in flights.items():
            axis.semilogy(
                flight.t, flight.q[:, channel], color=LINES[name][0], linewidth=1.0, label=name
            )
        axis.set(title=title, xlabel="time [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
    _save(figure, path)


def error_distributions(path: Path, groups: Mapping[str, Mapping[str, Sequence[Flight]]]) -> None:
    """Draw the share of epochs with at most an error: a row for each metric, a column a group."""
    metrics = (("|δp| [m], of PRMSE", 2), ("|δN| + |δE| + |δD| [m], of PMAE", 1))
    figure, axes = _axes(len(groups), len(metrics), sharex="col", sharey=True)
    share = np.linspace(0.0, 1.0, 501)
    for row, (metric, order) in zip(axes, metrics, strict=True):
        for axis, (title, by_method) in zip(row, groups.items(), strict=True):
            for name, (colour, style) in LINES.items():
                flights = by_method.get(name, ())
                if name == "spectral" or not flights or any(f.diverged for f in flights):
                    continue
                error = np.concatenate(
                    [np.linalg.norm(f.position_error, order, axis=1) for f in flights]
                )
                axis.plot(
                    np.quantile(error, share),
                    share,
                    color=colour,
                    linestyle=style,
                    label=name,
                    linewidth=2.6 if name == "ours" else 1.2,
                )
            axis.set(title=title, xscale="log", xlabel=metric)
            axis.set_xlim(left=0.02)
            between = (1.0, 2.0, 5.0) if axis.get_xlim()[1] < 2.0 else (1.0,)
            axis.xaxis.set_major_locator(ticker.LogLocator(subs=between))
            axis.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axis.xaxis.set_minor_formatter(ticker.NullFormatter())
        row[0].set_ylabel("share of epochs")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center")
    _save(figure, path)
