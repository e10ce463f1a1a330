"""
Initial alignment: level from gravity, position and velocity from the fixes, heading from a source.

Works standing and in flight: levelling averages the specific force over a window, rotated into the
window's last attitude by the gyroscopes; standing or moving is reflected in its uncertainty. The
first state is of the sample behind the last fix, so that nothing has to be assumed of what the
vehicle has done since: a filter processes the later ones of the window. There is a state for every
cell of headings, see `hybrid_ins.core.alignment.multiple_model`, and before those one for the
heading that a source gives, see `hybrid_ins.core.navigator.heading_check`.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 5.6.2.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.first_motion import FirstMotion, first_motion
from hybrid_ins.core.alignment.given_heading import GivenHeading, carried_heading
from hybrid_ins.core.alignment.levelling import Levelled, levelled, roll_pitch, tilt_by_bias
from hybrid_ins.core.alignment.multiple_model import HEADING_STD, heading_grid
from hybrid_ins.core.imu.health import ImuFault, find_fault
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.imu.standstill import is_standing, may_be_zero, sway
from hybrid_ins.core.inertial.earth import curvature_scale, earth_rate_n
from hybrid_ins.core.inertial.rotations import (
    UNKNOWN_ANGLE_STD,
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rpy,
)
from hybrid_ins.core.inertial.state import B_A, B_G, DP, DV, EPS, LAST_F, LAST_W, N_ERROR, NavState
from hybrid_ins.core.update.inflation import about_antenna
from hybrid_ins.core.update.measurements import (
    Measurement,
    PositionFix,
    VelocityFix,
    position_model,
    velocity_model,
)

Array = NDArray[np.float64]

TILT_STD_STANDING = 0.003  # rad, beside what the bias of the accelerometers does
TILT_STD_MOVING = 0.2  # rad, by accelerations
RATE_STD_STANDING = 0.002  # rad/s, mean of the gyroscopes about their bias
CRAB_STD = 0.15  # rad, between the nose and the course of a vehicle that moves where it points
FIXES_KEPT = 3.0  # s, of fixes that may give the first velocity
LONGEST_SPAN = 60.0  # s, between the two fixes of a slow receiver that do
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
class FirstStates:
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
    provisional : ndarray, shape (N_FLAT,), or None
        Flat state at the last attempt where that lacked a velocity or a heading, with the
        covariance of what may be anything. It is to be reported, not to be propagated.
    """

    def __init__(self, settings: AlignmentSettings, ring: ImuRing) -> None:
        self._settings = settings
        self._ring = ring
        self._fixes: deque[PositionFix] = deque(maxlen=64)
        self._velocity: VelocityFix | None = None
        self._imu_yaw: float | None = None
        self._biases: Biases | None = None
        self._given: GivenHeading | None = None
        self._source = settings.heading_source
        self.waiting = Waiting(Need.IMU_SAMPLES)
        self.provisional: Array | None = None
        self._outdated: list[float] = []

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
        self._given = GivenHeading(t_ns, yaw, std)

    def remember(self, biases: Biases) -> None:
        """Use the biases that an earlier filter estimated."""
        self._biases = biases

    def forget_parameter(self) -> None:
        """Ignore the heading given for the start from now on: the vehicle has moved since."""
        if self._source == "parameter":
            self._source, self._given = "auto", None

    def attempt(self) -> FirstStates | None:
        """Return the first states at a recent IMU sample, or None and set what is missing."""
        self.provisional = None
        now = int(self._ring.latest(1)["t_ns"][0])
        if self._given is None and self._source == "parameter":
            first_ns = int(self._ring.after(0)["t_ns"][0])
            self._given = GivenHeading(first_ns, self._settings.yaw, self._settings.yaw_std)
        window_ns = int(self._settings.window * 1e9)
        samples = self._ring.after(now - window_ns - 1)
        if len(samples) < 5 or now - samples["t_ns"][0] < 0.9 * window_ns:
            self.waiting = Waiting(Need.WINDOW, limit=self._settings.window)
            return None
        biases = self._first_biases(now)
        self._follow_given_heading(samples, biases)
        fault = find_fault(samples)
        if fault is not None and fault.unusable:
            self.waiting = Waiting(Need.USABLE_IMU, fault=fault)
            return None
        fixes = self._recent_fixes(now)
        if not fixes:
            self.waiting = Waiting(Need.FIX)
            return None
        window, lever_b = levelled(samples, self._newest_ns(fixes), *biases[:2]), fixes[-1].lever_b
        motion = first_motion(fixes, self._velocity, window.t_ns)
        given = self._given_heading(motion, window)
        missing = self._missing(motion, given)
        if missing is not None:
            self.waiting = missing
            window, motion = window.at_last(), first_motion(fixes, self._velocity, now)
            known = self._given_heading(motion, window) or (0.0, UNKNOWN_ANGLE_STD)
            level = self._states(window, motion, biases, [known], lever_b)[0]
            self.provisional = level.to_flat()
            self.provisional[LAST_F], self.provisional[LAST_W] = np.split(window.reading, 2)
            return None
        yaws = [] if given is None else [given]
        yaws += [(float(yaw), HEADING_STD) for yaw in heading_grid()]
        states = self._states(window, motion, biases, yaws, lever_b)
        return FirstStates(tuple(states), given is not None, window.t_ns, window.reading)

    def pop_outdated(self) -> list[float]:
        """Return the std [rad] of a heading that has become of no use since the last call."""
        found, self._outdated = self._outdated, []
        return found

    def _recent_fixes(self, now: int) -> list[PositionFix]:
        """Fixes that may give a position and a velocity now; of a slow receiver the last two."""
        recent = [f for f in self._fixes if now - f.t_ns < FIXES_KEPT * 1e9]
        if len(recent) == 1 and len(self._fixes) > 1:
            before = self._fixes[-2]
            if recent[0].t_ns - before.t_ns < LONGEST_SPAN * 1e9:
                recent.insert(0, before)
        return recent

    def _newest_ns(self, fixes: Sequence[PositionFix]) -> int:
        """Stamp [ns] of the last of what gives the first motion."""
        position_ns, velocity = fixes[-1].t_ns, self._velocity
        return position_ns if velocity is None else max(position_ns, velocity.t_ns)

    def _missing(self, motion: FirstMotion, given: tuple[float, float] | None) -> Waiting | None:
        """Return what the velocity or the heading waits for."""
        if not motion.has_velocity:
            return Waiting(Need.SECOND_FIX)
        if given is not None or self._source not in ("imu", "course"):
            return None
        if self._source == "imu":
            return Waiting(Need.ORIENTATION)
        return Waiting(Need.SPEED, motion.speed, self._settings.course_min_speed)

    def _states(
        self,
        window: Levelled,
        motion: FirstMotion,
        biases: tuple[Array, Array, Array],
        yaws: Sequence[tuple[float, float]],
        lever_b: Array,
    ) -> list[NavState]:
        """Return a state for each heading of the window's last attitude and its σ [rad]."""
        bias_a, bias_g, bias_P = biases
        samples = window.samples
        rate = samples["w"].mean(axis=0)
        standing = motion.has_velocity and is_standing(samples)
        standing = standing and may_be_zero(motion.velocity_n, motion.v_cov)
        tilt_std = TILT_STD_STANDING if standing else TILT_STD_MOVING
        ie_n, ie_d = earth_rate_n(motion.lla[0])
        bias_g_std = np.hypot(RATE_STD_STANDING, sway(samples)) if standing else np.full(3, np.inf)
        states = []
        for yaw, yaw_std in yaws:
            C_nb_last = matrix_from_quat(quat_from_rpy(*roll_pitch(window.down_b), yaw))
            C_nb = C_nb_last @ window.C_last_at
            P = np.zeros((N_ERROR, N_ERROR))
            P[DP, DP], P[DV, DV] = motion.p_cov, motion.v_cov
            P[9:, 9:] = bias_P
            by_bias = tilt_by_bias(C_nb)
            P[EPS, 9:] = by_bias @ bias_P[:3]
            P[9:, EPS] = P[EPS, 9:].T
            P[EPS, EPS] = P[EPS, B_A] @ by_bias.T + np.diag([tilt_std, tilt_std, yaw_std]) ** 2
            if np.all(bias_g_std**2 < np.diag(P[B_G, B_G])):
                bias_g = rate - C_nb.T @ np.array([ie_n, 0.0, ie_d])
                P[B_G, :] = P[:, B_G] = 0.0
                P[B_G, B_G] = np.diag(bias_g_std**2)
            quat = quat_from_matrix(C_nb)
            antenna = NavState(motion.lla, motion.velocity_n, quat, bias_a, bias_g, P)
            states.append(_at_imu(antenna, window.reading[3:], lever_b))
        return states

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

    def _follow_given_heading(
        self, window: NDArray[np.void], biases: tuple[Array, Array, Array]
    ) -> None:
        """Carry a given heading on, or ignore it where it has become of no use."""
        if self._given is None:
            return
        _, bias_g, bias_P = biases
        self._given.follow(self._ring, window, bias_g, np.sqrt(np.diag(bias_P)[3:]))
        if self._given.is_outdated:
            self._outdated.append(self._given.std)
            self._source, self._given = "auto", None

    def _given_heading(self, motion: FirstMotion, window: Levelled) -> tuple[float, float] | None:
        """Heading of the last attitude [rad from north] and its σ, by hand or from a source."""
        settings = self._settings
        if self._given is not None:
            return self._given.now(window.down_b), self._given.std
        if self._source == "imu" and self._imu_yaw is not None:
            return self._imu_yaw, settings.yaw_std
        if self._source == "course" and motion.speed >= settings.course_min_speed:
            velocity_n, v_cov = motion.velocity_n, motion.v_cov
            course_std = math.sqrt(max(v_cov[0, 0], v_cov[1, 1])) / motion.speed
            course = math.atan2(velocity_n[1], velocity_n[0])
            heading = carried_heading(course, window.C_last_at.T, window.down_b)
            return heading, math.hypot(course_std, CRAB_STD)
        return None


def _at_imu(antenna: NavState, rate_b: Array, lever_b: Array) -> NavState:
    """Return the state of an IMU whose antenna has that position and velocity."""
    nav = antenna.to_flat()
    nav[LAST_W] = rate_b
    away = position_model(nav, antenna.lla, lever_b)[0]
    moving = velocity_model(nav, antenna.velocity_n, lever_b)[0]
    T = about_antenna(nav, lever_b)
    return replace(
        antenna,
        lla=antenna.lla + away / curvature_scale(antenna.lla),
        velocity_n=antenna.velocity_n + moving,
        P=T @ antenna.P @ T.T,
    )
