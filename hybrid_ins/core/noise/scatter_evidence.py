"""
What an innovation shows of the scatter of a position, by the method of scoring, [1]_.

References
----------
.. [1] R. H. Shumway, D. S. Stoffer, *Time Series Analysis and Its Applications*, 4th ed., section
       6.3 (maximum likelihood estimation of state-space models).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.update.kalman import innovation_covariance
from hybrid_ins.core.update.linalg import factorise, solve

Evidence = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""See `scatter_evidence`."""


@kernel()
def scatter_evidence(packed, z, H, R, others):  # type: ignore[no-untyped-def]
    """
    Return what an innovation shows of factors on R, horizontally and vertically.

    With S = H P H' + f C + D the slope of its log-likelihood by f is
    (1/2) tr(S^-1 C (S^-1 z z' - 1)), the expected curvature -(1/2) tr(S^-1 C S^-1 C). Since S is
    linear in f, the step by both from any f is without bias. Where the innovation is mostly the
    IMU's, it shows little of f. Of the covariances between height and the rest, each has half.

    Parameters
    ----------
    packed : ndarray, shape (120,)
        Upper triangle of P, before the update.
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        Innovation, measurement matrix, and the covariance that the factors are on.
    others : ndarray, shape (m, m)
        Covariance D of the fix's other errors.

    Returns
    -------
    totals, counts : ndarray, shape (2,)
        The factors that it shows, 1 if R is right, times the number of components that would show
        as much if nothing else were in the innovation; and those numbers, up to 2 and 1.
    normalised : ndarray, shape (m,)
        The innovation by its standard deviations.
    """
    m = len(z)
    root, _ = innovation_covariance(packed, H, R + others)
    normalised = z.copy()
    for a in range(m):
        normalised[a] /= np.sqrt(root[a, a])
    factorise(root)
    y, shown, column = z.copy(), np.empty((m, m)), np.empty(m)
    solve(root, y)
    totals, counts = np.zeros(2), np.zeros(2)
    for part in range(m - 1):
        totals[part], counts[part] = _evidence_on(part, R, root, y, shown, column)
    return totals, counts, normalised


@register_jitable
def _evidence_on(part, R, root, y, shown, column):  # type: ignore[no-untyped-def]
    """Return total and count of `scatter_evidence` of one part: 0 horizontally, 1 vertically."""
    m, square, trace, count = len(y), 0.0, 0.0, 0.0
    for a in range(m):
        for b in range(m):
            column[b] = 0.5 * R[b, a] * ((a // 2 == part) + (b // 2 == part))
            square += y[a] * column[b] * y[b]
        solve(root, column)
        trace += column[a]
        for b in range(m):
            shown[b, a] = column[b]  # S^-1 C
    for a in range(m):
        for b in range(m):
            count += shown[a, b] * shown[b, a]
    return count + square - trace, count
