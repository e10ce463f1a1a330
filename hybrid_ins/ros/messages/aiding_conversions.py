"""
Messages of aiding sensors to measurements: velocity in the vehicle, heading, air pressure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import (
    FLIP,
    Message,
    Refused,
    floor_covariance,
    imu_yaw,
    time_of,
    unusable_stamp,
)

Array = NDArray[np.float64]

LARGEST_VARIANCE = 100.0  # (m/s)², of an axis that a sensor has
FASTEST = 300.0  # m/s
SEA_LEVEL, EXPONENT, SCALE_HEIGHT = 101325.0, 0.190263, 44330.8  # Pa, -, m: standard atmosphere


@dataclass(frozen=True, slots=True)
class AidingMessages:
    """
    How messages of aiding sensors become measurements; ``received_ns`` replaces stamps if given.

    Attributes
    ----------
    base_frame : str
        Velocities are in its axes.
    point_b : ndarray, shape (3,)
        Where velocity is measured, relative to the IMU [m], b.
    mount : ndarray, shape (3, 3)
        From the heading sensor's axes to b.
    velocity_std_min, heading_std_min, height_std_min : float
        Lower bounds [m/s, rad, m]; also those of a covariance that is unknown.
    """

    base_frame: str
    point_b: Array
    mount: Array
    velocity_std_min: float
    heading_std_min: float
    height_std_min: float

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], arm_b: Array) -> AidingMessages:
        """Read the ``aiding`` parameters; the IMU is at ``arm_b`` from the base frame's origin."""
        return cls(
            values["base_frame"],
            FLIP @ np.array(values["aiding.velocity_position"]) - arm_b,
            FLIP,
            values["aiding.velocity_std_min"],
            values["aiding.heading_std_min"],
            values["aiding.height_std_min"],
        )

    def twist(self, message: Message, received_ns: int | None = None) -> BodyVelocity | Refused:
        """Convert a geometry_msgs/TwistWithCovarianceStamped in the base frame."""
        return self._velocity(message, message.header.frame_id, received_ns)

    def odometry(self, message: Message, received_ns: int | None = None) -> BodyVelocity | Refused:
        """Convert the twist of a nav_msgs/Odometry, which is in its child frame."""
        return self._velocity(message, message.child_frame_id, received_ns)

    def _velocity(
        self, message: Message, frame: str, received_ns: int | None
    ) -> BodyVelocity | Refused:
        t_ns = time_of(message, received_ns)
        if t_ns <= 0:
            return unusable_stamp("aiding", t_ns)
        if frame not in ("", self.base_frame):
            return Refused(
                "aiding: other frame",
                f"the twist is in frame '{shortened(frame)}', not '{self.base_frame}': publish it "
                "there",
            )
        velocity, covariance = _twist(message)
        if claims_no_variance(message):  # wheels measure along the nose
            covariance = np.diag([self.velocity_std_min**2, np.inf, np.inf])
        variance = np.diag(covariance)
        given = _usable(velocity, variance)
        if not np.any(given):
            return Refused("aiding: no velocity", _why_unusable(velocity, variance))
        if np.max(np.abs(velocity[given])) > FASTEST:
            return Refused(
                "aiding: absurd velocity",
                f"{velocity} m/s is too fast for a vehicle: check the driver's unit (m/s)",
            )
        covariance = _of_axes(covariance, given)
        lacking = np.where(given, np.maximum(self.velocity_std_min**2 - variance, 0.0), 0.0)
        covariance += np.diag(lacking)
        velocity[~given] = np.nan
        return BodyVelocity(t_ns, velocity * np.diag(FLIP), FLIP @ covariance @ FLIP, self.point_b)

    def heading(self, message: Message, received_ns: int | None = None) -> Heading | Refused:
        """Convert the orientation of a sensor_msgs/Imu, ENU, in the axes of the base frame."""
        t_ns = time_of(message, received_ns)
        if t_ns <= 0:
            return unusable_stamp("aiding", t_ns)
        q = message.orientation
        variances = np.array(message.orientation_covariance, float)
        yaw = imu_yaw((q.x, q.y, q.z, q.w), self.mount)
        if variances[0] == -1.0 or yaw is None:
            return Refused("aiding: no orientation", "the message says that it has no orientation")
        variance = float(variances[8])
        if not (math.isfinite(variance) and variance > 0.0):
            variance = 0.0
        return Heading(t_ns, yaw, max(variance, self.heading_std_min**2))

    def pressure(
        self, message: Message, received_ns: int | None = None
    ) -> BarometricHeight | Refused:
        """Convert a sensor_msgs/FluidPressure; the height is that of the standard atmosphere."""
        t_ns = time_of(message, received_ns)
        if t_ns <= 0:
            return unusable_stamp("aiding", t_ns)
        pressure = float(message.fluid_pressure)
        if not (math.isfinite(pressure) and 1e4 < pressure < 1.2e5):
            return Refused(
                "aiding: no pressure",
                f"{pressure} Pa is not an air pressure: is it in hPa?",
            )
        height = SCALE_HEIGHT * (1.0 - (pressure / SEA_LEVEL) ** EXPONENT)
        slope = SCALE_HEIGHT * EXPONENT / SEA_LEVEL * (pressure / SEA_LEVEL) ** (EXPONENT - 1.0)
        variance = float(message.variance)
        variance = slope**2 * variance if math.isfinite(variance) and variance > 0.0 else 0.0
        return BarometricHeight(t_ns, height, max(variance, self.height_std_min**2))


