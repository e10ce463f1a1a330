"""
Simulated sensors of a moving body: exact on the rotating Earth, then with errors as specified.

``sample`` turns a trajectory into truth, ``corrupt`` turns truth into the readings of an imperfect
IMU, ``fixes`` into those of a GNSS receiver. All work on whole arrays and touch no file, for Monte
Carlo runs::

    rng = np.random.default_rng(seed)
    flight = quadrotor_flight(60.0)
    imu = corrupt(sample(flight, sample_times(60.0, 200.0)), ImuErrors(), rng)
    gnss = fixes(sample(flight, sample_times(60.0, 5.0)), rng)

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 4.4 (IMU errors) and 5.4 (navigation equations).
.. [2] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, Table I and appendix B.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.motions import Motion

MPU9250_ACCELEROMETER_STD = 0.02  # m/s2 per sample, the paper's Table I
MPU9250_GYROSCOPE_STD = 0.002  # rad/s per sample
RTK_STD = (0.1, 0.1, 0.02**0.5)  # m: north, east, down, likewise

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Truth:
    """Exact states of a body, and what a perfect IMU at its origin measures at those epochs."""

    t: Array  # (N,) s
    lla: Array  # (N, 3) rad, rad, m
    velocity_n: Array  # (N, 3) m/s
    quat_xyzw: Array  # (N, 4) of C_nb
    specific_force_b: Array  # (N, 3) m/s2
    angular_rate_b: Array  # (N, 3) rad/s, relative to the inertial frame

    @property
    def C_nb(self) -> Array:
        """Rotation matrices, body to navigation, shape (N, 3, 3)."""
        return matrix_from_quat(self.quat_xyzw)

    @property
    def angular_rate_eb_b(self) -> Array:
        """Angular rate relative to the Earth, body axes, shape (N, 3) [rad/s]."""
        return self.angular_rate_b - to_body(self.C_nb, _earth_rate_n(self.lla[:, 0]))

    def every(self, step: int) -> Truth:
        """Return every ``step``-th epoch."""
        return Truth(*(getattr(self, field.name)[::step] for field in fields(self)))


@dataclass(frozen=True)
class Tone:
    """One vibration, a sine of random phase on each axis."""

    frequency: float  # Hz
    accelerometer: ArrayLike = 0.0  # m/s2, amplitude, scalar or (3,)
    gyroscope: ArrayLike = 0.0  # rad/s, amplitude, scalar or (3,)


@dataclass(frozen=True)
class ImuErrors:
    """
    Errors of an IMU; all vectors in the sensor's own axes (FRD), scalars mean all axes.

    The defaults are white noise and bias of an MPU-9250. In order of application: the mount turns
    body into sensor axes, then scale factor and g-sensitivity, then bias and everything random.
    """

    accelerometer_std: ArrayLike = MPU9250_ACCELEROMETER_STD  # m/s2, white, per sample
    gyroscope_std: ArrayLike = MPU9250_GYROSCOPE_STD  # rad/s, white, per sample
    accelerometer_bias: ArrayLike = (0.05, -0.03, 0.04)  # m/s2, at the first sample
    gyroscope_bias: ArrayLike = (0.002, -0.003, 0.001)  # rad/s, at the first sample
    accelerometer_bias_walk: ArrayLike = 1e-3  # m/s2 per sqrt(s)
    gyroscope_bias_walk: ArrayLike = 1e-4  # rad/s per sqrt(s)
    noise_schedule: Sequence[tuple[float, float]] = ()  # (from s, multiplier of the white noise)

    accelerometer_scale: ArrayLike = 0.0  # relative error of the scale factor
    gyroscope_scale: ArrayLike = 0.0
    mount_rpy: ArrayLike = (0.0, 0.0, 0.0)  # rad, attitude of the sensor's axes in the body's
    g_sensitivity: ArrayLike = 0.0  # rad/s per m/s2, scalar or (3, 3)
    accelerometer_coloured_std: ArrayLike = 0.0  # m/s2, first-order Gauss-Markov noise
    gyroscope_coloured_std: ArrayLike = 0.0  # rad/s
    coloured_time: float = 0.05  # s, its correlation time
    tones: Sequence[Tone] = ()

    def noise_multiplier(self, t: Array) -> Array:
        """Factor on the white noise's standard deviation at times `t`, by `noise_schedule`."""
        starts, factors = np.array([(-np.inf, 1.0), *sorted(self.noise_schedule)]).T
        multiplier: Array = factors[np.searchsorted(starts, t, side="right") - 1]
        return multiplier


