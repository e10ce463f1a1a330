"""
The non-holonomic constraint: a vehicle on wheels moves along its nose.

The point of the vehicle that does not slip, the centre of a car's rear axle, has no velocity
across the nose and none up or down. That is a measurement of two components, true to the slip of
the tyres and the travel of the springs. Springs also let the body pitch up where the vehicle speeds
up, and down where it brakes (squat and dive): in proportion to the acceleration, [3]_.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.4.1.
.. [2] M. Brossard, A. Barrau, S. Bonnabel, "AI-IMU dead-reckoning", IEEE Transactions on
       Intelligent Vehicles 5, 2020.
.. [3] T. Gillespie, *Fundamentals of Vehicle Dynamics*, 1992, section 7 (squat and dive).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import earth_rate_n
from hybrid_ins.core.inertial.rotations import cross, matrix_from_quat, skew
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    B_G,
    BIAS_G,
    DV,
    EPS,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
)
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE
from hybrid_ins.core.update.measurements import IMU, LinearModel

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Nose:
    """Where a vehicle's nose points in b, and which point of it does not slip."""

    yaw: float  # rad, of the nose about the down axis of b
    pitch: float  # rad, up
    point_b: Array  # (3,) m, that does not slip, relative to the IMU
    squat: float = 0.0  # rad per m/s², by which the body pitches up where it speeds up

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

    def acceleration(self, nav: Array) -> float:
        """Acceleration along the nose [m/s²] in a flat state."""
        return float(matrix_from_quat(nav[QUAT]) @ self.forward @ nav[ACCELERATION])

    def squatting(self, nav: Array) -> Nose:
        """Return the nose in a body that is pitched by the acceleration of a flat state."""
        return replace(self, pitch=self.pitch - self.squat * self.acceleration(nav))


@dataclass(frozen=True, slots=True)
class NonHolonomic:
    """No velocity across the nose at the point that does not slip."""

    t_ns: int  # ns
    rate_b: Array  # (3,) rad/s, the gyroscopes' reading
    nose: Nose
    covariance: Array  # (2, 2) (m/s)², to the right and down
    swing: float = 0.0  # rad, by which the body is pitched up on its springs, against its mean
    by_scale: Array = field(default_factory=lambda: np.zeros((2, N_SCALE)))
    # derivative of z by the scale errors that the nose contains, see `ScaleErrorObserver`
    beside: LinearModel | None = None  # what is added to z, H and R for their sake

    kind: ClassVar[str] = "non-holonomic"
    sensor: ClassVar[str] = IMU
    in_body: ClassVar[bool] = True

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """
        See `Measurement.linearise`; [1]_ eq. 15.14.

        A body that squats, or swings on its springs, has its velocity in its axis down, too, but
        the speed is not read off it. The error of the squat, which lasts, would be one of the
        speed. And each swing would show, by the same angle in z and H, that there is no speed.
        """
        velocity_b, by_error = point_velocity(nav, self.rate_b, self.nose.point_b)
        squatting = self.nose.squatting(nav)
        still = replace(self.nose, pitch=self.nose.pitch - self.swing)
        z, H, R = -squatting.axes @ velocity_b, still.axes @ by_error, self.covariance
        if self.beside is None:
            return z, H, R
        return z + self.beside[0], H + self.beside[1], R + self.beside[2]


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
