"""
Measurements of sensors besides GNSS: velocity in the vehicle, heading, height.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 6.1 (heading), 6.2 (height), 16.2 (odometry).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.nonholonomic import point_velocity
from hybrid_ins.core.inertial.rotations import matrix_from_quat, rpy_from_quat, skew
from hybrid_ins.core.inertial.state import BIAS_G, DP, EPS, LAST_W, LLA, N_ERROR, QUAT

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BodyVelocity:
    """Velocity over ground of a point of the vehicle, in its axes: wheels, a Doppler log."""

    t_ns: int  # ns, IMU clock
    velocity_b: Array  # (3,) m/s; NaN where the sensor has no axis
    covariance_b: Array  # (3, 3) (m/s)²
    point_b: Array  # (3,) m, where it is measured, relative to the IMU

    kind: ClassVar[str] = "body velocity"
    sensor: ClassVar[str] = "velocity"
    in_body: ClassVar[bool] = True

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`; the rate is that of the last IMU sample."""
        velocity_b, by_error = point_velocity(nav, nav[LAST_W], self.point_b)
        z = self.velocity_b - velocity_b
        given = np.flatnonzero(np.isfinite(z))
        R = np.ascontiguousarray(self.covariance_b[np.ix_(given, given)])
        return z[given], by_error[given], R

    def by_scale_and_place(self, nav: Array) -> Array:
        """Return the derivative (m, 4) of z by the reading's scale and the place."""
        given = np.isfinite(self.velocity_b)
        turning = -skew(nav[LAST_W] - nav[BIAS_G])
        return np.hstack((self.velocity_b[given, None], turning[given]))


@dataclass(frozen=True, slots=True)
class Heading:
    """Heading of the vehicle: two antennas, a magnetic compass, an AHRS."""

    t_ns: int  # ns, IMU clock
    yaw: float  # rad, of b from north
    variance: float  # rad²

    kind: ClassVar[str] = "heading"
    sensor: ClassVar[str] = "heading"
    in_body: ClassVar[bool] = False

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`; the innovation is within ±π."""
        z = math.remainder(self.yaw - float(rpy_from_quat(nav[QUAT])[2]), 2.0 * math.pi)
        # The nose is C_nb e_x, and its error -ε × (C_nb e_x).
        nose = matrix_from_quat(nav[QUAT])[:, 0]
        level = max(nose[0] ** 2 + nose[1] ** 2, 1e-6)
        H = np.zeros((1, N_ERROR))
        H[0, EPS] = nose[0] * nose[2] / level, nose[1] * nose[2] / level, -1.0
        return np.array([z]), H, np.array([[self.variance]])


@dataclass(frozen=True, slots=True)
class BarometricHeight:
    """Height from air pressure."""

    t_ns: int  # ns, IMU clock
    height: float  # m, above the ellipsoid
    variance: float  # m²

    kind: ClassVar[str] = "height"
    sensor: ClassVar[str] = "baro"
    in_body: ClassVar[bool] = False

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`."""
        z = np.array([self.height - nav[LLA][2]])
        H = np.zeros((1, N_ERROR))
        H[0, DP] = 0.0, 0.0, -1.0
        return z, H, np.array([[self.variance]])
