"""
The result of an evaluation: the figures of one run.

References
----------
.. [1] B. Or, I. Klein, *A Hybrid Model and Learning-Based Adaptive Navigation Filter*, IEEE TIM
       71, 2022: eq. 25 (PRMSE), eq. 26 (PMAE).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.evaluation.statistics import Consistency
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory

GNSS_CLOCK, IMU_CLOCK = "gnss", "imu"


@dataclass(frozen=True)
class Scoring:
    """Which epochs are scored. Times [s]; `start` and `end` from the first truth epoch."""

    skip: float = 0.0  # after the first epoch that has an estimate
    start: float | None = None
    end: float | None = None
    time_offset: float | None = None  # added to truth and fix stamps; None: that of the verdicts
    include_fed: bool = False  # also score epochs at the stamps of fixes
    max_gap: float = 0.25  # longest between two estimates to interpolate
    outage_gap: float = 3.0  # shortest outage; it also exceeds 3 fix intervals
    truth_clock: str = GNSS_CLOCK  # or IMU_CLOCK, of which the truth's stamps are


@dataclass(frozen=True)
class Epochs:
    """Counts of the truth epochs between start and end."""

    truth: int  # all of them
    scored: int
    fed: int  # at the stamp of a fix: the filter was given this position
    skipped: int
    uncovered: int  # no estimate before or after, or too far apart
    invalid: int  # NaN in truth or estimate


@dataclass(frozen=True)
class TimeOffset:
    """The clock offset added to the stamps of fixes, and of truth of their clock [s]."""

    mean: float
    low: float
    high: float
    source: str  # "option", "verdicts" or "none"


@dataclass(frozen=True)
class Outage:
    """An interval without accepted fixes; its errors are None where no epoch in it is scored."""

    start: float  # s, last accepted fix before it
    duration: float  # s
    end_error: float | None = None  # m, position error at the last truth epoch in it
    end_horizontal_error: float | None = None  # m
    largest_error: float | None = None  # m, position error at any truth epoch in it


@dataclass(frozen=True)
class FixCount:
    """The filter's decisions on the position fixes within the scored time."""

    total: int
    accepted: int
    refused: dict[str, int]  # by reason


@dataclass(frozen=True, eq=False)
class Errors:
    """True minus estimated at every truth epoch that has an estimate, scored or not."""

    stamp_ns: Stamps  # (N,) IMU clock
    scored: NDArray[np.bool_]  # (N,)
    position_enu: Array  # (N, 3) m, map
    velocity_enu: Array | None  # (N, 3) m/s, map axes
    velocity_base: Array | None  # (N, 3) m/s, each velocity along its own vehicle's axes (FLU)
    rotation_enu: Array | None  # (N, 3) rad, rotation vector about the map axes
    estimate: Trajectory  # interpolated to these epochs
    truth: Trajectory  # in the estimate's map


