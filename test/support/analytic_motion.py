"""
Motions with an exact truth that shares nothing with the mechanisation but the gravity formula.

Position and attitude are sums of sines in a frame that is fixed to the Earth, so that the specific
force comes from Newton's law there: no transport rate, no radii of curvature, no error model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_matrix, quat_from_rpy
from hybrid_ins.core.inertial.state import (
    BIAS_A,
    BIAS_G,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
    NavState,
)

Array = NDArray[np.float64]
EARTH_RATE_E = np.array([0.0, 0.0, earth.EARTH_RATE])
TEL_AVIV = np.array([np.radians(32.1), np.radians(34.8), 0.0])


@dataclass(frozen=True)
class Wave:
    """``amplitude * sin(2 pi frequency t + phase)``, (3,) each but the frequency [Hz]."""

    amplitude: Sequence[float]
    frequency: float
    phase: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Series:
    """``start + rate * t`` and a sum of waves."""

    start: Sequence[float] = (0.0, 0.0, 0.0)
    rate: Sequence[float] = (0.0, 0.0, 0.0)
    waves: Sequence[Wave] = ()

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Value and two derivatives, (N, 3) each, at the times (N,) [s]."""
        value = np.asarray(self.start) + np.outer(t, self.rate)
        first = np.broadcast_to(np.asarray(self.rate, float), value.shape).copy()
        second = np.zeros_like(value)
        for wave in self.waves:
            omega = 2.0 * np.pi * wave.frequency
            angle = omega * t[:, None] + np.asarray(wave.phase)
            amplitude = np.asarray(wave.amplitude)
            value += amplitude * np.sin(angle)
            first += amplitude * omega * np.cos(angle)
            second -= amplitude * omega**2 * np.sin(angle)
        return value, first, second


@dataclass(frozen=True)
class Truth:
    """States of a body and what a perfect IMU at its origin measures."""

    t: Array  # (N,) s
    lla: Array  # (N, 3)
    velocity_n: Array  # (N, 3) m/s
    quat_xyzw: Array  # (N, 4)
    readings: Array  # (N, 6) specific force [m/s²] and angular rate [rad/s], b

    @property
    def t_ns(self) -> NDArray[np.int64]:
        return np.round(self.t * 1e9).astype(np.int64)

    @property
    def C_nb(self) -> Array:
        return matrix_from_quat(self.quat_xyzw)

    def state(self, k: int = 0, P: Array | None = None) -> NavState:
        """Return the state at epoch ``k``, without biases."""
        return NavState(
            self.lla[k],
            self.velocity_n[k],
            self.quat_xyzw[k],
            np.zeros(3),
            np.zeros(3),
            np.zeros((N_ERROR, N_ERROR)) if P is None else P,
        )

    def flat(self, k: int = 0, P: Array | None = None) -> Array:
        """Return the flat state at epoch ``k``, its last sample included."""
        nav = self.state(k, P).to_flat()
        nav[LAST_F], nav[LAST_W] = self.readings[k, :3], self.readings[k, 3:]
        return nav


def C_en_along(lla: Array) -> Array:
    """Rotation matrices (N, 3, 3) from NED to Earth-fixed at places (N, 3)."""
    (sin_lat, sin_lon, _), (cos_lat, cos_lon, _) = np.sin(lla).T, np.cos(lla).T
    north = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
    east = (-sin_lon, cos_lon, np.zeros_like(sin_lon))
    down = (-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat)
    return np.moveaxis(np.array((north, east, down)), 2, 0).swapaxes(1, 2)


def travel(t: Array, displacement: Series, rpy: Series, datum_lla: Array = TEL_AVIV) -> Truth:
    """
    Move along ``displacement`` [m] with attitude ``rpy`` [rad], both in NED axes at the datum.

    The axes stay those of the datum however far the body goes.
    """
    C_ed = earth.C_en(datum_lla)
    position, velocity, acceleration = displacement(t)
    (roll, pitch, yaw), rates = rpy(t)[0].T, rpy(t)[1].T
    r_e = earth.lla_to_ecef(datum_lla) + position @ C_ed.T
    v_e, a_e = velocity @ C_ed.T, acceleration @ C_ed.T
    lla = earth.ecef_to_lla(r_e)
    C_en = C_en_along(lla)
    C_eb = C_ed @ matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
    gravity_n = np.zeros_like(lla)
    gravity_n[:, 0], gravity_n[:, 2] = earth.normal_gravity(lla[:, 0], lla[:, 2])
    gravity_e = np.einsum("nij,nj->ni", C_en, gravity_n)
    f_e = a_e + 2.0 * np.cross(EARTH_RATE_E, v_e) - gravity_e
    rate_b = np.stack(
        (
            rates[0] - np.sin(pitch) * rates[2],
            np.cos(roll) * rates[1] + np.sin(roll) * np.cos(pitch) * rates[2],
            np.cos(roll) * np.cos(pitch) * rates[2] - np.sin(roll) * rates[1],
        ),
        axis=-1,
    )
    rate_b += EARTH_RATE_E @ C_eb
    f_b = np.einsum("nij,ni->nj", C_eb, f_e)
    return Truth(
        t,
        lla,
        np.einsum("nij,ni->nj", C_en, v_e),
        quat_from_matrix(np.swapaxes(C_en, 1, 2) @ C_eb),
        np.hstack((f_b, rate_b)),
    )


def difference(nav_true: Array, nav: Array) -> Array:
    """
    Error state, shape (15,), between two flat states: the exact inverse of ``kalman.inject``.

    ``inject(nav, dx)`` followed by ``difference(nav, before)`` gives dx.
    """
    dx = np.empty(N_ERROR)
    dx[:3] = (nav_true[LLA] - nav[LLA]) * earth.curvature_scale(nav[LLA])
    dx[3:6] = nav_true[VELOCITY] - nav[VELOCITY]
    dx[6:9] = misalignment(nav_true[QUAT], nav[QUAT])
    dx[9:12] = nav_true[BIAS_A] - nav[BIAS_A]
    dx[12:15] = nav_true[BIAS_G] - nav[BIAS_G]
    return dx


def misalignment(quat_true: Array, quat: Array) -> Array:
    """Rotation vectors eps (..., 3) with ``C_true = exp(-[eps x]) C``."""
    a, b = np.asarray(quat_true), np.asarray(quat)
    vector = b[..., 3:] * a[..., :3] - a[..., 3:] * b[..., :3] - np.cross(a[..., :3], b[..., :3])
    scalar = np.sum(a * b, axis=-1, keepdims=True)
    vector = np.where(scalar < 0.0, -vector, vector)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    return -vector * np.where(sine > 1e-14, angle / np.maximum(sine, 1e-300), 2.0)
