"""
What happens to a filter at a stamp besides IMU samples: measurements, and changes of its settings.

Events of one stamp are applied in the alphabetical order of their kinds, so that the result does
not depend on the order of their arrival.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.noise.process_noise import NoiseEstimate
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AntennaFound:
    """What an earlier filter has found of the antenna's place: `LeverArmObserver.or_earlier`."""

    t_ns: int
    earlier: LeverArmObserver
    kind: ClassVar[str] = "antenna found"


@dataclass(frozen=True, slots=True)
class AntennaShift:
    """From its stamp on the antenna is taken to be elsewhere in fixes: `LeverArmObserver.shift`."""

    t_ns: int
    by_b: Array  # (3,) m
    moves_odometry: bool  # it was that of the antenna, and is that of the IMU
    kind: ClassVar[str] = "antenna shift"


@dataclass(frozen=True, slots=True)
class NoiseChange:
    """Other noise, from its stamp on."""

    t_ns: int
    noise: FilterNoise
    kind: ClassVar[str] = "noise change"


@dataclass(frozen=True, slots=True)
class SettingsChange:
    """Other settings, from its stamp on; None: as they were."""

    t_ns: int
    gate: Gate | None = None  # one with the other limits
    clock_prior: ClockPrior | None = None  # relative to the offset that is in force then
    learn_scatter: bool | None = None
    kind: ClassVar[str] = "settings change"  # after a clock shift: the prior contains it


@dataclass(frozen=True, slots=True)
class ClockShift:
    """From its stamp on, more is added to the stamps of fixes."""

    t_ns: int
    by: float  # s
    kind: ClassVar[str] = "clock shift"


@dataclass(frozen=True, slots=True)
class ClockFound:
    """From its stamp on, a filter's clock offset is that of the mixture which it is chosen from."""

    t_ns: int
    residual: float  # s, still to be added to the stamps of fixes
    sigma: float  # s
    prior: ClockPrior | None
    kind: ClassVar[str] = "what was found of the clock"  # after measurements: it contains them


@dataclass(frozen=True, slots=True)
class ClockInflation:
    """At its stamp the stamps of fixes may lack ``std`` more, whatever was found until then."""

    t_ns: int
    std: float  # s
    kind: ClassVar[str] = "clock inflation"


@dataclass(frozen=True, slots=True)
class CovarianceInflation:
    """At its stamp the errors may be as large as ``std``: see `inflation.inflate`."""

    t_ns: int
    std: Array  # (15,) in the order of the error state; 0 where nothing is inflated
    lever_b: Array  # (3,) m, antenna relative to the IMU
    kind: ClassVar[str] = "covariance inflation"


@dataclass(frozen=True, slots=True)
class FilterChosen:
    """
    At its stamp a filter is chosen from several: its errors may be as large as theirs together.

    Attributes as of `CovarianceInflation`.
    """

    t_ns: int
    std: Array
    lever_b: Array
    kind: ClassVar[str] = "what other filters contain"  # after measurements: it contains them


@dataclass(frozen=True, slots=True)
class Outage:
    """Fixes are missing at its stamp: until the next one scale errors of the IMU are considered."""

    t_ns: int
    kind: ClassVar[str] = "an outage"  # before measurements


@dataclass(frozen=True, slots=True)
class ScatterInForce:
    """
    From its stamp on, positions are fused with the scatter that was learned; their stamps may, too.

    Hypotheses of a bank fuse them with the given one, at exact stamps: their likelihoods are to be
    those of the same measurements. ``jumps`` are those of the positions that an earlier filter has
    learned.
    """

    t_ns: int
    jumps: PositionJumps
    kind: ClassVar[str] = "scatter in force"


@dataclass(frozen=True, slots=True)
class ScatterShown:
    """
    What fixes before its stamp say of the factor on their covariance, see `FixDifferences`.

    The state that they led to is inflated by as much.
    """

    t_ns: int
    log_likelihood: Array  # of the hypotheses on noise
    claimed_std: Array  # (3,) m, NED
    kind: ClassVar[str] = "scatter shown"


@dataclass(frozen=True, slots=True)
class StateRestored:
    """At its stamp the state is what it would be had nothing aided it since an earlier stamp."""

    t_ns: int
    nav: Array  # (N_FLAT,) flat state then, with nothing pending
    since_ns: int
    kind: ClassVar[str] = "state restored"


Change = (
    AntennaFound
    | AntennaShift
    | NoiseEstimate
    | NoiseChange
    | ClockFound
    | ClockInflation
    | ClockShift
    | CovarianceInflation
    | FilterChosen
    | Outage
    | ScatterInForce
    | ScatterShown
    | SettingsChange
    | StateRestored
)
Event = Measurement | Change


def order(event: Event) -> tuple[int, str]:
    """Return what events are sorted by: stamp, then kind."""
    return event.t_ns, event.kind
