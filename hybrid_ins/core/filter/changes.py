"""What a change does to a filter at its own stamp."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import (
    AntennaFound,
    AntennaShift,
    Change,
    ClockFound,
    ClockInflation,
    ClockShift,
    CovarianceInflation,
    FilterChosen,
    NoiseChange,
    Outage,
    ScatterInForce,
    ScatterShown,
    SettingsChange,
    StateRestored,
)
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.state import (
    AGE_SENSITIVITY,
    COVARIANCE,
    DP,
    DV,
    N_ERROR,
    NAVIGATION,
    SENSITIVITY,
)
from hybrid_ins.core.noise.position_scatter import PositionScatter
from hybrid_ins.core.noise.process_noise import NoiseEstimate
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrorObserver
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.inflation import inflate
from hybrid_ins.core.update.kalman import inject

Array = NDArray[np.float64]

FIRST_SPAN = 1.0  # s, of the fixes that have given a first velocity


class Held(Protocol):
    """What a filter holds beside its state, see `MeasurementUpdate`."""

    noise: FilterNoise
    gate: Gate
    clock: ClockOffsetObserver
    scatter: PositionScatter
    corrected_ns: int
    lever_arm: LeverArmObserver
    scale_errors: ScaleErrorObserver


def apply_change(own: Held, nav: Array, change: Change, ring: ImuRing) -> None:
    """Do what a change does to a state, overwritten, and to what is held beside it."""
    if isinstance(change, NoiseChange):
        own.noise = own.noise.replaced_by(change.noise)
    elif isinstance(change, SettingsChange):
        if change.gate is not None:
            own.gate = own.gate.replaced_by(change.gate)
        if change.clock_prior is not None:
            own.clock.prior = change.clock_prior
        if change.learn_scatter is not None:
            own.scatter.begin(change.learn_scatter)
    elif isinstance(change, NoiseEstimate):
        own.noise.learn_estimate(change)
    elif isinstance(change, ClockFound):
        own.clock.set_estimate(change.residual, change.sigma)
        own.clock.prior = change.prior
    elif isinstance(change, ClockInflation):
        own.clock.inflate(change.std)
    elif isinstance(change, ClockShift):
        inject(nav, own.clock.shift(change.by, nav))
        own.lever_arm.shift_clock(change.by)
        own.scale_errors.shift_clock(change.by)
    elif isinstance(change, CovarianceInflation):
        inflate(nav, change.std, change.lever_b)
        own.noise.on_imu_fault(change.t_ns)
    elif isinstance(change, FilterChosen):
        inflate(nav, change.std, change.lever_b)
    elif isinstance(change, ScatterInForce):
        own.scatter.in_force = True
        own.noise.jumps = own.noise.jumps.or_earlier(change.jumps, change.t_ns)
    elif isinstance(change, ScatterShown):
        own.noise.begin_with(change.log_likelihood)
        std, unclaimed = np.zeros(N_ERROR), math.sqrt(max(own.noise.found.fixes - 1.0, 0.0))
        std[DP] = unclaimed * change.claimed_std
        std[DV] = math.sqrt(2.0) * std[DP] / FIRST_SPAN
        inflate(nav, std, np.zeros(3))
    elif isinstance(change, AntennaFound):
        own.lever_arm = own.lever_arm.or_earlier(change.earlier)
    elif isinstance(change, AntennaShift):
        inject(nav, own.lever_arm.shift(change.by_b, change.moves_odometry))
        own.noise.restart(keep_weights=False)
        own.scale_errors.restart()
    elif isinstance(change, StateRestored):
        for part in (NAVIGATION, COVARIANCE, SENSITIVITY, AGE_SENSITIVITY):
            nav[part] = change.nav[part]
        own.noise.restart(keep_weights=True)
    elif isinstance(change, Outage):
        own.scale_errors.begin_outage(nav, ring, own.corrected_ns, change.t_ns)
