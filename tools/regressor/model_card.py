"""The figures of a noise regressor, and the model card that states them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hybrid_ins.noise_regressor.models import NoiseRegressor
from tools.regressor import noise_data, noise_trials
from tools.regressor.noise_data import Windows
from tools.regressor.noise_trials import Trial

_CHUNK = 4000
_EVALUATION_SEED = 700_001


class Score(NamedTuple):
    """
    How an estimator did on labelled windows.

    Attributes
    ----------
    rmse : root mean square error of q [unit^2]; bound : the same of the Cramer-Rao bound.
    relative : root mean square of (estimate / q - 1), over that of the bound.
    median, low, high : quantiles 0.5, 0.05 and 0.95 of estimate / q.
    """

    rmse: float
    bound: float
    relative: float
    median: float
    low: float
    high: float


def estimate_all(regressor: NoiseRegressor, windows: Windows, rate_hz: float = 100.0) -> np.ndarray:
    """Return the estimates (B,) for all windows."""
    return np.concatenate(
        [
            regressor.estimate(windows.readings[start : start + _CHUNK].astype(float), rate_hz)
            for start in range(0, len(windows.variance), _CHUNK)
        ]
    )


def score(regressor: NoiseRegressor, windows: Windows) -> Score:
    """Return the score of a regressor."""
    estimate, true = estimate_all(regressor, windows), windows.variance
    ratio = estimate / true
    low, median, high = np.quantile(ratio, (0.05, 0.5, 0.95))
    return Score(
        float(np.sqrt(np.mean((estimate - true) ** 2))),
        noise_data.cramer_rao_rmse(true, regressor.window),
        float(np.sqrt(np.mean((ratio - 1.0) ** 2) / (2.0 / regressor.window))),
        float(median),
        float(low),
        float(high),
    )


def inference_time(regressor: NoiseRegressor, repeats: int = 2000) -> tuple[float, float]:
    """Return median and 99th percentile [s] of one estimate for six channels."""
    window = np.random.default_rng(0).standard_normal((6, regressor.window))
    elapsed = []
    for _ in range(repeats):
        start = time.perf_counter()
        regressor.estimate(window, 100.0)
        elapsed.append(time.perf_counter() - start)
    return float(np.median(elapsed)), float(np.quantile(elapsed, 0.99))


def paper_trials(
    window: int, test: Windows | None = None, duration_s: float = 400.0
) -> list[Trial]:
    """Return the paper's set: as a whole (or the given test share) and by whole trajectory."""
    everything = noise_data.paper_set(_EVALUATION_SEED, window, duration_s=duration_s)
    trials = [Trial("paper's set, random split", everything if test is None else test)]
    for index, name in enumerate(noise_data.PAPER_TRAJECTORIES):
        _, held_out = noise_data.trajectory_split(everything, index)
        trials.append(Trial(f"trajectory: {name}", held_out))
    middles = (noise_data.PAPER_VARIANCES[1:] + noise_data.PAPER_VARIANCES[:-1]) / 2
    between = noise_data.paper_set(_EVALUATION_SEED + 1, window, middles, duration_s=duration_s / 4)
    trials.append(Trial("levels between the 15", between))
    return trials


Row = tuple[str, NoiseRegressor, Windows]
"""What a row of a table is about, whose figures it gives, and on which windows."""


def rows_of(regressor: NoiseRegressor, trials: list[Trial]) -> list[Row]:
    """Return one row for each trial of a regressor."""
    return [(trial.name, regressor, trial.windows) for trial in trials]


def table(rows: list[Row]) -> str:
    """Return a Markdown table."""
    lines = [
        "| windows | q RMSE | bound | ratio | relative error / bound | median q̂/q | 5–95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, regressor, windows in rows:
        s = score(regressor, windows)
        lines.append(
            f"| {name} | {s.rmse:.3g} | {s.bound:.3g} | {s.rmse / s.bound:.3f} | "
            f"{s.relative:.2f} | {s.median:.3f} | {s.low:.2f} – {s.high:.2f} |"
        )
    return "\n".join(lines)


def write_card(
    path: Path,
    regressor: NoiseRegressor,
    *,
    title: str,
    text: str,
    command: str,
    paper_test: Windows | None,
    unseen: list[Row],
    quick: bool,
) -> None:
    """Write a model card: what the model is, how it was made, every figure, its limits."""
    count = 300 if quick else 3000
    # Rare misses weigh as much as all else: with fewer windows one of them decides the figure.
    many = 300 if quick else 20_000
    window = regressor.window
    median, p99 = inference_time(regressor, 200 if quick else 2000)
    parts = [
        f"# {title}",
        text,
        f"Made by `{command}`.",
        "## Figures",
        (
            "Per window. Bound: Cramer-Rao for white noise, a relative error of "
            f"{100 * np.sqrt(2 / window):.0f} % (N = {window}). A draw of the paper's set itself "
            "scatters by 1 % in its RMSE, by 2 % for one trajectory."
        ),
        "### The paper's set",
        table(
            rows_of(regressor, paper_trials(window, paper_test, 40.0 if quick else 400.0)) + unseen
        ),
        "### White noise far outside the paper's levels, the paper's motion",
        table(rows_of(regressor, noise_trials.level_trials(_EVALUATION_SEED + 2, many, window))),
        "### Disturbances, q = 0.01, the paper's motion",
        table(
            rows_of(regressor, noise_trials.disturbance_trials(_EVALUATION_SEED + 3, count, window))
        ),
        "### Validation, used for choices: synthetic, q from 1e-6 to 0.1",
        table(
            rows_of(regressor, noise_trials.validation_trials(_EVALUATION_SEED + 4, count, window))
        ),
        "### Held out until the model was final: unlike any in training, q from 1e-6 to 1",
        table(rows_of(regressor, noise_trials.fresh_trials(_EVALUATION_SEED + 5, count, window))),
        (
            "### Held out from the first model, which failed at the knocks; shocks with decaying "
            "oscillation are in the training since"
        ),
        table(
            rows_of(regressor, noise_trials.once_unseen_trials(_EVALUATION_SEED + 6, count, window))
        ),
        "### Inference",
        f"Six channels, one thread: median {1e3 * median:.3f} ms, 99 % {1e3 * p99:.3f} ms.",
    ]
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
