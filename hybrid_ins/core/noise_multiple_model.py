"""
What the IMU cannot show: how far its errors exceed its noise, told by the fixes.

A clock offset, a tilted or flexing mount, scale errors: to the filter they are process noise that
no look at the IMU reveals. The innovations do, but their size alone does not say whether the IMU
or the receiver is to blame. Their sequence does: process noise makes successive errors grow
together, a wrong R makes them jump back and forth, an outlier comes alone. So a grid of
hypotheses (factors on the accelerometer's and the gyroscope's noise, and on R) is compared by the
likelihood that each would have given the whole sequence.

The factors may also fall below 1, by a decade and a half: vibration that the regressor reads above
the frequencies of motion need not reach down to those that integrate into position.

Each hypothesis is the same filter with other noise: a covariance of its own, and no IMU. What the
running filter knows is in its innovations and corrections; a hypothesis only keeps how far its
own estimate leads the running one.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, sections 5.4 (innovations) and 11.6 (multiple models).
.. [2] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
       distribution", Journal of the American Statistical Association 84, 1989.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise import Correction, StateCorrection
from hybrid_ins.core.noise_multiple_model_step import advance, mean_system
from hybrid_ins.core.rotations import matrix_from_quat
from hybrid_ins.core.snapshot import Snapshot
from hybrid_ins.core.state import COVARIANCE, DV, N_ERROR, PLACES, QUAT, VELOCITY, covariance

Array = NDArray[np.float64]

DECADES = np.array([-1.5, 0.0, 1.0, 2.0, 3.0, 4.0])  # of the factor on the accelerometer's noise
RATE_DECADES = np.array([-1.5, 0.0, 3.0])  # on the gyroscope's
GNSS_DECADES = np.array([0.0, 0.7, 1.5, 3.0])  # on R
LEAVING = 2.0  # nats that a factor other than 1 must be worth: the model is right until shown wrong
COST = (1.0, 1.0, 2.0)  # and each of its decades
LESS, LESS_COST = 1.5, 0.3  # the same of factors below 1: vibration is an upper bound
MARGIN = 0.1  # decades that are not told from none
MEMORY = 20.0  # s over which the likelihood is remembered
TAIL = 6.0  # degrees of freedom of an innovation, [2]_
RESEAT = 3.0  # rise of a factor
LONGEST = 3.0  # s without a fix: beyond it the mean motion does not stand for the IMU any more

_A, _G, _R = (
    grid.ravel() for grid in np.meshgrid(DECADES, RATE_DECADES, GNSS_DECADES, indexing="ij")
)
_PRIOR = -sum(
    (
        np.where(grid < 0.0, LESS - LESS_COST * grid, LEAVING * (grid > 0.0) + cost * grid)
        for grid, cost in zip((_A, _G, _R), COST, strict=True)
    ),
    np.zeros(_A.size),
)
_DECADES = np.stack((_A, _G, _R))
_FACTORS = 10.0**_DECADES


class NoiseScale(Snapshot):
    """
    Factors on the process noise, from the likelihood of the innovations.

    Nothing is changed in place: a shallow copy is a snapshot.
    """

    def __init__(self) -> None:
        self._evidence = np.zeros(len(_PRIOR))  # log-likelihood of each hypothesis, fading
        self._P: Array | None = None  # (120, hypotheses), packed
        self._lead = np.zeros((N_ERROR, len(_PRIOR)))  # own minus running estimate
        self._t_ns = 0
        self._velocity_n = np.zeros(3)  # after the last correction
        self._C_nb = np.eye(3)
        self._scale = (1.0, 1.0)
        self._seated = np.ones(3)  # lowest since the state was last put where it belongs
        self._gnss = 1.0

    def scale(self) -> tuple[float, float]:
        """Factors on the noise variances of accelerometer and gyroscope, 0.04 to 10⁴ and 10³."""
        return self._scale

    def gnss(self) -> float:
        """Factor on the fixes' covariance, 1 to 10³: receivers claim too much, too."""
        return self._gnss

    def forget(self, evidence: bool) -> None:
        """Begin the hypotheses anew at the next correction, with the evidence or without."""
        self._P = None
        if evidence:
            self._evidence = np.zeros(len(_PRIOR))
            self._scale, self._gnss, self._seated = (1.0, 1.0), 1.0, np.ones(3)

    def learn(self, correction: Correction, psd: Array) -> StateCorrection | None:
        """
        Take a correction, or a measurement that was refused, into account.

        Returns where the state belongs when the factors have risen: the running filter, with too
        small a noise, has gone astray meanwhile, the hypotheses that are believed now have not.

        Parameters
        ----------
        correction : Correction
            With the state before it, its S with `gnss` in force; dx is zero if the measurement
            was refused.
        psd : ndarray, shape (12,)
            Qc's diagonal at factor 1.

        Notes
        -----
        After more than ``LONGEST`` without a fix the hypotheses begin anew with the running
        filter's covariance, and their evidence stays as it was.
        """
        nav = correction.nav
        P = covariance(nav)
        C_nb = matrix_from_quat(nav[QUAT])
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._P is None or not 0.0 <= T <= LONGEST:
            self._P = np.tile(nav[COVARIANCE][:, None], len(_PRIOR))
            self._lead = np.zeros((N_ERROR, len(_PRIOR)))
            T = 0.0
        F, C_mean = mean_system(nav, self._velocity_n, self._C_nb, T)
        R = (correction.S - correction.H @ P @ correction.H.T) / self._gnss
        self._P, self._lead, gained = advance(
            self._P,
            self._lead,
            F,
            T,
            C_mean,
            psd,
            _FACTORS,
            correction.z,
            correction.H,
            R,
            correction.dx,
            TAIL,
        )
        evidence = self._evidence * np.exp(-T / MEMORY) + gained
        self._evidence = evidence - evidence.max()
        self._t_ns = correction.t_ns
        self._velocity_n = nav[VELOCITY] + correction.dx[DV]
        self._C_nb = C_nb
        posterior = self._evidence + _PRIOR
        weights = np.exp(posterior - posterior.max())
        weights /= weights.sum()
        a, g, r = map(_factor, (_DECADES @ weights).tolist())
        self._scale, self._gnss = (a, g), r
        factors = np.array([a, g, r])
        risen = np.max(factors / self._seated)
        self._seated = np.minimum(self._seated, factors)
        if risen < RESEAT:
            return None
        self._seated = factors
        dx = self._lead @ weights
        apart = self._lead - dx[:, None]
        P = (self._P @ weights)[PLACES] + (weights * apart) @ apart.T
        self._lead, self._velocity_n = apart, self._velocity_n + dx[DV]
        return StateCorrection(dx, P)


def _factor(decades: float) -> float:
    """Of so many decades, less the margin towards 1."""
    return float(10.0 ** math.copysign(max(0.0, abs(decades) - MARGIN), decades))
