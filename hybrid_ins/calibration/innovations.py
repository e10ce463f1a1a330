"""
The innovations of a whole recording for given parameters, in one compiled pass.

It is `InsFilter` over a recording in order and without a gate, for an optimiser that calls it
thousands of times.

References
----------
.. [1] F. C. Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE
       Transactions on Information Theory 11, 1965.
.. [2] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
       distribution", Journal of the American Statistical Association 84, 1989.
"""

from __future__ import annotations

from functools import cache
from math import lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.propagation import propagate_covariance, step
from hybrid_ins.core.inertial.state import LAST_F, LAST_W, N_ERROR, N_NAV, PSD
from hybrid_ins.core.noise.slow_error import NO_GROWTH, change_slow_error
from hybrid_ins.core.sensor_errors.clock_sensitivity import (
    correct_sensitivities,
    noise_information,
    sensitivities,
)
from hybrid_ins.core.update.iterated_update import update
from hybrid_ins.core.update.kalman import innovation
from hybrid_ins.core.update.linalg import factorise, whiten
from hybrid_ins.core.update.measurements import position_model, velocity_model

Array = NDArray[np.float64]

POSITION, VELOCITY = 0, 1
INFORMATION, OF_NOISE = range(2)
"""What an innovation says of the clock offset [1/s²], and how much of that is noise of the INS; see
`hybrid_ins.core.sensor_errors.clock_sensitivity`."""

N_SAID = 2


