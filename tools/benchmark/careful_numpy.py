"""
The filter of ``hybrid_ins.core`` once more, in NumPy alone and as fast as that gets.

It is what a careful author writes who may not compile: scalars stay Python floats, arrays and
views are made once, one fancy assignment fills F, nothing is computed twice. The benchmark
compares with it, in speed and in accuracy.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import earth

Array = NDArray[np.float64]

_ENTRIES = [
    (0, 0), (0, 2), (1, 0), (1, 1), (1, 2),
    (3, 0), (3, 2), (3, 3), (3, 4), (3, 5), (3, 7), (3, 8), (3, 9), (3, 10), (3, 11),
    (4, 0), (4, 2), (4, 3), (4, 4), (4, 5), (4, 6), (4, 8), (4, 9), (4, 10), (4, 11),
    (5, 0), (5, 2), (5, 3), (5, 4), (5, 6), (5, 7), (5, 9), (5, 10), (5, 11),
    (6, 0), (6, 2), (6, 4), (6, 7), (6, 8), (6, 12), (6, 13), (6, 14),
    (7, 0), (7, 2), (7, 3), (7, 6), (7, 8), (7, 12), (7, 13), (7, 14),
    (8, 0), (8, 2), (8, 4), (8, 6), (8, 7), (8, 12), (8, 13), (8, 14),
]  # fmt: skip


class CarefulFilter:
    """
    Mechanisation, error model and update of the 15-state filter.

    Parameters
    ----------
    lla, velocity_n, quat_xyzw : ndarray, shape (3,), (3,), (4,)
        As in `core.state.NavState`; biases start at zero.
    P : ndarray, shape (15, 15)
        Covariance.
    reading : ndarray, shape (6,)
        The last IMU sample.
    psd : ndarray, shape (12,)
        Diagonal of Qc.
    """

    def __init__(
        self, lla: Array, velocity_n: Array, quat_xyzw: Array, P: Array, reading: Array, psd: Array
    ) -> None:
        self.lla = [float(v) for v in lla]
        self.velocity = [float(v) for v in velocity_n]
        self.quat = [float(v) for v in quat_xyzw]
        self.bias = [0.0] * 6
        self.last = [float(v) for v in reading]
        self.psd = np.asarray(psd, float)
        self.P = np.array(P, float)
        self.F = np.zeros((15, 15))
        self.F[0, 3] = self.F[1, 4] = self.F[2, 5] = 1.0
        self._F_flat = self.F.reshape(-1)
        self._entries = np.array([15 * i + j for i, j in _ENTRIES])
        self._identity = np.eye(15)
        self._Phi = np.empty((15, 15))
        self._A = np.empty((15, 15))
        self._C = np.empty((3, 3))
        self._psd_white = self.psd[:6].reshape(2, 1, 3)
        self._scaled = np.empty((2, 3, 3))
        self._Q = np.empty((2, 3, 3))
        self._own_views()

    def _own_views(self) -> None:
        """Views of P: its velocity and attitude blocks, shape (2, 3, 3), and biases' variances."""
        row, column = self.P.strides
        self._white = np.lib.stride_tricks.as_strided(
            self.P[3:, 3:], (2, 3, 3), (3 * (row + column), row, column)
        )
        self._bias_variance = self.P.reshape(-1)[9 * 16 :: 16]

    def step(self, dt: float, reading: list[float]) -> None:
        """Advance by one IMU sample: mechanisation, F, covariance."""
        f_n = self._mechanise(dt, reading)
        self._covariance(dt, f_n)

    def _mechanise(self, dt: float, reading: list[float]) -> tuple[float, float, float]:
        b, last = self.bias, self.last
        f0x, f0y, f0z = last[0] - b[0], last[1] - b[1], last[2] - b[2]
        w0x, w0y, w0z = last[3] - b[3], last[4] - b[4], last[5] - b[5]
        f1x, f1y, f1z = reading[0] - b[0], reading[1] - b[1], reading[2] - b[2]
        w1x, w1y, w1z = reading[3] - b[3], reading[4] - b[4], reading[5] - b[5]
        self.last = reading
        lat, lon, height = self.lla
        vn, ve, vd = self.velocity
        self._sin = sin_lat = sin(lat)
        self._cos = cos_lat = cos(lat)
        sin_sq = sin_lat * sin_lat
        self._w = w = 1.0 - earth.ECCENTRICITY_SQ * sin_sq
        root = sqrt(w)
        self._transverse = transverse_0 = earth.SEMI_MAJOR_AXIS / root
        self._meridian = meridian_0 = transverse_0 * (1.0 - earth.ECCENTRICITY_SQ) / w
        meridian, transverse = meridian_0 + height, transverse_0 + height
        tan_lat = sin_lat / cos_lat
        ie_n, ie_d = earth.EARTH_RATE * cos_lat, -earth.EARTH_RATE * sin_lat
        en_n, en_e = ve / transverse, -vn / meridian
        en_d = -en_n * tan_lat

        half, twelfth = 0.5 * dt, dt * dt / 12.0
        ax = half * (w0x + w1x) + twelfth * (w0y * w1z - w0z * w1y)
        ay = half * (w0y + w1y) + twelfth * (w0z * w1x - w0x * w1z)
        az = half * (w0z + w1z) + twelfth * (w0x * w1y - w0y * w1x)
        ux, uy, uz = half * (f0x + f1x), half * (f0y + f1y), half * (f0z + f1z)
        dx = (
            ux
            + 0.5 * (ay * uz - az * uy)
            + twelfth * (w0y * f1z - w0z * f1y + f0y * w1z - f0z * w1y)
        )
        dy = (
            uy
            + 0.5 * (az * ux - ax * uz)
            + twelfth * (w0z * f1x - w0x * f1z + f0z * w1x - f0x * w1z)
        )
        dz = (
            uz
            + 0.5 * (ax * uy - ay * ux)
            + twelfth * (w0x * f1y - w0y * f1x + f0x * w1y - f0y * w1x)
        )

        x, y, z, s = self.quat
        c00, c01, c02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - s * z), 2.0 * (x * z + s * y)
        c10, c11, c12 = 2.0 * (x * y + s * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - s * x)
        c20, c21, c22 = 2.0 * (x * z - s * y), 2.0 * (y * z + s * x), 1.0 - 2.0 * (x * x + y * y)
        self._rotation = c00, c01, c02, c10, c11, c12, c20, c21, c22
        tn = c00 * dx + c01 * dy + c02 * dz
        te = c10 * dx + c11 * dy + c12 * dz
        td = c20 * dx + c21 * dy + c22 * dz
        rn, re, rd = dt * (ie_n + en_n), dt * en_e, dt * (ie_d + en_d)
        un = tn - 0.5 * (re * td - rd * te)
        ue = te - 0.5 * (rd * tn - rn * td)
        ud = td - 0.5 * (rn * te - re * tn)

        surface = earth.GRAVITY_EQUATOR * (1.0 + earth.SOMIGLIANA * sin_sq) / root
        flattening = 1.0 + earth.FLATTENING * (1.0 - 2.0 * sin_sq) + earth.GRAVITY_RATIO
        self._slope = slope = -2.0 * surface * flattening / earth.SEMI_MAJOR_AXIS
        self._curve = curve = 3.0 * surface / earth.SEMI_MAJOR_AXIS**2
        self._tilt = tilt = earth.NORTH_GRADIENT * 2.0 * sin_lat * cos_lat
        g_n, g_d = tilt * height, surface + (slope + curve * height) * height
        kn, ke, kd = 2.0 * ie_n + en_n, en_e, 2.0 * ie_d + en_d
        mn = vn + 0.5 * (un + dt * (g_n + kd * ve - ke * vd))
        me = ve + 0.5 * (ue + dt * (kn * vd - kd * vn))
        md = vd + 0.5 * (ud + dt * (g_d + ke * vn - kn * ve))
        new_n = vn + un + dt * (g_n + kd * me - ke * md)
        new_e = ve + ue + dt * (kn * md - kd * mn)
        new_d = vd + ud + dt * (g_d + ke * mn - kn * me)
        self.velocity = [new_n, new_e, new_d]

        mean_n, mean_e = 0.5 * (vn + new_n), 0.5 * (ve + new_e)
        turn = dt * mean_n / meridian
        self.lla = [
            lat + turn,
            lon + dt * mean_e / (transverse * (cos_lat - 0.5 * turn * sin_lat)),
            height - half * (vd + new_d),
        ]

        en_n = mean_e / transverse
        rn, re, rd = dt * (ie_n + en_n), -turn, dt * (ie_d - en_n * tan_lat)
        angle = 0.25 * (ax * ax + ay * ay + az * az)
        scale = 0.5 * (1.0 - angle / 6.0 * (1.0 - angle / 20.0 * (1.0 - angle / 42.0)))
        c = 1.0 - angle / 2.0 * (1.0 - angle / 12.0 * (1.0 - angle / 30.0))
        bx, by, bz = scale * ax, scale * ay, scale * az
        qx = s * bx + x * c + y * bz - z * by
        qy = s * by - x * bz + y * c + z * bx
        qz = s * bz + x * by - y * bx + z * c
        qw = s * c - x * bx - y * by - z * bz
        nx, ny, nz = -0.5 * rn, -0.5 * re, -0.5 * rd
        x = qx + nx * qw + ny * qz - nz * qy
        y = qy - nx * qz + ny * qw + nz * qx
        z = qz + nx * qy - ny * qx + nz * qw
        s = qw - nx * qx - ny * qy - nz * qz
        norm = 1.5 - 0.5 * (x * x + y * y + z * z + s * s)
        self.quat = [x * norm, y * norm, z * norm, s * norm]
        return un / dt, ue / dt, ud / dt

    def _covariance(self, dt: float, f_n: tuple[float, float, float]) -> None:
        sin_lat, cos_lat, w = self._sin, self._cos, self._w
        vn, ve, vd = self.velocity
        height = self.lla[2]
        fn, fe, fd = f_n
        tan_lat = sin_lat / cos_lat
        bend = earth.ECCENTRICITY_SQ * sin_lat * cos_lat / w
        rm, rt = 1.0 / (self._meridian + height), 1.0 / (self._transverse + height)
        ie_n, ie_d = earth.EARTH_RATE * cos_lat, -earth.EARTH_RATE * sin_lat
        h_n, h_e = ve * rt * rt, -vn * rm * rm
        h_d = -h_n * tan_lat
        en_n, en_e, en_d = ve * rt, -vn * rm, -ve * tan_lat * rt
        in_n, in_d = ie_n + en_n, ie_d + en_d
        kn, kd = in_n + ie_n, in_d + ie_d
        d_transverse = self._transverse * bend
        g_n = rm * (ie_d - h_n * d_transverse)
        g_e = -h_e * rm * 3.0 * self._meridian * bend
        g_d = rm * (-ie_n - en_n / (cos_lat * cos_lat) + h_n * tan_lat * d_transverse)
        k_n, k_e, k_d = g_n + rm * ie_d, g_e, g_d - rm * ie_n
        sin_sq = sin_lat * sin_lat
        d_gravity = (
            rm
            * earth.GRAVITY_EQUATOR
            * sin_lat
            * cos_lat
            / sqrt(w)
            * (
                2.0 * earth.SOMIGLIANA
                + (1.0 + earth.SOMIGLIANA * sin_sq) * earth.ECCENTRICITY_SQ / w
            )
        )
        c00, c01, c02, c10, c11, c12, c20, c21, c22 = self._rotation
        self._F_flat[self._entries] = (
            -vd * rm,
            vn * rm,
            ve * tan_lat * rt,
            -(vd + vn * tan_lat) * rt,
            ve * rt,
            ve * k_d - vd * k_e,
            ve * h_d - vd * h_e - self._tilt,
            vd * rm,
            kd - ve * tan_lat * rt,
            -en_e,
            -fd,
            fe,
            -c00,
            -c01,
            -c02,
            vd * k_n - vn * k_d,
            vd * h_n - vn * h_d,
            -kd,
            (vd + vn * tan_lat) * rt,
            kn,
            fd,
            -fn,
            -c10,
            -c11,
            -c12,
            vn * k_e - ve * k_n + d_gravity,
            vn * h_e - ve * h_n - self._slope - 2.0 * self._curve * height,
            en_e - vn * rm,
            -kn - ve * rt,
            -fe,
            fn,
            -c20,
            -c21,
            -c22,
            g_n,
            h_n,
            rt,
            in_d,
            -en_e,
            c00,
            c01,
            c02,
            g_e,
            h_e,
            -rm,
            -in_d,
            in_n,
            c10,
            c11,
            c12,
            g_d,
            h_d,
            -tan_lat * rt,
            en_e,
            -in_n,
            c20,
            c21,
            c22,
        )
        self._C.flat = self._rotation
        self._propagate(dt)

    def _propagate(self, dt: float) -> None:
        Phi, A, P, C = self._Phi, self._A, self.P, self._C
        np.multiply(self.F, dt, out=Phi)
        Phi += self._identity
        np.dot(Phi, P, out=A)
        np.dot(A, Phi.T, out=P)
        np.multiply(C, self._psd_white, out=self._scaled)
        np.matmul(self._scaled, C.T, out=self._Q)
        self._Q *= dt
        self._white += self._Q
        self._bias_variance += self.psd[6:] * dt

    def update(self, lla_fix: Array, R: Array, lever_b: Array) -> None:
        """Fuse a GNSS position; Joseph form, closed loop."""
        lat, lon, height = self.lla
        metres = earth.curvature_scale(np.array(self.lla))
        x, y, z, s = self.quat
        C = self._C
        C.flat = (
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - s * z),
            2.0 * (x * z + s * y),
            2.0 * (x * y + s * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - s * x),
            2.0 * (x * z - s * y),
            2.0 * (y * z + s * x),
            1.0 - 2.0 * (x * x + y * y),
        )
        lever_n = C @ lever_b
        innovation = (lla_fix - self.lla) * metres - lever_n
        H = np.zeros((3, 15))
        H[:, :3] = np.eye(3)
        a, b, c = lever_n
        H[:, 6:9] = (0.0, -c, b), (c, 0.0, -a), (-b, a, 0.0)
        dx = self._correction(innovation, H, R)

        step = dx[:3] / metres
        self.lla = [lat + step[0], lon + step[1], height + step[2]]
        self.velocity = [v + d for v, d in zip(self.velocity, dx[3:6].tolist(), strict=True)]
        self.bias = [v + d for v, d in zip(self.bias, dx[9:].tolist(), strict=True)]
        ex, ey, ez = (-0.5 * dx[6:9]).tolist()
        x, y, z, s = (
            x + ex * s + ey * z - ez * y,
            y - ex * z + ey * s + ez * x,
            z + ex * y - ey * x + ez * s,
            s - ex * x - ey * y - ez * z,
        )
        norm = 1.0 / sqrt(x * x + y * y + z * z + s * s)
        self.quat = [x * norm, y * norm, z * norm, s * norm]

    def _correction(self, z: Array, H: Array, R: Array) -> Array:
        PHt = self.P @ H.T
        K = np.linalg.solve(H @ PHt + R, PHt.T).T
        A = np.eye(15) - K @ H
        P = A @ self.P @ A.T + K @ R @ K.T
        np.multiply(P + P.T, 0.5, out=self.P)
        return K @ z
