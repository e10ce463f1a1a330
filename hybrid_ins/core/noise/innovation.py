"""
Process noise from the filter's innovations, eq. (16)-(18) of [1]_: the paper's baseline.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import DV, EPS
from hybrid_ins.core.noise.process_noise import Correction, NoiseEstimate, ProcessNoise
from hybrid_ins.core.shallow_copy import ShallowCopy

Array = NDArray[np.float64]


class InnovationNoise(ShallowCopy):
    """
    Variances from the filter's own innovations, eq. (16)-(18) of [1]_.

    ``K C K'`` is the covariance of the corrections over one GNSS interval. As process noise it is
    a sum over the interval's IMU steps, so its density is K C K' divided by the interval; its
    diagonal on velocity and misalignment, rotated into b, gives the variances. A high variance
    raises the gain that measures it: the variances stay bounded, but settle far above the noise.
    (Taken literally, as the Q^d of every single IMU step, they diverge by many orders of magnitude
    and the filter follows the fixes alone; ``literal`` does that for comparison.)

    Parameters
    ----------
    initial, floor : ndarray, shape (6,)
        Variances before the first ``window`` corrections; their lower bounds.
    window : int
        Number of innovations averaged, the paper's xi.
    process : ProcessNoise
        Converts the density to variances.
    literal : bool
        See above.
    """

    uses_corrections: ClassVar[bool] = True

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

    def learn(self, observation: NoiseEstimate | Correction) -> bool:
        """Average the innovations and map them through the present gain."""
        if isinstance(observation, NoiseEstimate):
            return False
        correction = observation
        if correction.restarted:
            self._innovations = ()
        if not correction.fused or correction.interval <= 0.0 or len(correction.z) != 3:
            return False
        self._innovations = (*self._innovations, correction.z)[-self._window :]
        if len(self._innovations) < self._window:
            return False
        moved = np.array(self._innovations) @ correction.K.T
        interval = self._process.period if self._literal else correction.interval
        density = np.concatenate(
            [
                np.mean((moved[:, block] @ correction.C_nb) ** 2, axis=0) / interval
                for block in (DV, EPS)
            ]
        )
        self._q = np.maximum(self._process.q(density), self._floor)
        return False
