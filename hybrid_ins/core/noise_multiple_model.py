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
hypotheses have one of decimetres to metres, as a random walk of position.

Each hypothesis is the same filter with other noise: a covariance of its own, and no IMU. The
running filter's innovations and corrections carry all that its readings showed; a hypothesis only
keeps the offset of its own estimate from the running one. A correction that the running filter
found by iteration is one of the hypotheses, too: of the same linearisation, at its result.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, sections 5.4 (innovations) and 11.6 (multiple models).
.. [2] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
       distribution", Journal of the American Statistical Association 84, 1989.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.iterated_update import linearisation
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.noise_multiple_model_step import advance, mean_system
from hybrid_ins.core.position_scatter import SLOW_AXES, SLOW_TIME
from hybrid_ins.core.rotations import matrix_from_quat
from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.state import (
    COVARIANCE,
    DV,
    N_ERROR,
    PLACES,
    QUAT,
    VELOCITY,
    covariance,
)

Array = NDArray[np.float64]

DECADES = np.array([-1.5, 0.0, 1.0, 2.0, 3.0, 4.0])  # of the factor on the accelerometer's noise
RATE_DECADES = np.array([-1.5, 0.0, 3.0])  # on the gyroscope's
GNSS_DECADES = np.array([0.0, 0.7, 1.5, 3.0])  # on R
FACTOR_COST = 2.0  # nats of evidence that a factor above 1 needs
DECADE_COST = (1.0, 1.0, 2.0)  # and for each of its decades
REDUCTION_COST, REDUCTION_DECADE_COST = 1.5, 0.3  # the same of factors below 1
DEAD_BAND = 0.1  # decades that count as none
SLOW_STDS = np.array([0.3, 1.0, 3.0])  # m, of a slow error of the fixes
SLOW_DECADES = np.array([-1.5, 0.0, 1.0, 2.0])  # of the accelerometer's factor beside that
SLOW_RATIO = 20.0  # smallest, to the claimed σ: mount and clock cause what looks like less
SLOW_COST = 5.0  # nats of evidence that a slow error needs
SLOW_UNIT = 0.03  # m: of a smaller one the logarithm is near 0
MEMORY = 20.0  # s over which the likelihood is remembered
TAIL_DOF = 6.0  # degrees of freedom of an innovation's t distribution, [2]_
CORRECTION_RATIO = 3.0  # rise of a factor at which the running filter's state is corrected
MAX_INTERVAL = 3.0  # s without a fix: beyond it the mean motion does not represent the IMU

