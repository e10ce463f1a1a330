"""The filter in time: fixes at their own stamp, early, late, refused, and what comes of it."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_motion import Series, Truth, Wave, difference, travel

from hybrid_ins.core.filter.events import Event, NoiseChange, SettingsChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter, Measurement
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    HEADING_DOUBT,
    HEADING_VARIANCE,
    LLA,
    N_ERROR,
    N_NAV,
    PSD,
    QUAT,
    VELOCITY,
    Array,
    NavState,
    total_std,
    unpack_total,
)
from hybrid_ins.core.noise.process_noise import ConstantNoise, NoiseEstimate, ProcessNoise
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.kalman import inject
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

Q = np.repeat([4e-4, 4e-6], 3)
BIAS_WALK = np.repeat([1e-6, 1e-9], 3)
SIGMA_0 = np.repeat([1.0, 0.5, 0.03, 0.05, 0.003], 3)
R = np.diag([0.01, 0.01, 0.02])
LEVER_B = np.array([0.3, -0.1, -0.2])
NO_LEVER = np.zeros(3)
SECOND = 1_000_000_000


def flight(rate: float = 100.0, duration: float = 4.0) -> Truth:
    return travel(
        np.arange(int(rate * duration) + 1) / rate,
        Series(rate=(5, 2, 0), waves=[Wave((8, 8, 2), 0.1, (0, 1.57, 0))]),
        Series(waves=[Wave((0.3, 0.2, 1.0), 0.2), Wave((0.02, 0.03, 0.02), 1.3, (1, 0, 2))]),
    )


def imu(truth: Truth) -> np.ndarray:
    samples = np.empty(len(truth.t), SAMPLE_DTYPE)
    samples["t_ns"] = truth.t_ns
    samples["f"], samples["w"] = truth.readings[:, :3], truth.readings[:, 3:]
    return samples


def antenna(truth: Truth, k: int, lever_b: Array) -> Array:
    return truth.lla[k] + truth.C_nb[k] @ lever_b / earth.curvature_scale(truth.lla[k])


def fix(
    truth: Truth,
    t_ns: int,
    noise: Iterable[float] = (0.0, 0.0, 0.0),
    *,
    lever_b: Array = NO_LEVER,
    covariance: Array = R,
) -> PositionFix:
    """Return a fix of the antenna at ``t_ns``, on the line between two epochs of the truth."""
    at = t_ns * 1e-9
    k = min(int(np.searchsorted(truth.t, at, side="right")) - 1, len(truth.t) - 2)
    part = (at - truth.t[k]) / (truth.t[k + 1] - truth.t[k])
    lla = (1 - part) * antenna(truth, k, lever_b) + part * antenna(truth, k + 1, lever_b)
    return PositionFix(
        t_ns, lla + np.asarray(noise) / earth.curvature_scale(lla), covariance, lever_b
    )


def constant(q: np.ndarray, period: float = 0.01) -> FilterNoise:
    return FilterNoise(ConstantNoise(q), ProcessNoise(BIAS_WALK, period))


def make_filter(
    truth: Truth,
    *,
    sigma: Array = SIGMA_0,
    error: Array | None = None,
    interval: float = 0.0,
    max_delay: float = 1.0,
    threshold: float = 1e9,
    patience: float = 1.0,
    capacity: int = 8192,
) -> InsFilter:
    """Return a filter at the truth's first epoch, off by ``error`` (15,)."""
    nav = truth.flat(P=np.diag(sigma**2))
    if error is not None:
        inject(nav, -error)
    state = NavState.from_flat(nav)
    ring = ImuRing(capacity)
    ring.extend(imu(truth)[:1])
    return InsFilter(
        state,
        int(truth.t_ns[0]),
        truth.readings[0],
        constant(Q, float(truth.t[1] - truth.t[0])),
        Gate(dict.fromkeys(range(1, 7), threshold), patience),
        ring,
        FilterSettings(covariance_interval=interval, max_delay=max_delay),
    )


def fly(
    ins: InsFilter, samples: np.ndarray, arrivals: dict[int, list[Measurement]] | None = None
) -> None:
    """Push samples one by one; what arrives at a stamp is submitted after its sample."""
    for sample in samples:
        t_ns = int(sample["t_ns"])
        reading = (*sample["f"].tolist(), *sample["w"].tolist())
        ins.ring.push(t_ns, *reading)
        ins.predict(t_ns, *reading)
        for measurement in (arrivals or {}).get(t_ns, []):
            ins.submit(measurement)


