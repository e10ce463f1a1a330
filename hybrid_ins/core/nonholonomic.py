"""
The non-holonomic constraint: a vehicle on wheels moves along its nose.

The point of the vehicle that does not slip, the centre of a car's rear axle, has no velocity
across the nose and none up or down. That is a measurement of two components, true to the slip of
the tyres and the travel of the springs.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.4.1.
.. [2] M. Brossard, A. Barrau, S. Bonnabel, "AI-IMU dead-reckoning", IEEE Transactions on
       Intelligent Vehicles 5, 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.earth import earth_rate_n
from hybrid_ins.core.measurements import IMU
from hybrid_ins.core.rotations import cross, matrix_from_quat, skew
from hybrid_ins.core.state import B_G, BIAS_G, DV, EPS, LLA, N_ERROR, QUAT, VELOCITY

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Nose:
    """Where a vehicle's nose points in b, and which point of it does not slip."""

    yaw: float  # rad, of the nose about the down axis of b
    pitch: float  # rad, up
    point_b: Array  # (3,) m, that does not slip, relative to the IMU

    @property
    def axes(self) -> Array:
        """Axes to the right of the nose and down from it, (2, 3), b."""
        sin_yaw, cos_yaw = np.sin(self.yaw), np.cos(self.yaw)
        sin_pitch, cos_pitch = np.sin(self.pitch), np.cos(self.pitch)
        return np.array(
            [
                [-sin_yaw, cos_yaw, 0.0],
                [sin_pitch * cos_yaw, sin_pitch * sin_yaw, cos_pitch],
            ]
        )

    @property
    def forward(self) -> Array:
        """Axis along the nose, (3,), b."""
        level = np.cos(self.pitch)
        return np.array([level * np.cos(self.yaw), level * np.sin(self.yaw), -np.sin(self.pitch)])


@dataclass(frozen=True, slots=True)
class NonHolonomic:
    """No velocity across the nose at the point that does not slip."""

    t_ns: int  # ns
    rate_b: Array  # (3,) rad/s, the gyroscopes' reading
    nose: Nose
    covariance: Array  # (2, 2) (m/s)², to the right and down

    kind: ClassVar[str] = "non-holonomic"
    sensor: ClassVar[str] = IMU

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`; [1]_ eq. 15.14."""
        velocity_b, by_error = point_velocity(nav, self.rate_b, self.nose.point_b)
        axes = self.nose.axes
        return -axes @ velocity_b, axes @ by_error, self.covariance


def point_velocity(nav: Array, rate_b: Array, point_b: Array) -> tuple[Array, Array]:
    """
    Velocity over ground of a point of the vehicle, and its derivative by the error state.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state.
    rate_b : ndarray, shape (3,)
        The gyroscopes' reading [rad/s].
    point_b : ndarray, shape (3,)
        The point relative to the IMU [m].

    Returns
    -------
    velocity_b : ndarray, shape (3,)
        C_nb' v + ω_eb × l [m/s].
    by_error : ndarray, shape (3, 15)
        By δv, ε and b_g: [C_nb', -C_nb' [v×], [l×]].
    """
    C_bn = matrix_from_quat(nav[QUAT]).T
    ie_n, ie_d = earth_rate_n(nav[LLA][0])
    rate_eb = rate_b - nav[BIAS_G] - C_bn @ np.array([ie_n, 0.0, ie_d])
    velocity_n = nav[VELOCITY]
    by_error = np.zeros((3, N_ERROR))
    by_error[:, DV] = C_bn
    by_error[:, EPS] = -C_bn @ skew(velocity_n)
    by_error[:, B_G] = skew(point_b)
    return C_bn @ velocity_n + cross(rate_eb, point_b), by_error
