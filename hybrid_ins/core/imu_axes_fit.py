"""
Whether readings of an IMU fit the changes of velocity that fixes show.

The specific force, turned into one attitude by the gyroscope and integrated, is the change of
velocity over ground less gravity's, but for one constant rotation, [1]_. That rotation is found in
closed form, with the clock offset on a grid and the gyroscope's bias by least squares; what is left
over shows how well the readings fit.

References
----------
.. [1] Y. Wu, X. Pan, "Velocity/position integration formula part I: application to in-flight
       coarse alignment", IEEE Transactions on Aerospace and Electronic Systems 49, 2013.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu_health import GRAVITY
from hybrid_ins.core.measurements import turned
from hybrid_ins.core.rotations import matrix_from_quat, quat_from_rotvec, skew
from hybrid_ins.core.strapdown import multiply, rotation

Array = NDArray[np.float64]

STEP = 0.05  # s, over which readings are integrated
INTERVALS = (1.0, 2.5)  # s, between the fixes of a change of velocity: brisk and gentle motion
TOLERANCE = (0.5, 2.0)  # of an interval
LEAST_STEP = 0.24  # s, from one change of velocity to the next
CLOCK_OFFSETS = np.linspace(-1.0, 1.0, 21)  # s, that may explain a misfit
BIAS_STD, LARGEST_BIAS = 0.02, 0.05  # rad/s, of a gyroscope
CHANGE_STD = 0.3  # m/s, of a change of velocity by fixes
NUDGE = 1e-3  # rad/s, for derivatives by the bias


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
        changes[:, 2] -= GRAVITY * self.seconds
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
    C_ni : ndarray, shape (3, 3)
        Rotation to n from the IMU's axes at the first step.
    bias : ndarray, shape (3,)
        Of the gyroscope [rad/s], after it is multiplied.
    """

    sign: float
    gyroscope: Array
    left: float = np.inf
    C_ni: Array = field(default_factory=lambda: np.eye(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))


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
    """Return the changes (..., K, 3) of the mean velocity in positions (..., M, 3)."""
    first, middle, last = triples.T
    before = (t[middle] - t[first])[:, None]
    after = (t[last] - t[middle])[:, None]
    return np.asarray(
        (position[..., last, :] - position[..., middle, :]) / after
        - (position[..., middle, :] - position[..., first, :]) / before
    )


def fit(motion: Motion, start: Fit, iterations: int = 2) -> Generator[None, None, Fit]:
    """
    Return how well a hypothesis fits; without iterations, with the bias that it has.

    Pauses after some milliseconds of work.
    """
    turn, change_n = motion.turn @ start.gyroscope.T, motion.change_n
    impulse = start.sign * motion.impulse
    best, bias = start, start.bias
    for iteration in range(iterations + 1):
        yield
        last = iteration == iterations
        biases = bias + NUDGE * np.eye(4, 3, -1)[: 1 if last else 4]
        paths = _paths(motion, turn - STEP * biases[:, None], impulse)
        changes = _changes(motion, paths[0], CLOCK_OFFSETS)
        C = _rotations(changes, change_n)
        misfit = change_n - np.einsum("tij,tkj->tki", C, changes)
        left = np.sum(misfit[..., :2] ** 2, axis=(1, 2))
        k = int(np.argmin(left))
        if left[k] < best.left:
            best = Fit(start.sign, start.gyroscope, float(left[k]), C[k], bias)
        if not last:
            nudged = _changes(motion, paths, CLOCK_OFFSETS[k : k + 1])[:, 0] @ C[k].T
            step = _bias_step(nudged, misfit[k], bias)
            bias = np.clip(bias + step, -LARGEST_BIAS, LARGEST_BIAS)
    return best


def _bias_step(nudged_n: Array, misfit: Array, bias: Array) -> Array:
    """Return the change of the bias (3,) by least squares, with the rotation free."""
    columns = [-skew(nudged_n[0])[:, :, i] for i in range(3)]
    columns += [(nudged_n[1 + i] - nudged_n[0]) / NUDGE for i in range(3)]
    weight = CHANGE_STD / BIAS_STD
    H = np.vstack((np.stack(columns, axis=-1).reshape(-1, 6), weight * np.eye(3, 6, 3)))
    z = np.concatenate((misfit.ravel(), -weight * bias))
    return np.asarray(np.linalg.lstsq(H, z, rcond=None)[0][3:])


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


def _paths(motion: Motion, turn: Array, impulse: Array) -> Array:
    """Return the twofold integral (B, N + 1, 3) of the specific force in the first attitude."""
    paths = np.zeros((len(turn), len(motion.t), 3))
    integrate_force(turn, np.ascontiguousarray(impulse), paths)
    return paths


@kernel()
def integrate_force(turns, impulse, paths):  # type: ignore[no-untyped-def]
    """
    Integrate specific force twice, turned into the attitude at the first step.

    Parameters
    ----------
    turns, impulse : ndarray, shape (B, N, 3), (N, 3)
        Integrals over the steps of angular rate [rad], in several versions, and of specific
        force [m/s].
    paths : ndarray, shape (B, N + 1, 3)
        Written but for the first row, which is where they start [m].
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
            step = turned(C, force)
            paths[b, n + 1, 0] = paths[b, n, 0] + STEP * (vx + 0.5 * step[0])
            paths[b, n + 1, 1] = paths[b, n, 1] + STEP * (vy + 0.5 * step[1])
            paths[b, n + 1, 2] = paths[b, n, 2] + STEP * (vz + 0.5 * step[2])
            vx, vy, vz = vx + step[0], vy + step[1], vz + step[2]
            angle = np.sqrt(ax * ax + ay * ay + az * az)
            c = np.cos(0.5 * angle)
            s = np.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
            multiply(quat, s * ax, s * ay, s * az, c)


def _changes(motion: Motion, path: Array, offsets: Array) -> Array:
    """Return the changes of velocity (..., T, K, 3) on paths at clock offsets (T,) [s]."""
    at = (motion.fix_t + offsets[:, None] - motion.t[0]) / STEP
    k = np.clip(at.astype(np.intp), 0, len(motion.t) - 2)
    part = (at - k)[..., None]
    places = path[..., k, :] * (1.0 - part) + path[..., k + 1, :] * part
    return _differences(motion.fix_t, places, motion.triples)


def _rotations(changes: Array, change_n: Array) -> Array:
    """Return the rotations (..., 3, 3) that turn changes (..., K, 3) nearest to change_n (K, 3)."""
    M = np.einsum("ki,...kj->...ij", change_n, changes)
    u, _, vt = np.linalg.svd(M)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)
