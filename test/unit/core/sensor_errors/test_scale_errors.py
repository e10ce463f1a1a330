"""Scale errors: sensitivities, what fixes show of them, and the covariance in outages."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from support.analytic_motion import Series, Truth, Wave, difference, travel
from support.runs import begin as begin_run

from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose
from hybrid_ins.core.filter.events import Outage
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.earth import curvature_scale, normal_gravity
from hybrid_ins.core.inertial.rotations import matrix_from_quat, skew
from hybrid_ins.core.inertial.state import (
    DP,
    DV,
    EPS,
    N_ERROR,
    N_NAV,
    QUAT,
    VELOCITY,
    NavState,
    covariance,
    unpack_total,
)
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.outage_monitor import OutageMonitor
from hybrid_ins.core.noise.process_noise import ConstantNoise, Correction, ProcessNoise
from hybrid_ins.core.sensor_errors.scale_errors import N_LEVER, SHARES, VARYING, ScaleErrorObserver
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE, follow_samples
from hybrid_ins.core.update.chi_square import quantile
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.kalman import inject
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.simulation.motions import aircraft_flight, car_drive
from tools.paper.runs import Run, Scenario, draw

Array = np.ndarray[Any, np.dtype[np.float64]]
Samples = np.ndarray[Any, np.dtype[np.void]]

RATE = 100
SECOND = 1_000_000_000
STD = 0.01
SIGMA_0 = np.repeat([0.1, 0.05, 0.002, 0.01, 1e-4], 3)
Q = np.repeat([4e-4, 4e-6], 3)
NO_ROWS = np.empty((0, N_NAV))


def manoeuvres(seconds: float) -> Truth:
    """Return banked turns, climbs and changes of speed."""
    return travel(
        np.arange(int(RATE * seconds) + 1) / RATE,
        Series(rate=(12, 3, 0), waves=[Wave((30, 40, 8), 0.06, (0, 1.57, 0))]),
        Series(waves=[Wave((0.6, 0.3, 1.5), 0.11), Wave((0.1, 0.1, 0.2), 0.4, (1, 0, 2))]),
    )


def with_scale_errors(truth: Truth, m: Array) -> Samples:
    """
    Return the samples of an IMU with M_a and M_g, row by row in ``m``.

    They have no effect on gravity as it was measured after half a second, when outages begin: the
    biases contain that.
    """
    samples = np.zeros(len(truth.t), SAMPLE_DTYPE)
    samples["t_ns"] = truth.t_ns
    samples["f"], samples["w"] = truth.readings[:, :3], truth.readings[:, 3:]
    k = min(RATE // 2, len(truth.t) - 1)
    gravity_n = np.array([0.0, 0.0, normal_gravity(*truth.lla[k, ::2])[1]])
    return disturbed(samples, m, -truth.C_nb[k].T @ gravity_n)


def disturbed(samples: Samples, m: Array, f_0: Array) -> Samples:
    """Return samples with M_a (f - f₀) and M_g ω added, row by row in ``m``."""
    samples, (M_a, M_g) = samples.copy(), m.reshape(2, 3, 3)
    samples["f"] += (samples["f"] - f_0) @ M_a.T
    samples["w"] += samples["w"] @ M_g.T
    return samples


def advance(nav: Array, samples: Samples) -> Array:
    """Return a flat state, propagated by samples."""
    nav, readings = nav.copy(), np.hstack((samples["f"], samples["w"]))
    propagation.run(nav, np.full(len(samples), 1.0 / RATE), readings, 0.0, NO_ROWS)
    return nav


def start_filter(nav: Array, samples: Samples, std: float = STD) -> InsFilter:
    """Return a filter at the first of some samples; it is told ``std``."""
    ring = ImuRing()
    ring.extend(samples[:1])
    first = np.concatenate((samples["f"][0], samples["w"][0]))
    noise = FilterNoise(ConstantNoise(Q), ProcessNoise(np.zeros(6), 1.0 / RATE))
    gate = Gate({m: quantile(0.9999, m) for m in (1, 2, 3)}, 3.0)
    settings = FilterSettings(0.0, 5.0, scale_std=std)
    return InsFilter(NavState.from_flat(nav), 0, first, noise, gate, ring, settings)


def fly(ins: InsFilter, samples: Samples) -> list[Outage]:
    """Advance over samples in an outage, with its events; return these."""
    events = []
    for begin in range(0, len(samples), RATE // 2):
        part = samples[begin : begin + RATE // 2]
        ins.ring.extend(part)
        ins.predict_block(part)
        events.append(Outage(ins.t_ns))
        ins.submit(events[-1])
    return events


def turned_with(dx: Array) -> Array:
    """Return what `kalman.update_in_body` turns the errors by."""
    T = np.eye(N_ERROR)
    T[DP, EPS], T[DV, EPS] = skew(dx[DP]), skew(dx[DV])
    return T


def observer(ins: InsFilter) -> ScaleErrorObserver:
    """Return a filter's."""
    return ins.update.scale_errors