def fly_block(ins: InsFilter, samples: np.ndarray) -> None:
    ins.ring.extend(samples)
    ins.predict_block(samples)


# Fixes at their own stamp


def test_fix_between_two_samples_is_fused_at_its_own_stamp() -> None:
    """
    GIVEN a 50 Hz IMU and fixes between its samples
    WHEN it is filtered
    THEN the result is that of a 1 kHz IMU on the same course, with samples at the fixes' stamps.
    """
    truth = flight(50.0)
    coarse = imu(truth)
    dense = np.empty(20 * (len(coarse) - 1) + 1, SAMPLE_DTYPE)
    dense["t_ns"] = np.arange(len(dense)) * SECOND // 1000
    for name in ("f", "w"):
        for axis in range(3):
            dense[name][:, axis] = np.interp(dense["t_ns"], coarse["t_ns"], coarse[name][:, axis])
    results = []
    for samples in (coarse, dense):
        ins = make_filter(truth)
        for k in range(1, 9):
            ins.submit(fix(truth, k * SECOND * 2 // 5 + 7_000_000, (0.3, -0.2, 0.1)))
        fly_block(ins, samples[1:])
        assert len(ins.verdicts) == 8
        results.append(ins)

    error = difference(results[1].nav, results[0].nav)
    assert np.max(np.abs(error[:3])) < 2e-4
    assert np.max(np.abs(error / np.sqrt(np.diag(results[0].state.P)))) < 0.02
    np.testing.assert_allclose(np.diag(results[0].state.P), np.diag(results[1].state.P), rtol=0.02)


def test_fix_taken_at_the_next_sample_instead_would_be_seen() -> None:
    """At 8 m/s, 7 ms are 6 cm: the test above would not pass with fixes at the wrong stamp."""
    truth = flight(50.0)
    early, late = make_filter(truth), make_filter(truth)
    for ins, shift in ((early, 0), (late, 7_000_000)):
        given_at_7_ms = fix(truth, SECOND + 7_000_000)
        ins.submit(PositionFix(SECOND + shift, given_at_7_ms.lla, R, NO_LEVER))
        fly_block(ins, imu(truth)[1:])

    assert np.max(np.abs(difference(late.nav, early.nav)[:3])) > 0.02


def test_blocks_of_any_length_are_the_same_as_sample_by_sample() -> None:
    truth = flight()
    samples = imu(truth)[1:]
    fixes = [fix(truth, k * SECOND // 5 + 3_000_000 * (k % 3)) for k in range(1, 19)]
    live, rows = make_filter(truth, interval=0.03), []
    for measurement in fixes:
        live.submit(measurement)
    for sample in samples:
        fly(live, [sample])
        rows.append(live.nav[:N_NAV].copy())

    for length in (1, 7, 64, len(samples)):
        block = make_filter(truth, interval=0.03)
        for measurement in fixes:
            block.submit(measurement)
        kept = np.empty((len(samples), N_NAV))
        for start in range(0, len(samples), length):
            piece = slice(start, start + length)
            block.ring.extend(samples[piece])
            block.predict_block(samples[piece], kept[piece])
        np.testing.assert_array_equal(block.nav[:N_NAV], live.nav[:N_NAV])
        np.testing.assert_array_equal(kept, rows)


# Early, late, out of order


FIX_TIMES = [k * SECOND // 10 + 3_700_000 * (k % 3) for k in range(1, 34)]


@settings(max_examples=15)
@given(st.lists(st.floats(-0.3, 0.9), min_size=len(FIX_TIMES), max_size=len(FIX_TIMES)))
def test_late_and_out_of_order_fixes_give_the_result_of_an_in_order_run(
    delays: list[float],
) -> None:
    """To the last bit. Negative delay: the fix is there before the IMU is."""
    truth = flight()
    samples = imu(truth)[1:]
    rng = np.random.default_rng(0)
    measurements = [fix(truth, t_ns, rng.normal(0.0, 0.1, 3)) for t_ns in FIX_TIMES]
    in_order, late = make_filter(truth, interval=0.02), make_filter(truth, interval=0.02)
    for measurement in measurements:
        in_order.submit(measurement)
    fly_block(in_order, samples)
    arrivals: dict[int, list[Measurement]] = {}
    for measurement, delay in zip(measurements, delays, strict=True):
        slot = int(np.clip((measurement.t_ns * 1e-9 + delay) * 100, 1, len(samples)))
        arrivals.setdefault(int(samples["t_ns"][slot - 1]), []).append(measurement)

    fly(late, samples, arrivals)

    np.testing.assert_array_equal(late.nav[:N_NAV], in_order.nav[:N_NAV])
    assert len(late.verdicts) == len(measurements)
    assert {v.measurement.t_ns for v in late.verdicts} == set(FIX_TIMES)
    for verdict in late.verdicts:
        assert verdict.accepted


def test_a_copy_goes_on_alike_and_changes_nothing_of_the_first() -> None:
    # GIVEN a filter with a fix behind it and one ahead of it, two copies, and one without any
    truth = flight()
    samples, times = imu(truth), (SECOND, 2 * SECOND)
    first, alone = make_filter(truth), make_filter(truth)
    for ins in (first, alone):
        for t_ns in times:
            ins.submit(fix(truth, t_ns, (0.1, -0.2, 0.1)))
        fly_block(ins, samples[1:151])
    alike, other = copy.copy(first), copy.copy(first)
    # WHEN one copy gets another late fix than the others do
    other.submit(fix(truth, 6 * SECOND // 5, (1.0, 1.0, 1.0)))
    other.predict_block(samples[151:251])
    for ins in (first, alike, alone):
        ins.submit(fix(truth, 6 * SECOND // 5, (-0.1, 0.0, 0.2)))
    # THEN those that get the same are the same
    for ins in (first, alone):
        fly_block(ins, samples[151:251])
    alike.predict_block(samples[151:251])
    np.testing.assert_array_equal(first.nav[:N_NAV], alone.nav[:N_NAV])
    np.testing.assert_array_equal(alike.nav[:N_NAV], alone.nav[:N_NAV])
    assert np.abs(difference(other.nav, alone.nav)[:3]).max() > 0.02
    # AND a copy has told nothing of what was decided before
    assert [len(ins.verdicts) for ins in (first, alike, other)] == [3, 2, 2]


def test_age_of_a_late_fix_is_reported() -> None:
    truth = flight()
    ins = make_filter(truth)
    fly(ins, imu(truth)[1:201])

    ins.submit(fix(truth, SECOND + 500_000_000))

    (verdict,) = ins.verdicts
    assert verdict.accepted
    assert verdict.age == pytest.approx(0.5)


def test_a_late_fix_repeats_only_the_events_that_are_younger(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    applied: list[int] = []
    apply = InsFilter._apply

    def counting(ins: InsFilter, event: Event) -> None:
        applied.append(event.t_ns)
        apply(ins, event)

    truth, younger_ns = flight(), SECOND + 450_000_000
    ins = make_filter(truth)
    for t_ns in (SECOND, younger_ns):
        ins.submit(fix(truth, t_ns))
    fly(ins, imu(truth)[1:151])
    monkeypatch.setattr(InsFilter, "_apply", counting)

    late_ns = SECOND + 400_000_000
    ins.submit(fix(truth, late_ns))

    assert applied == [late_ns, younger_ns]


def test_what_other_filters_show_of_the_heading_outlasts_a_late_fix() -> None:
    truth = flight()
    ins, total = make_filter(truth), np.empty((N_ERROR, N_ERROR))
    fly(ins, imu(truth)[1:151])
    ins.nav[HEADING_DOUBT] = 0.5

    ins.submit(fix(truth, SECOND))

    assert len(ins.verdicts) == 1
    unpack_total(ins.nav, total)
    variance = ins.nav[HEADING_VARIANCE]
    assert total[8, 8] - variance == pytest.approx(0.5)
    assert total_std(ins.nav)[8] ** 2 - variance == pytest.approx(0.5)


def test_velocity_and_position_of_one_stamp_are_fused_in_one_order() -> None:
    truth = flight()
    position = fix(truth, SECOND, (0.1, 0.2, -0.1))
    velocity = VelocityFix(SECOND, truth.velocity_n[100].copy(), 0.01 * np.eye(3), NO_LEVER)
    results = []
    for pair in ((position, velocity), (velocity, position)):
        for late in (False, True):
            ins = make_filter(truth)
            fly(ins, imu(truth)[1 : 161 if late else 101])
            for measurement in pair:
                ins.submit(measurement)
            fly(ins, imu(truth)[161 if late else 101 :])
            results.append(ins.nav[:N_NAV].copy())

    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_fix_ahead_of_the_imu_waits() -> None:
    truth = flight()
    ins = make_filter(truth)

    ins.submit(fix(truth, SECOND))
    fly(ins, imu(truth)[1:100])
    assert not ins.verdicts
    fly(ins, imu(truth)[100:101])

    (verdict,) = ins.verdicts
    assert verdict.accepted
    assert verdict.measurement.t_ns == ins.t_ns == SECOND


@pytest.mark.parametrize(
    ("stamp", "max_delay", "capacity"),
    [(SECOND, 0.5, 8192), (-1, 10.0, 8192), (SECOND, 10.0, 64)],
    ids=["older than allowed", "before the filter's start", "older than the ring"],
)
def test_fix_that_is_too_old_is_refused_with_its_age(
    stamp: int, max_delay: float, capacity: int
) -> None:
    truth = flight()
    ins = make_filter(truth, max_delay=max_delay, capacity=capacity)
    fly(ins, imu(truth)[1:301])
    before = ins.nav.copy()

    ins.submit(PositionFix(stamp, truth.lla[100], R, NO_LEVER))

    (verdict,) = ins.verdicts
    assert not verdict.accepted
    assert verdict.reason == "too old"
    assert verdict.age == pytest.approx(3.0 - stamp * 1e-9)
    np.testing.assert_array_equal(ins.nav, before)


def test_noise_takes_effect_at_its_stamp_also_when_late() -> None:
    truth = flight()
    change = NoiseChange(SECOND + 3_000_000, constant(100.0 * Q))
    in_order, late = make_filter(truth), make_filter(truth)
    in_order.submit(change)
    fly_block(in_order, imu(truth)[1:])
    fly(late, imu(truth)[1:151])
    late.submit(change)
    fly(late, imu(truth)[151:])

    np.testing.assert_array_equal(late.nav[:N_NAV], in_order.nav[:N_NAV])
    np.testing.assert_allclose(in_order.nav[PSD][:6], 100.0 * Q * 0.01)
    assert not late.verdicts


def test_settings_outlast_a_rewind_and_apply_from_their_stamp_on() -> None:
    # GIVEN settings that change after a fix was valid that comes late
    truth = flight()
    ins, prior = make_filter(truth), ClockPrior(0.0, 0.004)
    ins.clock.prior = ClockPrior(0.0, 0.001)
    ins.submit(fix(truth, ins.t_ns))  # whose checkpoint has that prior
    fly(ins, imu(truth)[1:101])
    other = FilterSettings(max_delay=1.0, clock_prior=prior, learn_scatter=True)
    ins.submit(SettingsChange(ins.t_ns, gate=Gate({3: 9.0}, 7.0)))
    ins.change_settings(other)
    fly(ins, imu(truth)[101:151])

    ins.submit(fix(truth, ins.t_ns - 700_000_000))

    assert ins.update.gate.threshold(3) == 9.0
    assert ins.clock.prior == prior and ins.update.scatter.learning
    assert ins.verdicts[-1].threshold == 1e9

    # THEN nothing is left to change: the same settings make no event
    before = ins.update.clock.prior
    ins.change_settings(replace(other, clock_prior=ClockPrior(1e-12, 0.004)))
    assert ins.update.clock.prior is before


def test_very_late_noise_takes_effect_now() -> None:
    truth = flight()
    ins = make_filter(truth, max_delay=0.5)
    fly(ins, imu(truth)[1:301])

    ins.submit(NoiseChange(SECOND, constant(100.0 * Q)))
    ins.submit(NoiseEstimate(SECOND, Q))

    np.testing.assert_allclose(ins.nav[PSD][:6], 100.0 * Q * 0.01)


# What a fix does


def test_position_fixes_correct_every_state() -> None:
    """GIVEN an error in every state WHEN a minute is flown with fixes THEN all have shrunk."""
    truth = flight(100.0, 60.0)
    error = SIGMA_0 * np.tile([1.0, -1.0, 1.0], 5)
    ins = make_filter(truth, error=error, interval=0.01)
    for k in range(1, 300):
        ins.submit(fix(truth, k * SECOND // 5, lever_b=LEVER_B))
    fly_block(ins, imu(truth)[1:])

    # The bias is part of the error: the readings have none.
    left = np.abs(difference(truth.flat(-1), ins.nav)) / np.abs(error)
    assert np.all(left < np.repeat([0.05, 0.1, 0.2, 0.5, 0.2], 3))
    assert np.all(np.sqrt(np.diag(ins.state.P)) < SIGMA_0)


def test_lever_arm_makes_the_position_that_of_the_imu() -> None:
    """The wrong one of them, or none, would leave most of its length."""
    truth = flight(100.0, 20.0)
    left = []
    for lever_b in (LEVER_B, NO_LEVER, -LEVER_B):
        ins = make_filter(truth)
        for k in range(1, 100):
            lla = fix(truth, k * SECOND // 5, lever_b=LEVER_B).lla
            ins.submit(PositionFix(k * SECOND // 5, lla, R, lever_b))
        fly_block(ins, imu(truth)[1:])
        left.append(np.linalg.norm(difference(truth.flat(-1), ins.nav)[:3]))

    assert left[0] < 0.01
    assert left[1] > 0.2
    assert left[2] > 0.4


def test_horizontal_fix_leaves_height_to_the_imu() -> None:
    truth = flight()
    ins = make_filter(truth, error=np.concatenate(([1.0, -1.0, 1.0], np.zeros(12))))
    fly(ins, imu(truth)[1:101])
    before = difference(truth.flat(100), ins.nav)
    horizontal = fix(truth, SECOND)
    ins.submit(
        PositionFix(
            SECOND, np.array([*horizontal.lla[:2], np.nan]), horizontal.covariance_n, NO_LEVER
        )
    )
    after = difference(truth.flat(100), ins.nav)

    assert np.all(np.abs(after[:2]) < 0.1)
    assert after[2] == pytest.approx(before[2], abs=0.02)
    (verdict,) = ins.verdicts
    assert len(verdict.sigma) == 2


def test_cross_terms_of_the_fix_count() -> None:
    """GIVEN a fix that is sharp along north-east only THEN it corrects along north-east only."""
    truth = flight()
    error = np.zeros(15)
    error[:2] = 1.0, 0.0
    along, across = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    covariance = 1e-4 * np.outer(along, along) + 1e4 * np.outer(across, across)
    covariance[2, 2] = 1.0
    ins = make_filter(truth, error=error)
    fly(ins, imu(truth)[1:101])
    before = difference(truth.flat(100), ins.nav)
    ins.submit(fix(truth, SECOND, covariance=covariance))
    after = difference(truth.flat(100), ins.nav)

    assert abs(along @ after[:3]) < 0.02
    assert across @ after[:3] == pytest.approx(across @ before[:3], abs=0.01)


def test_velocity_fix_corrects_velocity() -> None:
    truth = flight()
    error = np.zeros(15)
    error[3:6] = 0.5, -0.5, 0.4
    ins = make_filter(truth, error=error)
    fly(ins, imu(truth)[1:101])
    rate_b = truth.readings[100, 3:] - truth.C_nb[100].T @ earth.C_en(truth.lla[100]).T @ [
        0.0,
        0.0,
        earth.EARTH_RATE,
    ]
    velocity_n = truth.velocity_n[100] + truth.C_nb[100] @ np.cross(rate_b, LEVER_B)

    ins.submit(VelocityFix(SECOND, velocity_n, 1e-6 * np.eye(3), LEVER_B))

    assert np.max(np.abs(difference(truth.flat(100), ins.nav)[3:6])) < 2e-3


# The gate


def gated(truth: Truth) -> InsFilter:
    return make_filter(
        truth, sigma=np.repeat([0.1, 0.1, 0.01, 0.01, 0.001], 3), threshold=16.3, patience=0.95
    )


def test_outlier_is_refused_and_leaves_no_trace() -> None:
    truth = flight()
    ins, clean = gated(truth), gated(truth)
    for k in range(1, 20):
        ins.submit(fix(truth, k * SECOND // 5))
        clean.submit(fix(truth, k * SECOND // 5))
        if k == 9:
            ins.submit(fix(truth, k * SECOND // 5 + 100_000_000, (5.0, 0.0, 0.0)))
    fly_block(ins, imu(truth)[1:])
    fly_block(clean, imu(truth)[1:])

    refused = [v for v in ins.verdicts if not v.accepted]
    assert [v.measurement.t_ns for v in refused] == [1_900_000_000]
    assert refused[0].nis > refused[0].threshold == 16.3
    assert refused[0].reason == "innovation beyond the gate"
    np.testing.assert_allclose(refused[0].sigma, [0.1, 0.1, np.sqrt(0.02)])
    # The interval was split at its stamp, no more.
    assert np.max(np.abs(difference(ins.nav, clean.nav)[:3])) < 1e-4


def test_fixes_rejected_for_long_are_accepted_at_last() -> None:
    """
    GIVEN fixes that jumped by 50 m and stay there
    WHEN they have been refused for the gate's patience
    THEN the covariance is inflated, the state goes there within one fix, and the verdict says so.
    """
    truth = flight()
    ins = gated(truth)
    for k in range(1, 20):
        ins.submit(fix(truth, k * SECOND // 5, (50.0, 0.0, 0.0) if k > 5 else (0.0, 0.0, 0.0)))
    fly_block(ins, imu(truth)[1:])

    accepted = [v.accepted for v in ins.verdicts]
    assert accepted == [True] * 5 + [False] * 5 + [True] * 9
    inflated = [v for v in ins.verdicts if v.inflated]
    assert [v.measurement.t_ns for v in inflated] == [11 * SECOND // 5]
    assert "inflated" in inflated[0].reason
    assert difference(truth.flat(-1), ins.nav)[0] == pytest.approx(-50.0, abs=0.5)
    np.linalg.cholesky(ins.state.P)


def test_one_good_fix_makes_the_gate_patient_again() -> None:
    truth = flight()
    ins = gated(truth)
    for k in range(1, 20):
        ins.submit(fix(truth, k * SECOND // 5, (0.0, 0.0, 0.0) if k % 4 == 0 else (9.0, 0.0, 0.0)))
    fly_block(ins, imu(truth)[1:])

    assert not any(v.inflated for v in ins.verdicts)
    assert [v.accepted for v in ins.verdicts] == [k % 4 == 0 for k in range(1, 20)]


# The ring and the flat state


@given(st.integers(1, 50), st.lists(st.integers(1, 30), max_size=8))
def test_ring_holds_the_latest_samples(capacity: int, blocks: list[int]) -> None:
    ring, everything = ImuRing(capacity), np.zeros(0, SAMPLE_DTYPE)
    for length in blocks:
        block = np.zeros(length, SAMPLE_DTYPE)
        block["t_ns"] = len(everything) + np.arange(length)
        block["f"] = block["t_ns"][:, None] * [1.0, 2.0, 3.0]
        everything = np.concatenate((everything, block))
        if length % 2:
            ring.extend(block)
        else:
            for sample in block:
                ring.push(int(sample["t_ns"]), *sample["f"].tolist(), *sample["w"].tolist())

    np.testing.assert_array_equal(ring.latest(10**6), everything[-capacity:])
    np.testing.assert_array_equal(ring.latest(3), everything[-capacity:][-3:])
    for t_ns in range(-1, len(everything) + 1):
        expected = everything[-capacity:]
        np.testing.assert_array_equal(ring.after(t_ns), expected[expected["t_ns"] > t_ns])
        assert ring.has_lost(t_ns) == (np.count_nonzero(everything["t_ns"] > t_ns) >= capacity)
        for end_ns in (t_ns - 1, t_ns + 2, t_ns + 20):
            inside = (expected["t_ns"] > t_ns) & (expected["t_ns"] <= end_ns)
            np.testing.assert_array_equal(ring.between(t_ns, end_ns), expected[inside])


def test_state_is_a_copy_with_its_covariance_up_to_date() -> None:
    truth = flight()
    lazy, eager = make_filter(truth, interval=10.0), make_filter(truth, interval=10.0)
    for ins in (lazy, eager):
        fly(ins, imu(truth)[1:51])
    early = lazy.state
    fly(lazy, imu(truth)[51:101])
    fly(eager, imu(truth)[51:101])

    np.testing.assert_array_equal(lazy.nav, eager.nav)
    assert early.P[0, 0] > SIGMA_0[0] ** 2
    np.testing.assert_array_equal(lazy.nav[LLA], lazy.state.lla)
    np.testing.assert_array_equal(lazy.nav[VELOCITY], lazy.state.velocity_n)
    np.testing.assert_allclose(
        matrix_from_quat(lazy.nav[QUAT]), matrix_from_quat(lazy.state.quat_xyzw)
    )
    assert lazy.state.P.shape == (N_ERROR, N_ERROR)
