"""
Initial alignment: level from gravity, position and velocity from the fixes, heading from a source.

Works standing and in flight: levelling averages the specific force over a window, rotated into the
window's last attitude by the gyroscopes; standing or moving is reflected in its uncertainty. There
is an initial state for every cell of headings, see `hybrid_ins.core.multiple_model`, and before
those one for the heading that a source gives, see `hybrid_ins.core.heading_check`.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 5.6.2.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.earth import curvature_scale, earth_rate_n
from hybrid_ins.core.imu_health import ImuFault, find_fault
from hybrid_ins.core.measurements import Measurement, PositionFix, VelocityFix
from hybrid_ins.core.multiple_model import HEADING_STD, heading_grid
from hybrid_ins.core.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_from_rpy,
    rpy_from_quat,
)
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.standstill import STANDING_RATE_STD, is_standing, may_be_zero
from hybrid_ins.core.state import B_G, DP, DV, EPS, N_ERROR, NavState

Array = NDArray[np.float64]

TILT_STD_STANDING = 0.02  # rad
TILT_STD_MOVING = 0.2  # rad
CRAB_STD = 0.15  # rad, between the nose and the course of a vehicle that moves where it points
FIXES_KEPT = 3.0  # s, of fixes that may give the first velocity
SHORTEST_SPAN = 0.3  # s
ACCELERATION_STD = 2.0  # m/s², of a vehicle that may manoeuvre
BIAS_A_DRIFT, BIAS_G_DRIFT = 3e-3, 3e-4  # m/s²/√s, rad/s/√s: of known biases while not watched


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """
    What alignment is given.

    Attributes
    ----------
    heading_source : str
        parameter, imu, course, motion, or auto, which is motion unless a heading is given by
        hand.
    yaw, yaw_std : float
        Heading of b from north [rad] for ``parameter``, its uncertainty (also of ``imu``).
    course_min_speed : float
        [m/s].
    window : float
        IMU time that levelling averages [s].
    bias_a, bias_a_std : ndarray, shape (3,)
        Accelerometer bias, b, and its uncertainty [m/s²].
    bias_g, bias_g_std : ndarray, shape (3,)
        Gyroscope bias, b, and its uncertainty [rad/s].
    """

    heading_source: str
    yaw: float
    yaw_std: float
    course_min_speed: float
    window: float
    bias_a: Array
    bias_a_std: Array
    bias_g: Array
    bias_g_std: Array


class Need(Enum):
    """What alignment waits for."""

    IMU_SAMPLES = "IMU samples"
    WINDOW = "a full window of IMU samples"
    USABLE_IMU = "usable IMU samples"
    FIX = "a GNSS fix"
    SECOND_FIX = "a second GNSS fix"
    ORIENTATION = "an orientation in the IMU messages"
    SPEED = "speed over ground"


@dataclass(frozen=True, slots=True)
class Waiting:
    """
    What alignment lacks.

    Attributes
    ----------
    need : Need
    value : float
        The speed over ground [m/s] of ``SPEED``.
    limit : float
        The window [s] of ``WINDOW``, the least speed [m/s] of ``SPEED``.
    fault : ImuFault or None
        Why the samples are of no use.
    """

    need: Need
    value: float = 0.0
    limit: float = 0.0
    fault: ImuFault | None = None

    @property
    def stage(self) -> str:
        """Which input it is about: imu, gnss, heading."""
        if self.need in (Need.IMU_SAMPLES, Need.WINDOW, Need.USABLE_IMU):
            return "imu"
        return "gnss" if self.need in (Need.FIX, Need.SECOND_FIX) else "heading"


@dataclass(frozen=True, slots=True)
class Biases:
    """Biases of the IMU that an earlier filter estimated."""

    t_ns: int
    accelerometer: Array  # (3,) m/s²
    gyroscope: Array  # (3,) rad/s
    P: Array  # (6, 6)

    @classmethod
    def of(cls, state: NavState, t_ns: int) -> Biases:
        """Return those of a filter's state at its stamp."""
        return cls(t_ns, state.bias_a, state.bias_g, state.P[9:, 9:])


@dataclass(frozen=True, slots=True)
class Start:
    """What filters start with: a state for each heading that is possible."""

    states: tuple[NavState, ...]
    given: bool  # the first state has a heading that was given
    t_ns: int
    sample: Array  # (6,) the IMU sample at t_ns