_GRID = np.stack(
    [grid.ravel() for grid in np.meshgrid(DECADES, RATE_DECADES, GNSS_DECADES, indexing="ij")]
)
_BESIDE_SLOW = np.zeros((3, SLOW_STDS.size * SLOW_DECADES.size))
_BESIDE_SLOW[0] = np.tile(SLOW_DECADES, SLOW_STDS.size)
_DECADES = np.hstack((_GRID, _BESIDE_SLOW))
_FACTORS = 10.0**_DECADES
_SLOW_STD = np.append(np.zeros(_GRID.shape[1]), np.repeat(SLOW_STDS, SLOW_DECADES.size))
_SLOW_LEVEL = np.log10(1.0 + _SLOW_STD / SLOW_UNIT)
_SLOW_WALK = np.outer(SLOW_AXES, 2.0 * _SLOW_STD**2 / SLOW_TIME)  # m²/s, NED
_LOG_PRIOR = -sum(
    (
        np.where(
            grid < 0.0,
            REDUCTION_COST - REDUCTION_DECADE_COST * grid,
            FACTOR_COST * (grid > 0.0) + cost * grid,
        )
        for grid, cost in zip(_DECADES, DECADE_COST, strict=True)
    ),
    SLOW_COST * (_SLOW_STD > 0.0),
)
_IDENTITY = np.eye(N_ERROR)
_FACTORS_OF_IMU = np.stack((_FACTORS[0], _FACTORS[1], np.ones(len(_LOG_PRIOR))))


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
    imu_factors : (float, float)
        On the variances of accelerometer and gyroscope, 0.04 to 10⁴ and to 10³.
    fix_factor : float
        On the covariance that fixes claim, 1 to 10³: receivers claim too small ones, too.
    slow_std : float
        Standard deviation of a slow error of the fixes, horizontally [m]; 0: the innovations show
        none.

    See Also
    --------
    multiple_model.MultipleModelBank : in the same terms. Its hypotheses are whole filters, their
        likelihoods do not fade, and unlikely hypotheses are dropped.
    """

    def __init__(self) -> None:
        self.imu_factors = (1.0, 1.0)
        self.fix_factor = 1.0
        self.slow_std = 0.0
        self._log_likelihood = np.zeros(len(_LOG_PRIOR))  # of each hypothesis, fading
        self._P: Array | None = None  # (120, hypotheses), packed
        self._state_offset = np.zeros((N_ERROR, len(_LOG_PRIOR)))  # own minus running estimate
        self._t_ns = 0
        self._velocity_n = np.zeros(3)  # after the last correction
        self._C_nb = np.eye(3)
        self._claimed_std = math.inf  # m, of the last position, horizontally
        self._lowest = np.ones(3)  # factors since the running state was last corrected

    def restart(self, *, keep_weights: bool) -> None:
        """Start the hypotheses anew at the next correction, with their weights or without."""
        self._P = None
        if not keep_weights:
            self._log_likelihood = np.zeros(len(_LOG_PRIOR))
            self.imu_factors, self.fix_factor, self._lowest = (1.0, 1.0), 1.0, np.ones(3)
            self.slow_std = 0.0

    def update(self, correction: Correction, psd: Array) -> StateCorrection | None:
        """
        Weigh the hypotheses by a correction, or by a measurement that was rejected.

        Returns where the state belongs when the factors have risen: the running filter has
        drifted with too small a noise meanwhile, the hypotheses that are likely now have not.

        Parameters
        ----------
        correction : Correction
            With the state before it, and its S with ``fix_factor`` in force; dx is zero if the
            measurement was rejected.
        psd : ndarray, shape (12,)
            Qc's diagonal at factor 1.

        Notes
        -----
        After more than ``MAX_INTERVAL`` without a fix the hypotheses start anew with the running
        filter's covariance, and their likelihoods stay as they were.
        """
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._P is None or not 0.0 <= T <= MAX_INTERVAL:
            self._P = np.tile(correction.nav[COVARIANCE][:, None], len(_LOG_PRIOR))
            self._state_offset = np.zeros((N_ERROR, len(_LOG_PRIOR)))
            T = 0.0
        total = self._log_likelihood * np.exp(-T / MEMORY)
        total += self._advance(correction, psd, T, _FACTORS, self.fix_factor)
        self._log_likelihood = total - total.max()
        log_weights = self._log_likelihood + _LOG_PRIOR
        is_small = (_SLOW_STD > 0.0) & (SLOW_RATIO * self._claimed_std > _SLOW_STD)
        log_weights[is_small] = -math.inf
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        return self._use_mixture(weights)

    def follow(self, correction: Correction, psd: Array) -> None:
        """Correct the hypotheses by a measurement that is no fix, and does not weigh them."""
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._P is None or not 0.0 <= T <= MAX_INTERVAL:
            self._P = None
            return
        self._log_likelihood = self._log_likelihood * np.exp(-T / MEMORY)
        self._advance(correction, psd, T, _FACTORS_OF_IMU, 1.0)

    def _advance(
        self, correction: Correction, psd: Array, T: float, factors: Array, fix_factor: float
    ) -> Array:
        """Propagate and correct the hypotheses; return the log-likelihood of each."""
        nav = correction.nav
        C_nb = matrix_from_quat(nav[QUAT])
        F, C_mean = mean_system(nav, self._velocity_n, self._C_nb, T)
        z, H, dx = correction.z, correction.H, correction.dx
        R = correction.S - H @ covariance(nav) @ H.T
        if H[0, 0] != 0.0:  # a position
            self._claimed_std = math.sqrt(max(0.5 * (R[0, 0] + R[1, 1]) / fix_factor, 0.0))
        G = _IDENTITY
        if correction.fused:
            z, H, dx, G = linearisation(nav[COVARIANCE], z, H, R / correction.weight)
        self._P, self._state_offset, log_likelihood = advance(
            self._P,
            self._state_offset,
            F,
            T,
            C_mean,
            psd,
            factors,
            _SLOW_WALK,
            z,
            H,
            R / fix_factor,
            dx,
            G,
            TAIL_DOF,
        )
        self._t_ns = correction.t_ns
        self._velocity_n = nav[VELOCITY] + correction.dx[DV]
        self._C_nb = C_nb
        return np.asarray(log_likelihood)

    def _use_mixture(self, weights: Array) -> StateCorrection | None:
        """Set the factors to the mixture's mean; where they have risen, correct the state."""
        a, g, r = map(_factor, (_DECADES @ weights).tolist())
        level = float(_SLOW_LEVEL @ weights)
        self.slow_std = SLOW_UNIT * (10.0**level - 1.0) if level > DEAD_BAND else 0.0
        self.imu_factors, self.fix_factor = (a, g), r
        factors = np.array([a, g, r])
        risen = np.max(factors / self._lowest)
        self._lowest = np.minimum(self._lowest, factors)
        if risen < CORRECTION_RATIO:
            return None
        assert self._P is not None
        self._lowest = factors
        dx = self._state_offset @ weights
        deviation = self._state_offset - dx[:, None]
        P = (self._P @ weights)[PLACES] + (weights * deviation) @ deviation.T
        self._state_offset, self._velocity_n = deviation, self._velocity_n + dx[DV]
        return StateCorrection(dx, P)


def _factor(decades: float) -> float:
    """Return the factor of a mean exponent, reduced by the dead band."""
    return float(10.0 ** math.copysign(max(0.0, abs(decades) - DEAD_BAND), decades))
