"""
Estimates the present noise levels from the ring of IMU samples.

The one place where a regressor meets the live samples: it checks the window, runs the model, bounds
the answer, and counts its refusals.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import ImuRing, as_numbers
from hybrid_ins.core.noise.process_noise import NoiseEstimate
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.models import NoiseRegressor, Regressor, SpectralRegressor
from hybrid_ins.noise_regressor.onnx_model import LARGEST_MODEL_BYTES
from hybrid_ins.noise_regressor.window import (
    WindowFault,
    find_fault,
    own_axes,
    quantisation_step,
    rounded,
    sampling_rate,
)
from hybrid_ins.resources import read_regular_file, share_path, shortened

Array = NDArray[np.float64]

ABSURD = 1e6  # m/s², rad/s
LOOKAHEAD = 15  # windows of a recording that are read along with one
TURNS_SEEN_HZ = 100.0  # below that the turns of a vehicle may fill the band of its gyroscopes
NAMES = "plateau", "spectral", "paper"
ALLOWED = f"noise.model is {', '.join(NAMES)}, or the path of an .onnx file"


class UnknownModelError(InputError):
    """What ``noise.model`` names does not come with the package, and is no file to read."""


def model_path(model: str) -> Path:
    """
    Return the file of a model that ``noise.model`` names, other than ``spectral``.

    Raises
    ------
    InputError
        `UnknownModelError`, or this installation lacks a model of its own.
    """
    try:
        if not model.endswith(".onnx"):
            return share_path(f"models/{model}.onnx")
        read_regular_file(Path(model), LARGEST_MODEL_BYTES, "a model")
        return Path(model)
    except InputError as error:
        if model in NAMES:
            raise
        is_path = model.endswith(".onnx")
        reason = str(error) if is_path else f"{shortened(model)!r} is no model"
        raise UnknownModelError(f"{reason}; {ALLOWED}") from None


def check_model(values: Mapping[str, Any]) -> None:
    """
    Check, before the work, that the regressor that checked parameters ask for exists.

    Raises
    ------
    InputError
        See `model_path`. A model that is damaged is found when it is loaded.
    """
    model = values["noise.model"]
    if values["noise.mode"] == "learned" and model not in NAMES:
        try:
            model_path(model)
        except InputError as error:
            raise InputError(f"parameter noise.model: {error}") from None


def find_regressor(model: str) -> NoiseRegressor:
    """
    Return the regressor that ``noise.model`` asks for.

    Parameters
    ----------
    model : str
        A path, the name of a model that comes with the package, or ``spectral``.

    Raises
    ------
    InputError
        The model cannot be used.
    """
    if model == "spectral":
        return SpectralRegressor()
    return Regressor.load(model_path(model))


def load_regressor(model: str, log: Callable[[str, str], None]) -> NoiseRegressor:
    """
    Return the regressor that ``noise.model`` asks for; the spectral one where that fails.

    Parameters
    ----------
    model : str
        See `find_regressor`.
    log : callable
        Called with a level and the reason why a model cannot be used: an error where it is none.
    """
    try:
        return find_regressor(model)
    except InputError as error:
        level = "error" if isinstance(error, UnknownModelError) else "warn"
        log(level, f"noise.model: {error}; the spectral estimator is used instead")
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
        self.set_mount(mount)
        limits = [
            (values[f"noise.q_{sensor}_min"], values[f"noise.q_{sensor}_max"])
            for sensor in ("accelerometer", "gyroscope")
        ]
        self._low, self._high = np.repeat(np.array(limits), 3, axis=0).T
        self._gyroscope = values["noise.q_gyroscope"]
        self._period_ns = int(values["noise.refresh_period"] * 1e9)
        self._lookahead: tuple[NDArray[np.int64], Array, Array] | None = None
        self._answers: dict[int, tuple[Array, Array]] = {}  # window and levels, by its end

    def set_mount(self, mount: Array) -> None:
        """Use another matrix (3, 3) from the IMU's axes to b."""
        self._mount, self._turn = mount, mount**2

    def preload(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> None:
        """
        Provide the readings of a recording: the regressor then runs on many windows at once.

        Parameters
        ----------
        t_ns : ndarray, shape (N,)
            Stamps [ns].
        force, rate : ndarray, shape (N, 3)
            Readings [m/s², rad/s] in the IMU's own axes.
        """
        self._lookahead = t_ns, force, rate

    def read(self, ring: ImuRing, t_ns: int) -> NoiseEstimate:
        """
        Return the levels at ``t_ns`` [ns], or an estimate without them.

        Of readings that are cut off at their limit, the levels are lower bounds.
        """
        q, at_least, self.fault = None, False, "window not full yet"
        samples = ring.latest(self.regressor.window)
        if len(samples) == self.regressor.window:
            readings = own_axes(as_numbers(samples), self._mount)
            fault = find_fault(samples["t_ns"], readings, self.regressor.rate_range)
            at_least = fault is WindowFault.SATURATED
            if fault is None or at_least:
                q, self.fault = self._levels(samples["t_ns"], readings)
            else:
                self.fault = fault.value
        if self.fault:
            self.refusals[self.fault] += 1
        return NoiseEstimate(t_ns, q, at_least)

    def _levels(self, t_ns: NDArray[np.int64], readings: Array) -> tuple[Array | None, str]:
        """
        Return the levels (6,) by a window, b frame, or why the answer is refused.

        Those of slow gyroscopes are the constant: their window does not tell noise from turns.
        """
        try:
            q = self._ask(t_ns, readings)
        except Exception:  # A model that answered at start may fail later; the filter goes on.
            return None, "the model failed"
        if not np.all(np.isfinite(q) & (q >= 0.0)):
            return None, "the model answered with no variance"
        if sampling_rate(t_ns) < 0.99 * TURNS_SEEN_HZ:
            q = np.append(q[:3], np.full(3, self._gyroscope))
        q = np.maximum(q, quantisation_step(readings) ** 2 / 12.0)
        q = np.concatenate((self._turn @ q[:3], self._turn @ q[3:]))
        if np.any(q > self._high):
            return None, "noise beyond noise.q_*_max"
        return np.maximum(q, self._low), ""

    def _ask(self, t_ns: NDArray[np.int64], readings: Array) -> Array:
        """Return the regressor's answer (6,) for a window: stamps (N,) and readings (N, 6)."""
        end_ns = int(t_ns[-1])
        window, q = self._answers.get(end_ns, (None, np.empty(0)))
        if window is not None and np.array_equal(window, readings):
            return q
        if max(self._answers, default=0) > end_ns:
            self._lookahead = None  # the samples differ from those preloaded
        windows = {end_ns: readings, **self._following(end_ns)}
        answers = self.regressor.estimate(
            np.concatenate([window.T for window in windows.values()]), sampling_rate(t_ns)
        )
        if len(windows) > 1:
            self._answers = {
                end: (window, answer)
                for (end, window), answer in zip(
                    windows.items(), answers.reshape(len(windows), -1), strict=True
                )
            }
        return answers[:6]

    def _following(self, end_ns: int) -> dict[int, Array]:
        """Return the windows after the one that ends at a stamp, by their ends, if all goes on."""
        found: dict[int, Array] = {}
        if self._lookahead is not None:
            t_ns, force, rate = self._lookahead
            for _ in range(LOOKAHEAD):
                end = 1 + int(np.searchsorted(t_ns, end_ns + self._period_ns))
                if not self.regressor.window <= end <= len(t_ns):
                    break
                end_ns = int(t_ns[end - 1])
                window = slice(end - self.regressor.window, end)
                readings = np.hstack((force[window], rate[window]))
                readings[~(np.abs(readings) < ABSURD)] = 0.0  # will be refused: it differs then
                found[end_ns] = rounded(readings)
        return found