class Alignment:
    """
    Collects what the first state needs, and knows what is missing.

    Parameters
    ----------
    settings : AlignmentSettings
        See there.
    ring : ImuRing
        Recent IMU samples; its owner fills it.

    Attributes
    ----------
    waiting : Waiting
        What the last attempt lacked.
    """

    def __init__(self, settings: AlignmentSettings, ring: ImuRing) -> None:
        self._settings = settings
        self._ring = ring
        self._fixes: deque[PositionFix] = deque(maxlen=64)
        self._velocity: VelocityFix | None = None
        self._imu_yaw: float | None = None
        self._biases: Biases | None = None
        self._given: tuple[int, float, float] | None = None  # stamp, heading, uncertainty
        self._source = settings.heading_source
        self.waiting = Waiting(Need.IMU_SAMPLES)

    def observe(self, measurement: Measurement) -> None:
        """Use a fix or a GNSS velocity."""
        if isinstance(measurement, PositionFix):
            self._fixes.append(measurement)
        elif isinstance(measurement, VelocityFix):
            self._velocity = measurement

    def observe_yaw(self, yaw: float) -> None:
        """Use the heading [rad from north] of the IMU's own orientation."""
        self._imu_yaw = yaw

    def set_yaw(self, t_ns: int, yaw: float, std: float) -> None:
        """Use a heading [rad from north] that was true at a stamp; it overrides all sources."""
        self._given = (t_ns, yaw, std)

    def remember(self, biases: Biases) -> None:
        """Use the biases that an earlier filter estimated."""
        self._biases = biases

    def forget_parameter(self) -> None:
        """Ignore the heading given for the start from now on: the vehicle has moved since."""
        if self._source == "parameter":
            self._source, self._given = "auto", None

    def attempt(self) -> Start | None:
        """Return the first state at the last IMU sample, or None and set ``waiting``."""
        now = int(self._ring.latest(1)["t_ns"][0])
        if self._given is None and self._source == "parameter":
            first_ns = int(self._ring.after(0)["t_ns"][0])
            self._given = first_ns, self._settings.yaw, self._settings.yaw_std
        window_ns = int(self._settings.window * 1e9)
        samples = self._ring.after(now - window_ns - 1)
        if len(samples) < 5 or now - samples["t_ns"][0] < 0.9 * window_ns:
            self.waiting = Waiting(Need.WINDOW, limit=self._settings.window)
            return None
        fault = find_fault(samples)
        if fault is not None and fault.unusable:
            self.waiting = Waiting(Need.USABLE_IMU, fault=fault)
            return None
        recent = [f for f in self._fixes if now - f.t_ns < FIXES_KEPT * 1e9]
        if not recent:
            self.waiting = Waiting(Need.FIX)
            return None
        motion = self._motion(recent, now)
        if motion is None:
            self.waiting = Waiting(Need.SECOND_FIX)
            return None
        lla, p_cov, velocity_n, v_cov = motion
        given = self._given_heading(velocity_n, v_cov)
        if given is None and self._source in ("imu", "course") and self._given is None:
            return None
        yaws = [] if given is None else [given]
        yaws += [(float(yaw), HEADING_STD) for yaw in heading_grid()]
        bias_a, bias_g, bias_P = self._first_biases(now)
        last = samples[-1]
        reading = np.concatenate((last["f"], last["w"]))
        rate = samples["w"].mean(axis=0)
        standing = is_standing(samples) and may_be_zero(velocity_n, v_cov)
        samples["f"] -= bias_a
        samples["w"] -= bias_g
        down_b = _down(samples)
        tilt_std = TILT_STD_STANDING if standing else TILT_STD_MOVING
        ie_n, ie_d = earth_rate_n(lla[0])
        bias_g_std = 0.1 * STANDING_RATE_STD
        states = []
        for yaw, yaw_std in yaws:
            quat = self._attitude(down_b, yaw)
            C_nb = matrix_from_quat(quat)
            P = np.zeros((N_ERROR, N_ERROR))
            P[DP, DP], P[DV, DV] = p_cov, v_cov
            P[EPS, EPS] = np.diag([tilt_std**2, tilt_std**2, yaw_std**2])
            P[9:, 9:] = bias_P
            if standing and P[14, 14] > bias_g_std**2:
                bias_g = rate - C_nb.T @ np.array([ie_n, 0.0, ie_d])
                P[B_G, :] = P[:, B_G] = 0.0
                P[B_G, B_G] = np.eye(3) * bias_g_std**2
            states.append(NavState(lla, velocity_n, quat, bias_a, bias_g, P))
        return Start(tuple(states), given is not None, now, reading)

    def _first_biases(self, now: int) -> tuple[Array, Array, Array]:
        """Biases and their covariance: as given, or the earlier estimate, grown since then."""
        settings = self._settings
        variance = np.concatenate((settings.bias_a_std, settings.bias_g_std)) ** 2
        given = settings.bias_a, settings.bias_g, np.diag(variance)
        known = self._biases
        if known is None:
            return given
        age = abs(now - known.t_ns) * 1e-9
        P = known.P + np.diag(age * np.repeat([BIAS_A_DRIFT**2, BIAS_G_DRIFT**2], 3))
        if np.any(np.diag(P) > variance):
            return given
        return known.accelerometer, known.gyroscope, P

    def _attitude(self, down_b: Array, yaw: float) -> Array:
        """Quaternion of C_nb now; a heading given for an earlier stamp is propagated to now."""
        if self._given is None:
            return quat_from_rpy(*_roll_pitch(down_b), yaw)
        C_then_now = _relative(self._ring.after(self._given[0] - 1))[0].T
        roll, pitch = _roll_pitch(C_then_now @ down_b)
        C_then = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
        return quat_from_matrix(C_then @ C_then_now)

    def _motion(
        self, fixes: list[PositionFix], now: int
    ) -> tuple[Array, Array, Array, Array] | None:
        """Position and velocity now with covariances, from fixes (and a GNSS velocity)."""
        last = fixes[-1]
        lla = last.lla.copy()
        if not math.isfinite(lla[2]):
            heights = [f.lla[2] for f in fixes if math.isfinite(f.lla[2])]
            lla[2] = heights[-1] if heights else 0.0
        scale = curvature_scale(lla)
        p_cov = last.covariance_n.copy()
        if not np.isfinite(p_cov[2, 2]) or not math.isfinite(last.lla[2]):
            p_cov[2, :] = p_cov[:, 2] = 0.0
            p_cov[2, 2] = 100.0**2
        if self._velocity is not None and abs(now - self._velocity.t_ns) < 1e9:
            velocity_n = np.nan_to_num(self._velocity.velocity_n)
            v_cov = np.diag(np.maximum(np.nan_to_num(np.diag(self._velocity.covariance_n)), 0.01))
        else:
            slope = _slope(fixes, p_cov, scale)
            if slope is None:
                return None
            velocity_n, v_cov = slope
        age = (now - last.t_ns) * 1e-9
        p_cov = p_cov + v_cov * age**2 + np.eye(3) * (0.5 * ACCELERATION_STD * age**2) ** 2
        return lla + velocity_n * age / scale, p_cov, velocity_n, v_cov

    def _given_heading(self, velocity_n: Array, v_cov: Array) -> tuple[float, float] | None:
        """Heading [rad from north] and its uncertainty; None if unknown, or ``waiting`` for it."""
        settings = self._settings
        if self._given is not None:
            return self._given[1:]
        if self._source == "imu":
            if self._imu_yaw is None:
                self.waiting = Waiting(Need.ORIENTATION)
                return None
            return self._imu_yaw, settings.yaw_std
        if self._source == "course":
            speed = math.hypot(velocity_n[0], velocity_n[1])
            if speed < settings.course_min_speed:
                self.waiting = Waiting(Need.SPEED, speed, settings.course_min_speed)
                return None
            course_std = math.sqrt(max(v_cov[0, 0], v_cov[1, 1])) / speed
            return math.atan2(velocity_n[1], velocity_n[0]), math.hypot(course_std, CRAB_STD)
        return None