@dataclass(frozen=True)
class ImuData:
    """Readings of an IMU (FRD, the sensor's axes), and their true errors."""

    t: Array  # (N,) s
    specific_force: Array  # (N, 3) m/s2
    angular_rate: Array  # (N, 3) rad/s
    accelerometer_bias: Array  # (N, 3) m/s2, in force at each sample
    gyroscope_bias: Array  # (N, 3) rad/s
    accelerometer_std: Array  # (N, 3) m/s2, white noise in force at each sample
    gyroscope_std: Array  # (N, 3) rad/s


@dataclass(frozen=True)
class GnssData:
    """Fixes of a receiver."""

    t: Array  # (M,) s, when the fixes were true
    lla: Array  # (M, 3) rad, rad, m
    position_std: Array  # (3,) m: north, east, down
    velocity_n: Array | None = None  # (M, 3) m/s, where the receiver reports it
    velocity_std: Array | None = None  # (3,) m/s

    def without(self, outages: Sequence[tuple[float, float]]) -> GnssData:
        """Leave out the fixes in outages (start, duration) [s]; the others stay as they are."""
        kept = ~in_outage(self.t, outages)
        velocity_n = None if self.velocity_n is None else self.velocity_n[kept]
        return replace(self, t=self.t[kept], lla=self.lla[kept], velocity_n=velocity_n)


def sample_times(duration: float, rate: float) -> Array:
    """Multiples of ``1 / rate`` [Hz] in [0, duration] [s]."""
    return np.arange(int(np.floor(duration * rate + 1e-6)) + 1) / rate


def sample(trajectory: Motion, times: ArrayLike) -> Truth:
    """
    Evaluate a trajectory, and the perfect IMU carried along it.

    Nothing is integrated: position and its two derivatives, attitude and its first come from the
    splines, and the navigation equations ([1]_ eq. 5.19, 5.27, 5.54; [2]_ eq. 35-37) are solved
    for specific force and angular rate.

    Parameters
    ----------
    trajectory : Motion
    times : array_like, shape (N,)
        [s], within the trajectory's duration.

    Returns
    -------
    Truth

    """
    t = np.asarray(times, float)
    displacement = trajectory.displacement
    lla, lla_rate, lla_acceleration = _curvilinear(
        trajectory.start_lla, *(displacement(t, order) for order in range(3))
    )
    lat, _, height = lla.T
    lat_rate, lon_rate, height_rate = lla_rate.T
    meridian, transverse = earth.radii(lat)
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    curvature = earth.ECCENTRICITY_SQ * sin_lat * cos_lat / (1 - earth.ECCENTRICITY_SQ * sin_lat**2)
    meridian_rate = 3.0 * meridian * curvature * lat_rate + height_rate
    transverse_rate = transverse * curvature * lat_rate + height_rate

    velocity_n = np.stack(
        (
            (meridian + height) * lat_rate,
            (transverse + height) * cos_lat * lon_rate,
            -height_rate,
        ),
        axis=-1,
    )
    acceleration_n = np.stack(
        (
            (meridian + height) * lla_acceleration[:, 0] + meridian_rate * lat_rate,
            (transverse + height) * cos_lat * lla_acceleration[:, 1]
            + (transverse_rate * cos_lat - (transverse + height) * sin_lat * lat_rate) * lon_rate,
            -lla_acceleration[:, 2],
        ),
        axis=-1,
    )
    earth_rate_n = _earth_rate_n(lat)
    transport_rate_n = np.stack(
        earth.transport_rate_n(lat, height, velocity_n[:, 0], velocity_n[:, 1]), axis=-1
    )
    specific_force_n = acceleration_n + np.cross(2.0 * earth_rate_n + transport_rate_n, velocity_n)
    gravity_north, gravity_down = earth.normal_gravity(lat, height)
    specific_force_n[:, 0] -= gravity_north
    specific_force_n[:, 2] -= gravity_down

    rpy, rpy_rate = trajectory.rpy(t), trajectory.rpy(t, 1)
    quat_xyzw = quat_from_rpy(*rpy.T)
    C_nb = matrix_from_quat(quat_xyzw)
    return Truth(
        t=t,
        lla=lla,
        velocity_n=velocity_n,
        quat_xyzw=quat_xyzw,
        specific_force_b=to_body(C_nb, specific_force_n),
        angular_rate_b=_rate_of_rpy(rpy, rpy_rate) + to_body(C_nb, earth_rate_n + transport_rate_n),
    )


