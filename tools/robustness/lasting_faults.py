"""
Faults that last from the start: wrong axes, units and clocks; and bytes that are no messages.

The estimator has to name each with its remedy. With wrong axes no estimate can be good.
"""

from __future__ import annotations

import numpy as np

from tools.robustness.disturbances import (
    FIX,
    IMU,
    Flight,
    Injection,
    always,
    both,
    change_fixes,
    change_force,
    change_rate,
    change_stamps,
    with_covariance,
)
from tools.robustness.faults import Fault

ONE = np.eye(3)
FRD = np.diag([1.0, -1.0, -1.0])
ON_ITS_SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
DEGREES = 180.0 / np.pi
EMPTY = b"\0\1\0\0"  # a CDR header without a message


def with_axes(accelerometer: np.ndarray, gyroscope: np.ndarray) -> Injection:
    """Return what multiplies the readings of the whole flight by matrices (3, 3)."""
    change = both(
        change_force(lambda force, _: accelerometer @ force),
        change_rate(lambda rate, _: gyroscope @ rate),
    )
    return lambda flight: always(flight, change)


def by_another_clock(ahead: float) -> Injection:
    """Return what stamps all fixes ahead of the IMU [s]."""
    change = change_stamps(FIX, lambda t, _: t + round(ahead * 1e9))
    return lambda flight: always(flight, change)


def insert_bytes(topic: str, random: bool) -> Injection:
    """Return what adds bytes that are no messages of the topic's type after one in twenty."""

    def inject(flight: Flight) -> None:
        for entry in list(flight.some(topic, 0.05)):
            count = int(flight.rng.integers(1, 400))
            data = EMPTY + (flight.rng.bytes(count) if random else b"")
            flight.insert(topic, entry.log_ns, data)

    return inject


LASTING: tuple[Fault, ...] = tuple(
    Fault(f"always_{name}", text, inject, signs, unusable=True)
    for name, text, inject, signs in (
        (
            "gyroscope_in_degrees",
            "rates in degrees per second from the start",
            with_axes(ONE, DEGREES * ONE),
            ("degrees per second",),
        ),
        (
            "gyroscope_too_small",
            "rates 57 times too small",
            with_axes(ONE, ONE / DEGREES),
            ("57.3 times too small",),
        ),
        ("gyroscope_zero", "rates all zero", with_axes(ONE, 0.0 * ONE), ("does not change",)),
        *(
            (
                f"gyroscope_{axis}_reversed",
                f"the gyroscope's {axis} axis reversed",
                with_axes(ONE, ONE - 2.0 * np.diag(ONE[k])),
                (f"{axis} of angular_velocity reversed",),
            )
            for k, axis in enumerate("xyz")
        ),
        ("frd", "FRD axes instead of FLU", with_axes(FRD, FRD), ("imu.mount_rpy to [3.142",)),
        (
            "on_its_side",
            "the IMU on its side",
            with_axes(ON_ITS_SIDE, ON_ITS_SIDE),
            ("imu.mount_rpy to [-1.571",),
        ),
        (
            "minus_g",
            "gravity instead of specific force",
            with_axes(-ONE, ONE),
            ("all axes of linear_acceleration reversed|negate linear_acceleration",),
        ),
        (
            "axes_exchanged",
            "x and y exchanged",
            with_axes(ONE[[1, 0, 2]], ONE[[1, 0, 2]]),
            ("exchanged",),
        ),
        (
            "gps_time",
            "fixes stamped in GPS time",
            by_another_clock(18.0),
            ("in GPS time, the other in UTC",),
        ),
        (
            "years_away",
            "fixes stamped decades behind the IMU",
            by_another_clock(-1.5e9),
            ("years behind the IMU's",),
        ),
        (
            "covariance_zero",
            "fixes with a covariance of zero",
            lambda flight: always(flight, change_fixes(with_covariance(np.zeros((3, 3))))),
            ("is used instead",),
        ),
    )
) + tuple(
    Fault(f"{name}_{kind}", text, insert_bytes(topic, kind == "bytes"), (sign,))
    for name, topic in (("imu", IMU), ("fix", FIX))
    for kind, text, sign in (
        ("header", "four bytes in place of a message", "not decodable|left out"),
        ("bytes", "random bytes in place of a message", "not decodable|left out"),
    )
)
