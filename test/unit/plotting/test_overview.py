"""Pictures: what is on them, that they never fail, and that matplotlib stays optional."""

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from support.recordings import (
    FAST,
    TRUTH,
    bag,
    complete_run,
    flight,
    run_program,
    stamps,
    verdicts,
    with_sigma,
    write_track,
)

from hybrid_ins.cli import replay, simulate
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.result import Scoring
from hybrid_ins.evaluation.run import Run, SensorErrors, Series
from hybrid_ins.plotting import style
from hybrid_ins.plotting.error_panels import _zoom
from hybrid_ins.plotting.map_view import finish_map
from hybrid_ins.plotting.overview import overview

pytest.importorskip("matplotlib")
from matplotlib.axes import Axes
from matplotlib.figure import Figure


@pytest.fixture(scope="module")
def whole() -> Run:
    return complete_run()


def texts(figure: Figure) -> str:
    from matplotlib.text import Text

    return "\n".join(t.get_text() for t in figure.findobj(Text))


def test_one_page_shows_everything(whole: Run, tmp_path: Path) -> None:
    result = evaluate_run(whole, Scoring(skip=1.0))

    figure = overview(whole, result)
    style.save(figure, tmp_path / "run.png")

    shown = texts(figure)
    for text in (
        "a_flight", "PRMSE 0.51 m", "east [m]", "rejected fix", "east error", "north error",
        "up error", "heading error", "tilt error", "velocity error", "m/s", "deg", "NIS",
        "threshold", "rejected: gate (6)", "rejected: no covariance (1)", "accelerometer bias",
        "gyroscope bias", "accelerometer q", "learned", "time [s]; shaded: no accepted fix",
    ):  # fmt: skip
        assert text in shown, text
    header = (tmp_path / "run.png").read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20], "big") == 1600
    assert int.from_bytes(header[20:24], "big") == 1000


def panel(figure: Figure, title: str) -> Axes:
    (found,) = (a for a in figure.axes if a.get_title(loc="left").startswith(title))
    return found


@pytest.mark.parametrize("count", [1, 4, 12])
def test_the_legend_of_nis_stays_in_its_panel_and_off_the_points(whole: Run, count: int) -> None:
    # GIVEN rejections for many reasons, told at length
    at = np.arange(0.0, 20.0, 0.1)
    accepted = np.arange(len(at)) % 2 > 0
    reasons = [
        "" if ok else f"{i // 2 % count}: a reason that takes more words than a panel has room for"
        for i, ok in enumerate(accepted)
    ]
    nis = np.where(accepted, 3.0, 400.0)
    busy = replace(whole, verdicts=verdicts(at, accepted=accepted, nis=nis, reason=reasons))

    axes = panel(overview(busy, evaluate_run(busy)), "NIS")

    legend, room = axes.get_legend().get_window_extent(), axes.get_window_extent()
    assert room.x0 <= legend.x0
    assert legend.x1 <= room.x1
    assert legend.y1 <= room.y1
    assert axes.transData.transform((0.0, 400.0))[1] < legend.y0


def test_the_legend_of_nis_counts_what_is_shown(whole: Run) -> None:
    # GIVEN fixes that were refused before the first estimate, where the axis begins
    late = replace(whole, estimate=whole.estimate.rows(slice(500, None)), truth=None)
    at = np.arange(0.0, 20.0, 0.1)
    accepted = (at > 4.0) & (at != 10.0)
    refused = replace(
        late,
        verdicts=verdicts(at, accepted=accepted, reason=["" if a else "gate" for a in accepted]),
    )

    axes = panel(overview(refused, evaluate_run(refused)), "NIS")

    assert "rejected: gate (1)" in [str(text.get_text()) for text in axes.get_legend().get_texts()]


def test_the_map_has_the_start_of_the_run_a_scale_and_north(whole: Run) -> None:
    # GIVEN an estimate that begins 5 s, and 50 m, after the first fix
    late = replace(whole, estimate=whole.estimate.rows(slice(500, None)))

    figure = overview(late, evaluate_run(late))

    axes = panel(figure, "track")
    markers = {str(line.get_label()): line for line in axes.lines}
    assert markers["start"].get_xdata()[0] == pytest.approx(0.0, abs=0.01)
    assert markers["first estimate"].get_xdata()[0] == pytest.approx(49.7, abs=0.01)
    shown = texts(figure).splitlines()
    assert "N" in shown
    assert "50 m" in shown


