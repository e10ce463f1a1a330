"""
The prediction: the state at every IMU sample, the covariance with it or over a few samples at once.

`step` is the live call, `run` and `run_samples` are the same step in a loop.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (5)-(7).
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial._covariance_step import covariance_step
from hybrid_ins.core.inertial.error_model import process_noise, system_matrix
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LAST_F,
    LAST_W,
    LLA,
    MEAN_RATE,
    N_NAV,
    PENDING_C,
    PENDING_DT,
    PENDING_F,
    PRODUCTS,
    PSD,
    QUAT,
    SCRATCH,
    SENSITIVITY,
    SYSTEM,
    VELOCITY,
)
from hybrid_ins.core.inertial.strapdown import mechanise

FASTMATH = {"contract", "arcp"}  # fused multiply-add, reciprocals: rounding only
MEAN_TIME = 0.05  # s, over which acceleration and angular rate are averaged
NO_ROWS = np.empty((0, N_NAV))  # no state is kept
GRAVITY = 9.8  # m/s²: the mean acceleration needs it no better


@kernel(allocates=False, fastmath=FASTMATH)
def propagate_covariance(nav):  # type: ignore[no-untyped-def]
    """
    Propagate the covariance over the time dt that is pending in the flat state ``nav``.

    With F at the mean specific force and attitude of that time, eq. (5)-(7) of [1]_::

        P <- Phi P Phi' + G Qc G' dt,   Phi = I + F dt

    The sensitivities to the clock offset and to the age of velocities move with it, s <- Phi s.
    F is `error_model.system_matrix`, G Qc G' dt is `error_model.process_noise`, and the products
    are the generated `_covariance_step.covariance_step`.
    """
    dt = nav[PENDING_DT]
    if dt <= 0.0:
        return
    f_n = nav[PENDING_F]
    C = nav[PENDING_C]
    for i in range(3):
        f_n[i] /= dt
    for i in range(9):
        C[i] /= dt
    F = nav[SYSTEM].reshape(15, 15)
    system_matrix(nav[LLA], nav[VELOCITY], f_n, C, F)
    q_v, q_eps, q_a, q_g = process_noise(C, nav[PSD], dt)
    s, s_age = nav[SENSITIVITY], nav[AGE_SENSITIVITY]
    covariance_step(nav[COVARIANCE], s, s_age, F, dt, q_v, q_eps, q_a, q_g, nav[PRODUCTS])
    acceleration, share = nav[ACCELERATION], dt / (dt + MEAN_TIME)
    acceleration[0] += share * (f_n[0] - acceleration[0])
    acceleration[1] += share * (f_n[1] - acceleration[1])
    acceleration[2] += share * (f_n[2] + GRAVITY - acceleration[2])
    nav[PENDING_DT] = 0.0
    for i in range(3):
        f_n[i] = 0.0
    for i in range(9):
        C[i] = 0.0


@kernel(allocates=False, fastmath=FASTMATH)
def step(nav, dt, fx, fy, fz, wx, wy, wz, interval):  # type: ignore[no-untyped-def]
    """
    Advance the flat state ``nav`` by one IMU sample.

    The state at every sample, the covariance once ``interval`` is pending::

        x <- f(x, sample)                                   strapdown.mechanise
        P <- Phi P Phi' + G Qc G' dt,   Phi = I + F dt      propagate_covariance

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state, see `core.inertial.state`; overwritten.
    dt : float
        Time since the previous sample [s], > 0.
    fx, fy, fz, wx, wy, wz : float
        Specific force [m/s²] and angular rate [rad/s], b, as measured.
    interval : float
        The covariance is propagated once this much time [s] is pending; 0: at every sample.
    """
    bias_a, bias_g = nav[BIAS_A], nav[BIAS_G]
    last_f, last_w = nav[LAST_F], nav[LAST_W]
    f0 = (last_f[0] - bias_a[0], last_f[1] - bias_a[1], last_f[2] - bias_a[2])
    w0 = (last_w[0] - bias_g[0], last_w[1] - bias_g[1], last_w[2] - bias_g[2])
    f1 = (fx - bias_a[0], fy - bias_a[1], fz - bias_a[2])
    w1 = (wx - bias_g[0], wy - bias_g[1], wz - bias_g[2])
    C, f_n = nav[SCRATCH][:9], nav[SCRATCH][9:]
    mechanise(nav[LLA], nav[VELOCITY], nav[QUAT], f0, w0, f1, w1, dt, C, f_n)
    pending_f, pending_c = nav[PENDING_F], nav[PENDING_C]
    for i in range(3):
        pending_f[i] += dt * f_n[i]
    for i in range(9):
        pending_c[i] += dt * C[i]
    nav[PENDING_DT] += dt
    last_f[0], last_f[1], last_f[2] = fx, fy, fz
    last_w[0], last_w[1], last_w[2] = wx, wy, wz
    rate, share = nav[MEAN_RATE], dt / (dt + MEAN_TIME)
    rate[0] += share * (wx - rate[0])
    rate[1] += share * (wy - rate[1])
    rate[2] += share * (wz - rate[2])
    if nav[PENDING_DT] >= interval:
        propagate_covariance(nav)


@kernel(allocates=False, fastmath=FASTMATH)
def run(nav, dt, samples, interval, rows):  # type: ignore[no-untyped-def]
    """
    Advance ``nav`` by many IMU samples, keeping the state after each where there is room.

    Parameters
    ----------
    dt : ndarray, shape (N,)
        Time from each sample's predecessor [s].
    samples : ndarray, shape (N, 6)
        Specific force and angular rate, b.
    rows : ndarray, shape (N, N_NAV) or (0, N_NAV)
        Written: the flat state after each sample; an empty array keeps nothing.
    """
    keep = rows.shape[0] > 0
    for k in range(dt.shape[0]):
        s = samples[k]
        step(nav, dt[k], s[0], s[1], s[2], s[3], s[4], s[5], interval)
        if keep:
            for i in range(N_NAV):
                rows[k, i] = nav[i]


@kernel(allocates=False)
def _seconds(duration_ns):  # type: ignore[no-untyped-def]
    """Return a time [s], rounded: `step` must not fuse the product with its own operations."""
    return duration_ns * 1e-9


@kernel(allocates=False, fastmath=FASTMATH)
def run_samples(  # type: ignore[no-untyped-def]
    nav, t_ns, numbers, integers, long_step_ns, interval, rows
):
    """
    Advance ``nav`` as `run`, up to the first gap; return how many samples that were.

    Parameters
    ----------
    t_ns : int
        Stamp of ``nav`` [ns].
    numbers, integers : ndarray, shape (N, 7)
        `samples.as_numbers`, and the same bits as integers: the first column are the stamps [ns].
    long_step_ns : int
        A longer step [ns] is a gap.
    interval, rows
        See `run`.
    """
    keep = rows.shape[0] > 0
    for k in range(numbers.shape[0]):
        step_ns = integers[k, 0] - t_ns
        if step_ns > long_step_ns:
            return k
        t_ns = integers[k, 0]
        s = numbers[k]
        step(nav, _seconds(step_ns), s[1], s[2], s[3], s[4], s[5], s[6], interval)
        if keep:
            for i in range(N_NAV):
                rows[k, i] = nav[i]
    return numbers.shape[0]