def smallest_eigenvalue(P: Array) -> float:
    """Return that of a covariance in units of its standard deviations."""
    std = np.sqrt(np.diag(P))
    return float(np.linalg.eigvalsh(P / np.outer(std, std))[0])


def test_growth_is_the_derivative_of_the_error_by_each_scale_error() -> None:
    """Over 8 s in pieces of any length, also between two samples."""
    truth = manoeuvres(8.0)
    exact, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    ins = start_filter(nav, exact, 1e-6)
    for end_ns in (500_000_000, 2_004_000_000, 2_007_000_000, 8 * SECOND):
        ins.submit(Outage(end_ns))
    ins.ring.extend(exact[1:])
    ins.predict_block(exact[1:])

    expected = np.empty((N_ERROR, N_SCALE))
    for k, m in enumerate(1e-4 * np.eye(N_SCALE)):
        up, down = (advance(nav, with_scale_errors(truth, s * m)[1:]) for s in (1.0, -1.0))
        expected[:, k] = difference(down, up) / 2e-4

    size = np.abs(expected).max(axis=1, keepdims=True) + 1e-6
    found = observer(ins).correlation / (1e-6 * SHARES)
    np.testing.assert_allclose(found / size, expected / size, atol=0.02)


def test_covariance_is_that_of_a_filter_that_considers_the_scale_errors() -> None:
    """
    GIVEN an outage in which wheels measure the velocity
    WHEN scale errors grow before and after that
    THEN the covariance is that of the state with 18 parameters that are never estimated.
    """
    truth = manoeuvres(1.0)
    samples, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    ins, plain = start_filter(nav, samples), start_filter(nav, samples)
    ins.submit(Outage(0))
    velocity_b = truth.C_nb[50].T @ truth.velocity_n[50]
    wheels = BodyVelocity(SECOND // 2, velocity_b, 1e-3 * np.eye(3), np.zeros(3))
    joint = np.zeros((N_ERROR + N_SCALE, N_ERROR + N_SCALE))
    joint[N_ERROR:, N_ERROR:] = np.eye(N_SCALE)
    for begin in (1, 51):
        part = samples[begin : begin + 50]
        for one in (ins, plain):
            one.ring.extend(part)
            one.predict_block(part)
        along, drive = np.eye(N_ERROR + N_SCALE), np.zeros((N_ERROR, N_SCALE))
        dt, readings = np.full(50, 1.0 / RATE), np.hstack((part["f"], part["w"]))
        transition = np.eye(N_ERROR)
        follow_samples(ins.nav, dt, readings, observer(ins)._reference, transition, drive)
        along[:N_ERROR, :N_ERROR], along[:N_ERROR, N_ERROR:] = transition, STD * SHARES * drive
        ins.submit(Outage(ins.t_ns))
        joint = along @ joint @ along.T
        joint[:N_ERROR, :N_ERROR] = covariance(ins.nav)
        if begin == 1:
            z, H, R = wheels.linearise(ins.nav)
            for one in (ins, plain):
                one.submit(wheels)
            assert ins.verdicts[-1].accepted
            P = joint[:N_ERROR, :N_ERROR]
            weight = ins.verdicts[-1].weight
            K = np.linalg.solve(H @ P @ H.T + R / weight, H @ P).T
            by_gain = np.eye(N_ERROR + N_SCALE)
            by_gain[:N_ERROR, :N_ERROR] -= K @ H
            joint = by_gain @ joint @ by_gain.T
            joint[:N_ERROR, :N_ERROR] += K @ (R / weight) @ K.T
            T = np.eye(N_ERROR + N_SCALE)
            T[:N_ERROR, :N_ERROR] = turned_with(K @ z)
            joint = T @ joint @ T.T
            np.testing.assert_allclose(covariance(ins.nav), joint[:15, :15], rtol=1e-6, atol=1e-15)
    assert smallest_eigenvalue(joint) > -1e-9  # covariance and correlation of one distribution
    correlation = observer(ins).correlation
    np.testing.assert_allclose(correlation, joint[:15, 15:], rtol=1e-6, atol=1e-12)
    assert covariance(ins.nav)[3, 3] > 1.2 * covariance(plain.nav)[3, 3]


def test_a_nose_that_contains_scale_errors_is_fused_as_what_it_is() -> None:
    """
    GIVEN an outage, scale errors of which something is known, and a nose that depends on them
    WHEN the constraint is fused
    THEN state, covariance and correlation are those of the optimal gain for the state and the 18
    parameters, which are never estimated.
    """
    truth, rng = manoeuvres(1.0), np.random.default_rng(5)
    samples, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    ins = start_filter(nav, samples)
    observer(ins)._parameters = np.concatenate((np.zeros(5), rng.standard_normal(N_SCALE)))
    fly(ins, samples[1:101])
    by_scale, rate_b = 0.02 * rng.standard_normal((2, N_SCALE)), samples["w"][100]
    x, y, z_ahead = matrix_from_quat(ins.nav[QUAT]).T @ ins.nav[VELOCITY]
    nose = Nose(np.arctan2(y, x) + 0.01, -np.arctan2(z_ahead, np.hypot(x, y)), np.zeros(3))
    constraint = NonHolonomic(ins.t_ns, rate_b, nose, np.diag([0.04, 0.09]), by_scale=by_scale)
    joint = np.eye(N_ERROR + N_SCALE)
    joint[:N_ERROR, :N_ERROR] = covariance(ins.nav)
    joint[:N_ERROR, N_ERROR:] = observer(ins).correlation
    joint[N_ERROR:, :N_ERROR] = observer(ins).correlation.T
    expected, (z, H, R) = ins.flat_state(), constraint.linearise(ins.nav)

    ins.submit(constraint)

    assert ins.verdicts[-1].accepted and ins.verdicts[-1].weight == 1.0
    m, H = observer(ins)._parameters[5:], np.hstack((H, by_scale))
    K = np.linalg.solve(H @ joint @ H.T + R, H @ joint).T
    K[N_ERROR:] = 0.0
    by_gain = np.eye(N_ERROR + N_SCALE) - K @ H
    joint = by_gain @ joint @ by_gain.T + K @ R @ K.T
    dx = K[:N_ERROR] @ (z - by_scale @ m)
    inject(expected, dx)
    T = turned_with(dx)
    P, correlation = T @ joint[:15, :15] @ T.T, T @ joint[:15, 15:]
    np.testing.assert_allclose(ins.nav[:16], expected[:16], rtol=1e-6)
    np.testing.assert_allclose(covariance(ins.nav), P, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(observer(ins).correlation, correlation, rtol=1e-5, atol=1e-9)


def position_nees(seconds: float, runs: int, std: float) -> Array:
    """Return the NEES of the position at the end of outages; the filter is told ``std``."""
    truth, found = manoeuvres(seconds), []
    for seed in range(runs):
        rng = np.random.default_rng([seed, 18])
        samples = with_scale_errors(truth, STD * SHARES * rng.standard_normal(N_SCALE))
        samples["f"] += 0.02 * rng.standard_normal((len(samples), 3))
        samples["w"] += 0.002 * rng.standard_normal((len(samples), 3))
        nav = truth.flat(P=np.diag(SIGMA_0**2))
        inject(nav, -SIGMA_0 * rng.standard_normal(N_ERROR))
        ins = start_filter(nav, samples, std)
        fly(ins, samples[1:])
        error = difference(truth.flat(len(truth.t) - 1), ins.nav)[DP]
        found.append(error @ np.linalg.solve(covariance(ins.nav)[DP, DP], error))
    return np.array(found)


@pytest.mark.parametrize("seconds", [10.0, 25.0])
def test_nees_at_the_end_of_an_outage_with_manoeuvres(seconds: float) -> None:
    """Two-sided, and seen to be wrong without scale errors or with twice as large ones."""
    runs = 60
    low, high = chi2.ppf((0.005, 0.995), 3 * runs) / runs

    assert low < position_nees(seconds, runs, STD).mean() < high
    assert position_nees(seconds, runs, 0.0).mean() > 2.0 * high
    assert position_nees(seconds, runs, 2.0 * STD).mean() < low


def test_an_outage_that_is_told_of_late_is_considered_from_then_on() -> None:
    """GIVEN 12 s without a fix or an event, longer than the motion is followed."""
    truth = manoeuvres(14.0)
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag(SIGMA_0**2)), samples)
    for end_ns in (12 * SECOND, 14 * SECOND):
        ins.submit(Outage(end_ns))
    ins.ring.extend(samples[1:])
    ins.predict_block(samples[1:])

    assert np.abs(observer(ins).correlation[3:6]).max() > STD


