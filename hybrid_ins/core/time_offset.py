"""
How far the fixes' clock is off, told by the innovations while flying.

A fix that was true a time tau after its stamp lies v tau ahead of where the vehicle was then. The
filter follows part of that: its state carries a sensitivity s = d(error)/d(tau), which moves with
the error dynamics and is corrected as the state is, so that an innovation holds (H s + v) tau. As
tau is a constant to the filter, regressing the innovations on that factor is what an augmented
filter would do, [1]_, and the filter itself is untouched by it.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.attitude import matrix_from_quat
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.noise_bank import mean_system
from hybrid_ins.core.state import DP, DV, N_ERROR, QUAT, VELOCITY

Array = NDArray[np.float64]

START_STD = 0.5  # s
DRIFT = 1e-3  # s per sqrt(s), of one clock against the other
LINEAR = 1.0  # of a shift: what is left uncertain, since the motion is no straight line
LONGEST = 60.0  # s without a fix after which the sensitivity begins anew
MEMORY = 40.0  # corrections over which the misfit is averaged


class ClockOffset:
    """
    Estimates what is missing from the offset that was added to the fixes' stamps.

    Nothing is changed in place: a shallow copy is a snapshot.

    Attributes
    ----------
    missing : float
        [s]; positive: a larger offset should be added.
    """

    def __init__(self) -> None:
        self.missing = 0.0
        self._variance = START_STD**2
        self._s: Array | None = None
        self._t_ns = 0
        self._velocity_n = np.zeros(3)
        self._C_nb = np.eye(3)
        self._misfit = 1.0

    @property
    def sigma(self) -> float:
        """Standard deviation of `missing` [s]."""
        return math.sqrt(self._variance * max(self._misfit, 1.0))

    def learn(self, correction: Correction) -> None:
        """Take a correction, or a measurement that was refused, into account."""
        nav = correction.nav
        velocity_n, C_nb = nav[VELOCITY].copy(), matrix_from_quat(nav[QUAT])
        T = (correction.t_ns - self._t_ns) * 1e-9
        acceleration: Array = np.zeros(3)
        if self._s is None or not 0.0 <= T <= LONGEST:
            s = following(velocity_n, acceleration)
        else:
            s = self._s
            if T > 0.0:
                acceleration = (velocity_n - self._velocity_n) / T
                F = mean_system(nav, self._velocity_n, self._C_nb, T)[0]
                once = T * (F @ s)
                twice = T * (F @ once)
                s = np.asarray(s + once + twice / 2.0 + T * (F @ twice) / 6.0)
        self._variance += DRIFT**2 * max(T, 0.0) if self._s is not None else 0.0
        if correction.fused:
            H, S = correction.H, correction.S
            factor = H @ s + H[:, DP] @ velocity_n + H[:, DV] @ acceleration
            weighted = np.linalg.solve(S, factor)
            left = correction.z - factor * self.missing
            nis = float(left @ np.linalg.solve(S, left))
            self._misfit += (nis / len(left) - self._misfit) / MEMORY
            gain = self._variance * weighted / (1.0 + self._variance * (weighted @ factor))
            self.missing = self.missing + float(gain @ left)
            self._variance = self._variance * (1.0 - float(gain @ factor))
            s = s - correction.K @ factor
        self._s, self._t_ns = s, correction.t_ns
        self._velocity_n, self._C_nb = velocity_n + correction.dx[DV], C_nb

    def shift(self, by: float) -> Array:
        """From now on ``by`` [s] more is added; returns what the state is off by that, (15,)."""
        self.missing -= by
        self._variance += (LINEAR * by) ** 2
        moved = np.zeros(N_ERROR) if self._s is None else by * self._s
        self._velocity_n = self._velocity_n + moved[DV]
        return moved

    def reseat(self, velocity_n: Array) -> None:
        """Take note that the state was put near the fixes."""
        self._s = following(velocity_n, np.zeros(3))
        self._velocity_n = velocity_n.copy()


def following(velocity_n: Array, acceleration_n: Array) -> Array:
    """Sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP], s[DV] = -velocity_n, -acceleration_n
    return s
