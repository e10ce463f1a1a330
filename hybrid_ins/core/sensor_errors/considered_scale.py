"""
What scale errors that are considered do to a state in an outage, as a smoother needs it.

They are n, of covariance I, and the errors of the state are correlated with them: C = E[δ nᵀ]. What
the samples add to the errors, D n, is told in part by the errors before it, δ⁻, since they contain
n, too. Of the state alone::

    δ⁺ = J δ⁻ + w,   J = I + D Cᵀ P⁻¹,   Q = cov(w) = D (I - Cᵀ P⁻¹ C) Dᵀ,

with which J P Jᵀ + Q is what `ScaleErrorObserver.follow` makes of P: it may become smaller, yet Q
has no negative eigenvalue, and a smoother takes J for a transition, [1]_.

References
----------
.. [1] H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of linear dynamic systems",
       AIAA Journal 3, 1965.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import COVARIANCE, N_ERROR, PLACES, covariance, pack
from hybrid_ins.core.update.kalman import inject

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ScaleStep:
    """What scale errors have done to a state since the event before."""

    dx: Array  # (15,) by which it was corrected
    J: Array  # (15, 15)
    Q: Array  # (15, 15)

    def apply(self, nav: Array) -> None:
        """Do it to a flat state, which is changed."""
        pack(self.J @ covariance(nav) @ self.J.T + self.Q, nav[COVARIANCE])
        inject(nav, self.dx)


class Considered(NamedTuple):
    """What was done to a state at an event in an outage."""

    dx: Array  # (15,)
    C: Array  # (15, N_SCALE)
    D: Array  # (15, N_SCALE)
    packed: Array  # (120,) upper triangle of P before

    @property
    def step(self) -> ScaleStep:
        """See `ScaleStep`."""
        told = _regression(self.packed[PLACES], self.C).T
        D = self.D
        return ScaleStep(self.dx, np.eye(N_ERROR) + D @ told, D @ D.T - D @ (told @ self.C) @ D.T)


def told_by_state(nav: Array, C: Array, own: Array) -> tuple[Array, Array]:
    """
    Return how the error of a flat state tells a measurement's own n, and what it leaves of that.

    ``own``, shape (m, N_SCALE), is the derivative of z by n beside that through the state. The
    former, (m, 15), is a part of H, the covariance of the latter, (m, m), one of R.
    """
    common = C @ own.T
    told = _regression(covariance(nav), common).T
    rest = own @ own.T - told @ common
    return told, 0.5 * (rest + rest.T)


def _regression(P: Array, C: Array) -> Array:
    """Return P⁻¹ C, shape (15, k); elements of P differ by ten orders of magnitude."""
    std = np.sqrt(np.diag(P))[:, None]
    return np.asarray(np.linalg.solve(P / (std * std.T), C / std) / std)
