"""
What an evaluation says: the figures of one run, for programs, for people and for pictures.

References
----------
.. [1] B. Or, I. Klein, *A Hybrid Model and Learning-Based Adaptive Navigation Filter*, IEEE TIM
       71, 2022: eq. 25 (PRMSE), eq. 26 (PMAE).
"""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.evaluation.statistics import Consistency
from hybrid_ins.ros.trajectory import Array, Stamps, Trajectory

_CORRELATED = (
    "epochs of one run are correlated: the first band is for n independent ones, the second for"
    " the number that these are worth"
)


@dataclass(frozen=True)
class Scoring:
    """Which epochs count. Times in seconds, `start` and `end` from the first truth epoch."""

    skip: float = 0.0  # after the first epoch that has an estimate
    start: float | None = None
    end: float | None = None
    time_offset: float | None = None  # added to truth and fix stamps; None: as the verdicts say
    include_fed: bool = False  # also epochs whose position was fed to the filter
    max_gap: float = 0.25  # between the two estimates that an epoch is interpolated from
    outage_gap: float = 3.0  # without an accepted fix for so long (and for 3 fix intervals)


@dataclass(frozen=True)
class Epochs:
    """What became of the truth epochs between start and end."""

    truth: int  # all of them
    scored: int
    fed: int  # at a fix stamp: the filter was given a measurement of this very position
    skipped: int
    uncovered: int  # no estimate before or after, or too long a gap between them
    invalid: int  # NaN in truth or estimate


@dataclass(frozen=True)
class TimeOffset:
    """What was added to the stamps of truth and fixes [s]."""

    mean: float
    low: float
    high: float
    source: str  # "option", "verdicts" or "none"


@dataclass(frozen=True)
class Outage:
    """A stretch without accepted fixes; its errors are None where none of its end is scored."""

    start: float  # s, last accepted fix before it
    duration: float  # s
    end_error: float | None = None  # m, position error at the last truth epoch in it
    end_horizontal_error: float | None = None  # m


