"""Settings of a filter besides its noise, and what they make of its corrections."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import SettingsChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.measurement_update import MeasurementUpdate
from hybrid_ins.core.noise.position_scatter import PositionScatter
from hybrid_ins.core.sensor_errors.clock_offset import MAX_STD, ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_prior import UNKNOWN_DRIFT, ClockDrift, ClockPrior
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrorObserver
from hybrid_ins.core.update.gate import Gate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """
    Settings of the filter besides its noise.

    Attributes
    ----------
    covariance_interval : float
        The covariance is propagated once this much time is pending [s]; 0: at every sample.
    max_delay : float
        Age of the oldest measurement that is still fused, by rewinding [s].
    clock_std : float
        Standard deviation of the clock offset of fixes at the start [s].
    clock_prior : ClockPrior, optional
    clock_drift : ClockDrift
        See `ClockOffsetObserver`.
    consider_clock : bool
        The covariances that are reported and that fixes are judged by contain the uncertainty of
        that offset.
    keep_record : bool
        Keep a `FilterRecord`, for a smoother.
    position_scatter : float
        Scatter of positions from fix to fix, relative to the standard deviations they claim.
    learn_scatter : bool
        Learn that from the fixes, see `PositionScatter`.
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b, as in the fixes.
    lever_std : ndarray, shape (3,)
        See `LeverArmObserver`.
    antenna_is_placed : bool
        Likewise.
    scale_std : float
        See `ScaleErrorObserver`.
    """

    covariance_interval: float = 0.01
    max_delay: float = 1.0
    clock_std: float = MAX_STD
    clock_prior: ClockPrior | None = None
    clock_drift: ClockDrift = UNKNOWN_DRIFT
    consider_clock: bool = False
    keep_record: bool = False
    position_scatter: float = 1.0
    learn_scatter: bool = False
    lever_b: Array = field(default_factory=lambda: np.zeros(3))
    lever_std: Array = field(default_factory=lambda: np.zeros(3))
    antenna_is_placed: bool = True
    scale_std: float = 0.0

    def clock_prior_at(self, t_ns: int) -> ClockPrior | None:
        """Return the prior of the clock offset at a stamp [ns]."""
        prior = self.clock_prior
        return None if prior is None else prior.at(t_ns, self.clock_drift)

    def change_of(self, update: MeasurementUpdate, t_ns: int) -> SettingsChange | None:
        """Return what a filter's update lacks of these settings at a stamp [ns], if anything."""
        prior, own = self.clock_prior, update.clock.prior
        if prior is None or own is None or prior.is_close(own):
            prior = None
        learns = self.learn_scatter
        learn_scatter = None if learns == update.scatter.learning else learns
        if prior is None and learn_scatter is None:
            return None
        return SettingsChange(t_ns, clock_prior=prior, learn_scatter=learn_scatter)

    def update(self, noise: FilterNoise, gate: Gate, t_ns: int) -> MeasurementUpdate:
        """Return what a filter that begins at a stamp [ns] applies events with."""
        return MeasurementUpdate(
            noise,
            gate,
            ClockOffsetObserver(self.clock_std, self.clock_prior, self.clock_drift),
            PositionScatter(self.position_scatter**2, self.learn_scatter),
            t_ns,
            LeverArmObserver(self.lever_std, self.antenna_is_placed),
            ScaleErrorObserver(self.scale_std),
        )
