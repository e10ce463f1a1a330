"""The compiled step of all noise hypotheses against one filter at a time, in matrices."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DV,
    LAST_W,
    LLA,
    N_ERROR,
    PLACES,
    QUAT,
    VELOCITY,
    Array,
    NavState,
    covariance,
)
from hybrid_ins.core.noise.hypotheses import (
    AGE_STD,
    COUNT,
    HYPOTHESES,
    ON_HEIGHT,
    ON_NOISE,
    ON_VELOCITY,
    SLOW_WALK,
    STAMP_STD,
)
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank, StateCorrection
from hybrid_ins.core.noise.multiple_model_step import OFFSETS, mean_system
from hybrid_ins.core.noise.multiple_model_update import (
    LOG_LIKELIHOOD,
    OF_FAMILY,
    PENDING_G,
    TAIL_DOF,
    WEIGHTS,
)
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.noise.stamp_scatter import stamp_covariance
from hybrid_ins.core.noise.weights import (
    FAMILIES,
    FAMILY,
    MEMORY,
    UNLIKELIEST,
    UNLIKELIEST_FAMILY,
)
from hybrid_ins.core.update.iterated_update import linearisation
from hybrid_ins.core.update.kalman import heading_turn
from hybrid_ins.core.update.measurements import position_model, velocity_model

SECOND = 1_000_000_000
SIGMA = np.repeat([1.0, 0.3, 0.02, 0.05, 0.005], 3)
PSD = np.repeat([1e-3, 1e-6, 1e-7, 1e-9], 3)


def flat_state(rng: np.random.Generator, tilt_std: float) -> Array:
    mixing = rng.normal(size=(N_ERROR, N_ERROR))
    sigma = SIGMA.copy()
    sigma[6:9] = tilt_std
    P = (mixing @ mixing.T + np.eye(N_ERROR)) * np.outer(sigma, sigma) * 0.1
    nav = NavState(
        np.array([*rng.uniform(-1.0, 1.0, 2), 50.0]),
        rng.normal(0.0, 5.0, 3),
        quat_from_rpy(*rng.uniform(-1.0, 1.0, 3)),
        np.zeros(3),
        np.zeros(3),
        P,
    ).to_flat()
    nav[LAST_W] = rng.normal(0.0, 0.3, 3)
    return nav


def correction_of(
    rng: np.random.Generator, nav: Array, k: int, fix_factor: float = 1.0, stamp_std: float = 0.0
) -> Correction:
    """Return what a fix does to a state: positions and velocities, some rejected, large ones."""
    size = 1.0 if k < 4 else 6.0
    if k % 3 == 2:
        z, H = velocity_model(
            nav, nav[VELOCITY] + rng.normal(0.0, size, 3), np.array([0.5, 0.0, 1])
        )
    else:
        away = rng.normal(0.0, size, 3) * [1.6e-7, 1.8e-7, 1.0]
        z, H = position_model(nav, nav[LLA] + away, np.array([0.5, -0.2, 1.0]))
    root = rng.normal(0.0, 0.3, (3, 3))
    is_position = k % 3 != 2
    acceleration_n = rng.normal(0.0, 2.0, 3)
    of_stamp = np.outer(acceleration_n, acceleration_n)
    if is_position:
        of_stamp = stamp_covariance(nav[VELOCITY], 0.7, 3)
    factors = (1.0, 9.0) if is_position else (2.0, 16.0)
    R = fix_factor * (root @ root.T + 0.2 * np.eye(3)) * scaling_of(factors)
    R += stamp_std**2 * of_stamp
    S = H @ covariance(nav) @ H.T + R
    K = covariance(nav) @ H.T @ np.linalg.inv(S)
    fused = k % 4 != 3
    dx = K @ z if fused else np.zeros(N_ERROR)
    C_nb = matrix_from_quat(nav[QUAT])
    weight = 0.7 if k == 4 else 1.0
    linear = linearisation(nav[COVARIANCE], z, H, R / weight) if fused else None
    interval = 0.2
    return Correction(
        k * SECOND // 5,
        z,
        S,
        H,
        K,
        dx,
        C_nb,
        interval,
        nav,
        fused,
        False,
        weight,
        linear,
        of_stamp,
        fix_factor,
        stamp_std,
        rng.uniform(0.0, 0.01, 3) if is_position else None,
        (0.05, 0.07) if is_position else (0.0, 0.0),
        "position" if is_position else "velocity",
        factors,
        rng.uniform(-0.3, 0.3) if fused else 0.0,
    )


def scaling_of(factors: tuple[float, float]) -> Array:
    roots = np.sqrt([factors[0], factors[0], factors[1]])
    return np.outer(roots, roots)


class Readable:
    """One hypothesis: the same as the step, as a filter of its own."""

    def __init__(self, hypothesis: Array, nav: Array) -> None:
        self.factors, self.walk = hypothesis[ON_NOISE], hypothesis[SLOW_WALK]
        self.stamp_variance, self.age_variance = hypothesis[[STAMP_STD, AGE_STD]] ** 2
        self.on_velocity = tuple(10.0 ** hypothesis[ON_VELOCITY])
        self.on_position = 1.0, 10.0 ** hypothesis[ON_HEIGHT]
        self.P, self.offset = covariance(nav), np.zeros(N_ERROR)

    def predict(self, F: Array, C: Array, T: float, slow_growth: Array) -> None:
        A = np.eye(N_ERROR) + T * F + T**2 / 2.0 * F @ F + T**3 / 6.0 * F @ F @ F
        half = np.eye(N_ERROR) + T / 2.0 * F + T**2 / 8.0 * F @ F
        D = np.zeros((N_ERROR, N_ERROR))
        D[3:6, 3:6] = self.factors[0] * C @ np.diag(PSD[:3]) @ C.T
        D[6:9, 6:9] = self.factors[1] * C @ np.diag(PSD[3:6]) @ C.T
        D[9:, 9:] = np.diag(PSD[6:])
        P = self.P.copy()
        P[:3, :3] += T * np.diag(self.walk)
        self.P = A @ P @ A.T + T / 6.0 * (D + 4.0 * half @ D @ half.T + A @ D @ A.T)
        self.P[:3, :3] += np.diag(np.maximum(slow_growth - T * self.walk, 0.0))
        self.offset = A @ self.offset

    def correct(self, correction: Correction, R: Array, linear: tuple[Array, ...]) -> float:
        (z, H, dx, G), weight = linear, 1.0
        G = heading_turn(correction.turn) @ G
        own, m = z - H @ self.offset, len(z)
        if correction.kind == "position":
            R = self.factors[2] * R * scaling_of(self.on_position)
            R += self.stamp_variance * correction.of_stamp
        else:
            R = self.factors[2] * R * scaling_of(self.on_velocity)
            R += self.age_variance * correction.of_stamp
        S = H @ self.P @ H.T + R
        nis = own @ np.linalg.solve(S, own)
        log_det = np.linalg.slogdet(S)[1]
        tail = np.log1p(nis / (TAIL_DOF - 1.3))
        log_likelihood = -0.5 * log_det - 0.5 * (TAIL_DOF + m) * tail
        if nis > m:
            weight = (TAIL_DOF + nis) / (TAIL_DOF + m)
            S = H @ self.P @ H.T + weight * R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.P = G @ (self.P - K @ S @ K.T) @ G.T
        self.offset = G @ (self.offset - dx + K @ own)
        return float(log_likelihood)


@pytest.mark.parametrize("tilt_std", [0.02, 0.2])
def test_the_compiled_step_is_one_filter_at_a_time(tilt_std: float) -> None:
    """Over positions and velocities, fused, weighted and rejected, and iterated corrections."""
    rng = np.random.default_rng(4)
    bank, iterated, moves = NoiseMultipleModelBank(), 0, 0
    velocity_n, C_nb, T = np.zeros(3), np.eye(3), 0.0
    readable: list[Readable] = []
    log_likelihood = np.zeros(COUNT)
    for k in range(1, 9):
        nav = flat_state(rng, tilt_std)
        # What S contains is what another bank has found: of innovations that scale errors raise.
        fix_factor, stamp_std = 3.0 ** rng.uniform(-1.0, 1.0), 0.1 * rng.uniform()
        correction = correction_of(rng, nav, k, fix_factor, stamp_std)
        moved = bank.update(correction, PSD)

        readable = readable or [Readable(hypothesis, nav) for hypothesis in HYPOTHESES.T]
        F, C = mean_system(nav, velocity_n, C_nb, T)
        R = correction.S - correction.H @ covariance(nav) @ correction.H.T
        R = (R - stamp_std**2 * correction.of_stamp) / fix_factor
        R /= scaling_of(correction.factors_by_axis)
        plain = correction.z, correction.H, correction.dx, np.eye(N_ERROR)
        linear = correction.linear or plain
        iterated += not np.array_equal(linear[3], np.eye(N_ERROR))
        log_likelihood *= np.exp(-T / MEMORY)
        growth = np.zeros(3) if correction.slow_growth is None else correction.slow_growth
        for h, one in enumerate(readable):
            one.predict(F, C, T, growth)
            log_likelihood[h] += one.correct(correction, R, linear)
        for f in range(FAMILIES):
            log_likelihood[f == FAMILY] -= log_likelihood[f == FAMILY].max()
        log_likelihood = np.maximum(log_likelihood, UNLIKELIEST)
        velocity_n, C_nb, T = nav[VELOCITY] + correction.dx[DV], correction.C_nb, 0.2
        if moved is not None:
            moves += 1
            velocity_n = velocity_n + moved.dx[DV]
            C_nb = heading_turn(moved.dx[8])[6:9, 6:9] @ C_nb
            correct_state(bank._values[WEIGHTS], readable, moved)
        compare(bank, readable)
        found = bank._values[LOG_LIKELIHOOD]
        np.testing.assert_allclose(found, log_likelihood, atol=1e-9)
    assert iterated > 1
    assert moves > 0


def correct_state(weights: Array, readable: list[Readable], moved: StateCorrection) -> None:
    """Check a mixture's correction of the running state, and refer the offsets to it."""
    offsets = np.array([one.offset for one in readable])
    dx = weights @ offsets
    P = sum(
        w * (one.P + np.outer(one.offset - dx, one.offset - dx))
        for w, one in zip(weights, readable, strict=True)
    )
    T = heading_turn(dx[8])
    P = T @ P @ T.T
    scale = np.sqrt(P.diagonal())
    np.testing.assert_allclose(moved.dx / scale, dx / scale, atol=1e-11)
    np.testing.assert_allclose(
        moved.P / np.outer(scale, scale), P / np.outer(scale, scale), atol=1e-11
    )
    for one in readable:
        one.P, one.offset = T @ one.P @ T.T, T @ (one.offset - dx)