def corrupt(truth: Truth, errors: ImuErrors, rng: np.random.Generator) -> ImuData:
    """
    Add an IMU's errors to its perfect readings ([1]_ eq. 4.16-4.17).

    Each kind of error draws from its own child of `rng`: switching one off or on leaves the others
    as they were, so that runs can be compared in pairs. Needs evenly spaced epochs.
    """
    t, count = truth.t, truth.t.size
    dt = (t[-1] - t[0]) / (count - 1) if count > 1 else 0.0
    C_bs = matrix_from_quat(quat_from_rpy(*np.asarray(errors.mount_rpy, float)))
    true_force, true_rate = truth.specific_force_b @ C_bs, truth.angular_rate_b @ C_bs
    specific_force = true_force * (1.0 + np.asarray(errors.accelerometer_scale))
    angular_rate = true_rate * (1.0 + np.asarray(errors.gyroscope_scale))
    angular_rate += true_force @ (np.asarray(errors.g_sensitivity, float) * np.eye(3)).T

    white_rng, walk_rng, coloured_rng, tone_rng = rng.spawn(4)
    multiplier = errors.noise_multiplier(t)[:, None]
    accelerometer_std = multiplier * np.broadcast_to(errors.accelerometer_std, 3)
    gyroscope_std = multiplier * np.broadcast_to(errors.gyroscope_std, 3)
    specific_force += accelerometer_std * white_rng.standard_normal((count, 3))
    angular_rate += gyroscope_std * white_rng.standard_normal((count, 3))

    accelerometer_bias = _random_walk(
        errors.accelerometer_bias, errors.accelerometer_bias_walk, count, dt, walk_rng
    )
    gyroscope_bias = _random_walk(
        errors.gyroscope_bias, errors.gyroscope_bias_walk, count, dt, walk_rng
    )
    decay = np.exp(-dt / errors.coloured_time)
    specific_force += accelerometer_bias + gauss_markov(
        errors.accelerometer_coloured_std, decay, count, coloured_rng
    )
    angular_rate += gyroscope_bias + gauss_markov(
        errors.gyroscope_coloured_std, decay, count, coloured_rng
    )
    for tone in errors.tones:
        angle = 2.0 * np.pi * (tone.frequency * t[:, None] + tone_rng.uniform(size=(2, 1, 3)))
        specific_force += np.asarray(tone.accelerometer) * np.sin(angle[0])
        angular_rate += np.asarray(tone.gyroscope) * np.sin(angle[1])
    return ImuData(
        t=t,
        specific_force=specific_force,
        angular_rate=angular_rate,
        accelerometer_bias=accelerometer_bias,
        gyroscope_bias=gyroscope_bias,
        accelerometer_std=accelerometer_std,
        gyroscope_std=gyroscope_std,
    )


def fixes(
    truth: Truth,
    rng: np.random.Generator,
    position_std: ArrayLike = RTK_STD,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    velocity_std: ArrayLike | None = None,
) -> GnssData:
    """
    Report the antenna's position, and its velocity, at the epochs of `truth`, with white noise.

    Parameters
    ----------
    truth : Truth
        Sampled at the fixes' epochs.
    rng : Generator
    position_std : array_like, shape (3,)
        North, east, down [m].
    lever_arm_b : array_like, shape (3,)
        From the IMU to the antenna, FRD [m].
    velocity_std : array_like, shape (3,), optional
        North, east, down [m/s]; None for a receiver that reports no velocity.
    """
    position_rng, velocity_rng = rng.spawn(2)
    position_std = np.broadcast_to(np.asarray(position_std, float), 3)
    lever_arm_b = np.asarray(lever_arm_b, float)
    C_nb = truth.C_nb
    offset_n = C_nb @ lever_arm_b + position_std * position_rng.standard_normal((truth.t.size, 3))
    lla = truth.lla + offset_n / np.array([earth.curvature_scale(place) for place in truth.lla])

    velocity_n = None
    if velocity_std is not None:
        velocity_std = np.broadcast_to(np.asarray(velocity_std, float), 3)
        noise = velocity_std * velocity_rng.standard_normal((truth.t.size, 3))
        velocity_n = antenna_velocity(truth, lever_arm_b) + noise
    return GnssData(truth.t, lla, position_std, velocity_n, velocity_std)


