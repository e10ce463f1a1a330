"""
What goes wrong in the field: named faults, each with what the estimator has to say about it.

A fault changes the messages of a recorded flight from ``start`` on, for its duration. Its signs are
what must be found in what the estimator publishes: a counter or a text of ``/diagnostics``, or a
reason of ``gnss/verdict``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.bags.messages import Message, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.ros.conversions import DIAGONAL, KNOWN, set_stamp, stamp_ns

IMU, FIX, VELOCITY, POSE = "/imu/data", "/gnss/fix", "/gnss/velocity", "/initialpose"
TYPES = {
    VELOCITY: "geometry_msgs/msg/TwistWithCovarianceStamped",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
}


@dataclass(slots=True)
class Entry:
    """One message of a recording."""

    log_ns: int
    topic: str
    message: Message


@dataclass
class Flight:
    """
    A recording in memory, and the stretch that a fault is to change.

    Attributes
    ----------
    entries : list of Entry
        In order of log time.
    types : dict of str
        Type by topic.
    origin_ns, from_ns, to_ns : int
        Log times: of the first message, and of the fault's beginning and end.
    rng : Generator
        Draws whatever is random in the fault.
    """

    entries: list[Entry]
    types: dict[str, str]
    origin_ns: int
    from_ns: int
    to_ns: int
    rng: np.random.Generator

    @classmethod
    def read(cls, path: Path, start: float, duration: float, seed: int = 0) -> Flight:
        """Read a bag; the fault lasts from ``start`` for ``duration`` [s]."""
        with BagReader(path) as bag:
            entries = [
                Entry(log_ns, topic, message)
                for topic, log_ns, message in bag.messages()
                if topic in (IMU, FIX, VELOCITY) or topic.startswith("/truth/")
            ]
            origin = bag.start_ns
            types = dict(bag.topics)
        return cls(
            entries,
            {**types, **TYPES},
            origin,
            origin + round(start * 1e9),
            origin + round((start + duration) * 1e9),
            np.random.default_rng(seed),
        )

    def write(self, path: Path) -> None:
        """Write the bag in order of log time."""
        with BagWriter(path, overwrite=True) as bag:
            for entry in sorted(self.entries, key=lambda e: e.log_ns):
                bag.write(entry.topic, entry.message, entry.log_ns)

    def within(self, topic: str) -> Iterator[Entry]:
        """Yield the entries of a topic that the fault is to change."""
        for entry in self.entries:
            if entry.topic == topic and self.from_ns <= entry.log_ns < self.to_ns:
                yield entry

    def some(self, topic: str, share: float) -> Iterator[Entry]:
        """Yield a random share of them."""
        for entry in self.within(topic):
            if self.rng.random() < share:
                yield entry

    def drop(self, topic: str, share: float = 1.0) -> None:
        """Lose a share of a topic's messages."""
        lost = {id(entry) for entry in self.some(topic, share)}
        self.entries = [entry for entry in self.entries if id(entry) not in lost]

    def insert(self, topic: str, log_ns: int, message: Message) -> None:
        """Add a message."""
        self.entries.append(Entry(log_ns, topic, message))

    def sort(self) -> None:
        """Bring the entries into the order of their log times."""
        self.entries.sort(key=lambda entry: entry.log_ns)


Injection = Callable[[Flight], None]


@dataclass(frozen=True)
class Fault:
    """
    One way to go wrong.

    Attributes
    ----------
    name, text : str
        Short name; what happens.
    inject : callable
        Changes a flight.
    signs : tuple of str
        Texts that the diagnostics, verdicts or log lines must contain.
    duration : float
        [s].
    values : mapping
        Parameters that differ from the defaults.
    stamp_shift : float
        Stamps after the fault are those of the clean flight plus this [s].
    silent : bool
        The right answer is to publish no odometry at all.
    """

    name: str
    text: str
    inject: Injection
    signs: tuple[str, ...]
    duration: float = 5.0
    values: Mapping[str, Any] = field(default_factory=dict)
    stamp_shift: float = 0.0
    silent: bool = False


def _force(message: Message) -> np.ndarray[Any, Any]:
    a = message.linear_acceleration
    return np.array([a.x, a.y, a.z])


