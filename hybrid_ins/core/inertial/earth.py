"""
WGS-84: radii of curvature, normal gravity, Earth and transport rate, and local frames.

Written in terms of ``np`` functions and marked jitable: the same text serves arrays of epochs and,
with scalars, the compiled filter step.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 2.4 and 5.3-5.4.
.. [2] NGA.STND.0036, *World Geodetic System 1984*, 2014.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

SEMI_MAJOR_AXIS = 6378137.0  # m
FLATTENING = 1.0 / 298.257223563
SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
ECCENTRICITY_SQ = FLATTENING * (2.0 - FLATTENING)
EARTH_RATE = 7.292115e-5  # rad/s
GM = 3.986004418e14  # m^3/s^2
STANDARD_GRAVITY = 9.80665  # m/s^2: that of the unit g
GRAVITY_EQUATOR = 9.7803253359  # m/s^2
SOMIGLIANA = 0.00193185265241
NORTH_GRADIENT = -8.08e-9  # 1/s²
GRAVITY_RATIO = EARTH_RATE**2 * SEMI_MAJOR_AXIS**2 * SEMI_MINOR_AXIS / GM


@register_jitable
def radii(lat):  # type: ignore[no-untyped-def]
    """Meridian and transverse radii of curvature (R_M, R_N) [m] at ``lat`` [rad]; [1]_ 2.105-6."""
    w = 1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2
    transverse = SEMI_MAJOR_AXIS / np.sqrt(w)
    return transverse * (1.0 - ECCENTRICITY_SQ) / w, transverse


@register_jitable
def normal_gravity(lat, height):  # type: ignore[no-untyped-def]
    """
    North and down component of normal gravity [m/s²] at (lat [rad], height [m]).

    Somigliana's formula on the ellipsoid, carried up to second order in height; [1]_ eq. 2.134,
    2.139 and 2.140. The north component comes from the plumb line's curvature.
    """
    surface, slope, curve = _gravity_polynomial(lat)
    north = 2.0 * NORTH_GRADIENT * height * np.sin(lat) * np.cos(lat)
    return north, surface + (slope + curve * height) * height


@register_jitable
def gravity_gradient(lat, height):  # type: ignore[no-untyped-def]
    """Change of normal gravity's north and down component per metre of height [1/s²]."""
    _, slope, curve = _gravity_polynomial(lat)
    return 2.0 * NORTH_GRADIENT * np.sin(lat) * np.cos(lat), slope + 2.0 * curve * height


@register_jitable
def _gravity_polynomial(lat):  # type: ignore[no-untyped-def]
    """Coefficients of the down component in powers of height; [1]_ eq. 2.134 and 2.139."""
    sin_sq = np.sin(lat) ** 2
    surface = (
        GRAVITY_EQUATOR * (1.0 + SOMIGLIANA * sin_sq) / np.sqrt(1.0 - ECCENTRICITY_SQ * sin_sq)
    )
    flattening = 1.0 + FLATTENING * (1.0 - 2.0 * sin_sq) + GRAVITY_RATIO
    return (
        surface,
        -2.0 * surface * flattening / SEMI_MAJOR_AXIS,
        3.0 * surface / (SEMI_MAJOR_AXIS**2),
    )


@register_jitable
def earth_rate_n(lat):  # type: ignore[no-untyped-def]
    """North and down component of the Earth's rotation rate [rad/s]; [1]_ eq. 2.123."""
    return EARTH_RATE * np.cos(lat), -EARTH_RATE * np.sin(lat)


@register_jitable
def transport_rate_n(lat, height, velocity_north, velocity_east):  # type: ignore[no-untyped-def]
    """Rotation rate of NED over the Earth (north, east, down) [rad/s]; [1]_ eq. 5.44."""
    meridian, transverse = radii(lat)
    north = velocity_east / (transverse + height)
    return north, -velocity_north / (meridian + height), -north * np.tan(lat)


def lla_to_ecef(lla: NDArray[np.float64]) -> NDArray[np.float64]:
    """Earth-fixed coordinates, shape (..., 3) [m], of lla, shape (..., 3); [1]_ eq. 2.112."""
    lat, lon, height = lla[..., 0], lla[..., 1], lla[..., 2]
    transverse = radii(lat)[1]
    horizontal = (transverse + height) * np.cos(lat)
    return np.stack(
        (
            horizontal * np.cos(lon),
            horizontal * np.sin(lon),
            ((1.0 - ECCENTRICITY_SQ) * transverse + height) * np.sin(lat),
        ),
        axis=-1,
    )