@dataclass(frozen=True, eq=False)
class Result:
    """The figures of one run; None where a figure cannot be computed."""

    origin_ns: int  # zero of all times: first truth epoch (or estimate), IMU clock
    scoring: Scoring
    epochs: Epochs | None
    coverage: float | None  # share of the truth epochs that have an estimate
    largest_gap: float  # s, between estimates, while there is truth
    time_offset: TimeOffset
    prmse: float | None  # m, [1]_ eq. 25
    pmae: float | None  # m, [1]_ eq. 26
    horizontal_rmse: float | None  # m
    vertical_rmse: float | None  # m
    largest_error: float | None  # m
    velocity_rmse: float | None  # m/s, along the map's axes
    body_velocity_rmse: float | None  # m/s, each velocity along its own vehicle's axes
    attitude_rmse: float | None  # rad, the whole angle
    heading_rmse: float | None  # rad, about the vertical
    tilt_rmse: float | None  # rad, about the horizontal
    nees_position: Consistency | None
    nees_velocity: Consistency | None
    nees_attitude: Consistency | None
    nis_position: Consistency | None  # accepted fixes
    nis_velocity: Consistency | None
    nis_tested: Consistency | None  # all position fixes that were tested, rejected ones included
    fixes: FixCount | None
    outages: tuple[Outage, ...]
    notes: tuple[str, ...]
    errors: Errors | None
    heading_known: bool = True  # at some time: otherwise nothing of it is scored

    def outage_error(self, percentile: float) -> float | None:
        """Return a percentile of the position errors at the ends of outages [m], or None."""
        known = [o.end_error for o in self.outages if o.end_error is not None]
        return float(np.percentile(known, percentile)) if known else None

    @property
    def largest_outage_error(self) -> float | None:
        """Largest position error within the outages [m], or None."""
        known = [o.largest_error for o in self.outages if o.largest_error is not None]
        return max(known, default=None)

    def as_dict(self) -> dict[str, Any]:
        """
        Return all figures as plain numbers for JSON: units in the keys, angles in degrees.

        NaN and infinity, which JSON does not have, become null.

        Returns
        -------
        dict
            ``prmse_m, pmae_m, horizontal_rmse_m, vertical_rmse_m, largest_error_m,
            velocity_rmse_mps, body_velocity_rmse_mps, attitude_rmse_deg, heading_rmse_deg,
            tilt_rmse_deg``: numbers, or null. ``nees_position, nees_velocity, nees_attitude,
            nis_position, nis_velocity, nis_tested``: null or ``{mean, dof, per_dof, count, band,
            effective_count, effective_band, verdict}``, bands of per_dof at 95 %. ``outages``:
            ``{count, end_error_median_m, end_error_p90_m, largest_error_m, each: [{start_s,
            duration_s, end_error_m, end_horizontal_error_m, largest_error_m}]}``. ``fixes``: null
            or ``{total, accepted, refused: {reason: count}}``. ``epochs``: null or ``{truth,
            scored, fed, skipped, uncovered, invalid}``. ``coverage, largest_gap_s``,
            ``time_offset_s``: ``{mean, low, high, source}``. ``scoring``: the options as given.
            ``notes``: list of texts.

        """

        def figures(consistency: Consistency | None) -> dict[str, object] | None:
            return None if consistency is None else consistency.as_dict()

        data = {
            "prmse_m": self.prmse,
            "pmae_m": self.pmae,
            "horizontal_rmse_m": self.horizontal_rmse,
            "vertical_rmse_m": self.vertical_rmse,
            "largest_error_m": self.largest_error,
            "velocity_rmse_mps": self.velocity_rmse,
            "body_velocity_rmse_mps": self.body_velocity_rmse,
            "attitude_rmse_deg": degrees(self.attitude_rmse),
            "heading_rmse_deg": degrees(self.heading_rmse),
            "tilt_rmse_deg": degrees(self.tilt_rmse),
            "nees_position": figures(self.nees_position),
            "nees_velocity": figures(self.nees_velocity),
            "nees_attitude": figures(self.nees_attitude),
            "nis_position": figures(self.nis_position),
            "nis_velocity": figures(self.nis_velocity),
            "nis_tested": figures(self.nis_tested),
            "outages": {
                "count": len(self.outages),
                "end_error_median_m": self.outage_error(50),
                "end_error_p90_m": self.outage_error(90),
                "largest_error_m": self.largest_outage_error,
                "each": [
                    {
                        "start_s": o.start,
                        "duration_s": o.duration,
                        "end_error_m": o.end_error,
                        "end_horizontal_error_m": o.end_horizontal_error,
                        "largest_error_m": o.largest_error,
                    }
                    for o in self.outages
                ],
            },
            "fixes": None if self.fixes is None else asdict(self.fixes),
            "epochs": None if self.epochs is None else asdict(self.epochs),
            "coverage": self.coverage,
            "largest_gap_s": self.largest_gap,
            "time_offset_s": asdict(self.time_offset),
            "scoring": asdict(self.scoring),
            "notes": list(self.notes),
        }
        finite: dict[str, Any] = _finite_only(data)
        return finite


def degrees(angle: float | None) -> float | None:
    """Convert an angle from radians, if it is known."""
    return None if angle is None else math.degrees(angle)


def _finite_only(value: Any) -> Any:
    """Replace NaN and infinity by None."""
    if isinstance(value, dict):
        return {key: _finite_only(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_only(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
