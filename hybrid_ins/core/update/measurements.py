"""
What aiding sensors measure, as innovation z, matrix H of the error state and covariance R.

A measurement is a small frozen record with its own model: the filter calls its ``linearise`` and
does not depend on its kind. With errors as true minus estimated, z is measured minus
predicted. A component that the sensor did not give (NaN) is left out. Records are valid by
construction: `conversions` rejects what is not.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 14.3.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu.samples import as_numbers
from hybrid_ins.core.imu.standstill import mean_and_std, sway
from hybrid_ins.core.inertial.earth import earth_rate_n, radii, wrapped
from hybrid_ins.core.inertial.state import B_G, BIAS_G, DV, LAST_W, LLA, N_ERROR, QUAT, VELOCITY
from hybrid_ins.core.inertial.strapdown import rotation

Array = NDArray[np.float64]
LinearModel = tuple[Array, Array, Array]
"""Of a measurement about a state: innovation z, H, R."""

GNSS, IMU, ASSUMED = "gnss", "imu", "assumed"  # sensors; the last is none

STANDING_SPEED_STD = 0.03  # m/s, of a vehicle that stands: it rocks
STANDING_RATE_STD = 3e-4  # rad/s
UNKNOWN_RATE = 1.0  # rad/s: far more than a stand may turn by


@kernel()
def position_model(nav, lla_fix, lever_b):  # type: ignore[no-untyped-def]
    """
    Antenna position: z [m, NED], shape (3,), and H, shape (3, 15); [1]_ eq. 14.102-14.114.

    Parameters
    ----------
    lla_fix : ndarray, shape (3,)
        Measured antenna position; a NaN height gives a NaN in z.
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b.
    """
    lla = nav[LLA]
    C = np.empty(9)
    rotation(nav[QUAT], C)
    lever_n = turned(C, lever_b)
    meridian, transverse = radii(lla[0])
    z = np.empty(3)
    z[0] = (lla_fix[0] - lla[0]) * (meridian + lla[2]) - lever_n[0]
    dlon = wrapped(lla_fix[1] - lla[1])
    z[1] = dlon * (transverse + lla[2]) * np.cos(lla[0]) - lever_n[1]
    z[2] = lla[2] - lla_fix[2] - lever_n[2]
    H = np.zeros((3, N_ERROR))
    for i in range(3):
        H[i, i] = 1.0
    _set_cross(H, 6, lever_n)
    return z, H


@kernel()
def velocity_model(nav, velocity_fix, lever_b):  # type: ignore[no-untyped-def]
    """
    Antenna velocity over ground: z [m/s, NED], shape (3,), and H, shape (3, 15); [1]_ eq. 14.103.

    Parameters as in `position_model`; the lever arm moves with the last angular rate.
    """
    C = np.empty(9)
    rotation(nav[QUAT], C)
    ie_n, ie_d = earth_rate_n(nav[LLA][0])
    swing_b, rate_b = np.empty(3), np.empty(3)
    for i in range(3):
        rate_b[i] = nav[LAST_W][i] - nav[BIAS_G][i] - C[i] * ie_n - C[6 + i] * ie_d
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        swing_b[i] = rate_b[j] * lever_b[k] - rate_b[k] * lever_b[j]
    swing_n = turned(C, swing_b)
    z, H = np.empty(3), np.zeros((3, N_ERROR))
    _set_cross(H, 6, swing_n)
    for i in range(3):
        z[i] = velocity_fix[i] - nav[VELOCITY][i] - swing_n[i]
        H[i, 3 + i] = 1.0
        for j in range(3):  # C_nb [lever_b x]
            k, m = (j + 1) % 3, (j + 2) % 3
            H[i, 12 + j] = C[3 * i + k] * lever_b[m] - C[3 * i + m] * lever_b[k]
    return z, H


@register_jitable
def turned(C, v_b):  # type: ignore[no-untyped-def]
    """Return C v, shape (3,), for a matrix (9,) row by row."""
    v_n = np.empty(3)
    for i in range(3):
        v_n[i] = C[3 * i] * v_b[0] + C[3 * i + 1] * v_b[1] + C[3 * i + 2] * v_b[2]
    return v_n


@register_jitable
def _set_cross(matrix, column, v):  # type: ignore[no-untyped-def]
    """Write [v x] into three columns of ``matrix``."""
    matrix[0, column + 1], matrix[0, column + 2] = -v[2], v[1]
    matrix[1, column], matrix[1, column + 2] = v[2], -v[0]
    matrix[2, column], matrix[2, column + 1] = -v[1], v[0]


class Measurement(Protocol):
    """
    What the filter asks of an aiding measurement.

    Attributes
    ----------
    kind : str
        What it measures; measurements of one stamp are fused in the order of their kinds.
    sensor : str
        What measured it: `GNSS`, `IMU`, `ASSUMED` (none), or the name of another sensor. Noise
        factors and clock offset are learned from GNSS only, and only GNSS can prove the state
        wrong.
    t_ns : int
        When it was true, IMU clock [ns].
    in_body : bool
        It is a velocity in b: a turn of the whole trajectory about the vertical leaves it as it is.
    """

    kind: ClassVar[str]
    sensor: ClassVar[str]
    in_body: ClassVar[bool]

    @property
    def t_ns(self) -> int:
        """See above."""
        ...

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """Return z (m,), H (m, 15) and R (m, m) at a flat state of the same time."""
        ...


@dataclass(frozen=True, slots=True)
class PositionFix:
    """A GNSS position of the antenna."""

    t_ns: int  # ns, IMU clock
    lla: Array  # (3,) rad, rad, m; the height is NaN where the receiver gave none
    covariance_n: Array  # (3, 3) m², NED
    lever_b: Array  # (3,) m, antenna relative to the IMU
    stamp_ns: int | None = None  # ns, receiver's clock; None: the IMU's

    kind: ClassVar[str] = "position"
    sensor: ClassVar[str] = GNSS
    in_body: ClassVar[bool] = False

    @property
    def claimed(self) -> Array:
        """R, (3, 3), or (2, 2) where the vertical component is not given."""
        return _given(self.covariance_n, self.lla)

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`."""
        z, H = position_model(nav, self.lla, self.lever_b)
        R = self.claimed
        return z[: len(R)], H[: len(R)], R


