"""The noise estimators by themselves, judged on labelled windows."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import numpy as np

from hybrid_ins import progress
from hybrid_ins.noise_regressor.models import NoiseRegressor, Regressor, SpectralRegressor
from hybrid_ins.resources import share_path
from tools.paper import figures
from tools.paper.report import Bar, at_most, table
from tools.regressor import noise_data, noise_trials
from tools.regressor.model_card import estimate_all, inference_time, score
from tools.regressor.noise_data import Windows

PAPER_TEST_SEED = 1  # the split that the paper's network was trained by
DATA_SEED = 810_000
LENGTHS = (50, 100, 150, 200, 300, 400)
PAPER_RMSE = 0.0032


def load(name: str) -> NoiseRegressor:
    """Return a regressor that comes with the package."""
    return Regressor.load(share_path(f"models/{name}.onnx"))


def ratio_table(
    regressors: dict[str, NoiseRegressor], trials: Iterable[noise_trials.Trial]
) -> tuple[str, dict[tuple[str, str], tuple[float, float]]]:
    """Return a table of RMSE over the bound and median q̂/q, and those figures."""
    figures: dict[tuple[str, str], tuple[float, float]] = {}
    rows = []
    for trial in trials:
        cells = [trial.name]
        for name, regressor in regressors.items():
            s = score(regressor, trial.windows)
            figures[name, trial.name] = s.rmse / s.bound, s.median
            cells.append(f"{s.rmse / s.bound:.3g} ({s.median:.3g})")
        rows.append(cells)
    return table(("windows", *regressors), rows), figures


def estimators(args: argparse.Namespace, bars: list[Bar]) -> list[str]:
    """Judge the estimators by themselves; return the report's part."""
    duration = 20.0 if args.quick else noise_data.PAPER_DURATION_S
    count = 300 if args.quick else 3000
    ours, paper = load("plateau"), load("paper")
    regressors = {"ours": ours, "paper's network": paper, "spectral": SpectralRegressor()}
    everything = noise_data.paper_set(PAPER_TEST_SEED, duration_s=duration)
    _, test = noise_data.random_split(everything, PAPER_TEST_SEED)
    del everything
    fresh = noise_data.paper_set(DATA_SEED, duration_s=duration)
    scores = {name: score(regressor, test) for name, regressor in regressors.items()}
    estimates = {name: estimate_all(regressors[name], test) for name in ("paper's network", "ours")}
    figures.predicted_against_true(args.figures / "paper_fig6.png", test.variance, estimates)
    held_out = [
        noise_trials.Trial(name, noise_data.trajectory_split(fresh, index)[1])
        for index, name in enumerate(noise_data.PAPER_TRAJECTORIES)
    ]
    by_trajectory, of_trajectory = ratio_table(
        regressors, progress.track(held_out, "trajectories", len(held_out), "set")
    )
    # Rare misses weigh as much as all else: with fewer windows one of them decides the figure.
    levels = noise_trials.level_trials(DATA_SEED + 1, count if args.quick else 20_000)
    by_level, of_level = ratio_table(
        regressors, progress.track(levels, "levels", len(levels), "set")
    )
    disturbances = noise_trials.disturbance_trials(DATA_SEED + 2, count)
    by_disturbance, of_disturbance = ratio_table(
        regressors, progress.track(disturbances, "disturbances", len(disturbances), "set")
    )
    aside = noise_trials.fresh_trials(DATA_SEED + 3, count)
    by_unseen, _ = ratio_table(regressors, progress.track(aside, "kept aside", len(aside), "set"))
    once_aside = noise_trials.once_unseen_trials(DATA_SEED + 4, count)
    by_once_unseen, _ = ratio_table(
        regressors, progress.track(once_aside, "once kept aside", len(once_aside), "set")
    )
    times = {name: inference_time(r, 200 if args.quick else 2000) for name, r in regressors.items()}

    bars += [
        Bar(
            "paper's network, paper's set, random split: q RMSE",
            scores["paper's network"].rmse,
            (-np.inf, 0.0018),
        ),
        Bar(
            "ours, paper's set, never trained on it: q RMSE",
            scores["ours"].rmse,
            *at_most(0.00165, 0.00158),
        ),
        Bar(
            "ours, worst trajectory: q RMSE / bound",
            max(of_trajectory["ours", t.name][0] for t in held_out),
            *at_most(1.15, 1.08),
        ),
        Bar(
            "ours, worst level from 1e-6 to 1: q RMSE / bound",
            max(of_level["ours", t.name][0] for t in levels),
            *at_most(1.35, 1.15),
        ),
        *(
            Bar(
                f"ours, {t.name}: median q̂/q",
                of_disturbance["ours", t.name][1],
                *(
                    ((0.75, 1.25), (0.9, 1.1))
                    if "low-pass" in t.name
                    else ((0.9, 1.1), (0.95, 1.05))
                ),
            )
            for t in disturbances
            if t.name != "clean"
        ),
        Bar(
            "inference, six channels, one thread: median [ms]",
            1e3 * times["ours"][0],
            *at_most(0.3, 0.1),
        ),
    ]
    bound = scores["ours"].bound
    return [
        "## The estimators by themselves",
        f"The paper's set: six trajectories, 400 s at 100 Hz, 15 variances, windows of 200; "
        f"{len(test.variance)} test windows of its random split, on whose other 80 % the paper's "
        "network was trained and ours was not. The Cramér–Rao bound of the set is "
        f"{bound:.5f}; the paper reports {PAPER_RMSE}.",
        table(
            ("estimator", "q RMSE", "RMSE / bound", "inference, six channels [ms]"),
            [
                (name, f"{s.rmse:.5f}", f"{s.rmse / s.bound:.3f}", f"{1e3 * times[name][0]:.3f}")
                for name, s in scores.items()
            ],
        ),
        "![Predicted against true q](figures/paper_fig6.png)",
        "*The paper's Fig. 6: predictions (grey) and their mean for each true q (points).*",
        lengths(args, test),
        "### Motion by trajectory",
        "q RMSE over the bound, and the median of q̂/q in brackets; fresh noise. The paper's "
        "network was trained on these motions, ours on none of them.",
        by_trajectory,
        "### Levels outside the paper's range",
        by_level,
        "### Disturbances, q = 0.01",
        by_disturbance,
        "### Held out until the model was final",
        "Disturbances of other kinds than any in training, q from 1e-6 to 1.",
        by_unseen,
        "### Held out from the first model",
        "That one failed at the knocks; blows that ring are in the training since, so that this "
        "set is not unseen any more.",
        by_once_unseen,
    ]


