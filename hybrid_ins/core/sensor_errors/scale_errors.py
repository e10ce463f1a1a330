"""
Errors of an IMU's scale factors and of the directions of its axes, estimated beside the filter.

They are constant: the readings are f + M_a f and ω + M_g ω with small unknown matrices M_a and M_g,
(3, 3), [2]_. Of the motion at the start nothing can be told from the biases, which are those about
it: the errors of the readings are b + M_a (f - f₀) and b + M_g ω, where f₀ is what was measured of
gravity then.

For the filter their elements m are constants, so the sensitivity U = d(error)/dm, shape (15, 18),
obeys the filter's own equations, [1]_::

    U <- Phi U + D        over IMU samples; D is what M (f - f₀) and M ω do meanwhile
    U <- G U - K H U      with every correction

and an innovation has the mean H U m. The estimate is a regression of the innovations on that, with
the clock offset of the fixes, the age of velocities and the error of the lever arm beside it: in
turns they do something similar. While fixes come they hold the state, and nothing is corrected. The
attitude of a vehicle that circles they hold only loosely: the mean square of U m is part of its
covariance as it is reported.

Where fixes are missing the state is corrected by U m, and what the samples do to it from then on by
D m; what is not known of m, and a part of it that is not constant, is *considered*, [3]_: with its
covariance P_m, U P_m U' is added to that of the state, so that a manoeuvre that ends as it began
takes away most of what it has brought.

A direction in the vehicle that was learned from the state while fixes came, such as that of its
nose, contains what scale errors have done to the attitude: the two cancel. A measurement that uses
it depends on m beside by the state.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
.. [2] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 4.4.2 (scale factor and cross-coupling errors).
.. [3] S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control
       Systems 3, 1966.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing, readings_of, steps_since
from hybrid_ins.core.inertial.earth import normal_gravity
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    HEADING_VARIANCE,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    QUAT,
    covariance,
    pack,
)
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.sensor_errors.clock_offset import MARGIN, MAX_STD, NIS_MEMORY, RANDOM_WALK
from hybrid_ins.core.sensor_errors.clock_sensitivity import sensitivities
from hybrid_ins.core.sensor_errors.considered_scale import Considered, told_by_state
from hybrid_ins.core.sensor_errors.lever_arm import AGE_STD, HEADING_STD, dependence_on_lever_arm
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE, follow_samples
from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.update.kalman import covariances_at_full_weight, heading_turn, inject
from hybrid_ins.core.update.linalg import factorise, mean_square, regress
from hybrid_ins.core.update.measurements import LinearModel

Array = NDArray[np.float64]

MAX_INTERVAL_NS = 10_000_000_000  # between two events, beyond which nothing is followed
LEVER_STD = 0.3  # m, of the place of the antenna

AXES = 0.5  # of the deviation of a scale factor: that of an axis' direction [rad], by data sheets
VARYING = 0.16  # of their variances: what is not constant, by temperature and nonlinearity
SHARES = np.tile(np.where(np.eye(3) > 0.0, 1.0, AXES).ravel(), 2)  # the same, by element

# Regressed: clock offset that the stamps lack [s], age of velocities [s], error of the lever arm
# [m], b, and m in units of its deviations; U is by those from the lever arm on.
CLOCK, LEVER, SCALE = 0, slice(2, 5), slice(5, 5 + N_SCALE)
N_PARAMETERS, N_LEVER = SCALE.stop, 3
_START_STD = np.array((MAX_STD, AGE_STD, *3 * [LEVER_STD], *N_SCALE * [math.sqrt(1.0 - VARYING)]))


class ScaleErrors(NamedTuple):
    """What the innovations show of an IMU."""

    M_a: Array  # (3, 3), relative errors of the accelerometers' readings
    M_g: Array  # (3, 3), of the gyroscopes'
    std_a: Array  # (3, 3)
    std_g: Array  # (3, 3)


class ScaleErrorObserver(ShallowCopy):
    """
    Estimates scale errors; in outages corrects a state by them, and considers what is not known.

    Arrays are replaced, never changed in place: a shallow copy is a checkpoint.

    Parameters
    ----------
    std : float
        Standard deviation of the elements on the diagonals of M_a and M_g; 0: there are no errors.
    """

    def __init__(self, std: float) -> None:
        self._units = std * SHARES
        self._parameters, self._P = np.zeros(N_PARAMETERS), np.diag(_START_STD**2)
        self._nis = 1.0  # mean normalised NIS
        self._t_ns: int | None = None  # up to which U holds
        self._U = np.zeros((N_ERROR, N_LEVER + N_SCALE))
        self._reference = np.zeros(6)  # f₀ and 0
        self._root: Array | None = None  # of P_m, while U P_m U' is part of a covariance
        self.done: Considered | None = None  # to the state at the last event

    @property
    def estimate(self) -> ScaleErrors:
        """See `ScaleErrors`."""
        m = (self._units * self._parameters[SCALE]).reshape(2, 3, 3)
        variance = np.diag(self._P)[SCALE]
        std = (self._units * np.sqrt(variance)).reshape(2, 3, 3)
        return ScaleErrors(*m, *std)

    @property
    def in_outage(self) -> bool:
        """Whether the covariance of the state contains what is considered."""
        return self._root is not None

    @property
    def correlation(self) -> Array:
        """E[δx nᵀ], shape (15, 18), in an outage: m is its mean and ``_root`` n."""
        assert self._root is not None
        correlation: Array = self._U[:, N_LEVER:] @ self._root
        return correlation

    @property
    def considered(self) -> Array:
        """
        Mean square of what they do to the attitude beside its covariance [rad²], (6,), n.

        Upper triangle, row by row. In an outage the covariance of the state itself contains it.
        """
        attitude = np.zeros(6)
        if self._root is None and self._t_ns is not None:
            attitude_mean_square(self._U, self._parameters, self._P, attitude)
        return attitude

    def sensitivity_at(self, nav: Array, ring: ImuRing, t_ns: int) -> Array:
        """
        Return d(error)/dm, shape (15, N_SCALE), by m in units of its deviations.

        Parameters as for `follow`; nothing is changed.
        """
        ahead = self.__copy__()
        ahead._root = None
        ahead.follow(nav, ring, t_ns)
        return ahead._U[:, N_LEVER:] if ahead._t_ns is not None else np.zeros((N_ERROR, N_SCALE))

    def decorrelated(self, nav: Array, by_scale: Array) -> tuple[LinearModel, Array]:
        """
        Return what makes a measurement whose error depends on m, in an outage, one that does not.

        What is known of m is taken out of z. The rest is correlated with the error of the state,
        which contains U m: the part that this error tells is one of H, what is left one of R.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            Flat state with nothing pending.
        by_scale : ndarray, shape (m, N_SCALE)
            Derivative of z by m, in units of its deviations, beside that through the state.

        Returns
        -------
        added : LinearModel
            To its z, H and R.
        beside : ndarray, shape (m, N_LEVER + N_SCALE)
            Derivative of z by the parameters beside H U.
        """
        assert self._root is not None
        told, rest = told_by_state(nav, self.correlation, by_scale @ self._root)
        beside = -told @ self._U
        beside[:, N_LEVER:] += by_scale
        return (-by_scale @ self._parameters[SCALE], told, rest), beside

    def restart(self) -> None:
        """Note that the state was changed by other means than measurements."""
        self._t_ns = self._root = None

    def shift_clock(self, by: float) -> None:
        """Note that ``by`` [s] more is added to the stamps of fixes from now on."""
        self._parameters, self._P = self._parameters.copy(), self._P.copy()
        self._parameters[CLOCK] -= by
        self._P[CLOCK, CLOCK] += by**2

    def follow(self, nav: Array, ring: ImuRing, t_ns: int) -> None:
        """
        Follow the IMU; in an outage correct the state and let its covariance grow.

        With the outage's U₁ = Φ U₀ + D, P ← P + U₁ P_m U₁ᵀ - Φ U₀ P_m U₀ᵀ Φᵀ.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            Flat state at a stamp with nothing pending; changed in place.
        ring : ImuRing
            Holds the samples up to there.
        t_ns : int
            The stamp [ns].
        """
        self.done = None
        if self._t_ns is None or t_ns <= self._t_ns:
            return
        if t_ns - self._t_ns > MAX_INTERVAL_NS or ring.has_lost(self._t_ns):
            self.restart()
            return
        samples = ring.between(self._t_ns, t_ns)
        if not len(samples) or samples["t_ns"][-1] < t_ns:
            last = np.array([(t_ns, nav[LAST_F], nav[LAST_W])], SAMPLE_DTYPE)
            samples = np.concatenate((samples, last))
        dt = steps_since(self._t_ns, samples["t_ns"]) * 1e-9
        U, driven = self._U.copy(), np.zeros((N_ERROR, N_SCALE))
        follow_samples(nav, dt, readings_of(samples), self._reference, U, driven)
        driven *= self._units
        if self._root is not None:
            before = U[:, N_LEVER:] @ self._root
            after, dx = before + driven @ self._root, driven @ self._parameters[SCALE]
            self.done = Considered(dx, before, after - before, nav[COVARIANCE].copy())
            pack(covariance(nav) + after @ after.T - before @ before.T, nav[COVARIANCE])
            inject(nav, dx)
        U[:, N_LEVER:] += driven
        self._U, self._P, elapsed = U, self._P.copy(), (t_ns - self._t_ns) * 1e-9
        self._P[CLOCK, CLOCK] += elapsed * RANDOM_WALK**2
        self._t_ns = t_ns

    def begin_outage(self, nav: Array, ring: ImuRing, fix_ns: int, t_ns: int) -> None:
        """
        Correct a state at a stamp [ns] by what is known, and consider the rest until the next fix.

        Without an outage that goes on already; ``fix_ns`` is the stamp of the last fix [ns].
        """
        if self._root is not None or not self._units.any():
            return
        if self._t_ns is None:
            is_out_of_reach = t_ns - fix_ns > MAX_INTERVAL_NS or ring.has_lost(fix_ns)
            self._begin(nav, t_ns if is_out_of_reach else fix_ns)
            self.follow(nav, ring, t_ns)
        P_m = self._P[SCALE, SCALE] + VARYING * np.eye(N_SCALE)
        self._root = np.linalg.cholesky(0.5 * (P_m + P_m.T))
        S, dx = self.correlation, self._U[:, N_LEVER:] @ self._parameters[SCALE]
        self.done = Considered(dx, np.zeros_like(S), S, nav[COVARIANCE].copy())
        pack(covariance(nav) + S @ S.T, nav[COVARIANCE])
        inject(nav, dx)

    def end_outage(self) -> None:
        """Note a fix: what is considered is part of the covariance, which goes on alone."""
        if self._root is not None:
            self.restart()

    def _begin(self, nav: Array, t_ns: int) -> None:
        """Begin with a state that was read off the fixes."""
        C_nb, gravity_n = matrix_from_quat(nav[QUAT]), normal_gravity(nav[LLA][0], nav[LLA][2])
        self._U = np.zeros((N_ERROR, N_LEVER + N_SCALE))
        self._U[:3, :N_LEVER] = -C_nb
        self._reference = np.zeros(6)
        self._reference[:3] = -C_nb.T @ [gravity_n[0], 0.0, gravity_n[1]]
        self._t_ns = t_ns

    def update(self, correction: Correction, is_fix: bool, beside: Array | float = 0.0) -> None:
        """
        Follow a correction, and learn from that by a fix.

        Parameters
        ----------
        correction : Correction
            With the state before it.
        is_fix : bool
            Otherwise another measurement corrected, which only changes U.
        beside : ndarray, shape (m, N_LEVER + N_SCALE), optional
            See `decorrelated`.
        """
        if self._root is None:
            if correction.nav[HEADING_VARIANCE] > HEADING_STD**2 or not self._units.any():
                self.restart()
                return
            if is_fix and self._t_ns is None:
                self._begin(correction.nav, correction.t_ns)
        if self._t_ns is None:
            return
        _, H, _, G = correction.linear or (None, correction.H, None, None)
        h = H @ self._U + beside
        if is_fix:
            direct = dependence_on_lever_arm(correction.nav, correction.H)
            h[:, :N_LEVER] += direct
            if correction.fused:
                self._learn(correction, direct)
        moved = self._U if G is None else G @ self._U
        self._U = moved - correction.K @ h
        if correction.turn:
            self._U = heading_turn(correction.turn) @ self._U

    def explain(self, correction: Correction) -> Correction | None:
        """
        Return a correction by a fix as that of an IMU without the scale errors that are known.

        Its state would be U m from here. None where these are not followed.
        """
        if self._t_ns is None or self._root is not None or not self._units.any():
            return None
        shift, linear = self._U[:, N_LEVER:] @ self._parameters[SCALE], correction.linear
        explained = correction.H @ shift
        if linear is not None:
            z_x, H_x, x, G = linear
            explained_x = H_x @ shift
            linear = (z_x - explained_x, H_x, x - np.linalg.solve(G, correction.K @ explained_x), G)
        z, dx = correction.z - explained, correction.dx - correction.K @ explained
        return replace(correction, z=z, dx=dx, linear=linear)

    def _learn(self, correction: Correction, of_lever: Array) -> None:
        """Regress an innovation; ``of_lever`` is how it depends on the lever arm itself, (m, 3)."""
        h = np.empty((len(correction.z), N_PARAMETERS))
        h[:, : LEVER.start], _ = sensitivities(correction.nav, correction.H)
        h[:, LEVER.start :] = correction.H @ self._U
        h[:, LEVER] += of_lever
        self._parameters, self._P = self._parameters.copy(), self._P.copy()
        self._nis = observe_scale_errors(
            self._parameters,
            self._P,
            self._nis,
            correction.nav[COVARIANCE],
            correction.z,
            correction.H,
            h,
            correction.S,
            correction.weight,
        )


@kernel()
def observe_scale_errors(  # type: ignore[no-untyped-def]
    parameters, P, nis, packed, z, H, h, S, weight
):
    """
    Correct the parameters by an innovation, and return the mean normalised NIS after it.

    Parameters
    ----------
    parameters, P : ndarray, shape (N_PARAMETERS,), (N_PARAMETERS, N_PARAMETERS)
        Overwritten.
    nis : float
        Mean normalised NIS before it: what is above 1 makes an innovation say less.
    packed : ndarray, shape (120,)
        Upper triangle of the state's covariance before the correction.
    z, H, h, S : ndarray, shape (m,), (m, 15), (m, N_PARAMETERS), (m, m)
        Innovation, measurement matrix, mean of the former by parameters, and its covariance.
    weight : float
        With which the measurement was fused: its covariance was divided by that.
    """
    root, _ = covariances_at_full_weight(packed, H, S, weight)
    factorise(root)
    nis += (mean_square(z, h, parameters, root) - nis) / NIS_MEMORY
    regress(parameters, P, z, h, MARGIN * np.sqrt(max(nis, 1.0)) * root)
    return nis


@kernel()
def attitude_mean_square(U, parameters, P, out):  # type: ignore[no-untyped-def]
    """
    Write the mean square of U m of an attitude: U (m mᵀ + P_m) Uᵀ.

    Parameters
    ----------
    U : ndarray, shape (15, N_LEVER + N_SCALE)
        Sensitivities.
    parameters, P : ndarray, shape (N_PARAMETERS,), (N_PARAMETERS, N_PARAMETERS)
        Estimate and its covariance, to which that is added which is not constant.
    out : ndarray, shape (6,)
        Upper triangle, row by row; overwritten.
    """
    from_m, mean, spread = SCALE.start, np.zeros(3), np.zeros((3, N_SCALE))
    for i in range(3):
        u = U[6 + i, N_LEVER:]
        for a in range(N_SCALE):
            mean[i] += u[a] * parameters[from_m + a]
            spread[i, a] = VARYING * u[a]
            for b in range(N_SCALE):
                spread[i, a] += u[b] * P[from_m + b, from_m + a]
    k = 0
    for i in range(3):
        for j in range(i, 3):
            out[k] = mean[i] * mean[j]
            for a in range(N_SCALE):
                out[k] += spread[i, a] * U[6 + j, N_LEVER + a]
            k += 1
