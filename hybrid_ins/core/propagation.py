"""
The compiled filter step: mechanisation at every IMU sample, covariance with it or in short bundles.

``step`` is the live call, ``run`` the same step in a loop for recorded data. Both are made of
`strapdown.mechanise`, `error_model.system_matrix` and the generated `covariance_step`.
"""

from __future__ import annotations

from hybrid_ins.core._covariance_step import covariance_step
from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.error_model import system_matrix
from hybrid_ins.core.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LAST_F,
    LAST_W,
    LLA,
    N_NAV,
    PENDING_C,
    PENDING_DT,
    PENDING_F,
    PSD,
    QUAT,
    SCRATCH,
    SYSTEM,
    VELOCITY,
)
from hybrid_ins.core.strapdown import mechanise


@kernel(fastmath={"contract"})
def flush(nav):  # type: ignore[no-untyped-def]
    """Propagate the covariance over the time that is pending in the flat state ``nav``."""
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
    psd = nav[PSD]
    ax, ay, az = dt * psd[0], dt * psd[1], dt * psd[2]
    gx, gy, gz = dt * psd[3], dt * psd[4], dt * psd[5]
    q_v = (
        C[0] * C[0] * ax + C[1] * C[1] * ay + C[2] * C[2] * az,
        C[0] * C[3] * ax + C[1] * C[4] * ay + C[2] * C[5] * az,
        C[0] * C[6] * ax + C[1] * C[7] * ay + C[2] * C[8] * az,
        C[3] * C[3] * ax + C[4] * C[4] * ay + C[5] * C[5] * az,
        C[3] * C[6] * ax + C[4] * C[7] * ay + C[5] * C[8] * az,
        C[6] * C[6] * ax + C[7] * C[7] * ay + C[8] * C[8] * az,
    )
    q_eps = (
        C[0] * C[0] * gx + C[1] * C[1] * gy + C[2] * C[2] * gz,
        C[0] * C[3] * gx + C[1] * C[4] * gy + C[2] * C[5] * gz,
        C[0] * C[6] * gx + C[1] * C[7] * gy + C[2] * C[8] * gz,
        C[3] * C[3] * gx + C[4] * C[4] * gy + C[5] * C[5] * gz,
        C[3] * C[6] * gx + C[4] * C[7] * gy + C[5] * C[8] * gz,
        C[6] * C[6] * gx + C[7] * C[7] * gy + C[8] * C[8] * gz,
    )
    q_a = (dt * psd[6], dt * psd[7], dt * psd[8])
    q_g = (dt * psd[9], dt * psd[10], dt * psd[11])
    covariance_step(nav[COVARIANCE], F, dt, q_v, q_eps, q_a, q_g)
    nav[PENDING_DT] = 0.0
    for i in range(3):
        f_n[i] = 0.0
    for i in range(9):
        C[i] = 0.0


@kernel(fastmath={"contract"})
def step(nav, dt, fx, fy, fz, wx, wy, wz, interval):  # type: ignore[no-untyped-def]
    """
    Advance the flat state ``nav`` by one IMU sample.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state, see `core.state`; overwritten.
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
    if nav[PENDING_DT] >= interval:
        flush(nav)


@kernel(fastmath={"contract"})
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
