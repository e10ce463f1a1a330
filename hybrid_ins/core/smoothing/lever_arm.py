"""
The lever arm of the antenna, estimated by a smoother where nobody gave it.

The filter runs with an assumed lever arm l. What is missing of it is constant and small, so that
the errors of all states are linear in it: e = s l + (what they were without), [1]_. The forward
sensitivity s moves with the transition matrices and the gains; each innovation, whose own
sensitivity is h = H s + D, adds information about l. The smoothed states have the sensitivity
s - P m, where the adjoint m takes h in as lambda takes the innovation in. What remains unknown of
l adds s V s' to their covariance, [2]_; to that of the antenna's position, which the fixes measure.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
.. [2] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DP,
    N_ERROR,
    PACKED_COLUMNS,
    PACKED_ROWS,
    QUAT,
    covariance,
)
from hybrid_ins.core.update.measurements import Measurement, PositionFix, VelocityFix

Array = NDArray[np.float64]
Fix = PositionFix | VelocityFix  # of the antenna

STD = 0.5  # m, of each component before anything is measured
SETTLED = 0.1  # standard deviations by which the last pass may still have moved it
MOST_PASSES = 5
N_SENSITIVITY = 3 * N_ERROR
_STEP = 1e-3  # m, of the differences; the innovation is linear in the lever arm


class SmoothedLeverArm:
    """
    Estimate of the antenna's position relative to the IMU, over several passes of a smoother.

    Attributes
    ----------
    lever_b : ndarray, shape (3,)
        Assumed in this pass [m], b.
    covariance_b : ndarray, shape (3, 3)
        Of its error, after a pass [m²], b.
    sensitivity : ndarray, shape (15, 3)
        Of the forward state's error to what is missing.
    """

    def __init__(self) -> None:
        self.lever_b = np.zeros(3)
        self.covariance_b = STD**2 * np.eye(3)
        self.begin()

    def begin(self) -> None:
        """Begin a pass."""
        self.sensitivity = np.zeros((N_ERROR, 3))
        self._information = np.eye(3) / STD**2
        self._gradient = -self.lever_b / STD**2
        self.begin_adjoint()

    def begin_adjoint(self) -> None:
        """Begin the backward part of a pass."""
        self._adjoint = np.zeros((N_ERROR, 3))

    def assumed(self, measurement: Measurement) -> Measurement:
        """Return a measurement with the lever arm of this pass, where it has one."""
        return _moved(measurement, self.lever_b) if isinstance(measurement, Fix) else measurement

    def propagate(self, F: Array, lengths: Array) -> None:
        """Propagate the sensitivity over covariance steps: (m, 225), (m,) [s]."""
        for A, length in zip(F.reshape(-1, N_ERROR, N_ERROR), lengths.tolist(), strict=True):
            self.sensitivity = self.sensitivity + length * (A @ self.sensitivity)

    def correct(self, measurement: Measurement, before: Array, K: Array, R: Array) -> None:
        """
        Add a measurement's information on the lever arm; correct the sensitivity by its gain.

        Parameters
        ----------
        measurement : Measurement
            With the lever arm of this pass.
        before : ndarray, shape (N_FLAT,)
            Flat state before it.
        K, R : ndarray, shape (15, m), (m, m)
            Gain, and the covariance with which it was fused.
        """
        z, H, h = self._linearised(measurement, before)
        weighted = np.linalg.solve(H @ covariance(before) @ H.T + R, h)
        self._information += weighted.T @ h
        self._gradient += weighted.T @ z
        self.sensitivity = self.sensitivity - K @ h

    def finish(self) -> bool:
        """Move the lever arm after the forward part; return whether it had settled before."""
        self.covariance_b = np.asarray(np.linalg.inv(self._information))
        step = self.covariance_b @ self._gradient
        if step @ self._information @ step < SETTLED**2:
            return True
        self.lever_b = self.lever_b + step
        return False

    def correct_adjoint(self, measurement: Measurement, before: Array, R: Array) -> None:
        """Carry the adjoint back through a measurement; ``sensitivity`` is that before it."""
        _, H, h = self._linearised(measurement, before)
        P = covariance(before)
        S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        m = self._adjoint
        self._adjoint = m - H.T @ (K.T @ m) + H.T @ np.linalg.solve(S, h)

    def propagate_adjoint(self, F: Array, lengths: Array) -> None:
        """Carry the adjoint back over covariance steps, see `propagate`."""
        steps = zip(F.reshape(-1, N_ERROR, N_ERROR)[::-1], lengths[::-1].tolist(), strict=True)
        for A, length in steps:
            self._adjoint = self._adjoint + length * (A.T @ self._adjoint)

    def smoothed(self, nav: Array) -> Array:
        """
        Return the sensitivity (15, 3) of the smoothed state, ``nav`` being the forward one.

        That of the position is the antenna's, which is moved by the lever arm itself.
        """
        s = self.sensitivity - covariance(nav) @ self._adjoint
        s[DP] += matrix_from_quat(nav[QUAT])
        return np.asarray(s)

    def consider(self, rows: Array, first: Array, last: Array, share: Array) -> None:
        """
        Add what is not known of the lever arm to the covariances of smoothed states.

        Parameters
        ----------
        rows : ndarray, shape (n, N_NAV)
            Flat states, changed.
        first, last : ndarray, shape (15, 3)
            `smoothed` before and behind them.
        share : ndarray, shape (n,)
            Where each is between the two, 0 to 1.
        """
        s = first + share[:, None, None] * (last - first)
        root = s @ np.linalg.cholesky(self.covariance_b)
        added = np.einsum("nir,njr->nij", root, root)
        rows[:, COVARIANCE] += added[:, PACKED_ROWS, PACKED_COLUMNS]

    def _linearised(self, measurement: Measurement, nav: Array) -> tuple[Array, Array, Array]:
        """Return innovation, measurement matrix, and the innovation's sensitivity (m, 3)."""
        z, H, _ = measurement.linearise(nav)
        h = H @ self.sensitivity
        if isinstance(measurement, Fix):
            for i, step in enumerate(_STEP * np.eye(3)):
                h[:, i] += (z - _moved(measurement, step).linearise(nav)[0]) / _STEP
        return z, H, h


def _moved(fix: Fix, by_b: Array) -> Fix:
    """Return a fix with the antenna's lever arm changed by ``by_b``."""
    return replace(fix, lever_b=fix.lever_b + by_b)
