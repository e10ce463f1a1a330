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

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.linalg import factorise, solve
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.noise_multiple_model_step import mean_system
from hybrid_ins.core.state import DP, DV, N_ERROR, QUAT, VELOCITY
from hybrid_ins.core.strapdown import rotation

Array = NDArray[np.float64]

RANDOM_WALK = 1e-3  # s per sqrt(s), of one clock against the other
NONLINEARITY = 0.5  # of a shift: what is left uncertain, since the motion is no straight line
MAX_INTERVAL = 60.0  # s without a fix after which the sensitivity begins anew
MEMORY = 40.0  # corrections over which the misfit is averaged


class ClockOffsetObserver:
    """
    Estimates what is missing from the offset that was added to the fixes' stamps.

    Nothing is changed in place: a shallow copy is a snapshot.

    Parameters
    ----------
    std : float
        How far it may be off at the start [s].

    Attributes
    ----------
    residual : float
        Offset still to be added to the stamps of fixes [s].
    """

    def __init__(self, std: float) -> None:
        self.residual = 0.0
        self._variance = std**2
        self._s: Array | None = None
        self._t_ns = 0
        self._velocity_n = np.zeros(3)
        self._C_nb = np.eye(3)
        self._nis_scale = 1.0

    @property
    def sigma(self) -> float:
        """Standard deviation of `residual` [s]."""
        return math.sqrt(self._variance * max(self._nis_scale, 1.0))

    def update(self, correction: Correction) -> None:
        """Take a correction, or a measurement that was refused, into account."""
        nav = correction.nav
        velocity_n = nav[VELOCITY].copy()
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._s is not None:
            self._variance += RANDOM_WALK**2 * max(T, 0.0)
        if self._s is None or not 0.0 <= T <= MAX_INTERVAL:
            self._s, T = initial_sensitivity(velocity_n), 0.0
        s, acceleration_n, C_nb = propagate_sensitivity(
            self._s, nav, self._velocity_n, self._C_nb, T
        )
        if correction.fused:
            information, pull, nis = regress(
                s,
                velocity_n,
                acceleration_n,
                correction.z,
                correction.H,
                correction.S,
                correction.K,
                self.residual,
            )
            self._nis_scale += (nis / len(correction.z) - self._nis_scale) / MEMORY
            gain = self._variance / (1.0 + self._variance * information)
            self.residual += gain * pull
            self._variance *= 1.0 - gain * information
        self._s, self._t_ns = s, correction.t_ns
        self._velocity_n, self._C_nb = velocity_n + correction.dx[DV], C_nb

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Take over what others have found, too [s]."""
        self.residual = residual
        self._variance = sigma**2 / max(self._nis_scale, 1.0)

    def shift(self, by: float) -> Array:
        """From now on ``by`` [s] more is added; returns what the state is off by that, (15,)."""
        self.residual -= by
        self._variance += (NONLINEARITY * by) ** 2
        moved = np.zeros(N_ERROR) if self._s is None else by * self._s
        self._velocity_n = self._velocity_n + moved[DV]
        return moved

    def restart(self, velocity_n: Array) -> None:
        """Take note that the state was put near the fixes."""
        self._s = initial_sensitivity(velocity_n)
        self._velocity_n = velocity_n.copy()


def initial_sensitivity(velocity_n: Array) -> Array:
    """Sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP] = -velocity_n
    return s


@kernel()
def propagate_sensitivity(s, nav, velocity_n, C_nb, T):  # type: ignore[no-untyped-def]
    """
    Move the sensitivity on with the error dynamics.

    Parameters
    ----------
    s : ndarray, shape (15,)
        After the last correction.
    nav : ndarray, shape (N_FLAT,)
        Flat state now.
    velocity_n, C_nb : ndarray, shape (3,), (3, 3)
        After the last correction.
    T : float
        Time since then [s].

    Returns
    -------
    s, acceleration_n, C_nb : ndarray, shape (15,), (3,), (3, 3)
        Now; the acceleration is the mean since then.
    """
    C_now, acceleration_n = np.empty(9), np.zeros(3)
    rotation(nav[QUAT], C_now)
    moved = s.copy()
    if T > 0.0:
        for i in range(3):
            acceleration_n[i] = (nav[VELOCITY][i] - velocity_n[i]) / T
        F, _ = mean_system(nav, velocity_n, C_nb, T)
        term = s.copy()
        for order in range(1, 4):
            last = term.copy()
            for i in range(N_ERROR):
                total = 0.0
                for k in range(N_ERROR):
                    total += F[i, k] * last[k]
                term[i] = total * T / order
                moved[i] += term[i]
    return moved, acceleration_n, C_now.reshape(3, 3)


@kernel()
def regress(s, velocity_n, acceleration_n, z, H, S, K, missing):  # type: ignore[no-untyped-def]
    """
    Hold an innovation against the sensitivity ``s``, which is corrected in place.

    Parameters
    ----------
    s, velocity_n, acceleration_n : ndarray, shape (15,), (3,), (3,)
        Now.
    z, H, S, K : ndarray, shape (m,), (m, 15), (m, m), (15, m)
        See `Correction`.
    missing : float
        Offset believed so far [s].

    Returns
    -------
    information, pull, nis : float
        With what ``residual`` leaves of the innovation, r, and its factor h on the offset:
        h' S^-1 h, h' S^-1 r, r' S^-1 r.
    """
    m = len(z)
    factor, left = np.empty(m), np.empty(m)
    for a in range(m):
        total = 0.0
        for k in range(N_ERROR):
            total += H[a, k] * s[k]
        for i in range(3):
            total += H[a, i] * velocity_n[i] + H[a, 3 + i] * acceleration_n[i]
        factor[a], left[a] = total, z[a] - total * missing
    root = S.copy()
    factorise(root)
    weighted_factor, weighted_left = factor.copy(), left.copy()
    solve(root, weighted_factor)
    solve(root, weighted_left)
    information, pull, nis = 0.0, 0.0, 0.0
    for a in range(m):
        information += factor[a] * weighted_factor[a]
        pull += factor[a] * weighted_left[a]
        nis += left[a] * weighted_left[a]
        for i in range(N_ERROR):
            s[i] -= K[i, a] * factor[a]
    return information, pull, nis
