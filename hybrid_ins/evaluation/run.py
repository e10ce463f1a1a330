"""One run of the filter as arrays: estimate, truth, fixes and verdicts, biases and noise levels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory


@dataclass(frozen=True)
class Topics:
    """Topic names in the bags."""

    odometry: str = "/odometry"
    truth: str = "/truth/odometry"
    truth_datum: str = "/truth/datum"
    datum: str = "/datum"
    fix: str = "/gnss/fix"
    verdict: str = "/gnss/verdict"
    bias: str = "/imu/bias"
    accelerometer_noise: str = "/q/accelerometer"
    gyroscope_noise: str = "/q/gyroscope"
    diagnostics: str = "/diagnostics"


@dataclass(frozen=True, eq=False)
class Fixes:
    """Valid GNSS positions, in the order of their stamps."""

    stamp_ns: Stamps  # (N,) reference clock
    lla: Array  # (N, 3) rad, rad, m; the height may be NaN

    @classmethod
    def none(cls) -> Fixes:
        """Return an empty table."""
        return cls(np.empty(0, np.int64), np.empty((0, 3)))

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True, eq=False)
class Verdicts:
    """The filter's decision on each fix, in the order of their stamps."""

    stamp_ns: Stamps  # (N,) of the fix, reference clock
    kind: NDArray[np.str_]  # (N,) "position" or "velocity"
    accepted: NDArray[np.bool_]  # (N,)
    reason: NDArray[np.str_]  # (N,) of the rejection
    nis: Array  # (N,) NaN where the fix was rejected before the chi-square test
    dof: Array  # (N,)
    threshold: Array  # (N,) of the chi-square test
    time_offset: Array  # (N,) s, added to the fix's stamp to reach the IMU clock

    _TYPES: ClassVar[dict[str, type]] = {"stamp_ns": np.int64, "accepted": bool, "kind": np.str_,
                                         "reason": np.str_}  # fmt: skip

    @classmethod
    def of(cls, rows: Iterable[tuple[int, str, bool, str, float, float, float, float]]) -> Verdicts:
        """Build from tuples in the order of the fields."""
        columns = list(zip(*sorted(rows, key=lambda row: row[0]), strict=True)) or [()] * 8
        names = [f.name for f in fields(cls)]
        return cls(
            *(
                np.array(column, cls._TYPES.get(name, float))
                for name, column in zip(names, columns, strict=True)
            )
        )

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def rows(self, keep: NDArray[np.bool_]) -> Verdicts:
        """Return the verdicts that `keep` selects."""
        return Verdicts(*(getattr(self, f.name)[keep] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Series:
    """Three components over time, base_link (FLU) axes."""

    stamp_ns: Stamps  # (N,) IMU clock
    values: Array  # (N, 3)
    sigma: Array | None = None  # (N, 3) the filter's own standard deviation


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Biases and noise variances of an IMU, estimated or true."""

    accelerometer_bias: Series | None = None  # m/s^2
    gyroscope_bias: Series | None = None  # rad/s
    accelerometer_noise: Series | None = None  # per-sample variance, (m/s^2)^2
    gyroscope_noise: Series | None = None  # per-sample variance, (rad/s)^2


@dataclass(frozen=True, eq=False)
class Run:
    """One run of the filter, as far as it was recorded."""

    name: str
    estimate: Trajectory  # from when its heading is known, where it ever was
    truth: Trajectory | None = None  # stamps in the reference clock, unless it is the IMU's
    fixes: Fixes = field(default_factory=Fixes.none)
    verdicts: Verdicts = field(default_factory=lambda: Verdicts.of(()))
    sensor_errors: SensorErrors = field(default_factory=SensorErrors)
    true_sensor_errors: SensorErrors = field(default_factory=SensorErrors)  # of a simulation
    noise_source: tuple[tuple[int, str], ...] = ()  # (stamp_ns, name) at each change
    notes: tuple[str, ...] = ()
    truth_topic: str = Topics.truth
    positions: Trajectory | None = None  # the estimate with the epochs before, if there are some