def ecef_to_lla(ecef: NDArray[np.float64]) -> NDArray[np.float64]:
    """
    Geodetic lla, shape (..., 3), of Earth-fixed coordinates, shape (..., 3) [m].

    Bowring's formula ([1]_ eq. 2.113) followed by two Newton-like refinements: exact to rounding
    from the deepest mine to orbit.
    """
    x, y, z = ecef[..., 0], ecef[..., 1], ecef[..., 2]
    p = np.hypot(x, y)
    theta = np.arctan2(z * SEMI_MAJOR_AXIS, p * SEMI_MINOR_AXIS)
    for _ in range(3):
        second_eccentricity_sq = ECCENTRICITY_SQ / (1.0 - ECCENTRICITY_SQ)
        lat = np.arctan2(
            z + second_eccentricity_sq * SEMI_MINOR_AXIS * np.sin(theta) ** 3,
            p - ECCENTRICITY_SQ * SEMI_MAJOR_AXIS * np.cos(theta) ** 3,
        )
        theta = np.arctan2((1.0 - FLATTENING) * np.sin(lat), np.cos(lat))
    transverse = radii(lat)[1]
    height = (
        p * np.cos(lat) + z * np.sin(lat) - transverse * (1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    )
    return np.stack((lat, np.arctan2(y, x), height), axis=-1)


def C_en(lla: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix, shape (3, 3), from NED at ``lla`` (3,) to Earth-fixed; [1]_ eq. 2.150."""
    sin_lat, cos_lat = np.sin(lla[0]), np.cos(lla[0])
    sin_lon, cos_lon = np.sin(lla[1]), np.cos(lla[1])
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lon, -cos_lat * cos_lon],
            [-sin_lat * sin_lon, cos_lon, -cos_lat * sin_lon],
            [cos_lat, 0.0, -sin_lat],
        ]
    )


class LocalFrame:
    """
    The tangent frame, NED axes, at a datum: the Cartesian plane that maps are drawn in.

    Parameters
    ----------
    datum_lla : ndarray, shape (3,)
        Latitude [rad], longitude [rad], ellipsoidal height [m].
    """

    def __init__(self, datum_lla: NDArray[np.float64]) -> None:
        self.datum_lla = np.asarray(datum_lla, float)
        self._origin_e = lla_to_ecef(self.datum_lla)
        self.C_en = C_en(self.datum_lla)

    def position(self, lla: NDArray[np.float64]) -> NDArray[np.float64]:
        """Position [m], NED axes at the datum, shape (..., 3), of lla, shape (..., 3)."""
        return (lla_to_ecef(np.asarray(lla, float)) - self._origin_e) @ self.C_en

    def lla(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `position`."""
        return ecef_to_lla(self._origin_e + np.asarray(position, float) @ self.C_en.T)

    def C_from_n(self, lla: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotation matrix, shape (3, 3), from NED at ``lla`` (3,) to NED at the datum."""
        return self.C_en.T @ C_en(lla)


@register_jitable
def curvature_scale(lla):  # type: ignore[no-untyped-def]
    """
    Metres of north, east and down per unit of latitude, longitude and height, shape (3,).

    Small differences only: ``dp_n = curvature_scale(lla) * dlla``.
    """
    meridian, transverse = radii(lla[0])
    return np.array([meridian + lla[2], (transverse + lla[2]) * np.cos(lla[0]), -1.0])


@register_jitable
def wrapped(turn):  # type: ignore[no-untyped-def]
    """Return a difference of longitudes [rad] within half a turn of zero."""
    return turn - 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5)


def displacement(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """
    Return north, east, down [m], shape (..., 3), from a position to others near by.

    Latitude, longitude [rad] and height [m], (3,) and (..., 3); the date line may be between them.
    """
    change = end - start
    change[..., 1] = wrapped(change[..., 1])
    return np.asarray(change * curvature_scale(start))


def horizontal_displacement(
    start: tuple[float, float], end: tuple[float, float]
) -> tuple[float, float]:
    """Return north, east [m] from one latitude and longitude [rad] to another near by."""
    meridian, transverse = radii(end[0])
    turn = math.remainder(end[1] - start[1], math.tau)
    return (end[0] - start[0]) * meridian, turn * transverse * math.cos(end[0])