def compare(bank: NoiseMultipleModelBank, readable: list[Readable]) -> None:
    """Check covariances and offsets, relative to the standard deviations."""
    assert bank.estimates is not None
    G = bank._values[PENDING_G].reshape(N_ERROR, N_ERROR)
    for h, one in enumerate(readable):
        P, scale = G @ bank.estimates[:OFFSETS, h][PLACES] @ G.T, np.sqrt(one.P.diagonal())
        square = np.outer(scale, scale)
        np.testing.assert_allclose(P / square, one.P / square, atol=1e-11)
        offset = G @ bank.estimates[OFFSETS:, h]
        np.testing.assert_allclose(offset / scale, one.offset / scale, atol=1e-11)


def test_a_copy_is_a_checkpoint() -> None:
    rng = np.random.default_rng(5)
    bank = NoiseMultipleModelBank()
    nav = flat_state(rng, 0.02)
    bank.update(correction_of(rng, nav, 1), PSD)
    kept = copy.copy(bank)
    later = correction_of(rng, flat_state(rng, 0.02), 2)
    bank.update(later, PSD)
    once = bank.found, bank._values.copy()

    kept.update(later, PSD)

    assert kept.found == once[0]
    np.testing.assert_array_equal(kept._values, once[1])


def jump_of(rng: np.random.Generator, nav: Array, k: int) -> tuple[Correction, Array]:
    found = correction_of(rng, nav, k)
    z = np.array([40.0, -30.0, 20.0])
    R = found.S - found.H @ covariance(nav) @ found.H.T
    return replace(found, z=z, dx=np.zeros(N_ERROR), fused=False), R


