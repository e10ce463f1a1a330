"""Several runs in one picture: what is on it, and the program that draws it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recordings import (
    DATUM,
    FAST,
    TRUTH,
    bag,
    complete_run,
    flight,
    run_program,
    shifted,
    with_sigma,
    write_track,
)

from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.run import Run

pytest.importorskip("matplotlib")
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from hybrid_ins.plotting.comparison import MOST_RUNS, comparison


def drawn(*runs: Run) -> Figure:
    return comparison([(run.name, run, evaluate_run(run)) for run in runs])


def texts(figure: Figure) -> str:
    return "\n".join(t.get_text() for t in figure.findobj(Text))


def panel(figure: Figure, title: str) -> Axes:
    (found,) = (a for a in figure.axes if a.get_title(loc="left").startswith(title))
    return found


def test_every_run_has_its_name_figures_track_and_errors() -> None:
    forward = complete_run()
    smoothed = replace(forward, name="smoothed", estimate=shifted(forward.estimate, [0.3, 0.4, 0]))

    figure = drawn(forward, smoothed)

    shown = texts(figure)
    for text in ("a_flight · PRMSE 0.51 m", "smoothed · PRMSE 0.1 m", "truth", "start", "N"):
        assert text in shown, text
    lines = panel(figure, "position error").lines
    assert [float(np.median(line.get_ydata())) for line in lines] == pytest.approx(
        [3 * 0.5 * 3**0.5, 0.51, 3 * 0.5 * 3**0.5, 0.1], abs=1e-3
    )


def test_two_runs_are_shown_with_their_separation_and_its_bound() -> None:
    forward = complete_run()
    assert forward.estimate.position_cov is not None
    better = replace(
        shifted(forward.estimate, [0.3, 0.4, 0.0]),
        position_cov=0.36 * forward.estimate.position_cov,
    )

    figure = drawn(forward, replace(forward, name="smoothed", estimate=better))

    apart, bound = panel(figure, "separation of the two (dotted: 3σ that it has where").lines
    assert np.median(apart.get_ydata()) == pytest.approx(0.5, abs=1e-6)
    assert np.median(bound.get_ydata()) == pytest.approx(3 * 0.8 * 0.5 * 3**0.5, abs=1e-6)
    three = drawn(*(replace(forward, name=name) for name in "abc"))
    assert "separation" not in texts(three)


def test_runs_of_different_datums_lie_on_one_map_and_one_time_axis() -> None:
    here = complete_run()
    there = LocalFrame(DATUM).lla(np.array([500.0, 300.0, 0.0]))
    moved = replace(
        here, name="moved", estimate=here.estimate.in_map_of(there).rows(slice(500, None))
    )

    figure = drawn(here, moved)

    first, second = panel(figure, "track").lines[:2]
    assert second.get_xdata()[-1] == pytest.approx(first.get_xdata()[-1], abs=0.01)
    heights = panel(figure, "height").lines
    assert heights[2].get_xdata()[0] == pytest.approx(5.0)


def test_without_truth_the_stated_bounds_are_drawn() -> None:
    alone = replace(complete_run(), truth=None)

    figure = drawn(alone, replace(alone, name="other"))

    assert "no truth" in panel(figure, "position: 3 ×").get_title(loc="left")
    assert len(panel(figure, "position: 3 ×").lines) == 2


def test_runs_without_covariance_and_truth_are_drawn() -> None:
    bare = Run("bare", flight(FAST))

    assert "not known" in texts(drawn(bare, bare))


def test_the_program_overlays_several_bags(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, east in (("one", 0.1), ("two", 0.2)):
        with bag(tmp_path / name, flight(TRUTH)) as out:
            write_track(out, "/odometry", with_sigma(shifted(flight(FAST), [east, 0.0, 0.0]), 0.5))
    picture = tmp_path / "both.svg"

    text, _ = run_program(
        capsys, 0, tmp_path / "one", tmp_path / "two", "--plot", picture, "--jobs", "1"
    )

    assert f"picture: {picture}" in text
    assert picture.stat().st_size > 10_000


def test_too_many_runs_for_one_picture_are_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [tmp_path / f"{k}.mcap" for k in range(MOST_RUNS + 1)]
    for name in names:
        name.write_bytes(b"")

    _, error = run_program(capsys, 2, *names, "--plot", tmp_path / "all.png")

    assert f"at most {MOST_RUNS} runs, not {MOST_RUNS + 1}" in error