@dataclass(frozen=True)
class FixCount:
    """What the filter did with the position fixes within the scored time."""

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
    """
    The figures of one run. None where there is nothing to compute a figure from.

    `as_dict` documents the keys for programs, `table` is for people, `errors` for pictures.
    """

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
    velocity_rmse: float | None  # m/s
    attitude_rmse: float | None  # rad, the whole angle
    heading_rmse: float | None  # rad, about the vertical
    tilt_rmse: float | None  # rad, about the horizontal
    nees_position: Consistency | None
    nees_velocity: Consistency | None
    nees_attitude: Consistency | None
    nis_position: Consistency | None  # accepted fixes
    nis_velocity: Consistency | None
    nis_tested: Consistency | None  # all position fixes that came to the test, refused ones too
    fixes: FixCount | None
    outages: tuple[Outage, ...]
    notes: tuple[str, ...]
    errors: Errors | None

    def outage_error(self, percentile: float) -> float | None:
        """Percentile of the position errors at outage ends [m]; None where none is known."""
        known = [o.end_error for o in self.outages if o.end_error is not None]
        return float(np.percentile(known, percentile)) if known else None

    def as_dict(self) -> dict[str, Any]:
        """
        Give all figures as plain numbers for JSON: units in the keys, degrees for angles.

        Returns
        -------
        dict
            ``prmse_m, pmae_m, horizontal_rmse_m, vertical_rmse_m, largest_error_m,
            velocity_rmse_mps, attitude_rmse_deg, heading_rmse_deg, tilt_rmse_deg``: numbers, or
            null. ``nees_position, nees_velocity, nees_attitude, nis_position, nis_velocity,
            nis_tested``: null or ``{mean, dof, per_dof, count, band, effective_count,
            effective_band, verdict}``, bands of per_dof at 95 %. ``outages``: ``{count,
            end_error_median_m, end_error_p90_m, each: [{start_s, duration_s, end_error_m,
            end_horizontal_error_m}]}``. ``fixes``: null or ``{total, accepted, refused:
            {reason: count}}``. ``epochs``: null or ``{truth, scored, fed, skipped, uncovered,
            invalid}``. ``coverage, largest_gap_s``, ``time_offset_s``: ``{mean, low, high,
            source}``. ``scoring``: the options as given. ``notes``: list of texts.

        """

        def figures(consistency: Consistency | None) -> dict[str, object] | None:
            return None if consistency is None else consistency.as_dict()

        return {
            "prmse_m": self.prmse,
            "pmae_m": self.pmae,
            "horizontal_rmse_m": self.horizontal_rmse,
            "vertical_rmse_m": self.vertical_rmse,
            "largest_error_m": self.largest_error,
            "velocity_rmse_mps": self.velocity_rmse,
            "attitude_rmse_deg": _degrees(self.attitude_rmse),
            "heading_rmse_deg": _degrees(self.heading_rmse),
            "tilt_rmse_deg": _degrees(self.tilt_rmse),
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
                "each": [
                    {
                        "start_s": o.start,
                        "duration_s": o.duration,
                        "end_error_m": o.end_error,
                        "end_horizontal_error_m": o.end_horizontal_error,
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

    def table(self) -> str:
        """Lay the figures out for a terminal, at most 80 columns."""
        return "\n".join(
            (
                *map(_wrapped, self._scored_lines()),
                *self._accuracy_lines(),
                *self._consistency_lines(),
                *map(_wrapped, self._fix_lines()),
                *(_wrapped(f"note: {note}") for note in self.notes),
            )
        )

    def _scored_lines(self) -> list[str]:
        if self.epochs is None or self.coverage is None:
            return ["no truth: only what the filter says of itself"]
        e, offset = self.epochs, self.time_offset
        left_out = [
            f"{count} {why}"
            for count, why in (
                (e.fed, "at fix stamps"),
                (e.skipped, "skipped"),
                (e.uncovered, "without estimate"),
                (e.invalid, "not finite"),
            )
            if count
        ]
        lines = [
            f"scored {e.scored} of {e.truth} truth epochs"
            + (f"; left out: {', '.join(left_out)}" if left_out else ""),
            f"estimate covers {100 * self.coverage:.1f} % of the truth, largest gap "
            f"{self.largest_gap:.3g} s; skipped {self.scoring.skip:g} s (--skip)",
        ]
        if offset.low or offset.high:
            spread = (
                f" ({offset.low:+.4f} to {offset.high:+.4f})" if offset.high > offset.low else ""
            )
            lines.append(
                f"truth stamps shifted by {offset.mean:+.4f} s{spread}, as given by the "
                f"{offset.source}"
            )
        return lines

    def _accuracy_lines(self) -> list[str]:
        if self.prmse is None:
            return []
        rows = (
            ("PRMSE", self.prmse, "m", (("horizontal", self.horizontal_rmse, "m"),
                                        ("vertical", self.vertical_rmse, "m"))),
            ("PMAE", self.pmae, "m", (("largest", self.largest_error, "m"),)),
            ("velocity RMSE", self.velocity_rmse, "m/s", ()),
            ("attitude RMSE", _degrees(self.attitude_rmse), "deg",
             (("heading", _degrees(self.heading_rmse), "deg"),
              ("tilt", _degrees(self.tilt_rmse), "deg"))),
        )  # fmt: skip
        lines = ["", "accuracy"]
        for name, value, unit, parts in rows:
            line = f"  {name:15}{_figure(value, unit):>12}"
            if value is not None:
                line += "".join(f"   {part} {_figure(v, u)}" for part, v, u in parts)
            lines.append(line)
        return lines

    def _consistency_lines(self) -> list[str]:
        rows = [
            ("position NEES", self.nees_position),
            ("velocity NEES", self.nees_velocity),
            ("attitude NEES", self.nees_attitude),
            ("position NIS", self.nis_position),
            ("velocity NIS", self.nis_velocity),
        ]
        if self.fixes is not None and self.fixes.accepted < self.fixes.total:
            rows.insert(4, ("  with refused", self.nis_tested))
        rows = [row for row in rows if row[1] is not None]
        if not rows:
            return ["", "consistency: no covariances and no verdicts to judge"]
        lines = ["", "consistency         /dof     n  95 % band   worth  95 % band"]
        for name, c in rows:
            assert c is not None
            low, high = c.band
            wide_low, wide_high = c.effective_band
            lines.append(
                f"  {name:15}{c.per_dof:7.3g}{c.count:6d}  {low:4.2f}-{high:4.2f}"
                f"{c.effective_count:8.0f}  {wide_low:4.2f}-{wide_high:<5.2f} {c.verdict}"
            )
        return [*lines, _wrapped(f"({_CORRELATED})", indent="  ")]

    def _fix_lines(self) -> list[str]:
        lines = [""]
        if self.fixes is not None:
            refused = ", ".join(f"{count} {reason}" for reason, count in self.fixes.refused.items())
            lines.append(
                f"fixes: {self.fixes.accepted} of {self.fixes.total} accepted"
                + (f"; refused: {refused}" if refused else "")
            )
        if self.outages:
            lasting = sorted(o.duration for o in self.outages)
            span = f"{lasting[0]:.1f} s" + (
                f" to {lasting[-1]:.1f} s" if lasting[-1] - lasting[0] > 0.05 else ""
            )
            line = f"outages: {len(self.outages)} of {span}"
            median, p90 = self.outage_error(50), self.outage_error(90)
            if median is not None:
                line += f"; error at their ends: median {median:.3g} m, p90 {p90:.3g} m"
            lines.append(line)
        return lines if len(lines) > 1 else []


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)


def _figure(value: float | None, unit: str) -> str:
    return "not known" if value is None else f"{value:.3g} {unit}"


def _wrapped(text: str, width: int = 80, indent: str = "") -> str:
    return textwrap.fill(text, width, initial_indent=indent, subsequent_indent=indent + "  ")