def _slope(fixes: list[PositionFix], p_cov: Array, scale: Array) -> tuple[Array, Array] | None:
    """
    Velocity now [m/s, NED] and its covariance from the fixes over the best of all spans.

    The slope is the velocity at the span's middle: a short span is noisy, a long one outdated.
    """
    last = fixes[-1]
    t = np.array([(f.t_ns - last.t_ns) * 1e-9 for f in fixes])
    offsets = np.nan_to_num(np.array([(f.lla - last.lla) * scale for f in fixes]))
    best: tuple[Array, Array] | None = None
    for start in range(len(fixes) - 1):
        centred = t[start:] - t[start:].mean()
        if t[start] > -SHORTEST_SPAN:
            break
        noise = np.diag(np.diag(p_cov)) / (centred @ centred)
        covariance = noise + np.eye(3) * (0.5 * ACCELERATION_STD * t[start]) ** 2
        if best is None or np.trace(covariance) < np.trace(best[1]):
            best = centred @ offsets[start:] / (centred @ centred), covariance
    return best


def _down(samples: NDArray[np.void]) -> Array:
    """Direction of gravity in the last attitude, from the mean specific force; [1]_ eq. 5.101."""
    total = np.einsum("kij,kj->i", _relative(samples), samples["f"])
    return np.asarray(-total / np.linalg.norm(total))


def _relative(samples: NDArray[np.void]) -> Array:
    """Rotations (N, 3, 3) from the attitude at each sample to that at the last, by gyroscopes."""
    dt = np.diff(samples["t_ns"])[:, None] * 1e-9
    mean_rate = 0.5 * (samples["w"][1:] + samples["w"][:-1])
    turns = matrix_from_quat(quat_from_rotvec(-dt * mean_rate))
    relative = np.empty((len(samples), 3, 3))
    relative[-1] = np.eye(3)
    for k in range(len(turns) - 1, -1, -1):
        relative[k] = relative[k + 1] @ turns[k]
    return relative


def _roll_pitch(down_b: Array) -> tuple[float, float]:
    """Roll and pitch [rad] of the b frame in which n's down axis is ``down_b``."""
    return (
        math.atan2(down_b[1], down_b[2]),
        math.atan2(-down_b[0], math.hypot(down_b[1], down_b[2])),
    )


def yaw_of(quat_xyzw: Array) -> float:
    """Heading [rad from north] of an attitude C_nb."""
    return float(rpy_from_quat(quat_xyzw)[2])
