"""
Admission of Imu readings: one rule for one reading and for many, live and of recordings.

A reading is used if it says what it should, was measured, and has a stamp that follows, as
`ImuStampCheck` decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.filter.ins_filter import NEVER_NS
from hybrid_ins.core.imu.straight_line import LASTING_NS, follows_line, no_line
from hybrid_ins.core.navigator.stamp_check import ImuStampCheck
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import Refused, unusable_stamp
from hybrid_ins.ros.reporting.wording import STAMP_FAULTS

Array = NDArray[np.float64]
Reading = tuple[float, float, float]

NO_READING = Refused(
    "imu: no reading",
    "covariance[0] is -1: the message says that it carries no acceleration or no angular rate",
)
INTERPOLATED = Refused(
    "imu: interpolated",
    f"all axes follow a straight line for more than {LASTING_NS * 1e-9:g} s: a gap that was "
    "filled, and not measured; it is treated as a gap",
)
USABLE, USELESS, NOT_MEASURED = range(3)  # what `judge` returns


class ImuAdmission:
    """
    Decides which Imu readings are used.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    stamps : ImuStampCheck
        Where the IMU is; its owner sets ``last_ns`` to the stamp of each reading that is used.
    """

    def __init__(self, values: Mapping[str, Any], stamps: ImuStampCheck) -> None:
        self._limits = values["imu.max_specific_force"], values["imu.max_angular_rate"]
        self._stamps = stamps
        self._line = no_line()

    def refused(self, imu: ImuFields, t_ns: int) -> Refused | None:
        """Return why a reading of a stamp [ns] is useless by itself, or None."""
        if imu.specific_force_cov0 == -1.0 or imu.angular_rate_cov0 == -1.0:
            return NO_READING
        force, rate = imu.specific_force, imu.angular_rate
        judged = judge(t_ns, force, rate, *self._limits, *self._line)
        if judged == USABLE:
            return None
        if judged == NOT_MEASURED:
            return INTERPOLATED
        return refusal(t_ns, force, rate, self._limits[0])

    def end_of_stretch(
        self, t_ns: NDArray[np.int64], force: Array, rate: Array, start: int, until_ns: int
    ) -> int:
        """Return the end of the readings from ``start`` on that need no check, see the kernel."""
        last_ns, steady_ns = self._stamps.last_ns, self._stamps.steady_ns
        rules = *self._limits, *self._line
        return int(end_of_stretch(t_ns, force, rate, start, last_ns, steady_ns, until_ns, *rules))


@dataclass(frozen=True, eq=False)
class AdmittedReadings:
    """Which readings of a recording are used, and why the others are not."""

    rows: NDArray[np.int64]  # (M,) their numbers
    refused: list[tuple[int, Refused]]  # how many for each reason, and the first of them


def admitted_readings(
    values: Mapping[str, Any],
    t_ns: NDArray[np.int64],
    force: Array,
    rate: Array,
    has_reading: NDArray[np.bool_],
) -> AdmittedReadings:
    """
    Return which readings of a recording the estimator uses, where all are of one frame.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    t_ns : ndarray, shape (N,)
        Stamps [ns].
    force, rate : ndarray, shape (N, 3)
        Specific force [m/s²] and angular rate [rad/s] in the IMU's own axes.
    has_reading : ndarray, shape (N,)
        False where the message says that it carries none.
    """
    stamps = ImuStampCheck(values["imu.max_gap"])
    admission = ImuAdmission(values, stamps)
    given = np.flatnonzero(has_reading)
    t_ns, force, rate = t_ns[given], force[given], rate[given]
    used = np.zeros(len(given), bool)
    counts: dict[str, tuple[int, Refused]] = {}
    if missing := len(has_reading) - len(given):
        counts[NO_READING.name] = missing, NO_READING
    k = 0
    while k < len(given):
        end = admission.end_of_stretch(t_ns, force, rate, k, NEVER_NS)
        if end == k:
            end, now_ns = k + 1, int(t_ns[k])
            imu = ImuFields(now_ns, tuple(force[k].tolist()), tuple(rate[k].tolist()), "")
            refused = admission.refused(imu, now_ns)
            if refused is None and (fault := stamps.check(now_ns)) is not None:
                refused = STAMP_FAULTS[fault]
            if refused is not None:
                count, first = counts.get(refused.name, (0, refused))
                counts[refused.name] = count + 1, first
                k = end
                continue
        used[k:end] = True
        stamps.last_ns = int(t_ns[end - 1])
        k = end
    return AdmittedReadings(given[used], list(counts.values()))


@kernel(allocates=False)
def judge(  # type: ignore[no-untyped-def]
    t_ns, force, rate, max_force, max_rate, line_stamps, line_readings
):
    """
    Return whether a reading is USABLE, USELESS by itself, or NOT_MEASURED.

    Parameters
    ----------
    t_ns : int
        Stamp [ns].
    force, rate : tuple of float or ndarray, shape (3,)
        Specific force [m/s²] and angular rate [rad/s] in the IMU's own axes.
    max_force, max_rate : float
        Largest values.
    line_stamps, line_readings : ndarray
        Of the `Line` of the readings before; overwritten.
    """
    fx, fy, fz = force[0], force[1], force[2]
    wx, wy, wz = rate[0], rate[1], rate[2]
    # A NaN fails every comparison.
    if not (
        -max_force <= fx <= max_force
        and -max_force <= fy <= max_force
        and -max_force <= fz <= max_force
        and -max_rate <= wx <= max_rate
        and -max_rate <= wy <= max_rate
        and -max_rate <= wz <= max_rate
        and t_ns > 0
        and (fx != 0.0 or fy != 0.0 or fz != 0.0)
    ):
        return USELESS
    is_on_line = follows_line(line_stamps, line_readings, t_ns, (fx, fy, fz, wx, wy, wz))
    return NOT_MEASURED if is_on_line else USABLE


@kernel(allocates=False)
def end_of_stretch(  # type: ignore[no-untyped-def]
    t_ns,
    force,
    rate,
    start,
    last_ns,
    steady_ns,
    until_ns,
    max_force,
    max_rate,
    line_stamps,
    line_readings,
):
    """
    Return the row behind the usable readings that follow each other from ``start`` on.

    Parameters
    ----------
    t_ns, force, rate : ndarray, shape (N,), (N, 3), (N, 3)
        Stamps [ns] and readings, as in `judge`.
    start, last_ns : int
        First row, and the stamp before it [ns].
    steady_ns : int
        Longest step from stamp to stamp [ns].
    until_ns : int
        The first row at or after this stamp [ns] is the last one.
    max_force, max_rate, line_stamps, line_readings
        See `judge`.
    """
    line = line_stamps, line_readings
    for k in range(start, t_ns.shape[0]):
        if not 0 < t_ns[k] - last_ns <= steady_ns:
            return k
        if judge(t_ns[k], force[k], rate[k], max_force, max_rate, *line) != USABLE:
            return k
        last_ns = t_ns[k]
        if last_ns >= until_ns:
            return k + 1
    return t_ns.shape[0]


def refusal(t_ns: int, force: Reading, rate: Reading, max_force: float) -> Refused:
    """Return why a reading is not usable."""
    if t_ns <= 0:
        return unusable_stamp("imu", t_ns)
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
