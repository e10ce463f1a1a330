"""
Whether readings of an IMU fit the changes of velocity that fixes show.

The specific force, turned into one attitude by the gyroscope and integrated, is the change of
velocity over ground less gravity's, but for one constant rotation, [1]_. That rotation is found in
closed form, with the clock offset on a grid; by least squares the gyroscope's bias, the lever arm
from the IMU to the antenna and the clock offset between the grid's. What is left over shows how
well the readings fit. Without the lever arm wrong axes may fit as well as right ones: 0.3 m between
IMU and antenna move like a horizontal force on a vehicle that tilts to accelerate.

References
----------
.. [1] Y. Wu, X. Pan, "Velocity/position integration formula part I: application to in-flight
       coarse alignment", IEEE Transactions on Aerospace and Electronic Systems 49, 2013.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu_axes.nuisance import CLOCK_OFFSETS, CLOCK_STEP, DRIFT_TIME, STRICT
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec, skew
from hybrid_ins.core.inertial.strapdown import multiply, rotation
from hybrid_ins.core.update.measurements import turned

Array = NDArray[np.float64]

STEP = 0.05  # s, over which readings are integrated
INTERVALS = (1.0, 2.5, 5.0)  # s, of a change of velocity: brisk motion, gentle motion, poor fixes
TOLERANCE = (0.5, 2.0)  # of an interval
LEAST_STEP = 0.24  # s, from one change of velocity to the next
LEAST_STD, CHANGE_STD = 0.2, 0.3  # m/s, of a change of velocity: by good fixes and by poor ones
NUDGE = 1e-3  # rad/s, for derivatives by the bias
ITERATIONS, TOLERANT_ITERATIONS = 8, 16  # at most, of few and of many nuisance parameters
SMALLER = 0.99  # times as much has to be left over for another one


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """
    Readings and fixes of some seconds.

    Attributes
    ----------
    t : ndarray, shape (N + 1,)
        Ends of the steps, ``STEP`` apart [s].
    turn, impulse : ndarray, shape (N, 3)
        Integrals of angular rate [rad] and specific force [m/s] over the steps, in the IMU's own
        axes.
    fix_t, position_n : ndarray, shape (M,), (M, 3)
        Stamps [s], and positions relative to the first [m].
    triples : ndarray, shape (K, 3)
        Fixes between which changes of velocity are formed, see `triples_of`.
    """

    t: Array
    turn: Array
    impulse: Array
    fix_t: Array
    position_n: Array
    triples: NDArray[np.intp]

    @property
    def seconds(self) -> Array:
        """Time (K,) over which the changes of velocity extend [s]."""
        first, _, last = self.triples.T
        return np.asarray(0.5 * (self.fix_t[last] - self.fix_t[first]))

    @property
    def change_n(self) -> Array:
        """Changes of velocity over ground less gravity's, (K, 3) [m/s]."""
        changes = _differences(self.fix_t, self.position_n, self.triples)
        changes[:, 2] -= STANDARD_GRAVITY * self.seconds
        return changes


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """
    How a hypothesis on the readings fits a motion.

    Attributes
    ----------
    sign, gyroscope : float, ndarray, shape (3, 3)
        The hypothesis: what specific force and angular rate are multiplied by.
    left : float
        Sum of the squares of what is left over of the changes of horizontal velocity [m²/s²].
    correlation : float
        Of successive errors of the horizontal velocity: near zero or negative if they come from
        the fixes' noise, near one if they come from the hypothesis.
    C_ni : ndarray, shape (3, 3)
        Rotation to n from the IMU's axes at the first step.
    bias : ndarray, shape (3,)
        Of the gyroscope [rad/s], after it is multiplied.
    lever_arm, given_arm : ndarray, shape (3,)
        From the IMU to the antenna [m], in the axes of the readings that are multiplied; where
        it is said to be.
    arm_std : ndarray, shape (3,)
        Standard deviation of ``lever_arm`` [m], of what is left over.
    """

    sign: float
    gyroscope: Array
    left: float = np.inf
    correlation: float = 1.0
    C_ni: Array = field(default_factory=lambda: np.eye(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    given_arm: Array = field(default_factory=lambda: np.zeros(3))
    arm_std: Array = field(default_factory=lambda: np.full(3, np.inf))


def triples_of(t: Array, interval: float) -> NDArray[np.intp]:
    """Return the fixes (K, 3) of changes of velocity, about an interval [s] apart."""
    index = np.arange(len(t))
    first = np.minimum(_nearest(t, t - interval), index - 1)[1:-1]
    last = np.maximum(_nearest(t, t + interval), index + 1)[1:-1]
    middle, stamps = index[1:-1], t[1:-1]
    before, after = stamps - t[first], t[last] - stamps
    low, high = interval * TOLERANCE[0], interval * TOLERANCE[1]
    usable = (np.minimum(before, after) >= low) & (np.maximum(before, after) <= high)
    rows = np.column_stack((first, middle, last))[usable]
    kept, last_used = [], -np.inf
    for k, stamp in enumerate(stamps[usable].tolist()):
        if stamp - last_used >= LEAST_STEP:
            kept.append(k)
            last_used = stamp
    return np.asarray(rows[kept], np.intp).reshape(-1, 3)


def _nearest(t: Array, wanted: Array) -> NDArray[np.intp]:
    """Return the indices of the stamps ``t``, in order, that are nearest to those wanted."""
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    return np.asarray(after - (wanted - t[after - 1] <= t[after] - wanted))


def _differences(t: Array, position: Array, triples: NDArray[np.intp]) -> Array:
    """Return the changes (K, 3) of the mean velocity between positions (M, 3)."""
    first, middle, last = triples.T
    before = (t[middle] - t[first])[:, None]
    after = (t[last] - t[middle])[:, None]
    return np.asarray(
        (position[last] - position[middle]) / after - (position[middle] - position[first]) / before
    )


def fit(motion: Motion, start: Fit, allowed: tuple[Array, Array] = STRICT) -> Fit:
    """
    Return how well a hypothesis fits, from the bias and the lever arm of its start on.

    ``allowed`` are the standard deviations and limits of what may explain the changes besides: of
    `nuisance`.
    """
    turn, change_n = motion.turn @ start.gyroscope.T, motion.change_n
    impulse = start.sign * motion.impulse
    std, largest = allowed
    tolerant = len(std) > 7
    best = replace(start, left=np.inf)
    nuisance = nuisance_of_best = np.zeros(len(std))
    nuisance[:6] = *start.bias, *(start.lever_arm - start.given_arm)
    for _ in range(TOLERANT_ITERATIONS if tolerant else ITERATIONS):
        lever_arm, offsets = start.given_arm + nuisance[3:6], CLOCK_OFFSETS + nuisance[6]
        force = impulse - STEP * nuisance[7:10] if tolerant else impulse
        path, arms = _paths(motion, _turns(turn, nuisance), force)
        at_antenna = np.tensordot(lever_arm, arms, 1)
        changes = _changes(motion, path + at_antenna, offsets)[0]
        C = _rotations(changes, change_n)
        misfit = np.empty_like(changes)
        subtract_turned(change_n, C, changes, misfit)
        left = np.sum(misfit[..., :2] ** 2, axis=(1, 2))
        k = int(np.argmin(left))
        if left[k] > best.left:  # the step was too long
            nuisance = 0.5 * (nuisance + nuisance_of_best)
            continue
        if left[k] > SMALLER * best.left:
            break
        nuisance_of_best = nuisance
        best = replace(
            best,
            left=float(left[k]),
            correlation=float(np.sum(misfit[k, 1:, :2] * misfit[k, :-1, :2]) / left[k]),
            C_ni=C[k],
            bias=nuisance[:3],
            lever_arm=lever_arm,
        )
        around = offsets[k] + CLOCK_STEP * np.arange(-1.0, 2.0)
        before, at, after = _changes(motion, path + at_antenna, around)[0]
        nudges = NUDGE * np.delete(np.eye(len(std)), np.s_[3:10], axis=0)
        paths, _ = _paths(motion, _turns(turn, nuisance + nudges[:, None]), force)
        nudged = _changes(motion, paths + at_antenna, around[1:2])[:, 0]
        by_turns = (nudged - at) / NUDGE
        by_arm = _changes(motion, arms, around[1:2])[:, 0]
        columns = [*by_turns[:3], *by_arm, (after - before) / (2.0 * CLOCK_STEP)]
        if tolerant:
            by_force = _changes(motion, -_twice_integrated(arms), around[1:2])[:, 0]
            columns += [*by_force, *by_turns[3:]]
        by_all = np.stack(columns, axis=-1)
        H, z = _equations(C[k], at, by_all, misfit[k], nuisance, std)
        step = np.linalg.lstsq(H, z, rcond=None)[0][3:]
        nuisance = np.clip(nuisance + step, -largest, largest)
    return replace(best, arm_std=_sigma(H, z, len(std))[3:6])


def _turns(turn: Array, nuisance: Array) -> Array:
    """Return turns (..., N, 3) without the errors of a gyroscope, of nuisances (..., 1, P)."""
    bias, scales, drift = nuisance[..., :3], nuisance[..., 10:19], nuisance[..., 19:]
    if scales.shape[-1]:
        errors = scales.reshape(*nuisance.shape[:-2], 3, 3)
        turn = turn - turn @ np.swapaxes(errors, -1, -2)
        since_middle = STEP * (np.arange(turn.shape[-2]) - 0.5 * turn.shape[-2])
        bias = bias + drift * (since_middle / DRIFT_TIME)[:, None]
    return np.asarray(turn - STEP * bias)


def _twice_integrated(axes: Array) -> Array:
    """Return paths (3, N + 1, 3) by specific force of 1 m/s² along axes (3, N + 1, 3)."""
    steps = STEP * axes[:, :-1]
    paths = np.zeros_like(axes)
    paths[:, 1:] = np.cumsum(STEP * (np.cumsum(steps, axis=1) - 0.5 * steps), axis=1)
    return paths


def _equations(
    C: Array, changes: Array, by_nuisance: Array, misfit: Array, nuisance: Array, std: Array
) -> tuple[Array, Array]:
    """Return H and z of the least squares for a rotation (3,) and nuisance parameters (P,)."""
    count = len(std)
    of_changes = np.concatenate((-skew(changes @ C.T), C @ by_nuisance), -1)
    least = LEAST_STD if count > len(STRICT[0]) else CHANGE_STD
    noise = np.clip(np.sqrt(np.mean(misfit[:, :2] ** 2)), least, CHANGE_STD)
    weight = np.diag(noise / std)
    H = np.vstack((of_changes.reshape(-1, 3 + count), np.hstack((np.zeros((count, 3)), weight))))
    return H, np.concatenate((misfit.ravel(), -weight @ nuisance))


def _sigma(H: Array, z: Array, count: int) -> Array:
    """Return σ of ``count`` nuisance parameters, of what `_equations` have left over."""
    misfit = z[:-count].reshape(-1, 3)
    noise = max(CHANGE_STD, float(np.sqrt(np.mean(misfit[:, :2] ** 2))))
    return np.asarray(noise * np.sqrt(np.diag(np.linalg.pinv(H.T @ H))[3:]))


def attitudes(turn: Array) -> Array:
    """Return rotations (..., N, 3, 3) at the begin of each step to the first; turns (..., N, 3)."""
    turns = matrix_from_quat(quat_from_rotvec(turn))
    C = np.empty_like(turns)
    C[..., 0, :, :] = np.eye(3)
    C[..., 1:, :, :] = turns[..., :-1, :, :]
    reach = 1
    while reach < C.shape[-3]:  # products of 2, 4, 8 ... neighbours
        C[..., reach:, :, :] = C[..., :-reach, :, :] @ C[..., reach:, :, :]
        reach *= 2
    return C


def _paths(motion: Motion, turns: Array, impulse: Array) -> tuple[Array, Array]:
    """
    Return the paths (B, N + 1, 3) by the specific force in the first attitude, and of arms.

    The turns (B, N, 3) or (N, 3) are versions of the motion's. The arms (3, N + 1, 3) are one
    metre along the axes, in the attitudes of the first version.
    """
    turns = turns.reshape(-1, *impulse.shape)
    paths = np.zeros((len(turns), len(motion.t), 3))
    arms = np.empty((3, len(motion.t), 3))
    integrate_force(turns, np.ascontiguousarray(impulse), paths, arms)
    return paths, arms


@register_jitable
def write_columns(C, columns, n):  # type: ignore[no-untyped-def]
    """Write the columns of a matrix C, shape (9,), to the n-th rows (3, n, 3)."""
    for i in range(3):
        for j in range(3):
            columns[j, n, i] = C[3 * i + j]


@kernel()
def integrate_force(turns, impulse, paths, arms):  # type: ignore[no-untyped-def]
    """
    Integrate specific force twice, turned into the attitude at the first step.

    Parameters
    ----------
    turns, impulse : ndarray, shape (B, N, 3), (N, 3)
        Integrals over the steps of angular rate [rad], in several versions, and of specific
        force [m/s].
    paths : ndarray, shape (B, N + 1, 3)
        Written but for the first row, which is where they start [m].
    arms : ndarray, shape (3, N + 1, 3)
        Written: where the three axes point, in the first version of the angular rate.
    """
    C = np.empty(9)
    for b in range(turns.shape[0]):
        quat = np.array([0.0, 0.0, 0.0, 1.0])
        vx, vy, vz = 0.0, 0.0, 0.0
        for n in range(turns.shape[1]):
            ax, ay, az = turns[b, n, 0], turns[b, n, 1], turns[b, n, 2]
            fx, fy, fz = impulse[n, 0], impulse[n, 1], impulse[n, 2]
            force = np.array(
                [
                    fx + 0.5 * (ay * fz - az * fy),
                    fy + 0.5 * (az * fx - ax * fz),
                    fz + 0.5 * (ax * fy - ay * fx),
                ]
            )
            rotation(quat, C)
            if b == 0:
                write_columns(C, arms, n)
            step = turned(C, force)
            paths[b, n + 1, 0] = paths[b, n, 0] + STEP * (vx + 0.5 * step[0])
            paths[b, n + 1, 1] = paths[b, n, 1] + STEP * (vy + 0.5 * step[1])
            paths[b, n + 1, 2] = paths[b, n, 2] + STEP * (vz + 0.5 * step[2])
            vx, vy, vz = vx + step[0], vy + step[1], vz + step[2]
            angle = np.sqrt(ax * ax + ay * ay + az * az)
            c = np.cos(0.5 * angle)
            s = np.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
            multiply(quat, s * ax, s * ay, s * az, c)
        if b == 0:
            rotation(quat, C)
            write_columns(C, arms, turns.shape[1])


def _changes(motion: Motion, paths: Array, offsets: Array) -> Array:
    """Return the changes of velocity (B, T, K, 3) on paths (B, ...) at clock offsets (T,) [s]."""
    changes = np.empty((len(paths), len(offsets), len(motion.triples), 3))
    change_on_paths(paths, motion.t[0], motion.fix_t, offsets, motion.triples, changes)
    return changes


@kernel()
def change_on_paths(paths, start, fix_t, offsets, triples, changes):  # type: ignore[no-untyped-def]
    """
    Form the changes of velocity between fixes, had they been taken on paths.

    Parameters
    ----------
    paths : ndarray, shape (B, N + 1, 3)
        Positions ``STEP`` apart [m].
    start : float
        Time of the first position [s].
    fix_t, offsets : ndarray, shape (M,), (T,)
        Stamps of the fixes, and clock offsets that are added to them [s].
    triples : ndarray, shape (K, 3)
        See `Motion`.
    changes : ndarray, shape (B, T, K, 3)
        Written [m/s].
    """
    places = np.empty((len(fix_t), 3))
    for b in range(len(paths)):
        for i in range(len(offsets)):
            for m in range(len(fix_t)):
                at = (fix_t[m] + offsets[i] - start) / STEP
                n = min(max(int(at), 0), paths.shape[1] - 2)
                part = at - n
                for j in range(3):
                    places[m, j] = paths[b, n, j] * (1.0 - part) + paths[b, n + 1, j] * part
            for k in range(len(triples)):
                first, middle, last = triples[k, 0], triples[k, 1], triples[k, 2]
                before, after = fix_t[middle] - fix_t[first], fix_t[last] - fix_t[middle]
                for j in range(3):
                    changes[b, i, k, j] = (places[last, j] - places[middle, j]) / after - (
                        places[middle, j] - places[first, j]
                    ) / before


@kernel()
def subtract_turned(change_n, C, changes, misfit):  # type: ignore[no-untyped-def]
    """Write what changes (T, K, 3), turned by C (T, 3, 3), leave over of change_n (K, 3)."""
    for t in range(changes.shape[0]):
        for k in range(changes.shape[1]):
            x, y, z = changes[t, k, 0], changes[t, k, 1], changes[t, k, 2]
            for i in range(3):
                turned_i = C[t, i, 0] * x + C[t, i, 2] * z + C[t, i, 1] * y
                misfit[t, k, i] = change_n[k, i] - turned_i


def _rotations(changes: Array, change_n: Array) -> Array:
    """Return the rotations (T, 3, 3) that turn changes (T, K, 3) nearest to change_n (K, 3)."""
    M = np.zeros((len(changes), 3, 3))
    add_products(change_n, changes, M)
    u, _, vt = np.linalg.svd(M)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return np.asarray(u @ vt)


@kernel()
def add_products(change_n, changes, M):  # type: ignore[no-untyped-def]
    """Add to M (T, 3, 3) the products of change_n (K, 3) and changes (T, K, 3), summed over k."""
    for t in range(changes.shape[0]):
        for k in range(changes.shape[1]):
            for i in range(3):
                for j in range(3):
                    M[t, i, j] += change_n[k, i] * changes[t, k, j]