def _set_force(message: Message, force: Any) -> None:
    a = message.linear_acceleration
    a.x, a.y, a.z = map(float, force)


def _rate(message: Message) -> np.ndarray[Any, Any]:
    w = message.angular_velocity
    return np.array([w.x, w.y, w.z])


def _set_rate(message: Message, rate: Any) -> None:
    w = message.angular_velocity
    w.x, w.y, w.z = map(float, rate)


# IMU: readings.


def _force_of(make: Callable[[np.ndarray[Any, Any], Flight], Any], share: float = 1.0) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.some(IMU, share):
            _set_force(entry.message, make(_force(entry.message), flight))

    return inject


def _rate_of(make: Callable[[np.ndarray[Any, Any], Flight], Any], share: float = 1.0) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.some(IMU, share):
            _set_rate(entry.message, make(_rate(entry.message), flight))

    return inject


def _both(*injections: Injection) -> Injection:
    def inject(flight: Flight) -> None:
        for each in injections:
            each(flight)

    return inject


def _imu_frozen(flight: Flight) -> None:
    first = next(flight.within(IMU)).message
    force, rate = _force(first), _rate(first)
    for entry in flight.within(IMU):
        _set_force(entry.message, force)
        _set_rate(entry.message, rate)


def _imu_saturated(flight: Flight) -> None:
    for entry in flight.within(IMU):
        shaken = _force(entry.message) + flight.rng.normal(0.0, 8.0, 3)
        _set_force(entry.message, np.clip(shaken, -16.0, 16.0))


def _imu_no_reading(flight: Flight) -> None:
    for entry in flight.within(IMU):
        entry.message.linear_acceleration_covariance = np.array([-1.0, *np.zeros(8)])


def _imu_covariances(flight: Flight) -> None:
    for entry in flight.within(IMU):
        entry.message.linear_acceleration_covariance = np.full(9, math.nan)
        entry.message.angular_velocity_covariance = np.zeros(9)
        entry.message.orientation_covariance = np.full(9, math.inf)


def _imu_noise(flight: Flight) -> None:
    for entry in flight.within(IMU):
        _set_force(entry.message, _force(entry.message) + flight.rng.normal(0.0, 6.0, 3))
        _set_rate(entry.message, _rate(entry.message) + flight.rng.normal(0.0, 0.3, 3))


def _imu_two_publishers(flight: Flight) -> None:
    for entry in list(flight.within(IMU)):
        second = copy.deepcopy(entry.message)
        second.header.frame_id = "second_imu"
        _set_force(second, -_force(second))
        flight.insert(IMU, entry.log_ns + 100_000, second)


# Stamps.


def _stamps_of(topic: str, make: Callable[[int, Flight], int], share: float = 1.0) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.some(topic, share):
            stamp = entry.message.header.stamp
            set_stamp(stamp, make(stamp_ns(stamp), flight))

    return inject


def _repeat_stamps(flight: Flight) -> None:
    last = None
    for k, entry in enumerate(flight.within(IMU)):
        if k % 4 == 3 and last is not None:
            set_stamp(entry.message.header.stamp, last)
        last = stamp_ns(entry.message.header.stamp)


def _swap_in_time(flight: Flight) -> None:
    entries = list(flight.within(IMU))
    for a, b in zip(entries[::8], entries[1::8], strict=False):
        a.log_ns, b.log_ns = b.log_ns, a.log_ns


def _clock_jump(seconds: float) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.entries:
            if entry.log_ns >= flight.from_ns and entry.topic != "/truth/datum":
                stamp = entry.message.header.stamp
                set_stamp(stamp, stamp_ns(stamp) + round(seconds * 1e9))

    return inject


def _bag_loop(flight: Flight) -> None:
    """Play the beginning, then all from the beginning again."""
    gap = 1_000_000
    behind = flight.from_ns - flight.origin_ns + gap
    before = [copy.deepcopy(entry) for entry in flight.entries if entry.log_ns < flight.from_ns]
    for entry in flight.entries:
        entry.log_ns += behind
    flight.entries = before + flight.entries


# Fixes.


def _fixes(change: Callable[[Message, Flight], None], share: float = 1.0) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.some(FIX, share):
            change(entry.message, flight)

    return inject