@dataclass(frozen=True, slots=True)
class VelocityFix:
    """A GNSS velocity of the antenna over ground."""

    t_ns: int  # ns, IMU clock
    velocity_n: Array  # (3,) m/s, NED; the down component is NaN where there is none
    covariance_n: Array  # (3, 3) (m/s)², NED
    lever_b: Array  # (3,) m, antenna relative to the IMU
    stamp_ns: int | None = None  # ns, receiver's clock; None: the IMU's

    kind: ClassVar[str] = "velocity"
    sensor: ClassVar[str] = GNSS
    in_body: ClassVar[bool] = False

    @property
    def claimed(self) -> Array:
        """R, (3, 3), or (2, 2) where the vertical component is not given."""
        return _given(self.covariance_n, self.velocity_n)

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`."""
        z, H = velocity_model(nav, self.velocity_n, self.lever_b)
        R = self.claimed
        return z[: len(R)], H[: len(R)], R

    def scaled(self, horizontally: float, vertically: float) -> VelocityFix:
        """Return it with a covariance multiplied by these factors."""
        if horizontally == vertically == 1.0:
            return self
        scaled = scaled_by_axis(self.covariance_n, horizontally, vertically)
        return replace(self, covariance_n=scaled)


@dataclass(frozen=True, slots=True)
class Standstill:
    """Zero velocity, and zero rotation relative to the Earth: a standing vehicle."""

    t_ns: int  # ns
    rate_b: Array  # (3,) rad/s, mean of the gyroscopes' readings
    rate_std: Array  # (3,) rad/s, of that mean

    kind: ClassVar[str] = "standstill"
    sensor: ClassVar[str] = IMU
    in_body: ClassVar[bool] = False

    @classmethod
    def of(cls, samples: NDArray[np.void], turns: bool = False) -> Standstill:
        """
        Return the one that ``samples`` (``SAMPLE_DTYPE``) of a standing IMU make.

        Of one that ``turns`` they show the velocity alone.
        """
        mean, std = mean_and_std(as_numbers(samples))
        noise = std[3:] / np.sqrt(len(samples))
        std = np.sqrt(noise**2 + STANDING_RATE_STD**2 + sway(samples) ** 2)
        return cls(int(samples["t_ns"][-1]), mean[3:], np.full(3, UNKNOWN_RATE) if turns else std)

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`; [1]_ section 15.3."""
        C = np.empty(9)
        rotation(nav[QUAT], C)
        ie_n, ie_d = earth_rate_n(nav[LLA][0])
        rate = C.reshape(3, 3).T @ np.array([ie_n, 0.0, ie_d])
        z = np.concatenate((-nav[VELOCITY], self.rate_b - nav[BIAS_G] - rate))
        H = np.zeros((6, N_ERROR))
        H[:3, DV] = H[3:, B_G] = np.eye(3)
        R = np.diag(np.concatenate((np.full(3, STANDING_SPEED_STD**2), self.rate_std**2)))
        return z, H, R


def clock_offset_ns(measurement: Measurement) -> int:
    """Return what was added to the stamp by the sensor's own clock [ns], 0 where there is none."""
    stamp_ns = getattr(measurement, "stamp_ns", None)
    return 0 if stamp_ns is None else measurement.t_ns - stamp_ns


def roots_by_axis(horizontally: ArrayLike, vertically: ArrayLike) -> Array:
    """Return the roots of factors on a covariance, of its rows and columns, (3,) or (3, n)."""
    return np.sqrt(np.array([horizontally, horizontally, vertically]))


@kernel()
def scaled_by_axis(R, horizontally, vertically):  # type: ignore[no-untyped-def]
    """Return a covariance (m, m), NED, multiplied by these factors."""
    scaled, across = np.empty(R.shape), np.sqrt(horizontally * vertically)
    for i in range(len(R)):
        for j in range(len(R)):
            factor = across
            if (i == 2) == (j == 2):
                factor = vertically if i == 2 else horizontally
            scaled[i, j] = R[i, j] * factor
    return scaled


def _given(R: Array, measured: Array) -> Array:
    """Return R, (3, 3), of a measurement, or (2, 2) where its vertical component is no number."""
    return np.ascontiguousarray(R if math.isfinite(measured[2]) else R[:2, :2])
