"""The HTML report: answers in words, everything in one file, nothing taken for markup."""

from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from support.recordings import (
    FAST,
    START_NS,
    TRUTH,
    bag,
    complete_run,
    flight,
    run_program,
    stamps,
    write_track,
)

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation import report
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.run import Run, SensorErrors, Series

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def whole() -> Run:
    return complete_run()


class Page(HTMLParser):
    """What a browser would load, and the tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [str(value) for name, value in attrs if name in ("src", "href")]


def test_the_questions_are_answered(whole: Run) -> None:
    answer = dict(report.answers(whole, evaluate_run(whole)))

    assert "PRMSE 0.51 m" in answer["How accurate is the estimate?"]
    assert (
        "NIS of the fixes is 1.00 per degree of freedom"
        in answer["Are the covariances consistent?"]
    )
    assert "× gate" in answer["Why were fixes rejected?"]
    assert "Gyroscope" in answer["When did the biases converge?"]
    assert "Source:" in answer["Which process noise was used?"]


def test_what_was_not_recorded_is_said() -> None:
    bare = Run("bare", flight(TRUTH))
    answers = report.answers(bare, evaluate_run(bare))

    assert "no truth" in answers[0][1]
    assert all("recorded" in answer for _, answer in answers[1:])


def test_a_bias_settles_when_its_uncertainty_stays_small() -> None:
    at = np.arange(0.0, 30.0)
    sigma = np.where(at < 12.0, 1.0, 0.1)[:, None] * np.ones(3)
    sigma[:, 1] = 1.0  # never
    times = report.settling_times(Series(stamps(at), np.zeros((30, 3)), sigma), START_NS)

    assert times == [12.0, 0.0, 12.0]


def test_an_axis_that_no_motion_showed_is_said_not_to_have_converged() -> None:
    at = np.arange(0.0, 30.0)
    sigma = np.where(at < 12.0, 1.0, 0.1)[:, None] * np.ones(3)
    sigma[:, 1] = 1.0
    seen = Series(stamps(at), np.zeros((30, 3)), sigma)
    run = replace(Run("run", flight(TRUTH)), sensor_errors=SensorErrors(seen))

    answer = dict(report.answers(run, evaluate_run(run)))["When did the biases converge?"]

    assert answer.startswith("Accelerometer: x after 12 s to ±0.1, y not yet, ±1, z after 12 s")


def test_page_is_complete_in_itself(whole: Run) -> None:
    odd = replace(whole, name="<script>alert(1)</script> & co")
    page = Page(report.page(odd, evaluate_run(odd), b"png"))

    assert "script" not in page.tags
    assert len(page.loads) == 1
    assert page.loads[0].startswith("data:image/png;base64,")


@pytest.mark.parametrize(("name", "text"), [("r.pdf", r"\.html"), ("no/r.html", "no such folder")])
def test_a_place_that_will_not_do_is_told_before_the_work(
    tmp_path: Path, name: str, text: str
) -> None:
    with pytest.raises(InputError, match=text):
        report.check(tmp_path / name)


def test_the_program_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", flight(FAST))
    page = tmp_path / "report.html"

    text, _ = run_program(capsys, 0, tmp_path / "run", "--report", page)

    assert f"report: {page}" in text
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
