"""What became of everything that a filter was given, kept for a smoother."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import Event
from hybrid_ins.core.filter.measurement_update import MeasurementUpdate, Outcome
from hybrid_ins.core.inertial.state import PAST_VARIANCE, NavState
from hybrid_ins.core.noise.position_scatter import Split
from hybrid_ins.core.sensor_errors.considered_scale import ScaleStep
from hybrid_ins.core.update.gate import Verdict

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FilterStart:
    """What a filter began with."""

    t_ns: int  # ns
    sample: Array  # (6,) the IMU sample then: m/s², rad/s, b
    state: NavState
    levels: Array  # (6,) per-sample variances in force
    lever_std: Array  # (3,) m, b: of the lever arm in fixes, see `LeverArmObserver`


@dataclass(frozen=True, slots=True)
class Decided:
    """An event and what became of it."""

    event: Event
    verdict: Verdict | None  # None: no measurement
    r_scale: float  # factor on the covariance of fixes
    state_moved: bool  # by a `StateCorrection`
    split: Split | None  # of a position's covariance
    levels: Array  # (6,) per-sample variances in force after it
    clock_residual: float  # s, to be added to the stamps of fixes
    clock_variance: float  # s²
    clock_drift: float  # s/s
    attitude_by_scale: Array  # (6,) `ScaleErrorObserver.considered`
    heading_by_noise: float  # rad², `HeadingInformation.considered`
    past_variance: Array  # (3,) m², NED, of positions: `FilterNoise.past_variance`
    scale_step: ScaleStep | None = None  # what scale errors did to the state, in an outage


class FilterRecord:
    """
    Everything decided in a filter's life, in the order of the stamps.

    Parameters
    ----------
    start : FilterStart
        What the filter began with.

    Attributes
    ----------
    decided : list of Decided
        After all rewinding.
    too_old : list of Decided
        Measurements that came too late to be fused.
    """

    def __init__(self, start: FilterStart) -> None:
        self.start = start
        self.decided: list[Decided] = []
        self.too_old: list[Decided] = []

    def __copy__(self) -> FilterRecord:
        twin = FilterRecord(self.start)
        twin.decided, twin.too_old = [*self.decided], [*self.too_old]
        return twin

    def add(self, event: Event, outcome: Outcome, after: MeasurementUpdate, nav: Array) -> None:
        """Append an event that was applied, with what is known and the flat state after it."""
        self.decided.append(_decided(event, outcome, after, nav))

    def add_too_old(self, verdict: Verdict, now: MeasurementUpdate, nav: Array) -> None:
        """Append a measurement that was not fused for its age; its verdict holds a threshold."""
        refused = Outcome(verdict, now.noise.found.fixes, False, None)
        self.too_old.append(_decided(verdict.measurement, refused, now, nav))

    def rewind(self, count: int) -> None:
        """Forget all but the first ``count`` events: the others are applied again."""
        del self.decided[count:]


def _decided(event: Event, outcome: Outcome, update: MeasurementUpdate, nav: Array) -> Decided:
    """Return what is kept of an event, with noise, clock, scale errors and heading as they are."""
    clock, scale = update.clock, outcome.scale
    return Decided(
        event,
        *outcome[:-1],
        levels=update.noise.levels(),
        clock_residual=clock.residual,
        clock_variance=clock.sigma**2,
        clock_drift=clock.drift,
        attitude_by_scale=update.scale_errors.considered,
        heading_by_noise=update.heading.considered(nav),
        past_variance=nav[PAST_VARIANCE].copy(),
        scale_step=scale.step if scale is not None else None,
    )
