"""Monte Carlo of the filter: seeded, paired, consistent where it is told the truth."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.errors import InputError
from hybrid_ins.simulation.motions import car_drive, static
from hybrid_ins.simulation.sensors import ImuErrors
from tools.paper.montecarlo import CONSTANTS, Method, fly, fly_all, state_errors
from tools.paper.runs import START_STD, T0_NS, Run, Scenario, draw

SHORT = Scenario("short", rate=100.0, duration=20.0, scored_from=5.0)
SWITCHING = replace(SHORT, duration=40.0, scored_from=10.0, rough=(10.0, 10.0), dwell=(5.0, 8.0))
ORACLE = Method("oracle", "oracle")


@pytest.fixture(scope="module")
def run() -> Run:
    return draw(SWITCHING, 1)


def test_a_seed_gives_the_same_run_and_another_seed_another() -> None:
    first, again, other = draw(SHORT, 3), draw(SHORT, 3), draw(SHORT, 4)

    assert first.samples.tobytes() == again.samples.tobytes()
    assert [f.lla.tolist() for f in first.fixes] == [f.lla.tolist() for f in again.fixes]
    assert first.samples.tobytes() != other.samples.tobytes()


def test_errors_at_the_start_are_drawn_from_the_covariance_that_the_filter_is_told() -> None:
    """Over its sigma the error has unit variance in every component; the vehicle stands yet."""
    scenario = replace(SHORT, duration=0.5, scored_from=0.0)
    runs = [draw(scenario, seed) for seed in range(60)]
    normalised = [state_errors(run, [run.start])[0] / START_STD for run in runs]
    run = runs[0]

    assert np.diag(run.start.P) == pytest.approx(np.square(START_STD))
    spread = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert np.all((spread > 0.7) & (spread < 1.35))


def test_noise_switches_between_two_levels_and_the_readings_show_it() -> None:
    run = draw(replace(SWITCHING, motion=lambda duration, seed: static(duration)), 1)
    factors = run.q[:, 0] / run.q[:, 0].min()

    assert set(np.round(np.unique(factors), 6)) == {1.0, 100.0}
    rough = factors > 50.0
    for part, std in ((rough, 0.2), (~rough, 0.02)):
        assert np.std(np.diff(run.samples["f"][part, 0])) == pytest.approx(
            std * np.sqrt(2.0), rel=0.15
        )


def test_no_epoch_is_scored_where_a_fix_was_fed(run: Run) -> None:
    scored = run.samples["t_ns"][run.scored]
    fixed = np.array([f.t_ns for f in run.fixes])

    assert run.t[0] >= SWITCHING.scored_from
    assert np.abs(scored[:, None] - fixed).min() == 100_000_000


def test_outages_take_fixes_away_and_leave_the_others_as_they_were(run: Run) -> None:
    outage = draw(replace(SWITCHING, outages=((20.0, 10.0),)), 1)
    left = {f.t_ns: f.lla.tolist() for f in outage.fixes}

    assert len(run.fixes) - len(left) == 50
    assert all(left[f.t_ns] == f.lla.tolist() for f in run.fixes if f.t_ns in left)
    assert not any(T0_NS + 20e9 <= t_ns < T0_NS + 30e9 for t_ns in left)


def test_told_the_truth_the_filter_is_consistent() -> None:
    """NEES of the oracle over flights: 15, within what so many independent flights may show."""
    values = [flights[0].nees.mean() for _, flights in fly_all(SWITCHING, [ORACLE], range(10))]

    assert 12.0 < np.mean(values) < 18.5


@pytest.mark.parametrize(("accelerometer", "most"), [(1.0, 1.15), (0.3, 1.4)])
def test_a_minute_without_fixes_leaves_the_filter_consistent(
    accelerometer: float, most: float
) -> None:
    """
    A car's errors grow to hundreds of metres; at the end of it and over 5 s after the return.

    The better the accelerometer, the less a tilt's error is hidden in its noise.
    """
    plain = ImuErrors()
    drive = Scenario(
        "outage",
        car_drive,
        rate=100.0,
        duration=126.0,
        scored_from=119.7,
        outages=((60.0, 60.0),),
        errors=replace(
            plain,
            accelerometer_std=accelerometer * plain.accelerometer_std,
            accelerometer_bias_walk=accelerometer * plain.accelerometer_bias_walk,
        ),
    )
    flights = [fly(draw(drive, seed), ORACLE) for seed in range(9000, 9030)]
    nees = np.mean([flight.nees for flight in flights], axis=0) / 15.0
    t = flights[0].t

    assert np.median([np.linalg.norm(f.position_error[0]) for f in flights]) > 100.0
    assert 0.85 < nees[t < 120.0].mean() < most
    assert 0.85 < nees[(t > 120.2) & (t < 125.0)].mean() < most


def test_the_learned_levels_come_close_to_the_oracle(run: Run) -> None:
    oracle = fly(run, ORACLE)
    learned = fly(run, Method("spectral", "learned", model="spectral"))

    assert learned.prmse < 1.05 * oracle.prmse
    assert not learned.fallback.any()
    assert np.median(learned.q / oracle.q) == pytest.approx(1.0, abs=0.1)
    assert oracle.q == pytest.approx(run.q[run.scored])


def test_units_as_printed_cost_accuracy(run: Run) -> None:
    consistent = fly(run, CONSTANTS[2])
    printed = fly(run, replace(CONSTANTS[2], as_printed=True))

    assert printed.prmse > 1.2 * consistent.prmse


def test_stable_innovation_levels_stay_bounded_and_the_literal_ones_run_away() -> None:
    """Without fixes the literal form is lost within seconds."""
    run = draw(replace(SHORT, duration=40.0, outages=((25.0, 10.0),)), 2)
    oracle = fly(run, ORACLE)
    stable = fly(run, Method("stable", "innovation", window=3))
    literal = fly(run, Method("literal", "literal", window=3))

    assert stable.q[:, :3].max() < 1e5
    assert np.median(literal.q[:, 0]) > 100.0 * np.median(stable.q[:, 0])
    assert literal.prmse > 3.0 * stable.prmse > 3.0 * oracle.prmse


def test_a_filter_that_is_lost_counts_as_infinitely_wrong(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.paper.montecarlo.LOST", 1e-3)
    flight = fly(run, ORACLE)

    assert flight.diverged
    assert flight.prmse == flight.pmae == np.inf


def test_metrics_are_those_of_the_paper(run: Run) -> None:
    flight = replace(fly(run, ORACLE), position_error=np.array([[3.0, -4.0, 0.0], [0.0, 0.0, 1.0]]))

    assert flight.prmse == pytest.approx(np.sqrt(26.0 / 2.0))
    assert flight.pmae == pytest.approx(4.0)


def test_a_model_that_cannot_be_loaded_is_an_error_not_another_model(run: Run) -> None:
    with pytest.raises(InputError, match="nowhere"):
        fly(run, Method("missing", "learned", model="nowhere.onnx"))


def test_processes_give_the_same_flights_as_one() -> None:
    scenario = replace(SHORT, errors=ImuErrors(accelerometer_std=0.05))
    alone = dict(fly_all(scenario, [ORACLE, *CONSTANTS[:1]], [1, 2]))
    together = dict(fly_all(scenario, [ORACLE, *CONSTANTS[:1]], [1, 2], jobs=2))

    assert alone.keys() == together.keys()
    for seed, flights in alone.items():
        for mine, theirs in zip(flights, together[seed], strict=True):
            assert mine.position_error.tolist() == theirs.position_error.tolist()
            assert mine.nees.tolist() == theirs.nees.tolist()
