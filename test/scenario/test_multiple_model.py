"""A clock that nothing is known of is found among many, and nothing else changes by that."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.clock_searches import (
    SCENE,
    SECOND,
    assert_heading_and_clock_are_found,
    estimating,
    nees_after_takeover,
    offset,
    told_and_waiting,
    until,
)
from support.runs import moved, stamped_early, through_estimator
from support.wander import smooth_wander

from hybrid_ins import parameters
from hybrid_ins.core.alignment import clock_search, multiple_model
from hybrid_ins.core.alignment.clock_search import (
    OFFSETS_NS,
    SPEED_STD,
    TILT_STD,
    ClockSearch,
    probabilities,
    state_at_offset,
)
from hybrid_ins.core.alignment.multiple_model import N_HEADINGS, MultipleModelBank
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.inertial.earth import LocalFrame, curvature_scale
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.inertial.state import DP, DV, EPS, NAVIGATION, VELOCITY, NavState, covariance
from hybrid_ins.core.navigator.phases import Searching, search_clock
from hybrid_ins.core.noise.heading_information import OF_FILTER, VARIANCE
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.update.kalman import inject
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.filter_factory import FilterFactory
from hybrid_ins.ros.messages.conversions import SWAP
from tools.paper.runs import Run, draw

AUTO = {"alignment.heading_source": "auto"}


def jumping(run: Run, at: float, by: float) -> Run:
    """Stamp the fixes ``by`` [s] early from ``at`` [s] on."""
    since = int(run.samples["t_ns"][0]) + round(at * SECOND)
    return replace(
        run,
        fixes=tuple(
            replace(f, t_ns=f.t_ns - round(by * SECOND)) if f.t_ns > since else f for f in run.fixes
        ),
    )


def found(estimator: Estimator) -> tuple[float, float]:
    told = estimator.clock.found()
    assert told is not None
    return told


@pytest.mark.parametrize(
    ("true", "late"),
    [
        (-0.23, 0.3),
        *(pytest.param(t, 0.0, marks=pytest.mark.slow) for t in (-0.5, 0.0, 0.35)),
    ],
)
def test_any_offset_within_reach_is_found_soon(true: float, late: float) -> None:
    run = until(stamped_early(draw(SCENE, 4), true), 22.0)
    estimator = estimating(run, late)

    assert estimator.navigator.phase.bank is None
    assert offset(estimator) == pytest.approx(true, abs=0.02)
    missing, sigma = found(estimator)
    assert sigma < 0.02
    assert abs(offset(estimator) + missing - true) < 4.0 * sigma
    # AND each fix is told of once, also those that waited for their samples by a wrong clock
    assert estimator.inputs.counts["gnss: clock offset found"] == 0
    if late == 0.0:
        told = told_and_waiting(estimator)
        np.testing.assert_allclose(told, [f.t_ns for f in run.fixes], rtol=0, atol=0.05 * SECOND)


@pytest.mark.parametrize(
    ("seed", "value", "true"),
    [
        (0, 0.0, -0.35),
        pytest.param(2, 0.5, 0.1, marks=pytest.mark.slow),
        pytest.param(5, -0.3, -0.2, marks=pytest.mark.slow),
    ],
)
def test_heading_and_clock_are_found_together(seed: int, value: float, true: float) -> None:
    assert_heading_and_clock_are_found(seed, value, true)


@pytest.mark.slow
def test_the_search_goes_on_beyond_its_edge() -> None:
    """A second search has to contradict the first for ten seconds."""
    estimator = estimating(until(stamped_early(draw(SCENE, 4), 1.1), 44.0))

    assert offset(estimator) == pytest.approx(1.1, abs=0.03)


@pytest.mark.slow
def test_the_filter_that_takes_over_is_where_it_says() -> None:
    """Its position is wrong by what the covariance allows, in the mean of 12 numbers."""
    assert 0.3 < np.mean(nees_after_takeover(range(4))) < 2.2


def test_the_position_that_is_published_meanwhile_is_that_of_its_stamp() -> None:
    run = until(stamped_early(draw(replace(SCENE, scored_from=1.0), 4), -0.25), 11.5)
    estimator = estimating(run, **AUTO)

    assert estimator.navigator.filter is None
    *_, last = (r.content for r in estimator.pop_reports() if r.topic == "gnss/filtered")
    stamps = run.samples["t_ns"][run.scored]
    latitude, longitude = (np.interp(last.t_ns, stamps, run.lla[:, k]) for k in (0, 1))
    north, east = (
        np.radians([last.latitude, last.longitude]) - [latitude, longitude]
    ) * curvature_scale(run.lla[0])[:2]
    speed = np.linalg.norm(run.velocity_n[np.searchsorted(stamps, last.t_ns)])
    assert np.hypot(north, east) < 0.3 * speed


@pytest.mark.slow
def test_before_the_heading_is_known_odometry_has_a_position_that_is_right() -> None:
    nees = []
    for seed in range(6):
        # GIVEN a flight whose heading and clock are unknown
        run = until(draw(replace(SCENE, scored_from=0.0), seed), 9.0)
        estimator = estimating(run, **AUTO)
        assert isinstance(estimator.navigator.phase, Searching)
        # THEN there is odometry from the second fix on, ten times a second
        collected = estimator.pop_reports()
        reports = [r.content for r in collected if r.topic == "odometry"]
        stamps = np.array([odometry.t_ns for odometry in reports])
        assert stamps[0] - run.fixes[0].t_ns < 1.1 * SECOND
        np.testing.assert_allclose(np.diff(stamps), 0.1 * SECOND, rtol=0.0, atol=0.011 * SECOND)
        # AND it is never said to lack fixes
        said = [r.content.text for r in collected if r.topic == "validity"]
        assert not any("coasting" in text for text in said) and "position good" in said[-1]
        # AND its position is right within its covariance
        truth = np.array([np.interp(stamps, run.samples["t_ns"][run.scored], x) for x in run.lla.T])
        found = np.array([odometry.values for odometry in reports])
        pose_covariance = found[:, 7:43].reshape(-1, 6, 6)
        error = found[:, :3] - LocalFrame(estimator.odometry.map.datum_lla).position(truth.T) @ SWAP
        nees.append(
            np.einsum("ni,nij,nj->n", error, np.linalg.inv(pose_covariance[:, :3, :3]), error) / 3.0
        )
        # AND the variance of the heading says that it is not known
        assert (pose_covariance[:, 5, 5] > 0.5**2).mean() > 0.8
    assert 0.2 < np.mean(nees) < 1.5


def test_the_mixture_is_a_second_moment_about_the_likeliest_hypothesis() -> None:
    # GIVEN hypotheses of which two are errors d away from the best
    rng = np.random.default_rng(3)
    best = NavState(
        np.array([0.6, 0.2, 30.0]), np.array([3.0, -2.0, 0.5]), quat_from_rpy(0.3, -0.2, 1.0),
        np.zeros(3), np.zeros(3), np.diag(rng.uniform(0.5, 1.0, 15)),
    )  # fmt: skip
    errors = np.repeat([2.0, 1.0, 0.4, 0.1, 0.01], 3) * rng.normal(size=(2, 15))
    states = [best]
    for d in errors:
        nav = best.to_flat()
        inject(nav, d)
        states.append(replace(NavState.from_flat(nav), P=2.0 * best.P))
    weights = np.array([0.5, 0.3, 0.2])
    bank = MultipleModelBank(
        states,
        lambda state, _: SimpleNamespace(nav=state.to_flat()),  # type: ignore[arg-type,return-value]
        FilterSettings(max_delay=1.0),
        weights,
    )
    # WHEN they are one state
    nav = bank.mixture()
    # THEN it is the best's, and its covariance is that of all about it
    np.testing.assert_array_equal(nav[NAVIGATION], best.to_flat()[NAVIGATION])
    expected = 1.5 * best.P + 0.3 * np.outer(errors[0], errors[0]) + 0.2 * np.outer(*errors[[1, 1]])
    np.testing.assert_allclose(covariance(nav), expected, rtol=0.0, atol=1e-6)


def test_fixes_in_quick_succession_are_not_given_to_all_hypotheses() -> None:
    run = until(draw(SCENE, 4), 6.0)
    bank = estimating(run).navigator.phase.bank
    assert isinstance(bank, ClockSearch)

    last, after = run.fixes[-1], (0.05, 0.2, 0.25, 0.3, 0.4)
    used = [bank.measure(replace(last, t_ns=last.t_ns + round(t * SECOND))) for t in after]

    assert used == [False, True, False, False, True]


def test_a_vehicle_that_hovers_is_searched_with_a_fix_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rotors shake it, so that it does not stand; its clock stays unknown for as long."""
    monkeypatch.setattr(clock_search, "IDLE_NS", 4 * SECOND)
    run = standing(draw(SCENE, 4))
    rng = np.random.default_rng(4)
    samples = run.samples.copy()
    samples["f"] += rng.normal(0.0, 0.5, (len(samples), 3))
    samples["w"] += rng.normal(0.0, 0.05, (len(samples), 3))
    run = until(replace(run, samples=samples), 12.0)
    bank = estimating(run).navigator.phase.bank
    assert isinstance(bank, ClockSearch) and len(bank.filters) > N_HEADINGS

    last = run.fixes[-1]
    used = [
        bank.measure(replace(last, t_ns=last.t_ns + round(t * SECOND)))
        for t in (1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
    ]

    assert used == [True, False, False, False, False, True]


def test_each_fix_is_told_of_once() -> None:
    # GIVEN fixes that wait for their samples, by the clock in force or by the right one
    run = until(stamped_early(draw(SCENE, 4), 0.1), 20.0)
    estimator = estimating(run, **{"gnss.time_offset.value": 0.5})

    assert offset(estimator) == pytest.approx(0.1, abs=0.02)
    assert estimator.inputs.counts["gnss: clock offset found"] > 0
    told = told_and_waiting(estimator)
    np.testing.assert_allclose(told, [f.t_ns for f in run.fixes], rtol=0, atol=0.05 * SECOND)


@pytest.mark.parametrize(
    ("seed", "by", "opened"),
    [
        (9, -0.2, 1),
        pytest.param(5, 0.2, 1, marks=pytest.mark.slow),
        pytest.param(9, -0.06, 0, marks=pytest.mark.slow),
        pytest.param(9, 0.1, 0, marks=pytest.mark.slow),
        pytest.param(6, 0.4, 1, marks=pytest.mark.slow),
    ],
)
def test_a_clock_that_jumps_is_found_anew_and_told_once(seed: int, by: float, opened: int) -> None:
    # GIVEN fixes that come by another clock of a sudden
    run = jumping(draw(replace(SCENE, duration=100.0), seed), 35.0, by)
    estimator = estimating(run)
    # THEN it shows in the state, or in the noise that the IMU would need, and the new one is found
    assert offset(estimator) == pytest.approx(by, abs=0.02)
    assert estimator.inputs.counts["gnss: clock offset"] == 1
    assert estimator.inputs.counts["gnss: state opened"] == opened


def test_the_filter_that_takes_over_knows_what_all_of_them_did(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = estimating(until(stamped_early(draw(SCENE, 4), -0.25), 6.0)).navigator.phase.bank
    assert isinstance(search, ClockSearch) and len(search.filters) > 1
    assert search.decide() is None
    monkeypatch.setattr(clock_search, "OFFSET_KNOWN", (1.0, 0))
    monkeypatch.setattr(multiple_model, "HEADING_KNOWN", ((3.0, 0),))
    headings = len(search.filters) // len(OFFSETS_NS)
    offsets = np.repeat(OFFSETS_NS, headings) * 1e-9
    prior = np.repeat(probabilities(ClockPrior(0.0, 0.0)), headings)
    means = offsets + [hypothesis.clock.residual for hypothesis in search.filters]
    squares = means**2 + [hypothesis.clock.sigma**2 for hypothesis in search.filters]
    decision = search.decide()
    assert decision is not None
    winner = decision.filter
    # By the innovations alone: the filter's clock has the same prior, which must not count twice.
    weights = np.exp(search.log_weights) / prior
    mean, square = (weights @ np.stack((means, squares), axis=1)) / weights.sum()
    assert decision.offset + winner.clock.residual == pytest.approx(mean)
    assert winner.clock.sigma == pytest.approx(np.sqrt(square - mean**2))
    assert winner.clock.missing[1] < winner.clock.sigma**2


@pytest.fixture
def clock_stays_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """No offset is ever known well enough."""
    for name in ("OFFSET_KNOWN", "OFFSET_BOUNDED"):
        monkeypatch.setattr(clock_search, name, (0.0, 0))
    monkeypatch.setattr(clock_search, "HARMLESS_NS", 10**18)


@pytest.mark.usefixtures("clock_stays_open")
def test_a_filter_runs_once_the_heading_is_known_while_the_clock_is_searched_for() -> None:
    # GIVEN a flight of which neither is known
    run = until(stamped_early(draw(SCENE, 0), -0.35), 20.0)
    estimator = estimating(run, **AUTO)
    # THEN a filter follows the IMU, at the likeliest offset, and the others go on
    phase = estimator.navigator.phase
    assert phase.is_provisional and phase.filter is not None
    assert phase.filter.t_ns == estimator.navigator.last_ns
    assert np.sqrt(phase.filter.state.P[8, 8]) < 0.1
    assert isinstance(phase.bank, ClockSearch) and phase.filter not in phase.bank.filters
    assert "the search goes on" in estimator.clock.status().text
    # AND what they find counts from the offset in force
    assert offset(estimator) == pytest.approx(-0.35, abs=0.1)
    assert phase.bank.in_force_ns == round(offset(estimator) * SECOND)
    assert offset(estimator) + found(estimator)[0] == pytest.approx(-0.35, abs=0.03)
    # AND each fix is told of once
    told = told_and_waiting(estimator)
    np.testing.assert_allclose(told, [f.t_ns for f in run.fixes], rtol=0, atol=0.05 * SECOND)
    # AND where the filter is surer of another offset than they are together, it is made less sure
    missing = found(estimator)[0]
    phase.filter.clock.set_estimate(0.3, 1e-3)
    estimator.navigator.continue_search()
    assert phase.filter.clock.sigma == pytest.approx(0.3 - missing, abs=0.02)


@pytest.mark.usefixtures("clock_stays_open")
def test_another_filter_runs_where_the_search_excludes_the_offset_of_the_first() -> None:
    # GIVEN a filter that runs at one of the offsets
    estimator = estimating(until(stamped_early(draw(SCENE, 0), -0.35), 20.0), **AUTO)
    first, bank = estimator.navigator.filter, estimator.navigator.phase.bank
    assert first is not None and isinstance(bank, ClockSearch)
    # WHEN the fixes show another one, half a second away
    bank._offsets_ns = [offset_ns + SECOND // 2 for offset_ns in bank._offsets_ns]
    bank._prior_of_offset = dict.fromkeys(bank._offsets_ns, 0.0)
    likeliest_ns = bank._offsets_ns[bank._best]
    estimator.navigator.continue_search()
    estimator._handle_notices()
    # THEN a filter runs at that
    second = estimator.navigator.filter
    assert estimator.navigator.phase.is_provisional and second is not None and second is not first
    assert offset(estimator) == pytest.approx(1e-9 * likeliest_ns)
    assert bank.in_force_ns == round(offset(estimator) * SECOND)


def test_the_filter_of_the_likeliest_offset_goes_on_once_that_is_known(
    monkeypatch: pytest.MonkeyPatch, clock_stays_open: None
) -> None:
    # GIVEN a filter that runs while the clock is open
    run = stamped_early(draw(SCENE, 0), -0.35)
    estimator = estimating(until(run, 20.0), **AUTO)
    bank = estimator.navigator.phase.bank
    assert isinstance(bank, ClockSearch)
    # WHEN the offset is known, and a fix waits for the IMU
    monkeypatch.setattr(clock_search, "OFFSET_KNOWN", (1.0, 0))
    last = next(f for f in run.fixes if f.t_ns > run.fixes[0].t_ns + 20 * SECOND)
    waits = replace(last, t_ns=estimator.navigator.last_ns + SECOND // 4)
    estimator.navigator.measure(waits)
    estimator.navigator.continue_search()
    estimator._handle_notices()
    # THEN the search has ended, with its best filter
    phase = estimator.navigator.phase
    assert not phase.is_provisional and phase.bank is None and phase.filter is bank.best
    # AND the fix still waits
    assert [m.lla.tolist() for m in phase.filter.withdraw()] == [waits.lla.tolist()]
    assert not estimator.navigator.phases.clock_open
    assert offset(estimator) == pytest.approx(-0.35, abs=0.1)


def test_a_search_expects_the_given_offset_where_the_given_drift_has_taken_it() -> None:
    """
    GIVEN an offset of 0.1 s at the first fix, and a clock that gains 10 ms a second
    THEN all hypotheses expect that drift, and the likeliest offset is the one it leads to.
    """
    given = {"gnss.time_offset.value": 0.1, "gnss.time_offset.drift": 1e4}
    estimator = estimating(until(draw(SCENE, 4), 5.0), **given)
    running = estimator.navigator.filter
    assert running is not None
    since = (running.t_ns - estimator.clock.prior.t_ns) * 1e-9
    assert 3.0 < since < 6.0 and running.clock.drift == pytest.approx(0.01, abs=5e-4)

    # Its own estimate, which is the same, says nothing here.
    running.clock.set_estimate(0.0, 10.0)
    search = search_clock(running, estimator._parts, estimator.navigator.ring)

    assert {hypothesis.clock.drift for hypothesis in search.filters} == {0.01}
    expected = 0.1 + 0.01 * since - estimator.clock.offset
    assert max(
        search._prior_of_offset, key=search._prior_of_offset.__getitem__
    ) * 1e-9 == pytest.approx(expected, abs=0.05)


def test_a_search_beside_a_filter_begins_with_the_noise_that_it_has_learned() -> None:
    """With an IMU much noisier than was assumed, chance favoured a clock 0.6 s away."""
    estimator = estimating(until(draw(SCENE, 4), 4.0))
    running = estimator.navigator.filter
    assert running is not None and running.noise.factors is not None
    running.noise.factors.found = NoiseFactors(800.0, 20.0)
    search = search_clock(running, FilterFactory(parameters.defaults()), estimator.navigator.ring)
    assert {hypothesis.noise.imu_factors for hypothesis in search.filters} == {(800.0, 20.0)}


def test_a_search_beside_a_filter_knows_how_little_the_motion_has_shown_of_the_heading() -> None:
    """A multirotor in a street was 75° off with 34° claimed, and 14° once the clock was found."""
    estimator = estimating(until(draw(SCENE, 4), 4.0))
    running = estimator.navigator.filter
    assert running is not None
    information = running.update.heading
    information.values[VARIANCE] = information.values[OF_FILTER] + 0.3
    before = information.considered(running.nav)

    search = search_clock(running, FilterFactory(parameters.defaults()), estimator.navigator.ring)

    assert before > 0.2
    considered = [h.update.heading.considered(running.nav) for h in search.filters]
    assert considered == pytest.approx(np.full(len(search.filters), before))
    assert all(h.update.heading is not information for h in search.filters)


@pytest.mark.slow
def test_a_known_clock_stays_known_when_the_filter_starts_anew() -> None:
    # GIVEN a clock that was found, and an IMU that is away for two seconds
    run = until(stamped_early(draw(SCENE, 4), 0.2), 26.0)
    t = (run.samples["t_ns"] - run.samples["t_ns"][0]) * 1e-9
    estimator = estimating(replace(run, samples=run.samples[(t < 19.0) | (t > 21.0)]))
    # THEN the filter that starts after that knows the clock from its beginning
    assert estimator.inputs.counts["restart: no IMU samples"] == 1
    assert estimator.navigator.phase.bank is None
    missing, sigma = found(estimator)
    assert sigma < 0.06
    assert offset(estimator) + missing == pytest.approx(0.2, abs=0.03)


def standing(run: Run) -> Run:
    rng = np.random.default_rng(1)
    samples = run.samples.copy()
    samples["f"] = [0.0, 0.0, -9.8] + 0.02 * rng.standard_normal(samples["f"].shape)
    samples["w"] = 0.002 * rng.standard_normal(samples["w"].shape)
    noise = 0.1 * rng.standard_normal((len(run.fixes), 3))
    fixes = tuple(
        replace(f, lla=run.fixes[0].lla + dn / curvature_scale(f.lla))
        for f, dn in zip(run.fixes, noise, strict=True)
    )
    return replace(run, samples=samples, fixes=fixes)


def test_fixes_that_wander_at_a_stand_show_their_slow_error_and_no_motion() -> None:
    # GIVEN a vehicle that stands while its fixes, which claim decimetres, wander by metres
    run = standing(draw(SCENE, 1))
    wander = smooth_wander(np.random.default_rng(3), (len(run.fixes), 3), 0.2, 6.0, 15.0)
    # WHEN nothing is known of heading and clock
    estimator = estimating(until(moved(run, wander), 35.0), **AUTO)
    # THEN neither is searched for, and what wanders is neither the vehicle nor its accelerometers
    bank = estimator.navigator.phase.bank
    assert bank is not None and not bank.clock_open
    assert np.linalg.norm(bank.best.nav[VELOCITY]) < 0.1
    noise = bank.best.noise
    assert noise.slow_error.stds[0] > 1.0
    assert noise.imu_factors[0] < 30.0


def test_while_nothing_moves_nothing_is_said() -> None:
    estimator = estimating(until(standing(draw(SCENE, 1)), 25.0))

    assert offset(estimator) == 0.0
    assert found(estimator)[1] > 0.2
    bank = estimator.navigator.phase.bank  # the heading that was given is not confirmed either
    assert bank is not None and not bank.clock_open and len(bank.filters) <= N_HEADINGS + 1
    assert "the search goes on" in estimator.clock.status().text


def test_while_nothing_moves_there_are_no_clocks_for_each_heading() -> None:
    run = standing(draw(SCENE, 1))
    estimator = estimating(until(run, 10.0), **AUTO)
    bank = estimator.navigator.phase.bank
    assert bank is not None and len(bank.filters) <= N_HEADINGS

    # WHEN the vehicle flies off
    moving = draw(SCENE, 1)
    t = (run.samples["t_ns"] - run.samples["t_ns"][0]) * 1e-9
    samples = np.where(t < 10.0, run.samples, moving.samples)
    estimator = estimating(until(replace(run, samples=samples), 12.0), **AUTO)
    # THEN there are
    bank = estimator.navigator.phase.bank
    assert bank is not None and len(bank.filters) > N_HEADINGS
    assert "clock offset" in estimator.status.waiting_for


def test_nothing_is_searched_for_unasked_and_no_longer_than_asked() -> None:
    run = until(stamped_early(draw(SCENE, 4), 0.1), 5.0)
    given = through_estimator(run, **{"gnss.time_offset.estimate": False})
    assert not isinstance(given.navigator.phase.bank, ClockSearch)

    estimator = through_estimator(run)
    assert isinstance(estimator.navigator.phase.bank, ClockSearch)
    estimator.change({"gnss.time_offset.estimate": False})
    assert estimator.navigator.phase.bank is None
    assert estimator.navigator.phases.filters == [estimator.navigator.filter]


def test_another_value_while_both_are_open_begins_anew() -> None:
    # GIVEN a search around a value that is then changed
    run = stamped_early(draw(SCENE, 4), 0.1)
    estimator = estimating(until(run, 6.0), **AUTO)
    bank = estimator.navigator.phase.bank
    assert bank is not None and bank.clock_open
    estimator.change({"gnss.time_offset.value": -0.2})

    assert estimator.navigator.phase.bank is None


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_of_what_clocks_differ_in_the_share_of_motion_is_evidence(
    monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """A car that was on a motorway from the start found a clock 0.58 s wrong, known to 0.06 s."""
    bank = estimating(until(draw(SCENE, 4), 6.0), **AUTO).navigator.phase.bank
    assert isinstance(bank, ClockSearch) and len(bank.filters) == len(OFFSETS_NS) * N_HEADINGS
    monkeypatch.setattr(clock_search, "share_of_motion", lambda values: share)
    bank.log_weights[:] = -np.log(len(bank.filters))
    of_clock = np.linspace(-1.0, 1.0, len(OFFSETS_NS))[:, None]
    of_heading = np.linspace(0.0, 3.0, N_HEADINGS)

    evidence = bank._evidence((of_clock + of_heading).ravel())

    expected = (share * of_clock + of_heading).ravel()
    np.testing.assert_allclose(evidence, expected, rtol=0, atol=1e-12)


def test_a_state_is_opened_to_what_a_wrong_clock_may_have_done() -> None:
    state = NavState(
        np.array([0.8, 0.2, 100.0]),
        np.array([10.0, -4.0, 1.0]),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        np.diag(np.full(15, 1e-4)),
    )
    there = state_at_offset(state, 0.5, False, np.zeros(3))

    moved = (there.lla - state.lla) * curvature_scale(state.lla)
    np.testing.assert_allclose(moved, [-5.0, 2.0, -0.5], atol=1e-6)
    std = np.sqrt(np.diag(there.P))
    np.testing.assert_allclose(std[DV], SPEED_STD)
    np.testing.assert_allclose(std[EPS], TILT_STD)
    np.testing.assert_allclose(std[DP], np.hypot(0.01, 0.5 * SPEED_STD))
    # A velocity that was too low has put the state too little back.
    np.testing.assert_allclose(there.P[DP, DV], -0.5 * SPEED_STD**2 * np.eye(3))
    # In calm motion a wrong clock does no more than displace the state.
    there = state_at_offset(state, 0.5, True, np.zeros(3))
    np.testing.assert_allclose((there.lla - state.lla) * curvature_scale(state.lla), moved)
    np.testing.assert_allclose(np.diag(there.P)[DV], 1e-4)
    np.testing.assert_allclose(np.diag(there.P)[EPS], 1e-4)
    np.testing.assert_allclose(there.P[DP, DV], -0.5e-4 * np.eye(3))