def _attributes(**values: Any) -> Callable[[Message, Flight], None]:
    def change(message: Message, _flight: Flight) -> None:
        for name, value in values.items():
            setattr(message, name, value)

    return change


def _status(value: int) -> Callable[[Message, Flight], None]:
    def change(message: Message, _flight: Flight) -> None:
        message.status.status = value

    return change


def _covariance(matrix: Any, kind: int = KNOWN) -> Callable[[Message, Flight], None]:
    def change(message: Message, _flight: Flight) -> None:
        message.position_covariance = np.asarray(matrix, float).ravel()
        message.position_covariance_type = kind

    return change


def _north(metres: Callable[[Flight], float]) -> Callable[[Message, Flight], None]:
    def change(message: Message, flight: Flight) -> None:
        message.latitude += metres(flight) / 111_000.0

    return change


def _drift(flight: Flight) -> None:
    for entry in flight.within(FIX):
        entry.message.latitude += 2.0 * (entry.log_ns - flight.from_ns) * 1e-9 / 111_000.0


def _fix_frozen(flight: Flight) -> None:
    first = next(flight.within(FIX)).message
    for entry in flight.within(FIX):
        for name in ("latitude", "longitude", "altitude"):
            setattr(entry.message, name, getattr(first, name))


def _fix_repeated(flight: Flight) -> None:
    for entry in list(flight.within(FIX)):
        flight.insert(FIX, entry.log_ns + 1_000_000, copy.deepcopy(entry.message))


def _fix_late(delay: Callable[[Flight], float]) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.within(FIX):
            entry.log_ns += round(delay(flight) * 1e9)
        flight.sort()

    return inject


def _fix_burst(flight: Flight) -> None:
    """Hold all fixes of 0.9 s back and deliver them at once."""
    for entry in flight.within(FIX):
        entry.log_ns += 900_000_000 - (entry.log_ns - flight.from_ns) % 900_000_000
    flight.sort()


def _frame_id(topic: str, name: str) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in flight.within(topic):
            entry.message.header.frame_id = name

    return inject


def _first_fix_wild(flight: Flight) -> None:
    first = next(entry for entry in flight.entries if entry.topic == FIX)
    first.message.latitude += 1.0


def _late_start(topic: str) -> Injection:
    def inject(flight: Flight) -> None:
        flight.entries = [
            entry
            for entry in flight.entries
            if entry.topic != topic or entry.log_ns >= flight.to_ns
        ]

    return inject


# Velocity and pose.


def _velocity(components: Callable[[Flight], tuple[float, float, float]]) -> Injection:
    def inject(flight: Flight) -> None:
        for entry in list(flight.within(FIX)):
            message = new_message(TYPES[VELOCITY])
            message.header = copy.deepcopy(entry.message.header)
            linear = message.twist.twist.linear
            linear.x, linear.y, linear.z = components(flight)
            message.twist.covariance[[0, 7, 14]] = 0.05**2
            flight.insert(VELOCITY, entry.log_ns + 500_000, message)

    return inject


def _pose(quat_xyzw: tuple[float, float, float, float], yaw_std: float = 0.05) -> Injection:
    def inject(flight: Flight) -> None:
        message = new_message(TYPES[POSE])
        q = message.pose.pose.orientation
        q.x, q.y, q.z, q.w = quat_xyzw
        message.pose.covariance[35] = yaw_std**2
        flight.insert(POSE, flight.from_ns, message)

    return inject


