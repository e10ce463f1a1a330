"""
The covariance of the non-holonomic constraint, read from the last second of IMU samples.

Vibration shows the road, and the road makes an axle heave and wander. The reader checks the window,
asks the model, bounds the answer and counts its refusals, as `hybrid_ins.noise_regressor.reader`
does for the noise of the IMU. It is asked only where the constraint holds.

References
----------
.. [1] M. Brossard, A. Barrau, S. Bonnabel, "AI-IMU dead-reckoning", IEEE Transactions on
       Intelligent Vehicles 5, 2020.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.imu.samples import ImuRing, as_numbers
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.onnx_model import OnnxModel
from hybrid_ins.noise_regressor.window import find_fault, own_axes
from hybrid_ins.resources import share_path

Array = NDArray[np.float64]

CHANNELS = 6
PARTS = 10  # of a window: a model wants a multiple of them
LONGEST = 10.0  # s, of a window
LOWEST, HIGHEST = 0.1, 10.0  # of the nominal standard deviations: bounds of an answer
HOLD_NS = 2_000_000_000  # an answer is in force for, while no other comes


class SlipRegressor:
    """
    A trained model: one window of readings in, variances to the right and down out.

    Parameters
    ----------
    model : OnnxModel
        Its metadata must hold ``hybrid_ins.name``, ``hybrid_ins.duration`` of a window [s],
        ``hybrid_ins.rate_min`` and ``hybrid_ins.rate_max`` [Hz]. Its input is (6, samples), its
        output (2,).

    Raises
    ------
    InputError
        If the model has other shapes or metadata, or answers plain noise with nonsense.
    """

    def __init__(self, model: OnnxModel) -> None:
        self._model = model
        self.name = model.text("name")
        self.rate_range = model.rate_range()
        self.duration = model.number("duration")
        if self.duration > LONGEST:
            raise InputError(f"{model.path}: metadata gives windows of {self.duration:g} s")
        model.check_ports((CHANNELS, "samples"), "float window (6, samples) and float variance (2)")
        size = PARTS * max(round(self.duration * self.rate_range[0] / PARTS), 2)
        noise = np.random.default_rng(0).normal(0.0, 0.1, (CHANNELS, size))
        model.probe(lambda: self.estimate(noise), 2)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> SlipRegressor:
        """Return the regressor of a model file; InputError where it cannot be used."""
        return cls(OnnxModel(path, "tools/regressor/train_slip.py"))

    def estimate(self, window: Array) -> Array:
        """Return variances (2,) [(m/s)²] for readings (6, N): forward, right, down."""
        return self._model.run(window)


class SlipReader:
    """
    Turns the youngest IMU samples into the covariance of the constraint.

    Parameters
    ----------
    model : str
        A path, the name of a model that comes with the package, or empty: none is used.
    std : ndarray, shape (2,)
        Nominal standard deviations [m/s], to the right and down: in force without an answer.
    mount : ndarray, shape (3, 3)
        From the IMU's axes to b.
    log : callable
        Called with a level and the reason why a model cannot be used.

    Attributes
    ----------
    refusals : Counter
        Windows and answers that were refused, by reason.
    fault : str
        Why the last window or answer was refused; empty when it was not.
    covariance : ndarray, shape (2, 2)
        In force since the last call of `read` [(m/s)²].
    """

    def __init__(
        self, model: str, std: Array, mount: Array, log: Callable[[str, str], None]
    ) -> None:
        self._wanted = model
        self._nominal = np.diag(std**2)
        self._mount = mount
        self._log = log
        self._regressor: SlipRegressor | None = None
        self._answered_ns: int | None = None
        self.refusals: Counter[str] = Counter()
        self.fault = ""
        self.covariance = self._nominal

    @property
    def answers(self) -> bool:
        """The covariance in force is the model's."""
        return self._answered_ns is not None

    @property
    def source(self) -> str:
        """Where the covariance in force comes from."""
        if self._regressor is None or not self.answers:
            return "constant"
        return f"learned ({self._regressor.name})"

    def prepare(self) -> None:
        """Load the model: a tenth of a second, better spent before an outage than in it."""
        if not self._wanted or self._regressor is not None:
            return
        name, self._wanted = self._wanted, ""
        try:
            path = name if name.endswith(".onnx") else share_path(f"models/{name}.onnx")
            self._regressor = SlipRegressor.load(path)
        except InputError as error:
            self._log("warn", f"vehicle.slip_model: {error}; vehicle.slip_std is used instead")

    def read(self, ring: ImuRing, nose: Nose, t_ns: int) -> Array:
        """Return the covariance (2, 2) at a stamp [ns], for a nose in b."""
        self.prepare()
        if self._regressor is None:
            return self._nominal
        variance, self.fault = self._ask(self._regressor, ring, nose, t_ns)
        if not self.fault:
            nominal = np.diag(self._nominal)
            bounded = np.clip(variance, LOWEST**2 * nominal, HIGHEST**2 * nominal)
            self.covariance, self._answered_ns = np.diag(bounded), t_ns
            return self.covariance
        self.refusals[self.fault] += 1
        if self._answered_ns is not None and not 0 <= t_ns - self._answered_ns <= HOLD_NS:
            self.covariance, self._answered_ns = self._nominal, None
        return self.covariance

    def _ask(
        self, regressor: SlipRegressor, ring: ImuRing, nose: Nose, t_ns: int
    ) -> tuple[Array, str]:
        """Return the model's answer (2,), or why there is none."""
        nothing = np.empty(0)
        duration_ns = round(regressor.duration * 1e9)
        samples = ring.after(t_ns - duration_ns)
        size = len(samples) - len(samples) % PARTS
        samples = samples[len(samples) - size :]
        if size < 2 * PARTS or samples["t_ns"][-1] - samples["t_ns"][0] < 0.8 * duration_ns:
            return nothing, "window not full yet"
        numbers = as_numbers(samples)
        fault = find_fault(samples["t_ns"], own_axes(numbers, self._mount), regressor.rate_range)
        if fault is not None:
            return nothing, fault.value
        C = np.vstack((nose.forward, nose.axes))
        try:
            variance = regressor.estimate(np.vstack((C @ numbers[:, 1:4].T, C @ numbers[:, 4:7].T)))
        except Exception:  # A model that answered at start may fail later; the filter goes on.
            return nothing, "the model failed"
        if not np.all(np.isfinite(variance) & (variance > 0.0)):
            return nothing, "the model answered with no variance"
        return variance, ""
