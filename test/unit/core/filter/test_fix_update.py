"""The compiled update by an ordinary fix against the readable form, on states of all kinds."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.measurement_update import MeasurementUpdate
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    CLOCK_VARIANCE,
    COVARIANCE,
    LAST_W,
    N_ERROR,
    N_NAV,
    PSD,
    SENSITIVITY,
    SLOW_VARIANCE,
    Array,
    NavState,
)
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.position_scatter import PositionScatter, Split
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_sensitivity import initial_sensitivity
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrorObserver
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

SECOND = 1_000_000_000
SIGMA = np.repeat([1.0, 0.3, 0.02, 0.05, 0.005], 3)


class OldVelocities(NoiseMultipleModelBank):
    """Finds, whatever the innovations, that stamps scatter, and that velocities are old and err."""

    def _read_factors(self) -> None:
        super()._read_factors()
        self.found = self.found._replace(
            stamp_std=0.03,
            age_std=0.2,
            horizontal_velocity=2.0,
            vertical_velocity=8.0,
            heights=4.0,
        )


def update(factors: bool) -> MeasurementUpdate:
    process = ProcessNoise(np.full(6, 1e-6), 0.01)
    bank = OldVelocities() if factors else None
    noise = FilterNoise(ConstantNoise(np.full(6, 1e-3)), process, bank)
    gate, clock = Gate({2: 9.0, 3: 11.0}, 3.0), ClockOffsetObserver(0.3)
    scatter, lever_arm = PositionScatter(0.5, learning=True), LeverArmObserver()
    scatter.in_force = factors
    return MeasurementUpdate(
        noise, gate, clock, scatter, SECOND, lever_arm, ScaleErrorObserver(0.0)
    )


def flat_state(rng: np.random.Generator) -> Array:
    mixing = rng.normal(size=(N_ERROR, N_ERROR))
    P = (mixing @ mixing.T + np.eye(N_ERROR)) * np.outer(SIGMA, SIGMA) * 0.1
    velocity_n = rng.normal(0.0, 5.0, 3)
    nav = NavState(
        np.array([*rng.uniform(-1.0, 1.0, 2), 50.0]),
        velocity_n,
        quat_from_rpy(*rng.uniform(-1.0, 1.0, 3)),
        rng.normal(0.0, 0.05, 3),
        rng.normal(0.0, 0.005, 3),
        P,
    ).to_flat()
    nav[SENSITIVITY] = initial_sensitivity(velocity_n, np.zeros(3)) + rng.normal(0.0, 0.1, N_ERROR)
    nav[AGE_SENSITIVITY] = rng.normal(0.0, 1.0, N_ERROR)
    nav[ACCELERATION], nav[LAST_W] = rng.normal(0.0, 3.0, 3), rng.normal(0.0, 0.3, 3)
    return nav


def fixes(rng: np.random.Generator, nav: Array) -> list[PositionFix | VelocityFix]:
    """Return alternating fixes near a state within its patience, some of them without height."""
    found: list[PositionFix | VelocityFix] = []
    for k in range(6):
        root, lever = rng.normal(0.0, 0.3, (3, 3)), rng.normal(0.0, 0.5, 3)
        R = root @ root.T + 0.2 * np.eye(3)
        away = rng.normal(0.0, 0.5 if k < 4 else 1.2, 3)
        if k % 3 == 2:
            velocity_n = nav[3:6] + away
            found.append(VelocityFix((3 + k) * SECOND // 2, velocity_n, R, lever))
            continue
        lla = nav[:3] + away * [1.6e-7, 1.8e-7, 1.0]
        lla[2] = np.nan if k == 3 else lla[2]
        found.append(PositionFix((3 + k) * SECOND // 2, lla, R, lever))
    return found


@given(st.integers(0, 2**31), st.booleans(), st.sampled_from([0.0, 0.05]))
@settings(max_examples=15, deadline=None)
def test_the_compiled_form_is_the_readable_one(seed: int, factors: bool, considered: float) -> None:
    """State, verdict, clock and noise factors, relative to their uncertainty."""
    rng = np.random.default_rng(seed)
    compiled, readable = update(factors), update(factors)
    readable._fuse_ordinary = lambda *arguments: None  # type: ignore[method-assign]
    nav = flat_state(rng)
    nav[CLOCK_VARIANCE] = considered**2
    nav[PSD] = compiled.noise.psd()
    other = nav.copy()
    scale = np.sqrt(np.outer(SIGMA, SIGMA)[np.triu_indices(N_ERROR)])
    for fix in fixes(rng, nav):
        one = compiled.apply(nav, fix, 0.1, considered > 0.0, ImuRing())
        two = readable.apply(other, fix, 0.1, considered > 0.0, ImuRing())

        np.testing.assert_allclose(nav[:N_NAV], other[:N_NAV], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(
            nav[COVARIANCE] / scale**2, other[COVARIANCE] / scale**2, rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(compiled.clock.values, readable.clock.values, rtol=1e-11)
        assert one.verdict is not None and two.verdict is not None
        assert (one.verdict.accepted, one.verdict.reason) == (
            two.verdict.accepted,
            two.verdict.reason,
        )
        assert one.verdict.nis == pytest.approx(two.verdict.nis, rel=1e-12)
        assert one.verdict.log_det == pytest.approx(two.verdict.log_det, rel=1e-12, abs=1e-12)
        assert one.verdict.weight == pytest.approx(two.verdict.weight, rel=1e-12)
        assert one.verdict.sigma == pytest.approx(two.verdict.sigma, rel=1e-12)
        assert compiled.scatter.learned == pytest.approx(readable.scatter.learned, rel=1e-12)
        assert one.split is None or one.split.factors == pytest.approx(two.split.factors, rel=1e-12)
        assert compiled.noise.imu_factors == pytest.approx(readable.noise.imu_factors, rel=1e-9)
        assert compiled.noise.found.fixes == pytest.approx(readable.noise.found.fixes, rel=1e-9)
        if factors and isinstance(fix, VelocityFix) and one.verdict.accepted:
            assert one.verdict.sigma[2] > np.sqrt(8.0 * fix.claimed.diagonal()[2])


def split_of(fix: PositionFix | VelocityFix) -> Split | None:
    """Return a split of a position's covariance with a slow error."""
    if isinstance(fix, VelocityFix):
        return None
    return Split(0.5 * fix.claimed, 0.5 * fix.claimed.diagonal(), 1.0, (0.5, 0.5))