@kernel(nogil=True)
def innovations(  # type: ignore[no-untyped-def]
    nav,
    t,
    samples,
    noise,
    aid_t,
    aid_kind,
    aid,
    aid_R,
    slow,
    lever_b,
    interval,
    tail,
    z,
    S,
    nis,
    states,
    clock,
):
    """
    Run the filter from ``nav`` over samples and later aiding measurements, up to the last of these.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state at the first sample, its noise densities set; overwritten.
    t, samples : ndarray, shape (N,), (N, 6)
        Time [s], specific force [m/s²] and angular rate [rad/s], b.
    noise : ndarray, shape (N, 2)
        Factors on the noise densities of accelerometer and gyroscope that ``nav`` has at first.
    aid_t, aid_kind, aid, aid_R : ndarray, shape (M,), (M,), (M, 3), (M, 3, 3)
        Measurements in order of time [s, IMU clock]: positions [rad, rad, m] or velocities
        [m/s, NED]; a component that is NaN is left out.
    slow : ndarray, shape (M, 3)
        Variance of a slow error of the positions [m²], NED: it is in the position of the state, and
        changes from one to the next, see `hybrid_ins.core.noise.position_scatter`.
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b.
    interval : float
        The covariance is propagated once this much time [s] is pending.
    tail : float
        Degrees of freedom of the Student-t distribution assumed for the measurements: outliers
        are given less weight rather than gated [2]_; 0: Gaussian.
    z, S, nis : ndarray, shape (M, 3), (M, 3, 3), (M,)
        Written: innovations, covariances, normalised squares; NaN for a measurement outside the
        samples or at the first, and for a component that was not given (S there: unit diagonal).
    states : ndarray, shape (M, N_NAV) or (0, N_NAV)
        Written if it is not empty: the flat state after each measurement.
    clock : ndarray, shape (M, N_SAID) or (0, N_SAID)
        Written if it is not empty: what each innovation says of the clock offset.
    """
    z[:], S[:], nis[:] = np.nan, np.nan, np.nan
    keep, keep_clock = states.shape[0] > 0, clock.shape[0] > 0
    clock[:], nothing = 0.0, np.empty(0)
    count, n, i, k, now = aid_t.shape[0], t.shape[0], 1, 0, t[0]
    last_fix = now
    nav[LAST_F], nav[LAST_W] = samples[0, :3], samples[0, 3:]
    f, w = nav[LAST_F], nav[LAST_W]
    psd = nav[PSD][:6].copy()
    while k < count and aid_t[k] <= now:  # the first state is made of them
        k += 1
    while i < n and k < count:
        aiding = aid_t[k] <= t[i]
        then = aid_t[k] if aiding else t[i]
        if then > now:
            # Between two samples the reading is interpolated linearly.
            s, a = samples[i], (then - now) / (t[i] - now)
            for axis in range(6):
                nav[PSD][axis] = psd[axis] * noise[i, axis // 3]
            step(
                nav,
                then - now,
                f[0] + a * (s[0] - f[0]),
                f[1] + a * (s[1] - f[1]),
                f[2] + a * (s[2] - f[2]),
                w[0] + a * (s[3] - w[0]),
                w[1] + a * (s[4] - w[1]),
                w[2] + a * (s[5] - w[2]),
                interval,
            )
            now = then
        if not aiding:
            i += 1
            continue
        propagate_covariance(nav)
        is_position = aid_kind[k] == POSITION
        if is_position:
            change_slow_error(nav, slow[k], now - last_fix, NO_GROWTH)
            last_fix = now
            residual, H = position_model(nav, aid[k], lever_b)
        else:
            residual, H = velocity_model(nav, aid[k], lever_b)
        said = clock[k] if keep_clock else nothing
        nis[k] = _fuse(nav, residual, H, aid_R[k], is_position, tail, z[k], S[k], said)
        if keep:
            states[k] = nav[:N_NAV]
        k += 1


@kernel()
def _fuse(nav, residual, H, R, is_position, tail, z, S, said):  # type: ignore[no-untyped-def]
    given = np.flatnonzero(np.isfinite(residual))
    m = given.shape[0]
    r, H_given, R_given = np.empty(m), np.empty((m, N_ERROR)), np.empty((m, m))
    for i in range(m):
        r[i] = residual[given[i]]
        H_given[i] = H[given[i]]
        for j in range(m):
            R_given[i, j] = R[given[i], given[j]]
    S_given, square = innovation(nav, r, H_given, R_given)
    S[:] = np.eye(3)
    for i in range(m):
        z[given[i]] = r[i]
        for j in range(m):
            S[given[i], given[j]] = S_given[i, j]
    scale = 1.0
    if tail > 0.0 and square > m:
        scale = (tail + square) / (tail + m)
        R_given *= scale
    if said.shape[0] == 0:
        update(nav, r, H_given, R_given)
        return square
    h, _ = sensitivities(nav, H_given)
    root, to_offset = S_given.copy(), h[:, 0].copy()
    factorise(root)
    said[INFORMATION] = whiten(root, to_offset) / scale
    dx, K, _ = update(nav, r, H_given, R_given)
    correct_sensitivities(nav, H_given, K, h, dx, is_position)
    said[OF_NOISE] = noise_information(nav, H_given, K, S_given, is_position) / scale
    return square


def log_likelihood(z: Array, S: Array, nis: Array, tail: float) -> Array:
    """
    Return the log-density (M,) of the innovations written by `innovations`; [1]_.

    Multivariate Student t with ``tail`` degrees of freedom, eq. (1) of [2]_, scaled so that
    Gaussian innovations have the largest likelihood at their own covariance; Gaussian for ``tail``
    0. Zero for a measurement outside the samples.
    """
    m = np.sum(np.isfinite(z), axis=1)
    used = np.isfinite(nis)
    safe = np.where(used[:, None, None], S, np.eye(3))
    half_log_det = 0.5 * np.linalg.slogdet(safe)[1]
    square = np.where(used, nis, 0.0)
    if tail:
        scale = np.array([gaussian_scale(tail, k) for k in range(4)])
        constant = np.array(
            [
                lgamma(0.5 * (tail + k)) - lgamma(0.5 * tail) - 0.5 * k * log(pi * scale[k])
                for k in range(4)
            ]
        )
        value = constant[m] - half_log_det - 0.5 * (tail + m) * np.log1p(square / scale[m])
    else:
        value = -half_log_det - 0.5 * square - 0.5 * m * log(2.0 * pi)
    return np.where(used, value, 0.0)


@cache
def gaussian_scale(tail: float, m: int) -> float:
    """
    Return the b for which (1 + nis / b)^-((tail + m) / 2) is unbiased on Gaussian data.

    There, the mean of (tail + m) nis / (b + nis) over chi-square(m) is m. A Student t of
    covariance S would overestimate the covariance of Gaussian innovations.
    """
    if m == 0:
        return tail
    from scipy.special import gammaincinv  # here: it takes longer to load than numpy

    probability = (np.arange(4000) + 0.5) / 4000
    square = 2.0 * gammaincinv(0.5 * m, probability)  # chi-square quantiles
    low, high = 0.1 * tail, 2.0 * tail
    while low < (b := 0.5 * (low + high)) < high:
        if np.mean((tail + m) * square / (b + square)) > m:
            low = b
        else:
            high = b
    return b


def empty_states(count: int = 0) -> Array:
    """Return an array for ``count`` flat states."""
    return np.zeros((count, N_NAV))
