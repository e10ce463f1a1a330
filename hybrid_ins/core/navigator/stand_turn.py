"""
What a stand leaves unknown of the gyroscopes' bias.

A boat at anchor, a balloon or a turntable may turn slowly and evenly while it stands: its readings
are those of a bias about the vertical. While it stands the two need not be told apart. When it sets
off, a turn taken for a bias would turn the heading away for minutes, so half of the mean rate is
allowed for, until the vehicle has moved for so long that fixes have shown its bias.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import B_G, N_ERROR

Array = NDArray[np.float64]

SHARE = 0.5  # of the mean rate about the vertical
MOVED_NS = 20_000_000_000  # of motion, that fixes show: its bias is known better by then


class StandTurn:
    """
    Follows the stands of a vehicle whose gyroscopes' bias motion has not shown yet.

    Parameters
    ----------
    bias_g : ndarray, shape (3,)
        The bias that was given [rad/s], b.

    Attributes
    ----------
    bias_g
        Likewise; what differs from it may be a turn.
    """

    def __init__(self, bias_g: Array) -> None:
        self.bias_g = bias_g
        self.forget()

    def forget(self) -> None:
        """Forget that motion has shown the bias: the filter that learned it was wrong."""
        self._moved_ns = 0
        self._std_g = np.zeros(3)
        self._stands = False

    def follow(
        self, samples: NDArray[np.void], stands: bool, moves: bool, period_ns: int
    ) -> Array | None:
        """
        Use a check of the IMU.

        Parameters
        ----------
        samples : ndarray of SAMPLE_DTYPE
            The last second.
        stands, moves : bool
            The vehicle may stand; fixes show that it moves.
        period_ns : int
            Time since the last check [ns].

        Returns
        -------
        ndarray or None
            Standard deviations, shape (15,), of what a stand taught wrongly; at the second check
            after it, since at the first one a search for the clock begins with the states before.
        """
        if self._moved_ns >= MOVED_NS:
            return None
        if stands:
            force, rate = samples["f"].mean(axis=0), samples["w"].mean(axis=0) - self.bias_g
            down_b = -force / np.linalg.norm(force)
            std_g = SHARE * np.abs((rate @ down_b) * down_b)
            self._std_g, self._stands = np.maximum(self._std_g, std_g), True
            return None
        if moves:
            self._moved_ns += period_ns
        ended, self._stands = not self._stands, False  # at the last check
        if not ended or not self._std_g.any():
            return None
        std = np.zeros(N_ERROR)
        std[B_G], self._std_g = self._std_g, np.zeros(3)
        return std
