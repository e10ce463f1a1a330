"""What an estimator published over a flight, its errors, and what is wrong with it."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.ros.messages.trajectory import trajectory_from_odometry

INPUTS = ("/gnss/fix", "/gnss/velocity")  # that a replay may carry over
ODOMETRY = struct.Struct("<4xiI")
SHORT = 0.1  # s between two estimates that a truth epoch may lie between


@dataclass(frozen=True)
class Trace:
    """Position error of a run at the truth's epochs."""

    t: np.ndarray[Any, Any]  # (K,) s since the flight's begin
    error: np.ndarray[Any, Any]  # (K,) m; NaN where there is no estimate

    def after(self, t: float) -> tuple[float, float]:
        """RMS error [m] and share of epochs that have an estimate, from a time [s] on."""
        error = self.error[self.t >= t]
        found = np.isfinite(error)
        rms = float(np.sqrt(np.mean(error[found] ** 2))) if found.any() else math.nan
        return rms, float(np.mean(found)) if len(found) else 0.0

    def largest(self, start: float, stop: float) -> float:
        """Largest error [m] in a stretch."""
        error = self.error[(self.t >= start) & (self.t < stop)]
        return float(np.nanmax(error)) if np.isfinite(error).any() else math.nan


@dataclass(frozen=True)
class Output:
    """What an estimator published, and what is wrong with it."""

    trace: Trace
    said: tuple[str, ...]
    faults: tuple[str, ...]
    odometry: int


def examine(path: Path, truth_path: Path, origin_ns: int, offset: float, shift: float) -> Output:
    """
    Read what was published over a flight.

    Parameters
    ----------
    path, truth_path : Path
        Bags of the estimate and of the truth.
    origin_ns : int
        Stamp at which times count from zero.
    offset : float
        Added to the truth's stamps [s].
    shift : float
        Taken from all stamps [s].
    """
    problems: list[str] = []
    said: list[str] = []
    with BagReader(path) as bag:
        estimate = _odometry(bag, "/odometry", problems)
        _odometry(bag, "/odometry/local", problems)
        others = [topic for topic in bag.topics if not topic.startswith(("/odometry", "/truth"))]
        datum = None
        for topic, _, message in bag.messages(*others):
            if topic == "/diagnostics":
                for status in message.status:
                    said.append(status.message)
                    said += [f"{item.key} ×{item.value}" for item in status.values]
            elif topic == "/gnss/verdict":
                said += _verdict(message)
            elif topic == "/datum":
                datum = message
            elif topic not in INPUTS and not all(map(math.isfinite, _numbers(message))):
                problems.append(f"NaN on {topic}")
    with BagReader(truth_path) as bag:
        truth = _odometry(bag, "/truth/odometry", [])
        [place] = [message for _, _, message in bag.messages("/truth/datum")][-1:]
    stamp_ns, rows = _last_pass(*truth)
    track = replace(trajectory_from_odometry(stamp_ns, rows)[0], datum_lla=_lla(place))
    if datum is not None:
        track = track.in_map_of(_lla(datum))
    t_ns = track.stamp_ns + round(offset * 1e9)
    error = np.full(len(t_ns), math.nan)
    at, found = _last_pass(*estimate)
    if len(at) > 1:
        right = np.clip(np.searchsorted(at, t_ns), 1, len(at) - 1)
        near = (at[right] - at[right - 1] < SHORT * 1e9) & (t_ns >= at[0]) & (t_ns <= at[-1])
        position = np.stack([np.interp(t_ns, at, found[:, i]) for i in range(3)], axis=1)
        error[near] = np.linalg.norm(position - track.position_enu, axis=1)[near]
    t = (t_ns - origin_ns) * 1e-9 - shift
    return Output(
        Trace(t, error),
        tuple(dict.fromkeys(said)),
        tuple(dict.fromkeys(problems)),
        len(estimate[0]),
    )


def _odometry(bag: BagReader, topic: str, problems: list[str]) -> tuple[Any, Any]:
    data = [message for _, _, message in bag.raw(topic)] if topic in bag.topics else []
    stamps = np.array([s * 10**9 + n for s, n in (ODOMETRY.unpack_from(d) for d in data)], np.int64)
    rows = np.frombuffer(b"".join(bytes(d[-680:]) for d in data), "<f8").reshape(-1, 85)
    if not np.all(np.isfinite(rows)):
        problems.append(f"NaN on {topic}")
    elif len(rows) and not topic.startswith("/truth"):
        for name, part in (("pose", rows[:, 7:43]), ("twist", rows[:, 49:85])):
            if np.linalg.eigvalsh(part.reshape(-1, 6, 6)).min() <= 0.0:
                problems.append(f"{topic}: a {name} covariance is not positive definite")
    return stamps, rows


def _verdict(message: Any) -> list[str]:
    said = {item.key: item.value for item in message.values}
    return [
        said["reason"],
        f"verdict dof {said['dof']}",
        f"verdict sigma_e {float(said['sigma_e']):.3g}",
        f"verdict age {float(said['age']):.1f}",
    ]


def _numbers(message: Any) -> Iterable[float]:
    """All floating-point numbers of a message."""
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if isinstance(value, float):
            yield value
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            yield from value.tolist()
        elif hasattr(value, "__dataclass_fields__"):
            yield from _numbers(value)


def _lla(place: Any) -> np.ndarray[Any, Any]:
    return np.array([math.radians(place.latitude), math.radians(place.longitude), place.altitude])


def _last_pass(stamps: Any, rows: Any) -> tuple[Any, Any]:
    """Keep what follows the last step back in time."""
    back = np.flatnonzero(np.diff(stamps) < 0)
    start = int(back[-1]) + 1 if len(back) else 0
    return stamps[start:], rows[start:]
