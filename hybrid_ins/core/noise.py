"""
The seam behind which the process noise varies.

A `NoiseModel` tells the noise level ``q`` of each IMU channel before a prediction and may learn
from a correction; the filter never knows which one it holds. `ProcessNoise` turns q into the power
spectral densities Qc that the error model takes.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (7), (16)-(19).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.snapshot import Snapshot
from hybrid_ins.core.state import DV, EPS

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Correction:
    """
    What a measurement tells about the process noise, and what it did to the state.

    Attributes
    ----------
    t_ns : int
        Stamp of the measurement [ns].
    z : ndarray, shape (m,)
        Innovation.
    S : ndarray, shape (m, m)
        Its predicted covariance.
    H : ndarray, shape (m, 15)
        Measurement matrix.
    K : ndarray, shape (15, m)
        Gain.
    dx : ndarray, shape (15,)
        Correction applied, K z.
    C_nb : ndarray, shape (3, 3)
        Attitude.
    interval : float
        Time since the previous correction [s].
    nav : ndarray, shape (N_FLAT,)
        Flat state before it.
    fused : bool
        False for a measurement that the gate refused: K and dx are zero.
    """

    t_ns: int
    z: Array
    S: Array
    H: Array
    K: Array
    dx: Array
    C_nb: Array
    interval: float
    nav: Array
    fused: bool


@dataclass(frozen=True, slots=True)
class StateCorrection:
    """Where the state belongs by another noise than the one that it was run with."""

    dx: Array  # (15,) to be added to the state
    P: Array  # (15, 15) covariance after that


class Scale(Protocol):
    """What `ScaledNoise` asks of `NoiseScale`."""

    def scale(self) -> tuple[float, float]:
        """Return the factors on the variances of accelerometer and gyroscope."""
        ...

    def gnss(self) -> float:
        """Return the factor on the covariance of fixes."""
        ...

    def learn(self, correction: Correction, psd: Array) -> StateCorrection | None:
        """Take a correction into account, given Qc's diagonal (12,) at factor 1."""
        ...

    def forget(self, evidence: bool) -> None:
        """See `NoiseModel.forget`."""
        ...


class NoiseModel(Protocol):
    """Levels before a prediction, learn after a correction. Copied for every rewind point."""

    @property
    def source(self) -> str:
        """What the levels in force come from: constant, learned, fallback, innovation."""
        ...

    def levels(self) -> Array:
        """Per-sample variances now: accelerometer x y z, gyroscope x y z, shape (6,), b frame."""
        ...

    @property
    def fix_factor(self) -> float:
        """Factor on the covariance that fixes claim."""
        ...

    def refresh(self, t_ns: int, q: Array | None) -> None:
        """Take a regressor's levels at a stamp, shape (6,), or None when it could not tell."""
        ...

    def learn(self, correction: Correction) -> StateCorrection | None:
        """Take a correction into account; may say where the state belongs instead."""
        ...

    def forget(self, evidence: bool) -> None:
        """
        Drop what refers to the present state: it is moved for another reason than noise.

        With ``evidence`` also what was learned: it came from measurements that proved wrong.
        """
        ...


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """
    From per-sample variances to Qc.

    Attributes
    ----------
    bias_walk : ndarray, shape (6,)
        PSD of the bias random walks: [(m/s²)²/s] and [(rad/s)²/s]; IMU parameters.
    period : float
        Nominal IMU sample period [s].
    consistent : bool
        True: Qc = q * period, so that Q^d on velocity is q * period². False: the paper's literal
        reading, Qc = q, which inflates Q^d by 1 / period.
    """

    bias_walk: Array
    period: float
    consistent: bool = True

    def psd(self, q: Array) -> Array:
        """Return Qc's diagonal, shape (12,), for levels ``q``, shape (6,); eq. (19) of [1]_."""
        return np.concatenate((q * self.period if self.consistent else q, self.bias_walk))

    def q(self, psd: Array) -> Array:
        """Return the levels, shape (6,), whose Qc is ``psd``, shape (6,)."""
        return psd / self.period if self.consistent else psd


# MB-EKF-CQ1 to CQ3 of section IV-B of [1]_: variances of accelerometer and gyroscope.
PAPER_CONSTANTS = {"cq1": (0.002, 0.02), "cq2": (0.001, 0.01), "cq3": (0.002, 0.01)}


class ConstantNoise:
    """
    Levels that never change.

    Parameters
    ----------
    q : ndarray, shape (6,)
        Per-sample variances [(m/s²)², (rad/s)²].
    """

    source = "constant"
    fix_factor = 1.0

    def __init__(self, q: Array) -> None:
        self._q = np.array(q, float)

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def refresh(self, t_ns: int, q: Array | None) -> None:
        """Ignore the estimate."""

    def learn(self, correction: Correction) -> None:
        """Ignore the correction."""

    def forget(self, evidence: bool) -> None:
        """See `NoiseModel.forget`."""