def test_many_jumps_raise_r_alone_and_one_does_not() -> None:
    rng = np.random.default_rng(6)
    bank, nav = NoiseMultipleModelBank(), flat_state(rng, 0.02)
    bank.update(correction_of(rng, nav, 1), PSD)

    found = []
    for k in range(2, 9):
        bank.weigh_jump(*jump_of(rng, nav, k))
        found.append((bank.found.fixes, bank.found.accelerometer, bank.found.gyroscope))

    assert found[0][0] < 2.0
    assert found[-1][0] > 10.0
    assert np.all(np.array(found)[:, 1:] < 2.0)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (2.0, 16.0)])
def test_jumps_of_velocities_say_nothing_of_heights(factors: tuple[float, float]) -> None:
    """Nor does their direction matter: the factors on each axis stay those in force."""
    found = []
    for z in ([0.0, 0.0, 30.0], [30.0, 0.0, 0.0]):
        rng = np.random.default_rng(6)
        bank, nav = NoiseMultipleModelBank(), flat_state(rng, 0.02)
        bank.update(correction_of(rng, nav, 1), PSD)
        nav = flat_state(rng, 0.02)
        nav[COVARIANCE] = np.eye(N_ERROR)[np.triu_indices(N_ERROR)] * 1e-4
        for k in range(2, 9):
            bank.weigh_jump(*jump_of_velocity(nav, k, np.array(z), factors))
        found.append(bank.found)

    assert all(one.heights == 1.0 for one in found)
    assert all(one.fixes > 10.0 for one in found)


