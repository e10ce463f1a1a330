"""
The Kalman update in Joseph form, and the closed loop that follows it.

An update is `gain` and `apply`; `innovation` is what a gate decides by. `iterated_update` fuses
with these functions, and iterates where the linear update is not accurate enough.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 3.2 and 14.1.1.
.. [2] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (8)-(12).
.. [3] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE
       TAC 62, 2017.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.earth import radii
from hybrid_ins.core.inertial.rotations import skew
from hybrid_ins.core.inertial.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    DP,
    DV,
    EPS,
    LLA,
    N_ERROR,
    PLACES,
    QUAT,
    VELOCITY,
    covariance,
    pack,
    pack_upper,
    unpack,
)
from hybrid_ins.core.inertial.strapdown import half_rotation
from hybrid_ins.core.update.linalg import factorise, solve, whiten

Array = NDArray[np.float64]

NORTH = (DP.start, DV.start, EPS.start)  # of each error in n, followed by east


@kernel()
def innovation(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Return the innovation's covariance S, shape (m, m), and the normalised square z' S^-1 z (NIS).

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending.
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        Innovation (measured minus predicted), measurement matrix, measurement covariance.
    """
    S, _ = innovation_covariance(nav[COVARIANCE], H, R)
    root = S.copy()
    factorise(root)
    return S, whiten(root, z.copy())


@register_jitable
def gain(packed, z, H, R):  # type: ignore[no-untyped-def]
    """Return K z, shape (15,), and the gain K = P H' S^-1, shape (15, m); eq. (10)-(11) of [2]_."""
    root, K = innovation_covariance(packed, H, R)
    factorise(root)
    dx = np.zeros(N_ERROR)
    for i in range(N_ERROR):
        solve(root, K[i])
        for a in range(len(z)):
            dx[i] += K[i, a] * z[a]
    return dx, K


@register_jitable
def apply(nav, dx, K, H, R):  # type: ignore[no-untyped-def]
    """Correct the flat state ``nav`` by ``dx`` and update its covariance by the gain K."""
    joseph_update(nav[COVARIANCE], K, H, R)
    inject(nav, dx)


@register_jitable
def innovation_covariance(packed, H, R):  # type: ignore[no-untyped-def]
    """Return S = H P H' + R, shape (m, m), and P H', shape (15, m); eq. (10) of [2]_."""
    m = H.shape[0]
    PHt, S = np.zeros((N_ERROR, m)), np.empty((m, m))
    for a in range(m):
        for k in range(N_ERROR):
            h = H[a, k]
            if h != 0.0:
                for i in range(N_ERROR):
                    PHt[i, a] += packed[PLACES[k, i]] * h
    for a in range(m):
        for b in range(m):
            S[a, b] = R[a, b]
        for k in range(N_ERROR):
            h = H[a, k]
            if h != 0.0:
                for b in range(m):
                    S[a, b] += h * PHt[k, b]
    return S, PHt


@register_jitable
def covariances_at_full_weight(packed, H, S, weight):  # type: ignore[no-untyped-def]
    """
    Return those of an innovation and of its measurement, (m, m).

    ``S`` is that of the innovation as it was fused: that of the measurement divided by ``weight``.
    """
    m = len(S)
    total, _ = innovation_covariance(packed, H, np.zeros((m, m)))
    R = np.empty((m, m))
    for a in range(m):
        for b in range(m):
            R[a, b] = (S[a, b] - total[a, b]) / weight
            total[a, b] += R[a, b]
    return total, R


@register_jitable
def joseph_update(packed, K, H, R):  # type: ignore[no-untyped-def]
    """
    P <- A P A' + K R K' with A = I - K H, eq. (12) of [2]_ in Joseph's form.

    H has few elements that are not zero: A P is P - K (P H')', and A P A' is A P - (A P) H' K'.
    """
    m = H.shape[0]
    _, PHt = innovation_covariance(packed, H, R)
    AP, right = np.empty((N_ERROR, N_ERROR)), np.zeros((N_ERROR, m))
    unpack(packed, AP)
    for i in range(N_ERROR):
        for a in range(m):
            k = K[i, a]
            for j in range(N_ERROR):
                AP[i, j] -= k * PHt[j, a]
    for i in range(N_ERROR):  # K R - A P H'
        for a in range(m):
            for b in range(m):
                right[i, a] += K[i, b] * R[b, a]
            for k in range(N_ERROR):
                if H[a, k] != 0.0:
                    right[i, a] -= AP[i, k] * H[a, k]
    at = 0
    for i in range(N_ERROR):
        for j in range(i, N_ERROR):
            total = AP[i, j]
            for a in range(m):
                total += right[i, a] * K[j, a]
            packed[at] = total
            at += 1


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
    norm = np.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    for i in range(4):
        quat[i] /= norm


def update_in_body(nav: Array, z: Array, H: Array, R: Array) -> tuple[Array, Array, Array]:
    """
    Fuse a measurement of velocity in b into the flat state ``nav``, in place.

    A turn of the whole trajectory leaves it as it is: it shows no heading. Of the errors before,
    δp and δv contain what a turn ε has moved by: [δp, δv] + [p, v] × ε. Behind the correction it
    is that of the corrected ones, and P becomes T P T', [3]_. Else it would seem to be less than
    that, and the next of such measurements would seem to show the heading.

    Parameters
    ----------
    nav, z, H, R
        See `innovation`.

    Returns
    -------
    dx, K : ndarray, shape (15,), (15, m)
        The correction, and its gain.
    T : ndarray, shape (15, 15)
        See above.
    """
    dx, K = linear_update(nav, z, H, R)
    T = np.eye(N_ERROR)
    T[DP, EPS], T[DV, EPS] = skew(dx[DP]), skew(dx[DV])
    pack(T @ covariance(nav) @ T.T, nav[COVARIANCE])
    return dx, K, T


@kernel()
def linear_update(nav, z, H, R):  # type: ignore[no-untyped-def]
    """Return correction and gain, as `gain`, which the flat state ``nav`` is corrected by."""
    dx, K = gain(nav[COVARIANCE], z, H, R)
    apply(nav, dx, K, H, R)
    return dx, K


def heading_turn(angle: float) -> Array:
    """Return T, shape (15, 15), with which `turn_errors` turns P to T P T'."""
    T, c, s = np.eye(N_ERROR), np.cos(angle), np.sin(angle)
    for north in NORTH:
        T[north : north + 2, north : north + 2] = ((c, s), (-s, c))
    return T


@register_jitable
def turn_errors(packed, angle):  # type: ignore[no-untyped-def]
    """
    Turn the errors in P about the vertical with a heading that was corrected by ``angle`` [rad].

    What an IMU's biases, errors in b, have added to those of position, velocity and tilt, errors in
    n, has the directions of the heading by which it was added up. With another heading the next
    fixes would seem to tell tilt from bias, which a vehicle that goes straight on cannot.
    """
    c, s, P = np.cos(angle), np.sin(angle), np.empty((N_ERROR, N_ERROR))
    unpack(packed, P)
    for i in NORTH:
        for j in range(N_ERROR):
            north, east = P[i, j], P[i + 1, j]
            P[i, j], P[i + 1, j] = c * north + s * east, c * east - s * north
    for j in NORTH:
        for i in range(N_ERROR):
            north, east = P[i, j], P[i, j + 1]
            P[i, j], P[i, j + 1] = c * north + s * east, c * east - s * north
    pack_upper(P, packed)
