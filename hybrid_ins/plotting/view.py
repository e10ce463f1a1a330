"""A run prepared for drawing: times from its origin, positions in one map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.evaluation.result import IMU_CLOCK, Result
from hybrid_ins.evaluation.run import Run
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory, enu_from_lla


class RunView:
    """
    A run and its evaluation.

    Attributes
    ----------
    run, result
        As given.
    estimate : Trajectory
        In the map drawn: at first that of the run.
    truth : Trajectory or None
        In the same map where the datums are known.
    origin_ns : int
        Zero of all times, IMU clock [ns]: at first that of the result.
    """

    def __init__(self, run: Run, result: Result) -> None:
        self.run = run
        self.result = result
        self.estimate = run.estimate
        self.truth: Trajectory | None = run.truth
        self.origin_ns = result.origin_ns
        self.set_map(run.estimate.datum_lla)

    def set_map(self, datum_lla: Array | None) -> None:
        """Express estimate and truth in the map of a datum, as far as theirs are known."""
        if datum_lla is None:
            return
        if self.estimate.datum_lla is not None:
            self.estimate = self.estimate.in_map_of(datum_lla)
        if self.truth is not None and self.truth.datum_lla is not None:
            self.truth = self.truth.in_map_of(datum_lla)

    def set_origin(self, origin_ns: int) -> None:
        """Count times from another stamp of the IMU clock [ns]."""
        self.origin_ns = origin_ns

    @property
    def seconds(self) -> Array:
        """Times of the estimate [s], shape (N,)."""
        return self.since(self.estimate.stamp_ns)

    @property
    def error_seconds(self) -> Array | None:
        """Times of the errors [s], shape (M,), where there is truth."""
        return None if self.result.errors is None else self.since(self.result.errors.stamp_ns)

    def span(self) -> tuple[float, float]:
        """Return begin and end of the time axis [s]."""
        first, last = min(0.0, float(self.seconds[0])), float(self.seconds[-1])
        if self.error_seconds is not None:
            last = max(last, float(self.error_seconds[-1]))
        margin = 0.01 * (last - first)
        return first - margin, last + margin

    @property
    def scored(self) -> NDArray[np.bool_] | None:
        """Which epochs of the errors are scored, shape (M,)."""
        return None if self.result.errors is None else self.result.errors.scored

    def since(self, stamp_ns: Stamps) -> Array:
        """Return times [s] from the origin; stamps of the IMU clock."""
        return np.asarray((stamp_ns - self.origin_ns) * 1e-9, float)

    def to_imu(self, stamp_ns: Stamps) -> Stamps:
        """Convert stamps of the reference clock to the IMU clock by the mean offset."""
        return stamp_ns + round(1e9 * self.result.time_offset.mean)

    def truth_stamp_ns(self, truth: Trajectory) -> Stamps:
        """Return the truth's stamps in the IMU clock."""
        is_imu = self.result.scoring.truth_clock == IMU_CLOCK
        return truth.stamp_ns if is_imu else self.to_imu(truth.stamp_ns)

    def outages(self) -> list[tuple[float, float]]:
        """Return start and end of each outage [s]."""
        later = (self.result.origin_ns - self.origin_ns) * 1e-9
        return [(o.start + later, o.start + later + o.duration) for o in self.result.outages]

    def scoring_start(self) -> float:
        """Return the time of the first scored epoch [s]."""
        errors = self.result.errors
        if errors is None:
            return float(self.seconds[0]) + self.result.scoring.skip
        return float(self.since(errors.stamp_ns[errors.scored][:1])[0])

    def error(
        self, quantity: str, part: slice | list[int]
    ) -> tuple[Array, Array | None, Array | None]:
        """
        Return times, an error and its stated standard deviation.

        Parameters
        ----------
        quantity : str
            ``position`` [m, map], ``velocity`` [m/s, base_link] or ``attitude`` [rad, map].
        part : slice or list of int
            Its components.

        Returns
        -------
        at : ndarray, shape (M,)
            [s]; those of the estimate where there is no truth.
        error, sigma : ndarray, shape (M, components), or None
            NaN where not known; None of a heading that never was.
        """
        if quantity == "attitude" and 2 in np.arange(3)[part] and not self.result.heading_known:
            return self.seconds, None, None
        errors = self.result.errors
        source = self.run.estimate if errors is None else errors.estimate
        covariance = getattr(source, f"{quantity}_cov")
        sigma = None
        if covariance is not None:
            variance = np.diagonal(covariance, axis1=1, axis2=2)[:, part]
            known = np.isfinite(variance) & (variance > 0.0)
            sigma = np.sqrt(np.where(known, variance, np.nan))
        if errors is None or self.error_seconds is None:
            return self.seconds, None, sigma
        name = {"attitude": "rotation_enu", "velocity": "velocity_base"}.get(
            quantity, "position_enu"
        )
        error = getattr(errors, name)
        return self.error_seconds, None if error is None else error[:, part], sigma

    def start_position(self) -> Array:
        """Return the first position (3,) [m] of truth, fixes and estimate: the run's start."""
        fixes, _ = self.fix_positions()
        first: list[tuple[int, Array]] = [
            (int(self.estimate.stamp_ns[0]), self.estimate.position_enu[0])
        ]
        if len(fixes):
            first.append((int(self.to_imu(self.run.fixes.stamp_ns[:1])[0]), fixes[0]))
        if self.truth is not None:
            first.append((int(self.truth_stamp_ns(self.truth)[0]), self.truth.position_enu[0]))
        return min(first, key=lambda stamped: stamped[0])[1]

    def fix_positions(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return the fixes in the map (K, 3) [m] and which were accepted (by default, all)."""
        fixes, verdicts = self.run.fixes, self.run.verdicts
        datum = self.estimate.datum_lla
        if datum is None and self.truth is not None:
            datum = self.truth.datum_lla
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