def test_a_manoeuvre_that_ends_as_it_began_takes_its_error_of_velocity_away() -> None:
    """GIVEN a scale error WHEN a vehicle speeds up and brakes THEN its speed is right again."""
    t = np.arange(8 * RATE + 1) / RATE
    truth = travel(t, Series(waves=[Wave((20, 0, 0), 1 / 8, (1.5 * np.pi, 0, 0))]), Series())
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag(SIGMA_0**2)), samples)
    velocity = []
    for half in (samples[1 : 2 * RATE + 1], samples[2 * RATE + 1 : 4 * RATE + 1]):
        fly(ins, half)
        velocity.append(abs(observer(ins).correlation[3, 0]) / STD)  # by the scale of f ahead

    assert velocity[0] == pytest.approx(truth.velocity_n[2 * RATE, 0], rel=0.02)
    assert velocity[0] > 15.0 and velocity[1] < 0.5


def test_covariance_stays_positive_definite_with_large_scale_errors_over_minutes() -> None:
    truth = manoeuvres(120.0)
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag((0.3 * SIGMA_0) ** 2)), samples, 0.1)

    fly(ins, samples[1:])

    assert covariance(ins.nav)[0, 0] > 1000.0**2
    assert smallest_eigenvalue(covariance(ins.nav)) > 0.0