@pytest.mark.slow
def test_the_map_of_a_vehicle_that_stands_is_no_smaller_than_the_vehicle() -> None:
    """Its scale bar said 1e-11 m."""
    axes = Figure().add_subplot()
    axes.plot([3.0, 3.0], [-2.0, -2.0 + 1e-12], label="estimate")

    finish_map(axes, [np.array([[3.0, -2.0, 0.0]])])

    for (low, high), at in ((axes.get_xlim(), 3.0), (axes.get_ylim(), -2.0)):
        assert high - low > 0.5 and 0.5 * (low + high) == pytest.approx(at)


def test_svg_is_well_formed_and_the_same_each_time(whole: Run, tmp_path: Path) -> None:
    for name in ("one.svg", "two.svg"):
        style.save(overview(whole, evaluate_run(whole)), tmp_path / name)

    assert ElementTree.parse(tmp_path / "one.svg").getroot().tag.endswith("svg")
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_without_truth_the_filter_s_own_sigma_is_drawn(whole: Run) -> None:
    alone = replace(whole, truth=None)

    shown = texts(overview(alone, evaluate_run(alone)))

    for title in ("east ±3σ", "heading ±3σ", "body velocity ±3σ"):
        assert title in shown
    assert "error" not in shown
    assert "PRMSE" not in shown


def test_a_wide_headline_ends_within_the_picture_and_short_reasons_are_whole(whole: Run) -> None:
    busy = replace(
        whole,
        name="a recording with a name that says all about vehicle, place, day, weather and crew",
        verdicts=verdicts(
            np.arange(0.0, 20.0, 0.1), accepted=np.arange(200) % 9 > 0, nis=np.full(200, 1e3),
            reason=["innovation beyond the gate"] * 200, kind=["position"] * 200,
        ),
    )  # fmt: skip
    result = replace(evaluate_run(busy), prmse=1.23e12, pmae=1.23e12, heading_rmse=1.0)

    figure = overview(busy, result)

    headline = figure._suptitle  # type: ignore[attr-defined]
    assert len(headline.get_text()) > 150
    assert headline.get_window_extent().x1 < figure.bbox.x1
    assert "rejected: innovation beyond the gate (" in texts(figure)


@pytest.mark.parametrize("most", [2.2, 3.0, 9.0, 40.0, 300.0])
def test_a_logarithmic_part_has_a_tick_near_its_end(most: float) -> None:
    """GIVEN errors of 0.2 m, and of metres in an outage WHEN drawn THEN a label tells how many."""
    figure = Figure()
    axes = figure.subplots()
    errors = np.full((100, 1), 0.2)
    errors[50:60] = most

    _zoom(axes, errors, None)

    assert 0.08 * most < max(axes.get_yticks()) <= 1.1 * most
    assert max(axes.get_yticks()) > 0.4


def test_a_long_title_ends_before_the_legend_beside_it() -> None:
    axes = Figure(figsize=(5.0, 2.0)).add_subplot()
    for name in "xyz":
        axes.plot([0.0, 1.0], label=name)
    title = axes.set_title("body velocity error: RMS 0.98 m/s, 74.2 % in ±3σ, log > 2", loc="left")

    style.legend_above(axes)

    assert title.get_window_extent().x1 < axes.get_legend().get_window_extent().x0


