"""
Admission of Imu readings: one rule for one reading and for many.
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.compilation import kernel
from hybrid_ins.ros.messages.conversions import Refused

Reading = tuple[float, float, float]

NO_READING = Refused(
    "imu: no reading",
    "covariance[0] is -1: the message says that it carries no acceleration or no angular rate",
)


@kernel()
def is_usable(t_ns, fx, fy, fz, wx, wy, wz, max_force, max_rate):  # type: ignore[no-untyped-def]
    """
    Return whether a reading may be used.

    Parameters
    ----------
    t_ns : int
        Stamp [ns].
    fx, fy, fz, wx, wy, wz : float
        Specific force [m/s²] and angular rate [rad/s] in the IMU's own axes.
    max_force, max_rate : float
        Largest values.
    """
    # A NaN fails every comparison.
    return (
        -max_force <= fx <= max_force
        and -max_force <= fy <= max_force
        and -max_force <= fz <= max_force
        and -max_rate <= wx <= max_rate
        and -max_rate <= wy <= max_rate
        and -max_rate <= wz <= max_rate
        and t_ns > 0
        and (fx != 0.0 or fy != 0.0 or fz != 0.0)
    )


@kernel()
def end_of_stretch(  # type: ignore[no-untyped-def]
    t_ns, force, rate, start, last_ns, steady_ns, until_ns, max_force, max_rate
):
    """
    Return the row behind the usable readings that follow each other from ``start`` on.

    Parameters
    ----------
    t_ns, force, rate : ndarray, shape (N,), (N, 3), (N, 3)
        Stamps [ns] and readings, as in `is_usable`.
    start, last_ns : int
        First row, and the stamp before it [ns].
    steady_ns : int
        Longest step from stamp to stamp [ns].
    until_ns : int
        The first row at or after this stamp [ns] is the last one.
    max_force, max_rate : float
        Largest values.
    """
    for k in range(start, t_ns.shape[0]):
        f, w = force[k], rate[k]
        if not (
            0 < t_ns[k] - last_ns <= steady_ns
            and is_usable(t_ns[k], f[0], f[1], f[2], w[0], w[1], w[2], max_force, max_rate)
        ):
            return k
        last_ns = t_ns[k]
        if last_ns >= until_ns:
            return k + 1
    return t_ns.shape[0]


def refusal(t_ns: int, force: Reading, rate: Reading, max_force: float) -> Refused:
    """Return why a reading is not usable."""
    if t_ns <= 0:
        return Refused("imu: zero stamp", "header.stamp is zero: the driver must set it")
    if not np.all(np.isfinite((*force, *rate))):
        return Refused("imu: not finite", "NaN or inf in the reading: check the driver")
    if not any(force):
        return Refused(
            "imu: no acceleration",
            "linear_acceleration is exactly zero: does the driver fill it?",
        )
    if max(map(abs, force)) > max_force:
        return Refused(
            "imu: absurd acceleration",
            f"{max(map(abs, force)):.0f} m/s² exceeds imu.max_specific_force: check the unit, "
            "or raise it",
        )
    return Refused(
        "imu: absurd rate",
        f"{max(map(abs, rate)):.0f} rad/s exceeds imu.max_angular_rate: is the rate given in "
        "degrees?",
    )