def claims_no_variance(message: Message) -> bool:
    """
    Return whether a twist gives no axis that is usable, and the x axis a variance of 0.

    Drivers of wheels do that: all are 0, or those of the other axes say that they are not measured.
    """
    if message.twist.covariance[0] != 0.0:
        return False
    velocity, covariance = _twist(message)
    return not np.any(_usable(velocity, np.diag(covariance)))


def substituted(message: Message, std: float) -> str:
    """
    Return that ``std`` [m/s] stands for a variance of 0, for the log; empty if it does not.

    Where all are 0 they are unknown, as ROS says: nothing is wrong.
    """
    if not (claims_no_variance(message) and np.any(np.diag(_twist(message)[1]))):
        return ""
    return (
        "the variance of the velocity along x is 0, and those of the other axes say that they are "
        f"not measured: aiding.velocity_std_min, {std:g} m/s, is used instead; let the driver set "
        "twist.covariance"
    )


def _twist(message: Message) -> tuple[Array, Array]:
    """Return the linear velocity (3,) [m/s] of a twist, and its covariance (3, 3)."""
    linear = message.twist.twist.linear
    covariance = np.array(message.twist.covariance, float).reshape(6, 6)[:3, :3]
    return np.array([linear.x, linear.y, linear.z], float), covariance


def _of_axes(covariance: Array, given: NDArray[np.bool_]) -> Array:
    """
    Return a covariance (3, 3) fit for use of the axes that are given; others have 1 m²/s².

    The diagonal alone counts where no errors have such correlations.
    """
    variances = np.diag(np.where(given, covariance.diagonal(), 1.0))
    return floor_covariance(np.where(np.outer(given, given), covariance, variances), 0.0, variances)


def _usable(velocity: Array, variance: Array) -> NDArray[np.bool_]:
    """Return which axes (3,) have a velocity, by its variance."""
    return np.isfinite(velocity) & (variance > 0.0) & (variance < LARGEST_VARIANCE)


def _why_unusable(velocity: Array, variance: Array) -> str:
    """Return why no axis is usable, and the remedy."""
    x, y, z = (f"{v:g} m/s with variance {s:g}" for v, s in zip(velocity, variance, strict=True))
    return (
        f"no axis of the twist is usable (x: {x}, y: {y}, z: {z}): a variance has to be above 0 "
        f"and below {LARGEST_VARIANCE:g} (m/s)²; let the driver set twist.covariance"
    )
