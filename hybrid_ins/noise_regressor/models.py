"""
Noise regressors behind one interface: a trained ONNX model, or the spectral estimator without one.

A regressor has a `name`, a `window` (samples it needs), a `rate_range` [Hz] and
``estimate(window, rate_hz)``, which takes readings (C, N), one channel a row, oldest first, in
m/s^2 and rad/s, and returns per-sample noise variances (C,) in those units squared. It neither
checks its input (`hybrid_ins.noise_regressor.window` does) nor bounds its output (the estimator
does).
"""

from __future__ import annotations

from os import PathLike
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise import spectral as noise_spectral
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.onnx_model import OnnxModel

Array = NDArray[np.float64]

LONGEST_WINDOW = 10_000


class NoiseRegressor(Protocol):
    """What the estimator needs of a regressor."""

    @property
    def name(self) -> str:
        """Return what to call it in diagnostics."""

    @property
    def window(self) -> int:
        """Return the number of samples N of a window."""

    @property
    def rate_range(self) -> tuple[float, float]:
        """Return the lowest and highest sampling rate [Hz] it knows."""

    def estimate(self, window: Array, rate_hz: float) -> Array:
        """Return noise variances (C,) of readings (C, N)."""


class SpectralRegressor:
    """
    The fallback that needs no model: the plateau of `hybrid_ins.core.noise.spectral`.

    Parameters
    ----------
    window : int
        Samples in a window.
    """

    name = "spectral"
    rate_range = (20.0, 10_000.0)

    def __init__(self, window: int = 200) -> None:
        self.window = window

    def estimate(self, window: Array, rate_hz: float) -> Array:
        """Return noise variances (C,) of readings (C, N)."""
        return noise_spectral.plateau(window)


class Regressor:
    """
    A trained model.

    Parameters
    ----------
    model : OnnxModel
        Its metadata must hold ``hybrid_ins.name``, ``hybrid_ins.window`` [samples],
        ``hybrid_ins.rate_min`` and ``hybrid_ins.rate_max`` [Hz], and ``hybrid_ins.centred``: "1"
        where the model wants each window less its mean. Its input is (channels, window), its
        output (channels,).

    Raises
    ------
    InputError
        If the model has other shapes or metadata, or answers plain noise with nonsense.
    """

    def __init__(self, model: OnnxModel) -> None:
        self._model = model
        self.name = model.text("name")
        self.rate_range = model.rate_range()
        window, centred = model.number("window"), model.text("centred")
        if window != int(window) or window > LONGEST_WINDOW:
            raise InputError(
                f"{model.path}: metadata hybrid_ins.window is {model.text('window')!r}"
            )
        if centred not in ("0", "1"):
            raise InputError(
                f"{model.path}: metadata hybrid_ins.centred is {centred!r}, not 0 or 1"
            )
        self.window = int(window)
        self._centred = centred == "1"
        model.check_ports(
            ("channels", self.window),
            f"float window (channels, {self.window}) and float variance (channels)",
        )
        self._probe()

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Regressor:
        """Return the regressor of a model file; InputError where it cannot be used."""
        return cls(OnnxModel(path, "tools/regressor/train.py"))

    def estimate(self, window: Array, rate_hz: float) -> Array:
        """
        Return noise variances (C,) of readings (C, N).

        Raises
        ------
        ValueError
            If the readings are not N samples long.
        """
        if window.ndim != 2 or window.shape[1] != self.window:
            raise ValueError(f"window of shape {window.shape}; expected (channels, {self.window})")
        if self._centred:
            # In double precision: single cannot hold small noise on a large bias.
            window = np.asarray(window, dtype=float)
            window = window - window.mean(axis=1, keepdims=True)
        return self._model.run(window)

    def _probe(self) -> None:
        """Answer plain noise once: shows a broken model at start, and warms the runtime up."""
        noise = np.random.default_rng(0).normal(0.0, 0.1, (6, self.window))
        self._model.probe(lambda: self.estimate(noise, self.rate_range[0]), 6)