def test_most_fixes_take_the_compiled_form() -> None:
    rng = np.random.default_rng(1)
    taken = 0
    for _ in range(20):
        nav = flat_state(rng)
        for fix in fixes(rng, nav):
            taken += update(False)._fuse_ordinary(nav.copy(), fix, split_of(fix), 0.0) is not None
    assert taken > 90


def test_a_fix_that_is_not_ordinary_changes_nothing() -> None:
    nav, whole = flat_state(np.random.default_rng(2)), update(False)
    lla = nav[:3] + np.array([0.0, 0.0, 20.0])
    fix = PositionFix(2 * SECOND, lla, np.eye(3), np.zeros(3))
    before, clock = nav.copy(), whole.clock.values.copy()

    assert whole._fuse_ordinary(nav, fix, split_of(fix), 0.0) is None

    assert nav.tobytes() == before.tobytes()
    assert whole.clock.values.tobytes() == clock.tobytes()


def test_a_position_that_is_rejected_leaves_its_slow_error_out() -> None:
    """GIVEN positions with a slow error WHEN others jump THEN the state stays as uncertain."""
    nav, whole = flat_state(np.random.default_rng(4)), update(False)
    whole.scatter.in_force, nav[PSD] = True, whole.noise.psd()
    whole.apply(nav, position(nav, 10, 0.0), 0.1, False, ImuRing())
    whole.apply(nav, position(nav, 11, 0.0), 0.1, False, ImuRing())
    before, usual = nav.copy(), whole.scatter.split(4.0 * np.eye(3), 12 * SECOND // 5)
    assert np.all(before[SLOW_VARIANCE] > 1.0)
    for k in range(12, 18):
        claimed = 4.0 if k % 2 else 1e-4  # the same receiver, and another solution of it
        outcome = whole.apply(nav, position(nav, k, 500.0, claimed), 0.1, False, ImuRing())
        assert outcome.verdict is not None and outcome.verdict.jump

        np.testing.assert_array_equal(nav[:N_NAV], before[:N_NAV])
        after = whole.scatter.split(4.0 * np.eye(3), 12 * SECOND // 5)
        np.testing.assert_array_equal(after.slow_variance, usual.slow_variance)


def position(nav: Array, k: int, off: float, claimed: float = 4.0) -> PositionFix:
    """Return a fix of the k-th fifth of a second, ``off`` [m] above a state."""
    lla = nav[:3] + np.array([0.0, 0.0, off])
    return PositionFix(k * SECOND // 5, lla, claimed * np.eye(3), np.zeros(3))


def test_a_state_that_is_not_finite_changes_nothing_and_is_named() -> None:
    nav, whole = flat_state(np.random.default_rng(3)), update(False)
    nav[COVARIANCE][7] = np.nan
    fix = PositionFix(2 * SECOND, nav[:3].copy(), np.eye(3), np.zeros(3))

    outcome = whole.apply(nav, fix, 0.0, False, ImuRing())

    assert outcome.verdict is not None and outcome.verdict.reason == "the state is lost"


def test_rejections_end_the_ordinary() -> None:
    gate = Gate({3: 11.0}, 3.0)
    fix = PositionFix(SECOND, np.zeros(3), np.eye(3), np.zeros(3))
    assert gate.ordinary_limit(fix.kind, 3, 0.2) == 11.0

    gate.judge(fix, np.full(3, 5.0), np.eye(3), np.eye(3), 75.0, 0.0, 0.2)

    assert gate.ordinary_limit(fix.kind, 3, 0.2) < 0.0
    assert gate.ordinary_limit(VelocityFix.kind, 3, 0.2) == 11.0
    assert copy.copy(gate).ordinary_limit(fix.kind, 3, 0.2) < 0.0


def test_a_pause_ends_the_ordinary() -> None:
    assert Gate({3: 11.0}, 3.0).ordinary_limit(PositionFix.kind, 3, 3.1) < 0.0
