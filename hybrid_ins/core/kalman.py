"""
The Kalman update in Joseph form and the closed loop that follows it.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 3.2 and 14.1.1.
.. [2] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (8)-(12).
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.earth import radii
from hybrid_ins.core.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
    pack,
    unpack,
)
from hybrid_ins.core.strapdown import half_rotation


@kernel()
def innovation(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Return the innovation's covariance S, shape (m, m), and its normalised square (NIS).

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending.
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        Innovation (measured minus predicted), measurement matrix, measurement covariance.
    """
    P = np.empty((N_ERROR, N_ERROR))
    unpack(nav[COVARIANCE], P)
    S = H @ P @ H.T + R
    return S, z @ np.linalg.solve(S, z)


@kernel()
def correct(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Fuse a measurement into the flat state ``nav``, in place; parameters as in `innovation`.

    Returns
    -------
    dx, K : ndarray, shape (15,), (15, m)
        The correction that was applied and the gain it came from, eq. (10)-(11) of [2]_.
    """
    P = np.empty((N_ERROR, N_ERROR))
    unpack(nav[COVARIANCE], P)
    PHt = P @ H.T
    K = np.linalg.solve(H @ PHt + R, PHt.T).T
    dx = K @ z
    A = np.eye(N_ERROR) - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    pack(P, nav[COVARIANCE])
    inject(nav, dx)
    return dx, K


@kernel()
def inject(nav, dx):  # type: ignore[no-untyped-def]
    """Move the estimate by the error state ``dx``, shape (15,): the closed loop's reset."""
    lla, quat = nav[LLA], nav[QUAT]
    meridian, transverse = radii(lla[0])
    lla[1] += dx[1] / ((transverse + lla[2]) * np.cos(lla[0]))
    lla[0] += dx[0] / (meridian + lla[2])
    lla[2] -= dx[2]
    velocity, bias_a, bias_g = nav[VELOCITY], nav[BIAS_A], nav[BIAS_G]
    for i in range(3):
        velocity[i] += dx[3 + i]
        bias_a[i] += dx[9 + i]
        bias_g[i] += dx[12 + i]
    # C_nb <- exp(-[eps x]) C_nb; a large correction is applied in parts the series is exact for.
    ex, ey, ez = -dx[6], -dx[7], -dx[8]
    parts = int(4.0 * np.sqrt(ex * ex + ey * ey + ez * ez)) + 1
    ex, ey, ez = ex / parts, ey / parts, ez / parts
    s, c = half_rotation(ex, ey, ez)
    ex, ey, ez = s * ex, s * ey, s * ez
    for _ in range(parts):
        x, y, z, w = quat[0], quat[1], quat[2], quat[3]
        quat[0] = c * x + ex * w + ey * z - ez * y
        quat[1] = c * y - ex * z + ey * w + ez * x
        quat[2] = c * z + ex * y - ey * x + ez * w
        quat[3] = c * w - ex * x - ey * y - ez * z
    quat /= np.sqrt(np.sum(quat * quat))
