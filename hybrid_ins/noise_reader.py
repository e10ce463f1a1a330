"""
Reads the present noise levels off the ring of IMU samples, and refuses what cannot be told.

The one place where a regressor meets the live samples: it checks the window, runs the model,
bounds the answer, and keeps count of its refusals.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.ins_filter import NoiseEstimate
from hybrid_ins.core.samples import ImuRing, as_numbers
from hybrid_ins.core.window import find_fault, own_axes, quantisation_step, sampling_rate
from hybrid_ins.errors import InputError
from hybrid_ins.regressor import NoiseRegressor, Regressor, SpectralRegressor
from hybrid_ins.resources import share_path

Array = NDArray[np.float64]


def load_regressor(model: str, log: Callable[[str, str], None]) -> NoiseRegressor:
    """
    Return the regressor that ``noise.model`` asks for; the spectral one where that fails.

    Parameters
    ----------
    model : str
        A path, the name of a model that comes with the package, or ``spectral``.
    log : callable
        Told why a model cannot be used.
    """
    if model == "spectral":
        return SpectralRegressor()
    try:
        path = model if model.endswith(".onnx") else share_path(f"models/{model}.onnx")
        return Regressor.load(path)
    except InputError as error:
        log("warn", f"noise.model: {error}; the spectral estimator takes its place")
        return SpectralRegressor()


class NoiseReader:
    """
    Turns the youngest window of IMU samples into noise levels.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    mount : ndarray, shape (3, 3)
        From the IMU's axes to b: noise is a property of the sensor's own axes.
    log : callable
        See `load_regressor`.

    Attributes
    ----------
    regressor : NoiseRegressor
        In use.
    refusals : Counter
        Windows and answers that were refused, by reason.
    fault : str
        Why the last window or answer was refused; empty when it was not.
    """

    def __init__(
        self, values: Mapping[str, Any], mount: Array, log: Callable[[str, str], None]
    ) -> None:
        self.regressor = load_regressor(values["noise.model"], log)
        self.refusals: Counter[str] = Counter()
        self.fault = ""
        self._mount = mount
        self._turn = mount**2
        limits = [
            (values[f"noise.q_{sensor}_min"], values[f"noise.q_{sensor}_max"])
            for sensor in ("accelerometer", "gyroscope")]
        self._low, self._high = np.repeat(np.array(limits), 3, axis=0).T

    def read(self, ring: ImuRing, t_ns: int) -> NoiseEstimate:
        """Return the levels at ``t_ns`` [ns], or an estimate that says None."""
        q, self.fault = self._estimate(ring)
        if self.fault:
            self.refusals[self.fault] += 1
        return NoiseEstimate(t_ns, q)

    def _estimate(self, ring: ImuRing) -> tuple[Array | None, str]:
        size = self.regressor.window
        samples = ring.latest(size)
        if len(samples) < size:
            return None, "window not full yet"
        readings = own_axes(as_numbers(samples), self._mount)
        fault = find_fault(samples["t_ns"], readings, self.regressor.rate_range)
        if fault is not None:
            return None, fault.value
        try:
            q = self.regressor.estimate(readings.T, sampling_rate(samples["t_ns"]))
        except Exception:  # A model that answered at start may fail later; the filter goes on.
            return None, "the model failed"
        if not np.all(np.isfinite(q) & (q >= 0.0)):
            return None, "the model answered with no variance"
        q = np.maximum(q, quantisation_step(readings) ** 2 / 12.0)
        q = np.concatenate((self._turn @ q[:3], self._turn @ q[3:]))
        if np.any(q > self._high):
            return None, "noise beyond noise.q_*_max"
        return np.maximum(q, self._low), ""
