"""
Jumps of GNSS positions that their receiver does not claim.

A receiver that takes a float solution for a fixed one, or fixes wrong ambiguities, claims
centimetres and is off by decimetres or metres for seconds to minutes, [1]_. Where it loses or gains
that solution its positions jump. No error of an INS does: the jump shows how large the error of
these positions is, before or after it, though not which of them is right. So from the first jump on
the mean square of the jumps is the variance of an error that is considered, as the slow one of
`position_scatter` is: it is added to the covariance of the position that is reported. Between jumps
the error is constant; the filter follows the fixes as ever. What was learned fades
while none jumps.

References
----------
.. [1] P. Teunissen, O. Montenbruck (eds.), *Springer Handbook of Global Navigation Satellite
       Systems*, 2017, section 23.4 (ambiguity success rate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JUMP_MEMORY = 300.0  # s, over which a jump is forgotten: wrong solutions last for minutes
UNCLAIMED = 2.0  # times what a position claims: less is no jump
DOUBTED_NS = 10_000_000_000  # after a fault of the IMU: the state may have been wrong


@dataclass(frozen=True, slots=True)
class PositionJumps:
    """
    Mean square of the jumps of positions.

    Attributes
    ----------
    size : float
        Of the last jump [m].
    claimed_std : float
        Standard deviation that the position after it claimed, horizontally [m].
    count : float
        Of the jumps; earlier ones count less.
    squares, last : ndarray, shape (3,)
        Sum of their squares, which fades likewise, and that of the last [m²], NED.
    t_ns : int
        Stamp of the last [ns].
    doubted_ns : int
        Until then a jump may be one of the state [ns].
    """

    size: float = 0.0
    claimed_std: float = 0.0
    count: float = 0.0
    squares: Array = field(default_factory=lambda: np.zeros(3))
    last: Array = field(default_factory=lambda: np.zeros(3))
    t_ns: int = 0
    doubted_ns: int = 0

    def doubted(self, t_ns: int) -> PositionJumps:
        """Return these, the IMU being faulty at a stamp [ns]: for a while no jump is learned."""
        return replace(self, doubted_ns=t_ns + DOUBTED_NS)

    def may_be_of_state(self, t_ns: int) -> bool:
        """Return whether a jump at a stamp [ns] may be one of the state."""
        return t_ns < self.doubted_ns

    def learned(self, z: Array, S: Array, claimed: Array, t_ns: int) -> PositionJumps:
        """
        Return these and a jump that neither errors of the state nor what is claimed explain.

        Parameters
        ----------
        z, S, claimed : ndarray, shape (m,), (m, m), (m, m)
            Innovation of a position [m], NED, its covariance, and that of the position; they may
            lack the height.
        t_ns : int
            Stamp [ns].
        """
        size = float(np.linalg.norm(z))
        if self.may_be_of_state(t_ns) or size < UNCLAIMED * math.sqrt(np.trace(claimed)):
            return self
        square = np.zeros(3)
        square[: len(z)] = np.maximum(z**2 - S.diagonal(), 0.0)
        square[:2] = square[:2].mean()
        square[2] = max(square[2], square[0])  # satellites show the height less than the rest
        fading = self._fading(t_ns)
        return replace(
            self,
            size=size,
            claimed_std=math.sqrt(0.5 * (claimed[0, 0] + claimed[1, 1])),
            count=fading * self.count + 1.0,
            squares=fading * self.squares + square,
            last=square,
            t_ns=t_ns,
        )

    def or_earlier(self, earlier: PositionJumps, t_ns: int) -> PositionJumps:
        """Return these, or those of an earlier filter where they are more, by a stamp [ns]."""
        went_back = earlier.t_ns > t_ns
        return self if went_back or self.count >= earlier.count else earlier

    def variance(self, t_ns: int) -> Array:
        """Return the variance of the positions' error by jumps at a stamp [ns], (3,) m², NED."""
        if self.count == 0.0:
            return self.squares
        variance = self._fading(t_ns) * np.maximum(self.squares / self.count, self.last)
        return np.asarray(variance if variance.max() >= self.claimed_std**2 else 0.0 * variance)

    def _fading(self, t_ns: int) -> float:
        """Return what is left at a stamp [ns] of what was learned up to the last jump."""
        return math.exp(-max(t_ns - self.t_ns, 0) * 1e-9 / JUMP_MEMORY)
