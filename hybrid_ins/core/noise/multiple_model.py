"""
Noise factors from the innovations: a bank of filters that differ in their assumed noise.

A clock offset, a tilted or flexing mount, scale errors: to the filter they are process noise that
IMU readings do not contain. The innovations do, but their size alone does not show whether the IMU
or the receiver causes it. Their sequence does: process noise makes successive errors grow
together, a wrong R makes them alternate, an outlier is isolated. So a grid of hypotheses (factors
on the noise of the accelerometer, of the gyroscope, and on R) is compared by the likelihood that
each gives to the whole sequence, [1]_.

The factors may also be below 1, by a decade and a half: vibration that the regressor measures
above the frequencies of motion need not extend down to those that integrate into position.

A slow error of the fixes that their covariance does not contain (see `position_scatter`) changes
from fix to fix by more than the IMU saw the vehicle move, and neither grows nor alternates: some
hypotheses have one of decimetres to metres, as a random walk of position. A driver that stamps
fixes when they arrive makes errors along the velocity, and no others: some have stamps that
scatter. Velocities that a receiver filters are old, and err along the acceleration, or for seconds:
some have an age of velocities, or a factor on their R alone. `weights` weighs them.

Each hypothesis is the same filter with other noise: a covariance of its own, and no IMU. The
running filter's innovations and corrections carry all that its readings showed; a hypothesis only
keeps the offset of its own estimate from the running one. A correction that the running filter
found by iteration is one of the hypotheses, too: of the same linearisation, at its result.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, sections 5.4 (innovations) and 11.6 (multiple models).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import COVARIANCE, DV, EPS, N_ERROR, PLACES
from hybrid_ins.core.noise.heading_information import HEADING
from hybrid_ins.core.noise.hypotheses import (
    AGE_STD,
    COUNT,
    ON_HEIGHT,
    ON_R,
    ON_VELOCITY,
    R_LEVELS,
    STAMP_STD,
    WIDE_HYPOTHESES,
    WIDTH,
    WITHOUT_SLOW_HEIGHTS,
    claims_in_search,
)
from hybrid_ins.core.noise.multiple_model_step import N_ROWS, OFFSETS
from hybrid_ins.core.noise.multiple_model_update import (
    CLAIMED_STDS,
    FACTORS,
    LAST_C,
    LAST_VELOCITY,
    LOG_LIKELIHOOD,
    LOWEST,
    OF_FAMILY,
    PENDING_G,
    TAIL_DOF,
    WEIGHTS,
    update_hypotheses,
)
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.noise.slow_error import NO_GROWTH
from hybrid_ins.core.noise.weights import (
    AT_START,
    NoiseFactors,
    add_likelihood,
    average,
    likelihood_of_r,
    weigh,
)
from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.update.kalman import heading_turn
from hybrid_ins.core.update.linalg import log_determinant
from hybrid_ins.core.update.measurements import (
    PositionFix,
    Standstill,
    VelocityFix,
    roots_by_axis,
    scaled_by_axis,
)

Array = NDArray[np.float64]

OUTLIERS = 0.05  # prior probability that a jump of the fixes is an error of its own
NEW_HEIGHTS_NS = 60_000_000_000  # in which the filter settles on heights that there were not before
MAX_INTERVAL = 3.0  # s without a fix: beyond it the mean motion does not represent the IMU
STAND_NS = 1_500_000_000  # after a standstill update, in which the vehicle still stands

_HYPOTHESES_OF_IMU = WIDE_HYPOTHESES.copy()  # about R there are none for what is no fix
_HYPOTHESES_OF_IMU[2] = 1.0
_ROOTS_OF_VELOCITY = roots_by_axis(*10.0 ** WIDE_HYPOTHESES[ON_VELOCITY])
# A wrong heading or clock looks like old velocities; not like fixes whose positions scatter alone.
_ROOTS_IN_SEARCH = roots_by_axis(*10.0 ** np.minimum(WIDE_HYPOTHESES[ON_VELOCITY], 0.0))
_ROOTS_OF_POSITION = roots_by_axis(np.ones(WIDTH), 10.0 ** WIDE_HYPOTHESES[ON_HEIGHT])
_ROOTS_OF_OTHERS = np.ones((N_ERROR, WIDTH))

_START = np.zeros(WEIGHTS.stop)
_START[FACTORS] = NoiseFactors()
_START[OF_FAMILY][1:] = AT_START
_START[LOWEST], _START[CLAIMED_STDS] = 1.0, math.inf
_IDENTITY = np.eye(N_ERROR)
_EXACT = [np.zeros((m, m)) for m in range(7)]  # contiguous: kernels are compiled for such alone
_START[PENDING_G] = _IDENTITY.ravel()


@dataclass(frozen=True, slots=True)
class StateCorrection:
    """Where the state belongs under other noise than the one that it was propagated with."""

    dx: Array  # (15,) to be added to the state
    P: Array  # (15, 15) covariance after that


class NoiseMultipleModelBank(ShallowCopy):
    """
    Factors on the assumed noise, from the likelihood of the innovations.

    Arrays are replaced, never changed in place: a shallow copy is a checkpoint.

    Attributes
    ----------
    found : NoiseFactors
    estimates : ndarray, shape (N_ROWS, WIDTH), or None
        Of the hypotheses, see `advance`; None before the second fix.
    t_ns : int
        Stamp of the last correction [ns]; 0 before the first.
    """

    def __init__(self) -> None:
        self.found = NoiseFactors()
        self._values = _START
        self.estimates: Array | None = None
        self.t_ns, self._heightless_ns, self._stood_ns = 0, -NEW_HEIGHTS_NS, -STAND_NS

    def restart(self, *, keep_weights: bool) -> None:
        """
        Start the hypotheses anew at the next correction, with their weights or without.

        Without: what is known of R stays all the same, whatever state it was learned with.
        """
        self.estimates = None
        if not keep_weights:
            of_fixes = likelihood_of_r(self._values[LOG_LIKELIHOOD], self._values[OF_FAMILY])
            self._forget()
            self.add_log_likelihood(of_fixes)

    def forget_heights(self, t_ns: int) -> None:
        """Forget what was found where it is of heights up to a stamp [ns]: they were none."""
        self._heightless_ns = t_ns
        if self.found.heights > 1.0 or self.found.slow_height_std > self.found.slow_std:
            self.estimates = None
            self._forget()
            self._read_factors()

    def _forget(self) -> None:
        self._values = self._values.copy()
        for part in (FACTORS, LOWEST, LOG_LIKELIHOOD, OF_FAMILY):
            self._values[part] = _START[part]

    def weigh_jump(self, correction: Correction, R: Array) -> None:
        """
        Weigh the factors on R by a fix that was rejected as a jump.

        No error of an INS makes a jump. Most are errors of their own, with the prior probability
        ``OUTLIERS``; where they are many the receiver claims too small a covariance.

        Parameters
        ----------
        correction : Correction
            With S that ``R`` is contained in.
        R : ndarray, shape (m, m)
            With the correction's ``fix_factor`` and ``factors_by_axis``.
        """
        z, m, found = correction.z, len(R), np.empty(COUNT)
        of_position = correction.kind == PositionFix.kind  # what is no position says no height
        for level in R_LEVELS:
            common, on_height = ON_R[:, level[0]]
            besides = on_height / correction.factors_by_axis[1] if of_position else 1.0
            factors = common, common * besides
            S = correction.S - R + scaled_by_axis(R / correction.fix_factor, *factors)
            tail = math.log1p(float(z @ np.linalg.solve(S, z)) / (TAIL_DOF - 1.3))
            found[level] = -0.5 * (log_determinant(S) + (TAIL_DOF + m) * tail)
        self.add_log_likelihood(np.logaddexp(found - found.max(), math.log(OUTLIERS)))

    def add_log_likelihood(self, one: Array) -> None:
        """Add log-likelihoods of the hypotheses, (COUNT,), and read the factors."""
        values = self._values = self._values.copy()
        lowest = values[LOWEST].copy()
        of_family = values[OF_FAMILY]
        claimed = float(values[CLAIMED_STDS][0]), float(values[CLAIMED_STDS][1])
        add_likelihood(one, claimed, values[LOG_LIKELIHOOD], of_family)
        weigh(values[LOG_LIKELIHOOD], of_family, claimed, values[WEIGHTS])
        average(values[WEIGHTS], values[FACTORS], values[LOWEST])
        values[LOWEST] = lowest  # the state is corrected with the next fix
        self._read_factors()

    def update(self, correction: Correction, psd: Array) -> StateCorrection | None:
        """
        Weigh the hypotheses by a correction, or by a measurement that was rejected.

        Returns where the state belongs when the factors have risen: the running filter has
        drifted with too small a noise meanwhile, the hypotheses that are likely now have not.

        Parameters
        ----------
        correction : Correction
            With the state before it; dx is zero if the measurement was rejected.
        psd : ndarray, shape (12,)
            Qc's diagonal at factor 1.

        Notes
        -----
        After more than ``MAX_INTERVAL`` the hypotheses start anew with the running filter's
        covariance, and their likelihoods stay as they were.
        """
        are_new = correction.t_ns - self._heightless_ns < NEW_HEIGHTS_NS
        without = are_new or self._is_search(correction)
        hypotheses = WITHOUT_SLOW_HEIGHTS if without else WIDE_HYPOTHESES
        have_risen = self._update(correction, psd, hypotheses, True)
        self._read_factors()
        return self._state_correction() if have_risen else None

    def follow(self, correction: Correction, psd: Array) -> None:
        """Correct the hypotheses by a measurement that is no fix, and do not weigh them."""
        if correction.kind == Standstill.kind:
            self._stood_ns = correction.t_ns
        if self.estimates is not None and 0.0 <= self._time_to(correction) <= MAX_INTERVAL:
            self._update(correction, psd, _HYPOTHESES_OF_IMU, False)
        else:
            self.estimates = None

    def stands(self, t_ns: int) -> bool:
        """Return whether the vehicle stands at a stamp [ns]."""
        return t_ns - self._stood_ns < STAND_NS

    def _is_search(self, correction: Correction) -> bool:
        """Return whether a wrong heading or clock may look like errors of a fix."""
        return correction.of_stamp is None and not self.stands(correction.t_ns)

    def _time_to(self, correction: Correction) -> float:
        """Return the time since the last correction [s]."""
        return (correction.t_ns - self.t_ns) * 1e-9

    def _update(self, correction: Correction, psd: Array, hypotheses: Array, weigh: bool) -> bool:
        """See `update_hypotheses`."""
        before, T, m = self.estimates, self._time_to(correction), len(correction.z)
        is_search, claims = self._is_search(correction), correction.claimed_stds
        stamp_stds, roots, in_force = STAMP_STD, _ROOTS_OF_OTHERS, np.ones(m)
        if correction.kind == PositionFix.kind:
            roots, in_force = _ROOTS_OF_POSITION, roots_by_axis(*correction.factors_by_axis)[:m]
        elif correction.kind == VelocityFix.kind:
            stamp_stds, in_force = AGE_STD, roots_by_axis(*correction.factors_by_axis)[:m]
            roots = _ROOTS_IN_SEARCH if correction.of_stamp is None else _ROOTS_OF_VELOCITY
        self._values = self._values.copy()
        if before is None or not 0.0 <= T <= MAX_INTERVAL:
            T, before = 0.0, np.zeros((N_ROWS, WIDTH))
            before[:OFFSETS] = correction.nav[COVARIANCE][:, None]
            self._values[PENDING_G] = _START[PENDING_G]
        self.estimates, self.t_ns = np.empty((N_ROWS, WIDTH)), correction.t_ns
        *linear, G = correction.linear or (correction.z, correction.H, correction.dx, _IDENTITY)
        if correction.turn:
            G = heading_turn(correction.turn) @ G
        have_risen = update_hypotheses(
            hypotheses,
            before,
            self.estimates,
            self._values,
            T,
            correction.nav,
            psd,
            correction.H,
            correction.S,
            correction.fix_factor,
            correction.stamp_std**2,
            _EXACT[m] if correction.of_stamp is None else correction.of_stamp,
            WIDE_HYPOTHESES[stamp_stds],
            roots[:m],
            in_force,
            NO_GROWTH if correction.slow_growth is None else correction.slow_growth,
            claims_in_search(*claims) if is_search else claims,
            correction.dx,
            *linear,
            G,
            weigh,
        )
        self._values[LAST_C] = correction.C_nb.ravel()
        return bool(have_risen)

    def _read_factors(self) -> None:
        self.found = NoiseFactors(*self._values[FACTORS].tolist())

    def _state_correction(self) -> StateCorrection:
        """Return where the state belongs by the mixture, which the hypotheses refer to from now."""
        assert self.estimates is not None
        values, weights = self._values, self._values[WEIGHTS]
        G = values[PENDING_G].reshape(N_ERROR, N_ERROR)
        covariances, offsets = self.estimates[:OFFSETS], self.estimates[OFFSETS:]
        mean = offsets[:, :COUNT] @ weights
        deviation = offsets - mean[:, None]
        spread = deviation[:, :COUNT]
        P = (covariances[:, :COUNT] @ weights)[PLACES] + (weights * spread) @ spread.T
        dx = G @ mean
        T = heading_turn(dx[HEADING])
        G = T @ G
        self.estimates, values[PENDING_G] = np.vstack((covariances, deviation)), G.ravel()
        values[LAST_VELOCITY] += dx[DV]
        values[LAST_C] = (T[EPS, EPS] @ values[LAST_C].reshape(3, 3)).ravel()
        return StateCorrection(dx, G @ P @ G.T)
