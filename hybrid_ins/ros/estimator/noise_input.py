"""
Noise levels into the navigator: a regressor asked at the period of ``noise.refresh_period``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.ins_filter import NEVER_NS
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.noise_regressor.models import NoiseRegressor
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.noise_regressor.window import WindowFault, sampling_rate
from hybrid_ins.ros.reporting.input_log import Log

Array = NDArray[np.float64]


class NoiseInput:
    """
    Refreshes the noise levels where ``noise.mode`` asks for it.

    Parameters
    ----------
    navigator : Navigator
    log : callable
        Called with a level (info, warn, error) and a line for the user.

    Attributes
    ----------
    reader : NoiseReader or None
        None where the levels do not come from a regressor.
    next_ns : int
        Stamp of the next estimate [ns].
    """

    def __init__(self, navigator: Navigator, log: Log) -> None:
        self._navigator = navigator
        self._log = log
        self._lookahead: tuple[NDArray[np.int64], Array, Array] | None = None
        self.reader: NoiseReader | None = None
        self.next_ns = NEVER_NS
        self._informed = False  # of a rate that the regressor does not know

    def configure(self, values: Mapping[str, Any], mount: Array) -> None:
        """Use checked parameters, and the matrix (3, 3) from the IMU's axes to b."""
        self.reader = None
        if values["noise.mode"] == "learned":
            self.reader = NoiseReader(values, mount, self._log)
            if self._lookahead is not None:
                self.reader.preload(*self._lookahead)
        self._period_ns = int(values["noise.refresh_period"] * 1e9)
        self.restart()

    def set_mount(self, mount: Array) -> None:
        """Use another matrix (3, 3) from the IMU's axes to b; the regressor is the same."""
        if self.reader is not None:
            self.reader.set_mount(mount)
        self.restart()

    def restart(self) -> None:
        """Make the next estimate due at once."""
        self.next_ns = NEVER_NS if self.reader is None else 0

    def preload(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> None:
        """Provide the readings of a recording, see `NoiseReader.preload`."""
        self._lookahead = t_ns, force, rate
        if self.reader is not None:
            self.reader.preload(*self._lookahead)

    def run_periodic(self, t_ns: int) -> None:
        """Estimate the levels at a stamp [ns] where that is due."""
        if self.reader is not None and t_ns >= self.next_ns:
            self.next_ns = t_ns + self._period_ns
            self._navigator.phases.submit(self.reader.read(self._navigator.ring, t_ns))
            if self.reader.fault == WindowFault.RATE.value and not self._informed:
                self._informed = True
                self._log("info", self._rate_unknown(self.reader.regressor))

    def _rate_unknown(self, regressor: NoiseRegressor) -> str:
        """Return what it means that the regressor does not know the IMU's rate."""
        rate = sampling_rate(self._navigator.ring.latest(regressor.window)["t_ns"])
        low, high = regressor.rate_range
        return (
            f"imu/data: {rate:.4g} Hz: the noise model {regressor.name} reads {low:g} to {high:g} "
            "Hz; the constants noise.q_* are used, and fixes correct them (noise.innovation_scale)"
        )