def antenna_velocity(truth: Truth, lever_arm_b: ArrayLike) -> Array:
    """Return the velocity NED, (N, 3) [m/s], of an antenna at ``lever_arm_b``, FRD [m]."""
    turning_b = np.cross(truth.angular_rate_eb_b, np.asarray(lever_arm_b, float))
    return np.asarray(truth.velocity_n + (truth.C_nb @ turning_b[..., None])[..., 0])


def in_outage(times: Array, outages: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which times [s] are within an outage (start, duration) [s]."""
    out = np.zeros(times.shape, bool)
    for start, duration in outages:
        out |= (times > start - 1e-6) & (times < start + duration - 1e-6)
    return out


def report_empty_outages(times: Array, outages: Sequence[tuple[float, float]]) -> None:
    """Warn of outages (start, duration) [s] in which no fix lies; ``times`` (M,) [s] are theirs."""
    for start, duration in outages:
        if len(times) and not in_outage(times, [(start, duration)]).any():
            _log.warning(
                "--outage %g %g: no fix lies in it: the fixes span %.1f to %.1f s",
                start,
                duration,
                times[0],
                times[-1],
            )


def to_body(C_nb: Array, vectors_n: Array) -> Array:
    """Turn vectors (N, 3) from n to b by the matrices (N, 3, 3)."""
    turned: Array = np.einsum("nij,ni->nj", C_nb, vectors_n)
    return turned


def _curvilinear(
    start_lla: Array, displacement: Array, velocity: Array, acceleration: Array
) -> tuple[Array, Array, Array]:
    per_metre = 1.0 / earth.curvature_scale(start_lla)
    return start_lla + displacement * per_metre, velocity * per_metre, acceleration * per_metre


def _earth_rate_n(lat: Array) -> Array:
    north, down = earth.earth_rate_n(lat)
    return np.stack((north, np.zeros_like(north), down), axis=-1)


def _rate_of_rpy(rpy: Array, rpy_rate: Array) -> Array:
    """Angular rate, body axes, of changing Euler angles ([2]_ eq. 36)."""
    (sin_roll, sin_pitch, _), (cos_roll, cos_pitch, _) = np.sin(rpy).T, np.cos(rpy).T
    roll_rate, pitch_rate, yaw_rate = rpy_rate.T
    return np.stack(
        (
            roll_rate - sin_pitch * yaw_rate,
            cos_roll * pitch_rate + sin_roll * cos_pitch * yaw_rate,
            cos_roll * cos_pitch * yaw_rate - sin_roll * pitch_rate,
        ),
        axis=-1,
    )


def _random_walk(
    first: ArrayLike, walk: ArrayLike, count: int, dt: float, rng: np.random.Generator
) -> Array:
    steps = np.asarray(walk, float) * np.sqrt(dt) * rng.standard_normal((count, 3))
    steps[0] = first
    return np.cumsum(steps, axis=0)


def gauss_markov(std: ArrayLike, decay: float, count: int, rng: np.random.Generator) -> Array:
    """Return a first-order Gauss-Markov process (N, 3), in its steady state from the start."""
    from scipy.signal import lfilter  # here: it takes longer to load than all else

    drive = np.asarray(std, float) * rng.standard_normal((count, 3))
    drive[1:] *= np.sqrt(1.0 - decay**2)  # the first value is drawn from the steady state
    coloured: Array = lfilter([1.0], [1.0, -decay], drive, axis=0)
    return coloured
