"""The fault campaign disturbs what it says, and judges; docs/fault_campaign.md has all of it."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.cli import simulate
from hybrid_ins.errors import InputError
from tools.robustness import fault_campaign, fault_replays
from tools.robustness.campaign_results import FAULTS, RECOVERY, ResultFile, Row, over_draws
from tools.robustness.disturbances import Flight
from tools.robustness.fault_output import Output, Trace
from tools.robustness.fault_replays import Case, attempt, attempt_all, judge, replayed
from tools.robustness.faults import Fault

T = np.arange(0.0, 40.0, 0.1)
FAULT = Fault("some", "something happens", lambda flight: None, ("restart|jump", "no panic"))
CASE = Case("simulated", Path("flight.mcap"), parameters.defaults(), 10.0)
CLEAN = Trace(T, np.full(len(T), 0.2))
GOOD = Output(CLEAN, ("restart ×1",), (), 400)
AFTER = 9.95 + FAULT.duration + RECOVERY < T


def trace(after: float) -> Trace:
    return Trace(T, np.where(AFTER, after, 5.0))


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("faults") / "flight.mcap"
    words = "--duration 11 --imu-rate 50 --truth-rate 2 --gnss-velocity"
    assert simulate.main([str(path), *words.split()]) == 0
    return path


def messages(flight: Flight) -> list[str]:
    return [f"{e.log_ns} {e.topic} {e.data!r}" for e in flight.entries]


def test_names_are_unique_and_those_chosen_exist() -> None:
    names = [fault.name for fault in FAULTS]

    assert len(names) == len(set(names))
    assert len(names) >= 60 and set(fault_campaign.QUICK) <= set(names)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_changes_its_stretch_alone(fault: Fault, bag: Path) -> None:
    flight = Flight.read(bag, 6.0, min(fault.duration, 4.0))
    clean = messages(flight)

    fault.inject(flight)

    changed = set(messages(flight)) ^ set(clean)
    assert changed or fault.values
    early = [line for line in changed if int(line.split()[0]) < flight.from_ns]
    whole = fault.name.startswith(("always_", "start_", "no_fixes", "fix_first", "bag_loop"))
    assert whole or not early


def test_a_run_that_is_as_it_should_be_passes() -> None:
    assert not judge(FAULT, CASE, replace(GOOD, trace=trace(0.23)), CLEAN).failures


@pytest.mark.parametrize(
    ("output", "failure"),
    [
        (replace(GOOD, said=()), "nothing says 'restart|jump'"),
        (replace(GOOD, said=("restart ×1", "panic")), "said 'panic'"),
        (replace(GOOD, trace=trace(0.25)), "error 0.250 m, undisturbed 0.200 m"),
        (replace(GOOD, trace=trace(np.nan)), "odometry for 0%"),
        (replace(GOOD, faults=("NaN on /odometry",)), "NaN on /odometry"),
    ],
    ids=["silent", "false alarm", "error stays", "no odometry", "NaN"],
)
def test_a_run_that_is_not_fails(output: Output, failure: str) -> None:
    found = judge(FAULT, CASE, output, CLEAN).failures

    assert any(failure in text for text in found)


def test_odometry_where_none_may_be_fails() -> None:
    silent = replace(FAULT, silent=True)

    assert judge(silent, CASE, GOOD, CLEAN).failures == ("400 odometry messages",)


def test_an_exception_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(*_: object) -> Output:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(fault_replays, "replayed", crash)

    row = attempt(CASE, FAULTS[0].name, CLEAN)

    assert row.failures[0] == "crash: ZeroDivisionError: of the test"


def test_faults_share_the_replay_of_what_comes_before_them(bag: Path, tmp_path: Path) -> None:
    case = Case("simulated", bag, parameters.defaults(), 6.0)
    faults = [f for f in FAULTS if f.name in ("imu_nan", "fix_first_wild")]
    clean = replayed(case, None, tmp_path).trace
    rows: list[Row] = []

    attempt_all(case, faults, clean, rows.append)

    assert [row.fault for row in rows] == [fault.name for fault in faults]
    for row in rows:
        alone = attempt(case, row.fault, clean)
        assert (row.said, row.failures) == (alone.said, alone.failures)
        assert row.peak == pytest.approx(alone.peak, rel=1e-6, nan_ok=True)


def test_a_process_that_ends_is_a_failure(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case("simulated", bag, parameters.defaults(), 6.0)
    monkeypatch.setattr(fault_replays, "judge", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    rows: list[Row] = []

    attempt_all(case, FAULTS[:1], CLEAN, rows.append)

    assert [row.failures for row in rows] == [("crash: the process ended",)]


def row(draw: int, error: float, fault: str = "imu_nan", case: str = "simulated") -> Row:
    failures = (f"error {error}",) if error > 0.24 else ()
    return Row(fault, case, "", 1.0 + draw, 0.2, error, failures, draw)


def test_draws_are_judged_together_and_all_faults_by_as_many() -> None:
    good = [row(0, 0.25), row(1, 0.20), row(2, 9.0)]
    other = [row(0, 0.2, "fix_zero"), row(1, 0.2, "fix_zero"), row(0, 0.2, case="recorded, live")]

    rows, draws = over_draws([*other, *good])

    assert draws == 2 and [r.fault for r in rows] == ["imu_nan", "imu_nan", "fix_zero"]
    found = next(r for r in rows if r == replace(r, fault="imu_nan", case="simulated"))
    assert found.error == pytest.approx(np.sqrt((0.25**2 + 0.20**2) / 2))
    assert found.peak == 2.0 and not found.failures
    assert over_draws(good)[0][0].failures == ("error 5.199 m, undisturbed 0.200 m",)


def test_results_are_kept_and_only_of_one_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "results.jsonl"
    ResultFile(file).add(row(1, 0.25))

    assert ResultFile(file).rows() == [row(1, 0.25)]
    monkeypatch.setattr("tools.robustness.campaign_results.revision", lambda: "other")
    with pytest.raises(InputError, match="this is other"):
        ResultFile(file)


def test_a_few_faults_are_survived(capfd: pytest.CaptureFixture[str]) -> None:
    assert fault_campaign.main(["--quick", "--jobs", "1", "--draws", "2"]) == 0, (
        capfd.readouterr().out
    )
