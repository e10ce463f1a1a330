"""Scale errors in outages: their derivative, what measurements leave of them, and the NEES."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from support.analytic_motion import Series, Truth, Wave, difference, travel

from hybrid_ins.core import propagation
from hybrid_ins.core.aiding_measurements import BodyVelocity
from hybrid_ins.core.chi_square import quantile
from hybrid_ins.core.earth import curvature_scale
from hybrid_ins.core.events import ScaleErrors
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.fix_watch import FixWatch
from hybrid_ins.core.gate import Gate, Verdict
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.kalman import inject
from hybrid_ins.core.measurements import PositionFix
from hybrid_ins.core.noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.scale_error_monitor import ScaleErrorMonitor
from hybrid_ins.core.scale_errors import N_SCALE, SHARES, ConsideredScaleErrors, sensitivity
from hybrid_ins.core.state import DP, N_ERROR, N_NAV, NavState, covariance

Array = np.ndarray[Any, np.dtype[np.float64]]
Samples = np.ndarray[Any, np.dtype[np.void]]

RATE = 100
SECOND = 1_000_000_000
STD = 0.01
SIGMA_0 = np.repeat([0.1, 0.05, 0.002, 0.01, 1e-4], 3)
Q = np.repeat([4e-4, 4e-6], 3)
MEAN = np.array([0.3, -0.1, -9.8, 0.0, 0.01, 0.05])  # f₀, ω₀ before the outage
NO_ROWS = np.empty((0, N_NAV))


def manoeuvres(seconds: float) -> Truth:
    """Return banked turns, climbs and changes of speed."""
    return travel(
        np.arange(int(RATE * seconds) + 1) / RATE,
        Series(rate=(12, 3, 0), waves=[Wave((30, 40, 8), 0.06, (0, 1.57, 0))]),
        Series(waves=[Wave((0.6, 0.3, 1.5), 0.11), Wave((0.1, 0.1, 0.2), 0.4, (1, 0, 2))]),
    )


def with_scale_errors(truth: Truth, m: Array) -> Samples:
    """Return the samples of an IMU with M_a and M_g, row by row in ``m``, about the mean motion."""
    M = m.reshape(2, 3, 3)
    off = truth.readings - MEAN
    samples = np.zeros(len(truth.t), SAMPLE_DTYPE)
    samples["t_ns"] = truth.t_ns
    samples["f"] = truth.readings[:, :3] + off[:, :3] @ M[0].T
    samples["w"] = truth.readings[:, 3:] + off[:, 3:] @ M[1].T
    return samples


def advance(nav: Array, samples: Samples) -> Array:
    """Return a flat state, propagated by samples."""
    nav, readings = nav.copy(), np.hstack((samples["f"], samples["w"]))
    propagation.run(nav, np.full(len(samples), 1.0 / RATE), readings, 0.0, NO_ROWS)
    return nav


def start_filter(nav: Array, samples: Samples) -> InsFilter:
    """Return a filter at the first of some samples."""
    ring = ImuRing()
    ring.extend(samples[:1])
    first = np.concatenate((samples["f"][0], samples["w"][0]))
    noise = FilterNoise(ConstantNoise(Q), ProcessNoise(np.zeros(6), 1.0 / RATE))
    gate = Gate({m: quantile(0.9999, m) for m in (1, 2, 3)}, 3.0)
    return InsFilter(NavState.from_flat(nav), 0, first, noise, gate, ring, FilterSettings(0.0, 5.0))


def fly(ins: InsFilter, samples: Samples, std: float) -> list[ScaleErrors]:
    """Advance over samples with scale errors twice a second; return these events."""
    events = []
    for begin in range(0, len(samples), RATE // 2):
        part = samples[begin : begin + RATE // 2]
        ins.ring.extend(part)
        ins.predict_block(part)
        events.append(ScaleErrors(ins.t_ns, MEAN, std))
        if std > 0.0:
            ins.submit(events[-1])
    return events


def considered(ins: InsFilter) -> ConsideredScaleErrors:
    """Return what a filter considers."""
    scale = ins._update._scale
    assert scale is not None
    return scale


def smallest_eigenvalue(P: Array) -> float:
    """Return that of a covariance in units of its standard deviations."""
    std = np.sqrt(np.diag(P))
    return float(np.linalg.eigvalsh(P / np.outer(std, std))[0])


def test_growth_is_the_derivative_of_the_error_by_each_scale_error() -> None:
    """Over 8 s in pieces of any length, also between two samples."""
    truth = manoeuvres(8.0)
    exact, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    ins = start_filter(nav, exact)
    for end_ns in (350_000_000, 2_004_000_000, 2_007_000_000, 8 * SECOND):
        ins.submit(ScaleErrors(end_ns, MEAN, 1e-6))
    ins.ring.extend(exact[1:])
    ins.predict_block(exact[1:])

    expected = np.empty((N_ERROR, N_SCALE))
    for k, m in enumerate(1e-4 * np.eye(N_SCALE)):
        up, down = (advance(nav, with_scale_errors(truth, s * m)[1:]) for s in (1.0, -1.0))
        expected[:, k] = difference(down, up) / 2e-4

    size = np.abs(expected).max(axis=1, keepdims=True) + 1e-6
    found = considered(ins).correlation / (1e-6 * SHARES)
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
    velocity_b = truth.C_nb[50].T @ truth.velocity_n[50]
    wheels = BodyVelocity(SECOND // 2, velocity_b, 1e-3 * np.eye(3), np.zeros(3))
    joint = np.zeros((N_ERROR + N_SCALE, N_ERROR + N_SCALE))
    joint[N_ERROR:, N_ERROR:] = np.eye(N_SCALE)
    for begin in (1, 51):
        part = samples[begin : begin + 50]
        for one in (ins, plain):
            one.ring.extend(part)
            one.predict_block(part)
        since_ns = int(samples["t_ns"][begin - 1])
        along = np.eye(N_ERROR + N_SCALE)
        along[:N_ERROR, :N_ERROR], drive = sensitivity(ins.nav, since_ns, part, MEAN)
        along[:N_ERROR, N_ERROR:] = STD * SHARES * drive
        ins.submit(ScaleErrors(ins.t_ns, MEAN, STD))
        joint = along @ joint @ along.T
        joint[:N_ERROR, :N_ERROR] = covariance(ins.nav)
        if begin == 1:
            _, H, R = wheels.linearise(ins.nav)
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
            np.testing.assert_allclose(covariance(ins.nav), joint[:15, :15], rtol=1e-6, atol=1e-15)
    assert smallest_eigenvalue(joint) > -1e-9  # covariance and correlation of one distribution
    correlation = considered(ins).correlation
    np.testing.assert_allclose(correlation, joint[:15, 15:], rtol=1e-6, atol=1e-12)
    assert covariance(ins.nav)[3, 3] > 1.2 * covariance(plain.nav)[3, 3]


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
        ins = start_filter(nav, samples)
        fly(ins, samples[1:], std)
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


def test_a_manoeuvre_that_ends_as_it_began_takes_its_error_of_velocity_away() -> None:
    """GIVEN a scale error WHEN a vehicle speeds up and brakes THEN its speed is right again."""
    t = np.arange(8 * RATE + 1) / RATE
    truth = travel(t, Series(waves=[Wave((20, 0, 0), 1 / 8, (1.5 * np.pi, 0, 0))]), Series())
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag(SIGMA_0**2)), samples)
    velocity = []
    for half in (samples[1 : 2 * RATE + 1], samples[2 * RATE + 1 : 4 * RATE + 1]):
        fly(ins, half, STD)
        velocity.append(abs(considered(ins).correlation[3, 0]) / STD)  # by the scale of f ahead

    lasting = MEAN[0] * 2.0  # what it differs from the mean before all the time
    assert velocity[0] == pytest.approx(truth.velocity_n[2 * RATE, 0], abs=1.2 * lasting)
    assert velocity[0] > 15.0 and velocity[1] < 2.5 * lasting


def test_covariance_stays_positive_definite_with_large_scale_errors_over_minutes() -> None:
    truth = manoeuvres(120.0)
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag((0.3 * SIGMA_0) ** 2)), samples)

    fly(ins, samples[1:], 0.1)

    assert covariance(ins.nav)[0, 0] > 1000.0**2
    assert smallest_eigenvalue(covariance(ins.nav)) > 0.0


@pytest.mark.parametrize("std", [0.005, 0.1])
def test_covariance_stays_positive_definite_with_wheels_at_any_stamp(std: float) -> None:
    """Readings of all axes at 10 Hz, stamped between samples, late, and hardly ever at a growth."""
    truth = manoeuvres(20.0)
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    ins = start_filter(truth.flat(P=np.diag(SIGMA_0**2)), samples)
    for begin in range(1, len(samples), RATE // 10):
        fly(ins, samples[begin : begin + RATE // 10], std if begin % (RATE // 2) == 31 else 0.0)
        k = begin + RATE // 10 - 4
        velocity_b = truth.C_nb[k].T @ truth.velocity_n[k]
        stamp_ns = int(samples["t_ns"][k]) + 3_000_000
        ins.submit(BodyVelocity(stamp_ns, velocity_b, 0.0025 * np.eye(3), np.zeros(3)))
        assert smallest_eigenvalue(covariance(ins.flat_state())) > 0.0

    assert all(verdict.accepted for verdict in ins.verdicts)
    assert np.abs(considered(ins).correlation).max() > 0.0


def test_a_late_fix_gives_the_result_of_an_in_order_run() -> None:
    """To the last bit, with scale errors before and after the fix; the fix ends the outage."""
    truth = manoeuvres(4.0)
    samples, nav = with_scale_errors(truth, np.zeros(N_SCALE)), truth.flat(P=np.diag(SIGMA_0**2))
    events = fly(start_filter(nav, samples), samples[1:], STD)
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
    np.testing.assert_array_equal(considered(late).correlation, considered(in_order).correlation)
    velocity = [np.abs(considered(ins).correlation[3:6]).max() for ins in (late, without)]
    assert velocity[0] < 0.6 * velocity[1]  # since the fix, not since the start


class Phases:
    """What the monitor uses of a `PhaseMachine`."""

    def __init__(self) -> None:
        self.filter = object()
        self.submitted: list[ScaleErrors] = []

    def submit(self, event: ScaleErrors) -> None:
        self.submitted.append(event)


def watched(std: float, fixes_until: int, seconds: int) -> tuple[Phases, ScaleErrorMonitor]:
    """Return what a monitor does: a fix every second from 1 s on, until one."""
    truth = manoeuvres(float(seconds))
    samples = with_scale_errors(truth, np.zeros(N_SCALE))
    samples["t_ns"] += SECOND
    phases, ring = Phases(), ImuRing()
    monitor, watch = ScaleErrorMonitor(std), FixWatch()
    for k, sample in enumerate(samples):
        ring.extend(samples[k : k + 1])
        t_ns = int(sample["t_ns"])
        if t_ns % SECOND == 0 and t_ns <= fixes_until * SECOND:
            fix = PositionFix(t_ns, np.zeros(3), np.eye(3), np.zeros(3))
            watch.on_verdict(replace(Verdict.rejected(fix, ""), accepted=True))
        monitor.run_periodic(phases, ring, watch, t_ns)  # type: ignore[arg-type]
    return phases, monitor


def test_monitor_lets_filters_consider_scale_errors_in_outages_alone() -> None:
    phases, monitor = watched(STD, 10, 20)
    stamps = [event.t_ns for event in phases.submitted]

    assert min(stamps) == pytest.approx(13.0 * SECOND, abs=0.6 * SECOND)
    np.testing.assert_array_equal(np.diff(stamps), SECOND // 2)
    for event in phases.submitted:
        np.testing.assert_array_equal(event.mean, monitor.mean)
    assert not watched(STD, 20, 20)[0].submitted
    assert not watched(0.0, 10, 20)[0].submitted


def test_monitor_follows_the_mean_motion_with_fixes() -> None:
    _, monitor = watched(STD, 60, 60)
    recent = manoeuvres(60.0).readings[-20 * RATE :].mean(axis=0)

    assert monitor.mean is not None
    np.testing.assert_allclose(monitor.mean[:3], recent[:3], atol=2.0)
    np.testing.assert_allclose(monitor.mean[3:], recent[3:], atol=0.1)
    monitor.restart()
    assert monitor.mean is None
