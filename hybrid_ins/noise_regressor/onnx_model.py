"""
A trained network in an ONNX file: read with care, and run on one thread.

onnxruntime is imported here and nowhere else, only when a model is loaded, and with its telemetry
switched off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.errors import InputError
from hybrid_ins.resources import read_regular_file

Array = NDArray[np.float64]

LARGEST_MODEL_BYTES = 20_000_000
FORMAT = "1"
"""Version of the metadata that a model carries."""


class OnnxModel:
    """
    A network with one input ``window`` and one output ``variance``, both float32.

    Parameters
    ----------
    path : path
        The file. Its metadata must hold ``hybrid_ins.format``, here "1".
    maker : str
        The program that makes such models, for messages.

    Raises
    ------
    InputError
        If the file is missing, too large, no ONNX model, uses operators that the runtime does not
        know, or is of another format.
    """

    def __init__(self, path: str | PathLike[str], maker: str) -> None:
        self.path = Path(path)
        self._maker = maker
        self._session = _session(self.path)
        self._declared = self._session.get_modelmeta().custom_metadata_map
        if self.text("format") != FORMAT:
            raise InputError(
                f"{self.path}: metadata hybrid_ins.format is {self.text('format')!r}; "
                f"this version reads {FORMAT!r}"
            )

    def text(self, key: str) -> str:
        """Return what the model declares as ``hybrid_ins.KEY``; InputError where it does not."""
        try:
            return str(self._declared[f"hybrid_ins.{key}"])
        except KeyError:
            raise InputError(
                f"{self.path}: metadata hybrid_ins.{key} is missing; make models with {self._maker}"
            ) from None

    def number(self, key: str) -> float:
        """Return a positive number that the model declares; InputError where it is none."""
        text = self.text(key)
        try:
            result = float(text)
        except ValueError:
            result = np.nan
        if not (np.isfinite(result) and result > 0.0):
            raise InputError(f"{self.path}: metadata hybrid_ins.{key} is {text!r}, not a number")
        return result

    def rate_range(self) -> tuple[float, float]:
        """Return the sampling rates [Hz] that the model declares to know."""
        low, high = self.number("rate_min"), self.number("rate_max")
        if low > high:
            raise InputError(f"{self.path}: metadata gives the rate range {low:g} to {high:g} Hz")
        return low, high

    def check_ports(self, columns: Sequence[int | str], expected: str) -> None:
        """
        Refuse a model whose input and output are not those that are expected.

        Parameters
        ----------
        columns : sequence of int or str
            Of the input's shape: a number must agree, a name stands for any number.
        expected : str
            The same for the user.
        """
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        found = [(port.name, port.type, list(port.shape)) for port in (*inputs, *outputs)]
        fits = (
            len(inputs) == len(outputs) == 1
            and (inputs[0].name, outputs[0].name) == ("window", "variance")
            and inputs[0].type == outputs[0].type == "tensor(float)"
            and len(inputs[0].shape) == len(columns)
            and all(
                size == wanted
                for size, wanted in zip(inputs[0].shape, columns, strict=True)
                if isinstance(wanted, int)
            )
            and len(outputs[0].shape) == 1
        )
        if not fits:
            raise InputError(f"{self.path}: input and output are {found}; expected {expected}")

    def run(self, window: Array) -> Array:
        """Return the network's answer."""
        readings = np.asarray(window, dtype=np.float32)
        output = self._session.run(("variance",), {"window": readings})[0]
        return np.asarray(output, dtype=float)

    def probe(self, answer: Callable[[], Array], size: int) -> None:
        """Refuse a model unless an answer to plain noise is ``size`` finite numbers."""
        try:
            found = answer()
        except Exception as error:  # The runtime's own exceptions share no public base.
            reason = " ".join(str(error).split())
            raise InputError(f"{self.path}: the model fails on a window ({reason[:200]})") from None
        if found.shape != (size,):
            raise InputError(
                f"{self.path}: the model answers shape {found.shape}, expected ({size},)"
            )
        if not np.isfinite(found).all():
            raise InputError(f"{self.path}: the model answers plain noise with {found.tolist()}")


def _session(path: Path) -> Any:
    """Return a session of the runtime for a model file."""
    read_regular_file(path, LARGEST_MODEL_BYTES, "a model, an .onnx file")  # refuses others
    # Otherwise the runtime keeps a database in the user's cache and calls its maker's server.
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(
            f"{path}: needs onnxruntime, which cannot be imported ({error}); "
            "install onnxruntime, or use no model"
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    try:
        # Given the content instead, a session keeps it.
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # The runtime's own exceptions share no public base.
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: no usable ONNX model ({reason[:200]})") from None
