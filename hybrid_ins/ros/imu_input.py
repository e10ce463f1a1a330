"""
Imu readings into the navigator and odometry out of it, one by one and many at a time.

Both ways admit readings by `is_usable` and by the navigator's check of stamps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.navigator import Navigator
from hybrid_ins.core.navigator_events import RestartCause
from hybrid_ins.core.samples import SAMPLE_DTYPE
from hybrid_ins.core.state import N_NAV
from hybrid_ins.ros.conversions import Refused
from hybrid_ins.ros.input_log import InputLog
from hybrid_ins.ros.odometry import OdometrySource
from hybrid_ins.ros.reports import Odometry, OdometryBlock
from hybrid_ins.ros.sensor_placement import SensorPlacement
from hybrid_ins.ros.wording import STAMP_FAULTS

Array = NDArray[np.float64]
Reading = tuple[float, float, float]

NO_READING = Refused(
    "imu: no reading",
    "covariance[0] is -1: the message says that it carries no acceleration or no angular rate",
)


class ImuInput:
    """
    Hands readings to a navigator.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    placement : SensorPlacement
        Rotates readings into b.
    odometry : OdometrySource
        Makes odometry of the navigator's filter.
    inputs : InputLog
        Counts what is refused.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        placement: SensorPlacement,
        odometry: OdometrySource,
        inputs: InputLog,
    ) -> None:
        self._limits = (
            float(values["imu.max_specific_force"]),
            float(values["imu.max_angular_rate"]),
        )
        self._navigator = navigator
        self._placement = placement
        self._odometry = odometry
        self._inputs = inputs

    def use(self, t_ns: int, force: Reading, rate: Reading) -> Odometry | None:
        """
        Use a reading in the IMU's own axes.

        Parameters
        ----------
        t_ns : int
            Stamp [ns].
        force, rate : tuple of float
            Specific force [m/s²] and angular rate [rad/s].

        Returns
        -------
        Odometry or None
            None where the reading is refused, or no filter runs.
        """
        fx, fy, fz = force
        wx, wy, wz = rate
        if not is_usable(t_ns, fx, fy, fz, wx, wy, wz, *self._limits):
            self._inputs.count_and_warn("imu/data", refusal(t_ns, force, rate, self._limits[0]))
            return None
        xx, xy, xz, yx, yy, yz, zx, zy, zz = self._placement.mount_rows
        navigator = self._navigator
        fault = navigator.imu(
            t_ns,
            xx * fx + xy * fy + xz * fz,
            yx * fx + yy * fy + yz * fz,
            zx * fx + zy * fy + zz * fz,
            xx * wx + xy * wy + xz * wz,
            yx * wx + yy * wy + yz * wz,
            zx * wx + zy * wy + zz * wz,
        )
        if fault is not None:
            self._inputs.count_and_warn("imu/data", STAMP_FAULTS[fault])
            return None
        running = navigator.filter
        if running is None or self._odometry.map is None:
            return None
        rate_variance = running.noise.levels()[3:]
        odometry = self._odometry.make(t_ns, running.nav, self._placement.arm_b, rate_variance)
        if odometry is None:
            navigator.give_up(RestartCause.NOT_FINITE)
        return odometry

    def end_of_stretch(
        self, t_ns: NDArray[np.int64], force: Array, rate: Array, start: int, until_ns: int
    ) -> int:
        """Return the end of the rows for `use_stretch`, see `end_of_stretch`."""
        running = self._navigator.filter
        if running is None or self._odometry.map is None:
            return start
        stamps = self._navigator.stamps
        until_ns = min(until_ns, running.next_event_ns)
        return int(
            end_of_stretch(
                t_ns, force, rate, start, stamps.last_ns, stamps.steady_ns, until_ns, *self._limits
            )
        )

    def use_stretch(
        self, t_ns: NDArray[np.int64], force: Array, rate: Array
    ) -> OdometryBlock | None:
        """Use readings (N,), (N, 3), (N, 3) up to `end_of_stretch`, as `use` would one by one."""
        running, mount = self._navigator.filter, self._placement.mount
        assert running is not None
        samples = np.empty(len(t_ns), SAMPLE_DTYPE)
        samples["t_ns"] = t_ns
        samples["f"], samples["w"] = force @ mount.T, rate @ mount.T
        rows = np.empty((len(t_ns), N_NAV))
        self._navigator.imu_block(samples, rows)
        rate_variance = running.noise.levels()[3:]
        block = self._odometry.make_block(t_ns, rows, self._placement.arm_b, rate_variance)
        if block is None:
            self._navigator.give_up(RestartCause.NOT_FINITE)
        return block


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