def jump_of_velocity(
    nav: Array, k: int, z: Array, factors: tuple[float, float]
) -> tuple[Correction, Array]:
    _, H = velocity_model(nav, nav[VELOCITY], np.zeros(3))
    R = 0.01 * scaling_of(factors) * np.eye(3)
    S, none = H @ covariance(nav) @ H.T + R, np.zeros(N_ERROR)
    K, C_nb = np.zeros((N_ERROR, 3)), matrix_from_quat(nav[QUAT])
    jump = Correction(k * SECOND // 5, z, S, H, K, none, C_nb, 0.2, nav, False)
    return replace(jump, kind="velocity", factors_by_axis=factors), R


def test_what_is_known_of_r_outlasts_an_inflation() -> None:
    rng = np.random.default_rng(7)
    bank, nav = NoiseMultipleModelBank(), flat_state(rng, 0.02)
    bank.update(correction_of(rng, nav, 1), PSD)
    for k in range(2, 9):
        bank.weigh_jump(*jump_of(rng, nav, k))
    before = bank.found.fixes

    bank.restart(keep_weights=False)

    assert bank.found.fixes > 0.5 * before
    assert max(bank.found.accelerometer, bank.found.gyroscope) <= 1.5


def test_no_hypothesis_is_beyond_return() -> None:
    rng = np.random.default_rng(8)
    bank, nav = NoiseMultipleModelBank(), flat_state(rng, 0.02)
    for k in range(1, 400):
        bank.update(correction_of(rng, nav, 1 + k % 2), PSD)

    assert bank._values[LOG_LIKELIHOOD].min() >= UNLIKELIEST
    assert bank._values[LOG_LIKELIHOOD].max() == 0.0
    assert bank._values[OF_FAMILY].min() >= UNLIKELIEST_FAMILY
    assert bank._values[OF_FAMILY].max() == 0.0
