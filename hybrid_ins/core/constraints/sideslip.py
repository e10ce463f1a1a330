"""
No sideslip: a fixed wing flies along its nose, against the air.

Its velocity to the right is that of the wind, to the gusts. The wind is estimated beside the filter
while fixes determine the velocity, as a random walk, and so is how much the flight scatters about
it. Where fixes are missing the wind's part of the velocity to the right is a measurement, with what
is not known of the wind in its covariance.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.constraint_observer import EVIDENCE_MEMORY, STATE_TIME, inflated
from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.constraints.slip import SlipEstimator
from hybrid_ins.core.inertial.rotations import matrix_from_quat, skew
from hybrid_ins.core.inertial.state import DV, EPS, N_ERROR, QUAT, VELOCITY, covariance
from hybrid_ins.core.update.measurements import IMU

Array = NDArray[np.float64]

AIRBORNE = 8.0  # m/s of airspeed, from which the air keeps a plane on its nose
SIDESLIP_STD = 1.0  # m/s, nominal: gusts and sideslip
GUST_TIME = 3.0  # s, their correlation time
WIND_STD, WIND_WALK = 5.0, 0.1  # m/s, m/s/√s: of each component, at first, and its random walk
WIND_TIME = 10.0  # s for which an error of the wind shows the same: turns show another part


@dataclass(frozen=True, slots=True)
class NoSideslip:
    """No velocity to the right of the nose against the air."""

    t_ns: int  # ns
    right_b: Array  # (3,) axis to the right of the nose
    wind_n: Array  # (3,) m/s
    variance: float  # (m/s)²

    kind: ClassVar[str] = "sideslip"
    sensor: ClassVar[str] = IMU
    in_body: ClassVar[bool] = False

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`: H is r' [0, C_nb', -C_nb' [(v - w)×], 0, 0]."""
        C_bn = matrix_from_quat(nav[QUAT]).T
        velocity_n = nav[VELOCITY] - self.wind_n
        H = np.zeros((1, N_ERROR))
        H[0, DV] = self.right_b @ C_bn
        H[0, EPS] = -self.right_b @ C_bn @ skew(velocity_n)
        return -H[:, DV] @ velocity_n, H, np.array([[self.variance]])


class WindObserver:
    """
    Estimates the wind from the velocity of a plane across its nose.

    Parameters
    ----------
    nose : Nose
        Where it points in b.

    Attributes
    ----------
    wind_n : ndarray, shape (3,)
        North, east, and zero down [m/s].
    slip : SlipEstimator
        The scatter of the velocity across the nose about that wind.
    """

    def __init__(self, nose: Nose) -> None:
        self._nose = nose
        self.wind_n = np.zeros(3)
        self._P = WIND_STD**2 * np.eye(2)
        self._t_ns: int | None = None
        self.slip = SlipEstimator(np.array([SIDESLIP_STD]))

    @property
    def sigma(self) -> Array:
        """Standard deviations of the wind to the north and east [m/s], (2,)."""
        return np.asarray(np.sqrt(np.diag(self._P)))

    def observe(self, t_ns: int, nav: Array, interval: float, *, settled: bool) -> None:
        """
        Use the motion at an instant.

        Parameters
        ----------
        t_ns : int
            Its stamp [ns].
        nav : ndarray, shape (N_NAV,) or longer
            Flat state with nothing pending.
        interval : float
            What the instant stands for [s].
        settled : bool
            Fixes alone have determined that state for a while.
        """
        elapsed = interval if self._t_ns is None else max((t_ns - self._t_ns) * 1e-9, 0.0)
        self._t_ns = t_ns
        self._P = self._P + WIND_WALK**2 * elapsed * np.eye(2)
        self._P *= min(1.0, WIND_STD**2 / float(self._P.diagonal().max()))  # what any wind is
        if not settled or not self._flies(nav):
            return
        z, H, _ = self._constraint(0, 0.0).linearise(nav)
        by_wind = H[0, DV][:2]
        state = H @ covariance(nav) @ H.T
        wind = by_wind @ self._P @ by_wind
        share = min(interval / GUST_TIME, 1.0)
        self.slip.observe(z, state + wind, share, math.exp(-interval / EVIDENCE_MEMORY))
        R = inflated(state, STATE_TIME, interval)
        R = R + inflated(self.slip.covariance, GUST_TIME, interval)
        K = self._P @ by_wind / (wind + R[0, 0])
        self.wind_n[:2] -= K * z[0]
        A = np.eye(2) - np.outer(K, by_wind)
        self._P = A @ self._P @ A.T + R[0, 0] * np.outer(K, K)

    def measurement(self, t_ns: int, nav: Array, interval: float) -> NoSideslip | None:
        """Return the constraint at a stamp [ns], for one every ``interval`` [s]; None on ground."""
        if not self._flies(nav):
            return None
        by_wind = self._constraint(t_ns, 0.0).linearise(nav)[1][0, DV][:2]
        R = inflated(self.slip.covariance, GUST_TIME, interval)
        R = R + inflated(np.array([[by_wind @ self._P @ by_wind]]), WIND_TIME, interval)
        return self._constraint(t_ns, float(R[0, 0]))

    def _constraint(self, t_ns: int, variance: float) -> NoSideslip:
        return NoSideslip(t_ns, self._nose.axes[0], self.wind_n.copy(), variance)

    def _flies(self, nav: Array) -> bool:
        """Return whether the airspeed along the nose is that of a flight."""
        airspeed_b = matrix_from_quat(nav[QUAT]).T @ (nav[VELOCITY] - self.wind_n)
        return float(self._nose.forward @ airspeed_b) > AIRBORNE
