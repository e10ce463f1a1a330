"""Whether a recording suffices for calibration: the IMU's stamps and units, and enough fixes."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.stamps import stamps_of
from hybrid_ins.core.imu.health import FaultKind, ImuFault, find_fault
from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.errors import InputError
from hybrid_ins.ros.reporting.wording import describe_fault

Array = NDArray[np.float64]

FEWEST_SAMPLES = 100
FEWEST_FIXES = 15
SHORTEST_SPAN = 8.0  # s of fixes
WINDOW = 1.0  # s of samples that show a fault of the IMU
LASTING = 0.5  # share of the windows: falls and stuck readings are shorter in a usable recording
TURNING = 0.1  # share of the windows that show degrees, which only fast turns do


def check_stamps(stamps: NDArray[np.int64], place: str) -> None:
    """
    Refuse an IMU whose stamps (N,) [ns] its driver does not set; ``place`` heads the error.

    Raises
    ------
    InputError
        Most of the stamps are zero, or negative.
    """
    missing = int(np.sum(stamps <= 0))
    if 2 * missing > len(stamps):
        raise InputError(
            f"{place}: header.stamp is zero or negative in {missing} of {len(stamps)} samples: let "
            "the IMU's driver set it, and record again"
        )


def check_imu(t: Array, samples: Array, place: str) -> None:
    """
    Refuse an IMU that no filter can use.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Times [s], the first of them 0.
    samples : ndarray, shape (N, 6)
        Specific force [m/s²] and angular rate [rad/s].
    place : str
        Heads the error: the bag and the topic.

    Raises
    ------
    InputError
        Units are wrong, gravity is missing, or the readings are stuck, for much of the time.
    """
    table = as_samples(stamps_of(t), samples[:, :3], samples[:, 3:])
    edges = np.searchsorted(t, np.arange(0.0, t[-1], WINDOW)).tolist()
    windows = [
        find_fault(table[begin:end]) for begin, end in zip(edges, [*edges[1:], len(t)], strict=True)
    ]
    faults = [fault for fault in windows if fault is not None and fault.unusable]
    fault = _lasting(faults, len(windows))
    if fault is not None:
        raise InputError(f"{place}: {describe_fault(fault)}")


def _lasting(faults: list[ImuFault], windows: int) -> ImuFault | None:
    """Return one of the faults of the kind that most windows show, where they are enough."""
    if not faults:
        return None
    [(kind, count)] = Counter(fault.kind for fault in faults).most_common(1)
    share = TURNING if kind is FaultKind.DEGREES else LASTING
    alike = sorted((fault for fault in faults if fault.kind is kind), key=lambda one: one.value)
    return alike[len(alike) // 2] if count >= share * windows else None


def check_fixes(fixes: Array, others: int, length: float, place: str) -> None:
    """
    Refuse a recording that is too short or has too few fixes.

    Parameters
    ----------
    fixes : ndarray, shape (M,)
        Times of those near the IMU's samples, in order [s].
    others : int
        Fixes that are farther from them.
    length : float
        Time of the IMU's samples [s].
    place : str
        Heads the error: the bag.

    Raises
    ------
    InputError
        Says what is too little.
    """
    if length < SHORTEST_SPAN:
        raise InputError(
            f"{place}: the IMU's samples span {length:.1f} s without a gap: calibration needs "
            f"{SHORTEST_SPAN:g} s; record half a minute or more"
        )
    if len(fixes) < FEWEST_FIXES:
        elsewhere = (
            f", and {others} more are stamped outside these: do both clocks have one epoch?"
            if others
            else "; record half a minute or more"
        )
        raise InputError(
            f"{place}: {len(fixes)} usable fixes within {length:.0f} s of IMU samples: calibration "
            f"needs {FEWEST_FIXES}{elsewhere}"
        )
    span = float(fixes[-1] - fixes[0])
    if span < SHORTEST_SPAN:
        raise InputError(
            f"{place}: the {len(fixes)} usable fixes span {span:.1f} s of {length:.0f} s of IMU "
            f"samples: calibration needs {SHORTEST_SPAN:g} s of fixes"
        )


def check_rest(fixes: Array, length: float, search: float, is_cut: bool, place: str) -> None:
    """
    Refuse options that leave too little of a recording.

    Parameters
    ----------
    fixes : ndarray, shape (M,)
        Times of the fixes that are left, in order [s].
    length : float
        Time of the IMU's samples that are used [s].
    search : float
        Clock offsets within this of the nominal one are searched [s].
    is_cut : bool
        The recording is longer than what is used.
    place : str
        Heads the error: the bag.

    Raises
    ------
    InputError
        Names the option, its value and its bound.
    """
    span = float(fixes[-1] - fixes[0]) if len(fixes) else 0.0
    if len(fixes) >= FEWEST_FIXES and span >= SHORTEST_SPAN:
        return
    interval = span / (len(fixes) - 1) if len(fixes) > 1 else 0.0
    needed = max(SHORTEST_SPAN, FEWEST_FIXES * interval) + max(interval, 0.5)
    most = math.floor(5.0 * (length - needed)) / 10.0
    if is_cut:
        remedy = f"give --longest at least {math.ceil(needed + 2.0 * search)}"
    elif most > 0.0:
        remedy = f"give --search at most {most:g}"
    else:
        remedy = "record half a minute or more"
    raise InputError(
        f"{place}: {len(fixes)} fixes over {span:.1f} s are left of the {length:.0f} s that are "
        f"used, by a search for clock offsets within ±{search:g} s: calibration needs "
        f"{FEWEST_FIXES} over {SHORTEST_SPAN:g} s: {remedy}"
    )