@pytest.mark.parametrize("std", [0.005, 0.1])
def test_covariance_stays_positive_definite_with_wheels_at_any_stamp(std: float) -> None:
    """Readings of all axes at 10 Hz, stamped between samples, late, and hardly ever at a growth."""
    truth = manoeuvres(20.0)
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag(SIGMA_0**2)), samples, std)
    for begin in range(1, len(samples), RATE // 10):
        part = samples[begin : begin + RATE // 10]
        ins.ring.extend(part)
        ins.predict_block(part)
        if begin % (RATE // 2) == 31:
            ins.submit(Outage(ins.t_ns))
        k = begin + RATE // 10 - 4
        velocity_b = truth.C_nb[k].T @ truth.velocity_n[k]
        stamp_ns = int(samples["t_ns"][k]) + 3_000_000
        ins.submit(BodyVelocity(stamp_ns, velocity_b, 0.0025 * np.eye(3), np.zeros(3)))
        assert smallest_eigenvalue(covariance(ins.flat_state())) > 0.0

    assert all(verdict.accepted for verdict in ins.verdicts)
    assert np.abs(observer(ins).correlation).max() > 0.0


def test_a_late_fix_gives_the_result_of_an_in_order_run() -> None:
    """To the last bit, with scale errors before and after the fix; the fix ends the outage."""
    truth = manoeuvres(4.0)
    samples, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    events = fly(start_filter(nav, samples), samples[1:])
    lla = truth.lla[230] + np.array([0.2, -0.3, 0.1]) / curvature_scale(truth.lla[230])
    fix = PositionFix(2_300_000_000, lla, 0.01 * np.eye(3), np.zeros(3))
    late, in_order, without = (start_filter(nav, samples) for _ in range(3))
    in_order.submit(fix)
    for ins in (late, in_order, without):
        for event in events:
            ins.submit(event)
        ins.ring.extend(samples[1:])
        ins.predict_block(samples[1:])
    late.submit(fix)

    assert late.verdicts[-1].accepted
    np.testing.assert_array_equal(late.nav[:N_NAV], in_order.nav[:N_NAV])
    np.testing.assert_array_equal(observer(late).correlation, observer(in_order).correlation)
    velocity = [np.abs(observer(ins).correlation[3:6]).max() for ins in (late, without)]
    assert velocity[0] < 0.6 * velocity[1]  # since the fix, not since the start


class Phases:
    """What the monitor uses of a `PhaseMachine`."""

    def __init__(self) -> None:
        self.filter = object()
        self.submitted: list[Outage] = []

    def submit(self, event: Outage) -> None:
        self.submitted.append(event)


def watched(fixes_until: int, seconds: int) -> list[int]:
    """Return the stamps of a monitor's events: a fix every second from 1 s on, until one."""
    phases, watch, monitor = Phases(), FixWatch(), OutageMonitor()
    for t_ns in range(SECOND, (1 + seconds) * SECOND, SECOND // RATE):
        if t_ns % SECOND == 0 and t_ns <= fixes_until * SECOND:
            fix = PositionFix(t_ns, np.zeros(3), np.eye(3), np.zeros(3))
            watch.on_verdict(replace(Verdict.rejected(fix, ""), accepted=True))
        monitor.run_periodic(phases, watch, t_ns)  # type: ignore[arg-type]
    return [event.t_ns for event in phases.submitted]


def test_monitor_tells_filters_of_outages_alone() -> None:
    stamps = watched(10, 20)

    assert min(stamps) == pytest.approx(13.0 * SECOND, abs=0.6 * SECOND)
    np.testing.assert_array_equal(np.diff(stamps), SECOND // 2)
    assert not watched(20, 20)


DRIVE = Scenario("drive", car_drive, rate=100.0, duration=120.0, fix_rate=1.0, scored_from=0.6)
ORBIT = Scenario(
    "orbit", aircraft_flight, rate=100.0, duration=120.0, fix_rate=1.0, scored_from=0.6
)
FLIGHT = Scenario("flight", rate=100.0, duration=30.0, scored_from=0.6)


def precise(seed: int, scenario: Scenario = DRIVE) -> Run:
    """Return a run with a position known to 2 cm wherever the truth is, once a second."""
    run, rng = draw(scenario, seed), np.random.default_rng([seed, 4])
    stamps, fixes = run.samples["t_ns"][run.scored], []
    for t_ns, lla in zip(stamps, run.lla, strict=True):
        lla = lla + 0.02 * rng.standard_normal(3) / curvature_scale(lla)
        fixes.append(PositionFix(int(t_ns), lla, 4e-4 * np.eye(3), np.zeros(3)))
    return replace(run, fixes=tuple(fixes))


def filtered(run: Run, std: float, scale: Array, f_0: Array | None = None) -> InsFilter:
    """Run a filter that is told ``std`` over all samples, with scale errors (N_SCALE,) added."""
    f_0 = run.samples["f"][:50].mean(axis=0) if f_0 is None else f_0
    run = replace(run, samples=disturbed(run.samples, scale, f_0))
    ins = begin_run(run, scale_std=std)
    ins.ring.extend(run.samples[1:])
    for fix in run.fixes:
        ins.submit(fix)
    last = int(run.samples["t_ns"][-1])
    for t_ns in range(run.fixes[-1].t_ns + 3 * SECOND, last + 1, SECOND // 2):
        ins.submit(Outage(t_ns))
    ins.predict_block(run.samples[1:])
    return ins


@pytest.mark.parametrize("element", [0, 1, 8, 9, 13, 14, 17])
def test_sensitivity_is_the_derivative_of_the_filter_by_a_scale_error(element: int) -> None:
    run = draw(replace(FLIGHT, fix_rate=5.0), 1)
    last = int(np.searchsorted(run.samples["t_ns"], run.fixes[-1].t_ns, side="right"))
    run = replace(run, samples=run.samples[:last])
    right = filtered(run, 1e-9, np.zeros(N_SCALE))
    f_0 = observer(right)._reference[:3]
    wrong = filtered(run, 1e-9, 1e-4 * np.eye(N_SCALE)[element], f_0)
    U = observer(right)._U[:, N_LEVER + element] / (1e-9 * SHARES[element])
    sigma = np.sqrt(np.diag(right.state.P))

    by_difference = difference(right.nav, wrong.nav) / 1e-4

    assert np.linalg.norm(U / sigma) > 1.0
    assert np.linalg.norm((by_difference - U) / sigma) < 0.15 * np.linalg.norm(U / sigma)


def test_innovations_without_known_scale_errors_are_those_of_an_exact_imu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GIVEN a filter that knows the scale errors of its IMU, and one whose IMU has none."""
    run, m, seen = draw(replace(FLIGHT, fix_rate=5.0), 1), 1e-4 * SHARES, list[list[Correction]]()
    known = np.zeros(N_SCALE)
    learn = FilterNoise.learn_correction

    def learning(self: FilterNoise, wrong: Correction, explained: Correction | None = None) -> None:
        seen[-1].append(explained or wrong)
        learn(self, wrong, explained)

    def knowing(self: ScaleErrorObserver, *_: Any) -> None:
        self._parameters = np.concatenate((np.zeros(5), known))

    monkeypatch.setattr(FilterNoise, "learn_correction", learning)
    monkeypatch.setattr(ScaleErrorObserver, "_learn", knowing)
    f_0: Array | None = None
    for share, errors in ((0.0, 0.0 * m), (0.0, m), (0.01, m)):
        known[:] = share
        seen.append([])
        ins = filtered(run, STD, errors, f_0)
        f_0 = observer(ins)._reference[:3] if f_0 is None else f_0

    for part in ("z", "dx"):
        exact, wrong, explained = (
            np.array([getattr(one, part) for one in run[20:140]]) for run in seen
        )
        assert np.linalg.norm(explained - exact) < 0.2 * np.linalg.norm(wrong - exact), part


def test_scale_errors_are_found_with_an_honest_sigma() -> None:
    """Errors of many drives over their sigma; turns show the scale of the gyroscope about them."""
    squares, sharper = [], []
    for seed in range(20):
        constant = STD * np.sqrt(1.0 - VARYING) * SHARES
        m = constant * np.random.default_rng([seed, 5]).standard_normal(N_SCALE)
        found = filtered(precise(seed), STD, m).scale_errors
        for found_M, std, M in zip(found[:2], found[2:], m.reshape(2, 3, 3), strict=True):
            squares.append(np.square((found_M - M) / std))
        sharper.append(found.std_g[:, 2] / (STD * SHARES[11::3]))

    assert 0.6 < np.mean(squares) < 1.3
    assert np.all(np.median(sharper, axis=0) < 0.8)


def attitude_nees(reported: bool) -> float:
    """Return that of aircraft, by the covariance that is reported or that of the state alone."""
    found, P = [], np.empty((N_ERROR, N_ERROR))
    for seed in range(15):
        m = STD * SHARES * np.random.default_rng([seed, 7]).standard_normal(N_SCALE)
        run = precise(seed, ORBIT)
        run = replace(run, samples=run.samples[: int(run.scored[-1]) + 1])
        ins = filtered(run, STD, m)
        unpack_total(ins.nav, P)
        if not reported:
            P = covariance(ins.nav)
        turn = matrix_from_quat(run.quat_xyzw[-1]) @ matrix_from_quat(ins.nav[QUAT]).T
        error = 0.5 * np.array(
            (turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2], turn[0, 1] - turn[1, 0])
        )
        found.append(error @ np.linalg.solve(P[EPS, EPS], error) / 3.0)
    return float(np.mean(found))


def test_the_reported_attitude_of_an_aircraft_that_turns_contains_its_scale_errors() -> None:
    assert 0.6 < attitude_nees(reported=True) < 1.6  # 99.9 % of 45 independent values
    assert attitude_nees(reported=False) > 2.5


def headings_after_an_outage(std: float, seeds: range) -> tuple[Array, Array]:
    """Return errors of the heading after 15 s without fixes, and their variances [rad²]."""
    errors, variances = [], []
    for seed in seeds:
        m = STD * SHARES * np.random.default_rng([seed, 6]).standard_normal(N_SCALE)
        run = precise(seed)
        stamps = run.samples["t_ns"]
        end = int(run.scored[-1])
        run = replace(
            run,
            samples=run.samples[: end + 1],
            fixes=tuple(fix for fix in run.fixes if fix.t_ns < stamps[end] - 15 * SECOND),
        )
        ins = filtered(run, std, m)
        right = matrix_from_quat(run.quat_xyzw[-1]) @ matrix_from_quat(ins.nav[QUAT]).T
        errors.append(0.5 * (right[0, 1] - right[1, 0]))
        variances.append(covariance(ins.nav)[8, 8])
    return np.array(errors), np.array(variances)


def test_what_was_found_corrects_the_heading_in_an_outage() -> None:
    ignored, _ = headings_after_an_outage(0.0, range(12))
    errors, variances = headings_after_an_outage(STD, range(12))

    assert np.sqrt(np.mean(errors**2)) < 0.8 * np.sqrt(np.mean(ignored**2))
    low, high = chi2.ppf((0.005, 0.995), 12)
    assert low < np.sum(errors**2 / variances) < high