class LearnedNoise(Snapshot):
    """
    Levels that a regressor reads off the IMU, and a constant while it cannot tell.

    What it reads holds motion and vibration besides noise: an upper bound, since at no frequency
    do they lie below the noise. Where recordings have told the noise of ordinary motion
    (``fallback``) and what is hardly ever exceeded there (B, ``background``), a level L counts as
    L - B²/L more than that: nothing below B, nearly all of L far above.

    Parameters
    ----------
    fallback : ndarray, shape (6,)
        Levels before the first estimate, and when the last one is older than ``HOLD_NS``: asked
        once a second or more often, the regressor has given way within a second.
    background : ndarray, shape (6,), optional
        See above; zero where it is not known: levels are taken as they are read.
    """

    HOLD_NS = 500_000_000
    fix_factor = 1.0

    def __init__(self, fallback: Array, background: Array | None = None) -> None:
        self._fallback = np.array(fallback, float)
        self._background = np.zeros(6) if background is None else np.array(background, float)
        self._q = self._fallback
        self._estimated_ns: int | None = None

    @property
    def source(self) -> str:
        """See `NoiseModel.source`."""
        return "fallback" if self._estimated_ns is None else "learned"

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def refresh(self, t_ns: int, q: Array | None) -> None:
        """Take a regressor's levels, or let the old ones grow stale."""
        if q is not None:
            self._q, self._estimated_ns = self._beyond_background(q), t_ns
        elif self._estimated_ns is not None and t_ns - self._estimated_ns > self.HOLD_NS:
            self._q, self._estimated_ns = self._fallback, None

    def _beyond_background(self, q: Array) -> Array:
        share = np.divide(self._background, q, out=np.ones(6), where=q > self._background)
        return np.asarray(np.minimum(q, self._fallback + q * (1.0 - share**2)))

    def learn(self, correction: Correction) -> None:
        """Ignore the correction."""

    def forget(self, evidence: bool) -> None:
        """See `NoiseModel.forget`."""


class InnovationNoise:
    """
    Levels from the filter's own innovations, eq. (16)-(18) of [1]_.

    ``K C K'`` is what the corrections of one GNSS interval moved the state by. As process noise
    that is a sum over the interval's IMU steps, so its density is K C K' over the interval; its
    diagonal on velocity and misalignment, turned into b, gives the levels. A high level raises the
    gain that measures it: the levels stay bounded, but settle far above the noise. (Taken
    literally, as the Q^d of every single IMU step, they run away by many orders of magnitude and
    the filter follows the fixes blindly; ``literal`` does that for comparison.)

    Parameters
    ----------
    initial, floor : ndarray, shape (6,)
        Levels before the first ``window`` corrections; lowest levels ever.
    window : int
        Number of innovations averaged, the paper's xi.
    process : ProcessNoise
        Converts the density back to levels.
    literal : bool
        See above.
    """

    source = "innovation"
    fix_factor = 1.0

    def __init__(
        self,
        initial: Array,
        floor: Array,
        window: int,
        process: ProcessNoise,
        literal: bool = False,
    ) -> None:
        self._q = np.array(initial, float)
        self._floor = np.array(floor, float)
        self._window = window
        self._process = process
        self._literal = literal
        self._innovations: tuple[Array, ...] = ()

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def refresh(self, t_ns: int, q: Array | None) -> None:
        """Ignore the estimate."""

    def learn(self, correction: Correction) -> None:
        """Average the innovations and map them through the present gain."""
        if not correction.fused or correction.interval <= 0.0 or len(correction.z) != 3:
            return
        self._innovations = (*self._innovations, correction.z)[-self._window :]
        if len(self._innovations) < self._window:
            return
        moved = np.array(self._innovations) @ correction.K.T
        interval = self._process.period if self._literal else correction.interval
        density = np.concatenate(
            [
                np.mean((moved[:, block] @ correction.C_nb) ** 2, axis=0) / interval
                for block in (DV, EPS)
            ]
        )
        self._q = np.maximum(self._process.q(density), self._floor)

    def forget(self, evidence: bool) -> None:
        """See `NoiseModel.forget`."""
        self._innovations = ()


class ScaledNoise:
    """
    Another model's levels, times what the innovations say of them.

    Parameters
    ----------
    inner : NoiseModel
        Tells the levels that the IMU shows.
    process : ProcessNoise
        Converts them to densities.
    scale : NoiseScale
        Finds the factors.
    """

    def __init__(self, inner: NoiseModel, process: ProcessNoise, scale: Scale) -> None:
        self.inner = inner
        self.scale = scale
        self._process = process

    def __copy__(self) -> ScaledNoise:
        return ScaledNoise(copy.copy(self.inner), self._process, copy.copy(self.scale))

    @property
    def source(self) -> str:
        """See `NoiseModel.source`."""
        return self.inner.source

    @property
    def fix_factor(self) -> float:
        """See `NoiseModel.fix_factor`."""
        return self.scale.gnss()

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        a, g = self.scale.scale()
        levels: Array = self.inner.levels() * np.array((a, a, a, g, g, g))
        return levels

    def refresh(self, t_ns: int, q: Array | None) -> None:
        """See `NoiseModel.refresh`; what a fallback had to be raised by says nothing of levels."""
        before = self.source
        self.inner.refresh(t_ns, q)
        if self.source != before == "fallback" and max(self.scale.scale()) > 1.0:
            self.scale.forget(evidence=True)

    def learn(self, correction: Correction) -> StateCorrection | None:
        """See `NoiseModel.learn`."""
        self.inner.learn(correction)
        return self.scale.learn(correction, self._process.psd(self.inner.levels()))

    def forget(self, evidence: bool) -> None:
        """See `NoiseModel.forget`."""
        self.inner.forget(evidence)
        self.scale.forget(evidence)
