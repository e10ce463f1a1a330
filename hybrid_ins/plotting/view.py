"""A run prepared for drawing: times from its origin, positions in one map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.evaluation.result import Result
from hybrid_ins.evaluation.run import Run
from hybrid_ins.ros.trajectory import Array, Stamps, Trajectory, enu_from_lla


class RunView:
    """
    A run and its evaluation.

    Attributes
    ----------
    run, result
        As given.
    seconds : ndarray, shape (N,)
        Times of the estimate [s] from the origin of the result.
    error_seconds : ndarray, shape (M,), or None
        Times of the errors [s], where there is truth.
    truth : Trajectory or None
        In the map of the estimate where both datums are known.
    """

    def __init__(self, run: Run, result: Result) -> None:
        self.run = run
        self.result = result
        self.seconds = self.since(run.estimate.stamp_ns)
        errors = result.errors
        self.error_seconds = None if errors is None else self.since(errors.stamp_ns)
        self.truth: Trajectory | None = run.truth
        datum_lla = run.estimate.datum_lla
        if self.truth is not None and self.truth.datum_lla is not None and datum_lla is not None:
            self.truth = self.truth.in_map_of(datum_lla)

    @property
    def scored(self) -> NDArray[np.bool_] | None:
        """Which epochs of the errors are scored, shape (M,)."""
        return None if self.result.errors is None else self.result.errors.scored

    def since(self, stamp_ns: Stamps) -> Array:
        """Return times [s] from the origin of the result; stamps of the IMU clock."""
        return np.asarray((stamp_ns - self.result.origin_ns) * 1e-9, float)

    def to_imu(self, stamp_ns: Stamps) -> Stamps:
        """Convert stamps of the reference clock to the IMU clock by the mean offset."""
        return stamp_ns + round(1e9 * self.result.time_offset.mean)

    def outages(self) -> list[tuple[float, float]]:
        """Return start and end of each outage [s]."""
        return [(o.start, o.start + o.duration) for o in self.result.outages]

    def scoring_start(self) -> float:
        """Return the time of the first scored epoch [s]."""
        errors = self.result.errors
        if errors is None:
            return float(self.seconds[0]) + self.result.scoring.skip
        return float(self.since(errors.stamp_ns[errors.scored][:1])[0])

    def fix_positions(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return the fixes in the map (K, 3) [m] and which were accepted (by default, all)."""
        fixes, verdicts = self.run.fixes, self.run.verdicts
        datum = self.run.estimate.datum_lla
        if datum is None and self.run.truth is not None:
            datum = self.run.truth.datum_lla
        if datum is None or not len(fixes):
            return np.empty((0, 3)), np.empty(0, bool)
        # Before the first estimate no fix could be fused: those are not shown as rejected.
        running = self.since(self.to_imu(verdicts.stamp_ns)) >= self.seconds[0]
        rejected = verdicts.stamp_ns[(verdicts.kind == "position") & ~verdicts.accepted & running]
        lla = fixes.lla.copy()
        no_height = np.isnan(lla[:, 2])
        lla[no_height, 2] = datum[2]
        position = enu_from_lla(lla, datum)
        position[no_height, 2] = np.nan
        return position, ~np.isin(fixes.stamp_ns, rejected)
