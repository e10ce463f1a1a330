"""
Roll and pitch from the mean specific force, and attitudes relative to each other by gyroscopes.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 5.6.2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec

Array = NDArray[np.float64]


class Levelled(NamedTuple):
    """A window of samples that a state is levelled by, and which of them it is of."""

    samples: NDArray[np.void]
    at: int  # index of that one
    down_b: Array  # (3,) direction of gravity in the last attitude, a unit vector
    C_last: Array  # (N, 3, 3) from b at each sample to b at the last

    @property
    def t_ns(self) -> int:
        """Stamp of the state [ns]."""
        return int(self.samples["t_ns"][self.at])

    @property
    def reading(self) -> Array:
        """The sample that the state is of, (6,): specific force [m/s²], angular rate [rad/s]."""
        return np.concatenate((self.samples["f"][self.at], self.samples["w"][self.at]))

    @property
    def C_last_at(self) -> Array:
        """The matrix (3, 3) from b at that sample to b at the last."""
        return np.asarray(self.C_last[self.at])

    def at_last(self) -> Levelled:
        """Return the same for a state of the last sample."""
        return self._replace(at=len(self.samples) - 1)


def levelled(samples: NDArray[np.void], t_ns: int, bias_a: Array, bias_g: Array) -> Levelled:
    """
    Level a state by the mean specific force; [1]_ eq. 5.101.

    It is of the first of ``samples`` (``SAMPLE_DTYPE``) behind a stamp [ns], or of the last one.
    ``bias_a`` and ``bias_g``, shape (3,), are theirs [m/s², rad/s].
    """
    at = min(int(samples["t_ns"].searchsorted(t_ns)), len(samples) - 1)
    unbiased = samples.copy()
    unbiased["f"] -= bias_a
    unbiased["w"] -= bias_g
    C_last = relative_attitudes(unbiased)
    total = np.einsum("kij,kj->i", C_last, unbiased["f"])
    return Levelled(samples, at, -total / np.linalg.norm(total), C_last)


def tilt_by_bias(C_nb: Array) -> Array:
    """
    Return the error ε (3, 3) of a levelled attitude by that of the accelerometers' bias [rad s²/m].

    The attitude is such that no horizontal force is felt, so that this error is one with the bias
    until the vehicle turns: neither shows at a standstill, and both do in a turn.
    """
    return np.asarray(np.array([-C_nb[1], C_nb[0], np.zeros(3)]) / STANDARD_GRAVITY)


def relative_attitudes(samples: NDArray[np.void]) -> Array:
    """Rotations (N, 3, 3) from the attitude at each sample to that at the last, by gyroscopes."""
    dt = np.diff(samples["t_ns"])[:, None] * 1e-9
    mean_rate = 0.5 * (samples["w"][1:] + samples["w"][:-1])
    turns = matrix_from_quat(quat_from_rotvec(-dt * mean_rate))
    relative = np.empty((len(samples), 3, 3))
    relative[-1] = np.eye(3)
    for k in range(len(turns) - 1, -1, -1):
        relative[k] = relative[k + 1] @ turns[k]
    return relative


def roll_pitch(down_b: Array) -> tuple[float, float]:
    """Roll and pitch [rad] of the b frame in which n's down axis is ``down_b``."""
    return (
        math.atan2(down_b[1], down_b[2]),
        math.atan2(-down_b[0], math.hypot(down_b[1], down_b[2])),
    )