def lengths(args: argparse.Namespace, test: Windows) -> str:
    """Draw the paper's Fig. 4 and return what to say about it."""
    true = np.sqrt(np.mean(test.variance**2))
    curves: dict[str, dict[int, float]] = {"spectral": {}, "ours": {}, "paper's network": {}}
    stems = {"ours": "plateau", "paper's network": "paper"}
    for n in progress.track(LENGTHS, "window lengths", len(LENGTHS), "set"):
        # Another seed than any network's training noise, and as many samples for every length.
        duration = 20.0 if args.quick else 60.0
        windows = noise_data.paper_set(DATA_SEED + n, n, duration_s=duration)
        curves["spectral"][n] = score(SpectralRegressor(n), windows).rmse
        for name, stem in stems.items():
            path = share_path(f"models/{stem}.onnx")
            if n != 200:
                if args.by_window is None or not (args.by_window / f"{stem}_{n}.onnx").is_file():
                    continue
                path = args.by_window / f"{stem}_{n}.onnx"
            curves[name][n] = score(Regressor.load(path), windows).rmse
    figures.rmse_against_length(args.figures / "paper_fig4.png", curves, true)
    retrained = len(curves["paper's network"]) > 1
    origin = (
        "The networks for other lengths than 200 were trained for this figure alone, in two "
        "minutes each, with less data and fewer epochs than those in `models/`, by "
        "`python -m tools.regressor.train --out FOLDER --window N` with "
        "`--model plateau --name plateau_N --windows 300000` and "
        "`--model paper --name paper_N --epochs 10`."
        if retrained
        else "The networks' window is fixed at 200; for other lengths train them with "
        "`tools/regressor/train.py --window N` and give their folder by `--by-window`."
    )
    heads = ("N", "bound", *curves)
    rows = [
        (
            n,
            f"{true * np.sqrt(2.0 / n):.5f}",
            *(f"{curve[n]:.5f}" if n in curve else "–" for curve in curves.values()),
        )
        for n in LENGTHS
    ]
    return "\n\n".join(
        (
            "![q RMSE against the window's length](figures/paper_fig4.png)",
            f"*The paper's Fig. 4: q RMSE against the window's length N.* {origin}",
            table(heads, rows),
        )
    )
