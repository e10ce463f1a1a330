"""
Noise regressors behind one interface: a trained ONNX model, or the spectral estimator without one.

A regressor has a `name`, a `window` (samples it needs), a `rate_range` [Hz] and
``estimate(window, rate_hz)``, which takes readings (C, N), one channel a row, oldest first, in
m/s^2 and rad/s, and returns per-sample noise variances (C,) in those units squared. It neither
checks its input (`hybrid_ins.noise_regressor.window` does) nor bounds its output (the estimator
does).

onnxruntime is imported here and nowhere else, only when a model is loaded, and with its telemetry
switched off.
"""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import noise_spectral
from hybrid_ins.errors import InputError
from hybrid_ins.resources import read_regular_file

Array = NDArray[np.float64]

LARGEST_MODEL_BYTES = 20_000_000
FORMAT = "1"
"""Version of the metadata that a model carries; the keys are those of `Regressor.load`."""


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
    The fallback that needs no model: the plateau of `hybrid_ins.core.noise_spectral`.

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
    """A trained model in ONNX Runtime, on one thread."""

    def __init__(
        self,
        session: Any,
        name: str,
        window: int,
        rate_range: tuple[float, float],
        centred: bool,
    ) -> None:
        self._session = session
        self._centred = centred
        self.name = name
        self.window = window
        self.rate_range = rate_range

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Regressor:
        """
        Return the regressor of a model file.

        The file's metadata must hold ``hybrid_ins.format`` (here "1"), ``hybrid_ins.name``,
        ``hybrid_ins.window`` [samples], ``hybrid_ins.rate_min`` and ``hybrid_ins.rate_max`` [Hz],
        and ``hybrid_ins.centred``: "1" where the model wants each window less its mean.
        Its one input is float32 (channels, window), its one output float32 (channels,).

        Raises
        ------
        InputError
            If the file is missing, too large, no ONNX model, uses operators that the runtime does
            not know, has other shapes or metadata, or answers plain noise with nonsense.
        """
        path = Path(path)
        content = read_regular_file(path, LARGEST_MODEL_BYTES, "a model, an .onnx file")
        # Otherwise the runtime keeps a database in the user's cache and calls its maker's server.
        os.environ["ORT_DISABLE_TELEMETRY"] = "1"
        try:
            import onnxruntime
        except ImportError as error:
            raise InputError(
                f"{path}: needs onnxruntime, which cannot be imported ({error}); "
                "install onnxruntime, or use the spectral regressor"
            ) from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.log_severity_level = 4
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry("session.inter_op.allow_spinning", "0")
        try:
            session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # The runtime's own exceptions share no public base.
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: no usable ONNX model ({reason[:200]})") from None
        regressor = cls(session, *_metadata(path, session))
        _check_shapes(path, session, regressor.window)
        regressor._probe(path)
        return regressor

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
        return self._run(np.asarray(window, dtype=np.float32))

    def _run(self, readings: NDArray[np.float32]) -> Array:
        output = self._session.run(("variance",), {"window": readings})[0]
        return np.asarray(output, dtype=float)

    def _probe(self, path: Path) -> None:
        """Answer plain noise once: shows a broken model at start, and warms the runtime up."""
        noise = np.random.default_rng(0).normal(0.0, 0.1, (6, self.window))
        try:
            levels = self.estimate(noise, self.rate_range[0])
        except Exception as error:  # The runtime's own exceptions share no public base.
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: the model fails on a window ({reason[:200]})") from None
        if levels.shape != (6,):
            raise InputError(f"{path}: the model answers shape {levels.shape}, expected (6,)")
        if not np.isfinite(levels).all():
            raise InputError(f"{path}: the model answers plain noise with {levels.tolist()}")


def _metadata(path: Path, session: Any) -> tuple[str, int, tuple[float, float], bool]:
    """Return name, window, rate range and centring that the model declares."""
    declared = session.get_modelmeta().custom_metadata_map

    def value(key: str) -> str:
        try:
            return str(declared[f"hybrid_ins.{key}"])
        except KeyError:
            raise InputError(
                f"{path}: metadata hybrid_ins.{key} is missing; "
                "make models with tools/regressor/train.py"
            ) from None

    def number(key: str) -> float:
        try:
            result = float(value(key))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            result = np.nan
        if not (np.isfinite(result) and result > 0.0):
            raise InputError(f"{path}: metadata hybrid_ins.{key} is {value(key)!r}, not a number")
        return result

    if value("format") != FORMAT:
        raise InputError(
            f"{path}: metadata hybrid_ins.format is {value('format')!r}; "
            f"this version reads {FORMAT!r}"
        )
    rates = number("rate_min"), number("rate_max")
    window = number("window")
    if rates[0] > rates[1]:
        raise InputError(f"{path}: metadata gives the rate range {rates[0]:g} to {rates[1]:g} Hz")
    if window != int(window) or window > 10_000:
        raise InputError(f"{path}: metadata hybrid_ins.window is {value('window')!r}")
    if value("centred") not in ("0", "1"):
        raise InputError(f"{path}: metadata hybrid_ins.centred is {value('centred')!r}, not 0 or 1")
    return value("name"), int(window), rates, value("centred") == "1"


def _check_shapes(path: Path, session: Any, window: int) -> None:
    """Refuse a model whose input and output are not those of a regressor."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    found = [(port.name, port.type, list(port.shape)) for port in (*inputs, *outputs)]
    fits = (
        len(inputs) == len(outputs) == 1
        and (inputs[0].name, outputs[0].name) == ("window", "variance")
        and inputs[0].type == outputs[0].type == "tensor(float)"
        and len(inputs[0].shape) == 2
        and inputs[0].shape[1] == window
        and len(outputs[0].shape) == 1
    )
    if not fits:
        raise InputError(
            f"{path}: input and output are {found}; expected float window (channels, {window}) "
            "and float variance (channels)"
        )
