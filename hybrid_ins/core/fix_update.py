"""
The measurement update by an ordinary fix, in one compiled call.

Nearly all fixes agree with the state so well that the gate gives them their full weight, and
nothing is inflated or rejected. `fuse_ordinary_fix` does with such a fix what
`measurement_update.MeasurementUpdate` does with any: that is the readable form, and both give the
same.
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.clock_offset import VELOCITY_AGE_STD, observe, sensitivities
from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.iterated_update import update
from hybrid_ins.core.kalman import innovation_covariance
from hybrid_ins.core.linalg import factorise, whiten
from hybrid_ins.core.state import CLOCK_VARIANCE, COVARIANCE, N_ERROR, SENSITIVITY, VELOCITY


@kernel()
def fuse_ordinary_fix(nav, z, H, R, is_position, clock, interval, limit):  # type: ignore[no-untyped-def]
    """
    Fuse a fix if its NIS is at most ``limit``; otherwise change nothing.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending; overwritten.
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        Innovation, measurement matrix, and measurement covariance; R is overwritten.
    is_position : bool
        Otherwise the fix is a velocity.
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`; overwritten.
    interval : float
        Time since the last correction by a fix that ``clock`` contains [s].
    limit : float
        `Gate.ordinary_limit`.

    Returns
    -------
    fused : bool
    nis, log_det : float
        Of the innovation, with the variance of the clock offset considered.
    sigma : ndarray, shape (m,)
        Standard deviations used for the fix, likewise.
    S : ndarray, shape (m, m)
        Covariance of the innovation, without it.
    dx, K : ndarray, shape (15,), (15, m)
        Correction and gain.
    """
    m, variance = len(z), nav[CLOCK_VARIANCE]
    finite = limit >= 0.0
    for i in range(len(nav)):
        finite = finite and np.isfinite(nav[i])
    if not finite:
        return False, 0.0, 0.0, z, R, z, H
    h, change = sensitivities(nav, clock, interval, H)
    if variance > 0.0 and not is_position:
        for a in range(m):
            for b in range(m):
                R[a, b] += VELOCITY_AGE_STD**2 * change[a] * change[b]
    S, _ = innovation_covariance(nav[COVARIANCE], H, R)
    root, sigma = np.empty((m, m)), np.empty(m)
    for a in range(m):
        sigma[a] = np.sqrt(R[a, a] + variance * h[a] * h[a])
        for b in range(m):
            root[a, b] = S[a, b] + variance * h[a] * h[b]
    factorise(root)
    nis, log_det = whiten(root, z.copy()), 0.0
    for a in range(m):
        log_det += 2.0 * np.log(root[a, a])
    if not nis <= limit:
        return False, nis, log_det, sigma, S, z, H
    velocity_n = nav[VELOCITY].copy()
    dx, K = update(nav, z, H, R)
    s = nav[SENSITIVITY]
    for i in range(N_ERROR):
        for a in range(m):
            s[i] -= K[i, a] * h[a]
    observe(clock, interval, velocity_n, dx, z, h, S, is_position)
    return True, nis, log_det, sigma, S, dx, K