NAN, INF = math.nan, math.inf
INDEFINITE = [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

FAULTS: tuple[Fault, ...] = (
    # Readings of the IMU.
    Fault(
        "imu_nan",
        "one acceleration in ten is NaN",
        _force_of(lambda f, _: (NAN, *f[1:]), 0.1),
        ("imu: not finite",),
    ),
    Fault(
        "imu_inf",
        "one rate in ten is infinite",
        _rate_of(lambda w, _: (*w[:2], INF), 0.1),
        ("imu: not finite",),
    ),
    Fault(
        "imu_nan_long",
        "nothing but NaN for 3 s",
        _force_of(lambda f, _: (NAN, NAN, NAN)),
        ("imu: not finite", "restart: no IMU samples"),
        3.0,
    ),
    Fault(
        "imu_absurd_force",
        "one acceleration in ten is 1e6 m/s²",
        _force_of(lambda f, _: 1e6 * np.sign(f), 0.1),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_absurd_rate",
        "one rate in ten is 1e9 rad/s",
        _rate_of(lambda w, _: (1e9, 0.0, 0.0), 0.1),
        ("imu: absurd rate",),
    ),
    Fault(
        "imu_huge_values",
        "one message in ten holds 1e308",
        _both(_force_of(lambda f, _: (1e308,) * 3, 0.1), _rate_of(lambda w, _: (-1e308,) * 3, 0.1)),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_zeros",
        "all readings are zero",
        _both(_force_of(lambda f, _: (0.0,) * 3), _rate_of(lambda w, _: (0.0,) * 3)),
        ("imu: no acceleration",),
    ),
    Fault(
        "imu_half_filled",
        "the acceleration is left zero",
        _force_of(lambda f, _: (0.0,) * 3),
        ("imu: no acceleration",),
    ),
    Fault(
        "imu_gravity_removed",
        "the driver removes gravity",
        _force_of(lambda f, _: f - np.array([0.0, 0.0, 9.8])),
        ("imu: no gravity",),
    ),
    Fault(
        "imu_in_g",
        "accelerations in g",
        _force_of(lambda f, _: f / 9.80665),
        ("the unit seems to be g",),
    ),
    Fault(
        "imu_in_mg",
        "accelerations in mg",
        _force_of(lambda f, _: f * 101.97),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_degrees",
        "rates in degrees per second",
        _rate_of(lambda w, _: np.degrees(w)),
        ("imu: degrees|imu: absurd rate",),
    ),
    Fault("imu_frozen", "the same reading again and again", _imu_frozen, ("imu: frozen",)),
    Fault(
        "imu_saturated",
        "vibration beyond the accelerometer's range",
        _imu_saturated,
        ("imu: saturated",),
    ),
    Fault("imu_no_reading", "covariance[0] is -1", _imu_no_reading, ("imu: no reading",)),
    Fault(
        "imu_covariances", "covariances are NaN, zero, infinite", _imu_covariances, ("no restart",)
    ),
    Fault("imu_vibration", "a hundred times the noise", _imu_noise, ("no restart",)),
    Fault(
        "imu_bias_steps",
        "biases step by 0.1 m/s², 0.2°/s, and back",
        _both(_force_of(lambda f, _: f + 0.1), _rate_of(lambda w, _: w + 0.0035)),
        ("no restart",),
    ),
    Fault(
        "imu_spikes",
        "one acceleration in a hundred is 60 m/s² off",
        _force_of(lambda f, _: f + np.array([60.0, -60.0, 60.0]), 0.01),
        ("imu: spikes", "no restart"),
    ),
    Fault(
        "imu_two_publishers",
        "a second IMU on the topic",
        _imu_two_publishers,
        ("imu: repeated stamp", "imu/data: frame_id changes"),
    ),
    Fault(
        "imu_frame_id",
        "the frame_id changes",
        _frame_id(IMU, "elsewhere"),
        ("imu/data: frame_id changes",),
    ),
    Fault(
        "imu_frame_id_empty",
        "the frame_id is lost",
        _frame_id(IMU, ""),
        ("imu/data: frame_id changes",),
    ),
    # Stamps and gaps of the IMU.
    Fault(
        "imu_zero_stamps",
        "one stamp in ten is zero",
        _stamps_of(IMU, lambda t, _: 0, 0.1),
        ("imu: zero stamp",),
    ),
    Fault(
        "imu_repeated_stamps",
        "every fourth stamp repeats the last",
        _repeat_stamps,
        ("imu: repeated stamp",),
    ),
    Fault(
        "imu_reordered", "samples overtake each other", _swap_in_time, ("imu: stamp out of order",)
    ),
    Fault(
        "imu_stray_future",
        "one stamp in a hundred is an hour ahead",
        _stamps_of(IMU, lambda t, _: t + 3600 * 10**9, 0.01),
        ("imu: stamp jumps",),
    ),
    Fault(
        "imu_stray_past",
        "one stamp in a hundred is of yesterday",
        _stamps_of(IMU, lambda t, _: t - 86_400 * 10**9, 0.01),
        ("imu: stamp jumps",),
    ),
    Fault(
        "imu_jitter",
        "stamps jitter by 2 ms",
        _stamps_of(IMU, lambda t, f: t + round(f.rng.normal(0.0, 2e6))),
        ("no restart",),
    ),
    Fault(
        "imu_gap_short", "no samples for 0.3 s", lambda f: f.drop(IMU), ("imu: gaps bridged",), 0.3
    ),
    Fault(
        "imu_gap_long",
        "no samples for 3 s",
        lambda f: f.drop(IMU),
        ("restart: no IMU samples",),
        3.0,
    ),
    Fault(
        "imu_lossy", "a third of the samples is lost", lambda f: f.drop(IMU, 0.35), ("no restart",)
    ),
    Fault(
        "clock_forward",
        "all clocks jump an hour ahead",
        _clock_jump(3600.0),
        ("restart: no IMU samples",),
        0.1,
        stamp_shift=3600.0,
    ),
    Fault(
        "clock_back",
        "all clocks jump an hour back",
        _clock_jump(-3600.0),
        ("restart: the IMU's stamps went back",),
        0.1,
        stamp_shift=-3600.0,
    ),
    Fault(
        "bag_loop",
        "the bag is played in a loop",
        _bag_loop,
        ("restart: the IMU's stamps went back",),
        0.1,
    ),
    # Fixes: values.
    Fault(
        "fix_nan",
        "latitude is NaN",
        _fixes(_attributes(latitude=NAN)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_inf",
        "altitude is infinite",
        _fixes(_attributes(altitude=-INF)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_scaled",
        "latitude in 1e-7 degrees",
        _fixes(_attributes(latitude=3.2e8)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_zero",
        "latitude and longitude are zero",
        _fixes(_attributes(latitude=0.0, longitude=0.0, altitude=0.0)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_pole",
        "latitude is 90",
        _fixes(_attributes(latitude=90.0)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_status_none",
        "status is NO_FIX",
        _fixes(_status(-1)),
        ("gnss: no fix", "dead reckoning"),
    ),
    Fault(
        "fix_status_unknown",
        "status is UNKNOWN",
        _fixes(_status(-2)),
        ("gnss: no fix", "dead reckoning"),
    ),
    Fault("fix_altitude_nan", "no altitude", _fixes(_attributes(altitude=NAN)), ("verdict dof 2",)),
    Fault(
        "fix_outliers",
        "one fix in four is 50 m off",
        _fixes(_north(lambda f: float(f.rng.choice([-50.0, 50.0]))), 0.25),
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_scattered",
        "every fix is somewhere else, 100 m off",
        _fixes(_north(lambda f: f.rng.normal(0.0, 100.0))),
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_shift",
        "all fixes are 30 m off, and then right again",
        _fixes(_north(lambda f: 30.0)),
        ("gnss: state opened",),
    ),
    Fault(
        "fix_drift",
        "fixes drift off by 2 m/s, and then are right again",
        _drift,
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_frozen",
        "the same position again and again",
        _fix_frozen,
        ("gnss: same position while moving",),
    ),
    Fault(
        "fix_first_wild", "the very first fix is 111 km off", _first_fix_wild, ("no restart",), 0.1
    ),
    Fault(
        "fix_frame_id",
        "the frame_id changes",
        _frame_id(FIX, "elsewhere"),
        ("gnss/fix: frame_id changes",),
    ),
    # Fixes: covariances.
    Fault(
        "cov_unknown",
        "covariance type is unknown",
        _fixes(_covariance(np.eye(3), 0)),
        ("verdict sigma_e 3",),
    ),
    Fault(
        "cov_zero",
        "covariance is zero",
        _fixes(_covariance(np.zeros((3, 3)))),
        ("verdict sigma_e 3",),
    ),
    Fault(
        "cov_negative",
        "variances are negative",
        _fixes(_covariance(-np.eye(3), DIAGONAL)),
        ("verdict sigma_e 3",),
    ),
    Fault(
        "cov_nan",
        "covariance is NaN",
        _fixes(_covariance(np.full((3, 3), NAN))),
        ("verdict sigma_e 3",),
    ),
    Fault(
        "cov_indefinite",
        "covariance is not positive definite",
        _fixes(_covariance(INDEFINITE)),
        ("verdict sigma_e 3",),
    ),
    Fault(
        "cov_tiny",
        "a nanometre is claimed",
        _fixes(_covariance(1e-18 * np.eye(3))),
        ("verdict sigma_e 0.01",),
    ),
    Fault(
        "cov_tight",
        "three millimetres are claimed of noise of a decimetre",
        _fixes(_covariance(9e-6 * np.eye(3))),
        ("verdict sigma_e 0.01",),
    ),
    Fault(
        "cov_huge",
        "a kilometre is claimed",
        _fixes(_covariance(1e6 * np.eye(3))),
        ("gnss: poor fix", "dead reckoning"),
    ),
    # Fixes: time.
    Fault("fix_outage", "no fixes for 10 s", lambda f: f.drop(FIX), ("dead reckoning",), 10.0),
    Fault("fix_sparse", "most fixes are lost", lambda f: f.drop(FIX, 0.8), ("no restart",)),
    Fault("fix_repeated", "every fix comes twice", _fix_repeated, ("gnss: repeated stamp",)),
    Fault(
        "fix_zero_stamp", "stamps are zero", _stamps_of(FIX, lambda t, _: 0), ("gnss: zero stamp",)
    ),
    Fault(
        "fix_future",
        "stamps are a minute ahead",
        _stamps_of(FIX, lambda t, _: t + 60 * 10**9),
        ("gnss: stamped ahead of the IMU",),
    ),
    Fault(
        "fix_past",
        "stamps are a minute behind",
        _stamps_of(FIX, lambda t, _: t - 60 * 10**9),
        ("gnss: too old",),
    ),
    Fault(
        "fix_late",
        "fixes arrive 0.3 s late",
        _fix_late(lambda f: 0.3),
        ("verdict age 0.3|verdict age 0.2",),
    ),
    Fault(
        "fix_late_reordered",
        "fixes arrive up to 0.5 s late and overtake each other",
        _fix_late(lambda f: f.rng.uniform(0.0, 0.5)),
        ("verdict age 0.4|verdict age 0.3",),
    ),
    Fault("fix_burst", "fixes are held back and come in bursts", _fix_burst, ("verdict age 0.6",)),
    Fault("fix_too_late", "fixes arrive 2 s late", _fix_late(lambda f: 2.0), ("gnss: too old",)),
    # Other input.
    Fault(
        "velocity_nan",
        "a velocity that is NaN",
        _velocity(lambda f: (NAN, 0.0, 0.0)),
        ("velocity: not finite",),
    ),
    Fault(
        "velocity_absurd",
        "a velocity of 1e6 m/s",
        _velocity(lambda f: (1e6, 0.0, 0.0)),
        ("velocity: absurd",),
    ),
    Fault(
        "velocity_wrong",
        "a velocity that is 30 m/s off, claiming 0.05 m/s",
        _velocity(lambda f: (30.0, 0.0, 0.0)),
        ("innovation beyond the gate",),
    ),
    Fault(
        "pose_no_rotation",
        "an initialpose whose quaternion is zero",
        _pose((0.0, 0.0, 0.0, 0.0)),
        ("initialpose: no orientation",),
        0.1,
    ),
    # From the start.
    Fault("start_in_flight", "the IMU comes up in flight", _late_start(IMU), ("no restart",), 0.1),
    Fault(
        "start_without_fixes",
        "the receiver finds its first fix in flight",
        _late_start(FIX),
        ("waiting for GNSS",),
        0.1,
    ),
    Fault(
        "always_in_g",
        "accelerations in g from the start",
        lambda f: _always(f, _force_of(lambda force, _: force / 9.80665)),
        ("the unit seems to be g",),
        silent=True,
    ),
    Fault(
        "no_fixes_at_all",
        "not one fix is valid",
        lambda f: _always(f, _fixes(_status(-1))),
        ("waiting for GNSS",),
        silent=True,
    ),
)


def _always(flight: Flight, inject: Injection) -> None:
    flight.from_ns, flight.to_ns = flight.origin_ns, 2**62
    inject(flight)