def test_a_bare_estimate_makes_a_picture_that_says_what_is_missing(tmp_path: Path) -> None:
    bare = Run("bare", replace(flight(FAST), quat_xyzw=None, velocity_enu=None))

    figure = overview(bare, evaluate_run(bare))
    style.save(figure, tmp_path / "bare.png")

    shown = texts(figure)
    assert "no verdicts recorded" in shown
    assert "not recorded" in shown
    assert "not known" in shown


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "value",
    [0.0, np.inf, *(pytest.param(odd, marks=pytest.mark.slow) for odd in (np.nan, 1e12))],
)
def test_odd_values_do_not_stop_it(whole: Run, tmp_path: Path, value: float) -> None:
    estimate = whole.estimate
    assert estimate.position_cov is not None
    cov = estimate.position_cov.copy()
    cov[500:900] = value
    odd = Series(stamps(np.arange(4.0)), np.full((4, 3), value), np.full((4, 3), value))
    run = replace(
        whole,
        estimate=replace(estimate, position_cov=cov, attitude_cov=cov),
        sensor_errors=SensorErrors(odd, None, None, odd),
        verdicts=replace(whole.verdicts, nis=np.full(len(whole.verdicts), value)),
    )

    style.save(overview(run, evaluate_run(run)), tmp_path / "odd.png")


def test_long_runs_are_thinned_without_losing_a_spike() -> None:
    at = np.arange(0.0, 600.0, 0.001)
    values = np.sin(at)
    values[123_456], values[400_001] = 50.0, -60.0
    values[200] = np.nan

    t, y = style.thin(at, values)

    assert len(t) < 4000
    assert np.nanmax(y) == 50.0
    assert np.nanmin(y) == -60.0
    assert np.all(np.diff(t) > 0)


def test_lines_are_broken_where_time_is_missing() -> None:
    at = np.concatenate((np.arange(0.0, 5.0, 0.1), np.arange(9.0, 12.0, 0.1)))

    t, y = style.thin(at, at)

    assert np.sum(np.isnan(t)) == 1
    assert np.isnan(y[50])


@pytest.mark.parametrize(
    ("value", "text"), [(184.2, "180"), (0.0614, "0.061"), (12345.0, "12000"), (5.01, "5")]
)
def test_numbers_of_a_headline_have_no_exponent(value: float, text: str) -> None:
    assert style.rounded(value, 2) == text


@pytest.mark.parametrize(("name", "text"), [("run.jpg", ".png or .svg"), ("run", ".png or .svg")])
def test_other_formats_are_rejected(tmp_path: Path, name: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        style.check(tmp_path / name)


def test_without_matplotlib_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    with pytest.raises(InputError, match=r"hybrid_ins\[plot\]"):
        style.check(tmp_path / "run.png")


def test_evaluation_does_not_load_matplotlib() -> None:
    code = "import sys, hybrid_ins.cli.evaluate; sys.exit('matplotlib' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_heading_that_was_never_known_is_not_drawn() -> None:
    stated = with_sigma(flight(FAST), 0.5)
    assert stated.attitude_cov is not None
    attitude_cov = stated.attitude_cov.copy()
    attitude_cov[:, 2, 2] = 1.84**2
    run = Run("run", replace(stated, attitude_cov=attitude_cov), flight(TRUTH))

    shown = texts(overview(run, evaluate_run(run)))

    assert "heading never known" in shown
    assert "heading error" in shown
    assert "not known" in shown


def test_the_program_writes_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", with_sigma(flight(FAST), 0.5))

    text, _ = run_program(capsys, 0, tmp_path / "run", "--plot", tmp_path / "run.svg")

    assert f"picture: {tmp_path / 'run.svg'}" in text
    assert (tmp_path / "run.svg").stat().st_size > 10_000


@pytest.mark.slow
def test_replay_draws_what_it_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown, out, picture = (str(tmp_path / name) for name in ("flown", "out", "run.png"))
    options = ["--duration", "8", "--imu-rate", "100", "--heading", "0"]
    given = ["-p", "alignment.heading_source:=parameter", "-p", "alignment.yaw:=1.5708"]
    given += ["-p", "gnss.time_offset.estimate:=false"]
    assert simulate.main([flown, *options]) == 0

    assert replay.main([flown, out, *given, "--plot", picture]) == 0
    assert f"picture: {picture}" in capsys.readouterr().out
    assert Path(picture).stat().st_size > 10_000

    assert replay.main([flown, out, "--overwrite", "--plot", "run.bmp"]) == 2
    assert replay.main([flown, flown, out, "--plot", picture]) == 2
