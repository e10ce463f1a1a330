"""
The error state's slices, and the layout of the flat state that the kernels work on.

One float64 vector holds the whole state of a filter, so that a compiled call has one argument, a
checkpoint is one copy and a rewind one assignment. ``nav[NAVIGATION]`` is the navigation state;
``nav[COVARIANCE]`` is the upper triangle of P, row by row, symmetric by construction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Error state, shape (15,), true minus estimated.
N_ERROR = 15
DP = slice(0, 3)
DV = slice(3, 6)
EPS = slice(6, 9)
B_A = slice(9, 12)
B_G = slice(12, 15)

# Noise input, shape (12,).
N_NOISE = 12
W_A = slice(0, 3)
W_G = slice(3, 6)
W_AB = slice(6, 9)
W_GB = slice(9, 12)

# The flat state: what a checkpoint holds (N_NAV), and behind it the kernels' scratch.
LLA = slice(0, 3)  # rad, rad, m
VELOCITY = slice(3, 6)  # m/s, n
QUAT = slice(6, 10)  # C_nb, xyzw
BIAS_A = slice(10, 13)  # m/s², b
BIAS_G = slice(13, 16)  # rad/s, b
NAVIGATION = slice(0, 16)
LAST_F = slice(16, 19)  # the last IMU sample, as measured
LAST_W = slice(19, 22)
LAST_SAMPLE = slice(16, 22)
PSD = slice(22, 34)  # Qc's diagonal
PENDING_DT = 34  # time, integrated f_n and C_nb since the covariance was last propagated
PENDING_F = slice(35, 38)
PENDING_C = slice(38, 47)
COVARIANCE = slice(47, 47 + N_ERROR * (N_ERROR + 1) // 2)
SENSITIVITY = slice(COVARIANCE.stop, COVARIANCE.stop + N_ERROR)  # s = d(error)/d(clock offset)
# likewise to the age of velocities against positions
AGE_SENSITIVITY = slice(SENSITIVITY.stop, SENSITIVITY.stop + N_ERROR)
ACCELERATION = slice(AGE_SENSITIVITY.stop, AGE_SENSITIVITY.stop + 3)  # m/s², n, the recent mean
CLOCK_VARIANCE = ACCELERATION.stop  # V [s²], of what the clock offset of fixes lacks
SLOW_VARIANCE = slice(CLOCK_VARIANCE + 1, CLOCK_VARIANCE + 4)  # B [m²], NED: `position_scatter`
# m², NED, of errors that positions have shown before: `position_jumps`, `slow_error`
PAST_VARIANCE = slice(SLOW_VARIANCE.stop, SLOW_VARIANCE.stop + 3)
# m², NED, of a position that refers to an antenna in another place: `sensor_errors.lever_arm`
ANTENNA_VARIANCE = slice(PAST_VARIANCE.stop, PAST_VARIANCE.stop + 3)
# rad², NED, upper triangle row by row, of an attitude: by an IMU's scale errors, that antenna, and
# what fixes only seem to show of the heading, `heading_information`
ATTITUDE_COVARIANCE = slice(ANTENNA_VARIANCE.stop, ANTENNA_VARIANCE.stop + 6)
HEADING_CONSIDERED = ATTITUDE_COVARIANCE.stop - 1  # the heading's of these
MEAN_RATE = slice(ATTITUDE_COVARIANCE.stop, ATTITUDE_COVARIANCE.stop + 3)  # rad/s, b, recent mean
# m/rad, NE: an error of the heading turns the vehicle about its antenna, whose place is known
HEADING_ARM = slice(MEAN_RATE.stop, MEAN_RATE.stop + 2)
HEADING_DOUBT = HEADING_ARM.stop  # rad², of a heading that may be another: `heading_check`
N_NAV = HEADING_DOUBT + 1
SYSTEM = slice(N_NAV, N_NAV + N_ERROR * N_ERROR)
SCRATCH = slice(SYSTEM.stop, SYSTEM.stop + 12)
PRODUCTS = slice(SCRATCH.stop, SCRATCH.stop + 24 * 16)  # see `covariance_step`
N_FLAT = PRODUCTS.stop

PACKED_ROWS, PACKED_COLUMNS = np.triu_indices(N_ERROR)
PLACES = np.zeros((N_ERROR, N_ERROR), np.int64)  # of P's elements in its packed triangle
PLACES[PACKED_ROWS, PACKED_COLUMNS] = PLACES[PACKED_COLUMNS, PACKED_ROWS] = np.arange(
    len(PACKED_ROWS)
)
DIAGONAL = np.array([i * N_ERROR - i * (i - 1) // 2 for i in range(N_ERROR)])
HEADING_VARIANCE = COVARIANCE.start + int(DIAGONAL[8])  # place of P[8, 8] in the flat state


@register_jitable
def unpack(packed, full):  # type: ignore[no-untyped-def]
    """Write the symmetric matrix ``full`` (15, 15) from its upper triangle ``packed`` (120,)."""
    k = 0
    for i in range(N_ERROR):
        for j in range(i, N_ERROR):
            full[i, j] = packed[k]
            full[j, i] = packed[k]
            k += 1


@register_jitable
def pack_upper(full, packed):  # type: ignore[no-untyped-def]
    """Write the upper triangle ``packed`` (120,) of the symmetric matrix ``full`` (15, 15)."""
    k = 0
    for i in range(N_ERROR):
        for j in range(i, N_ERROR):
            packed[k] = full[i, j]
            k += 1


@register_jitable
def unpack_total(nav, full):  # type: ignore[no-untyped-def]
    """
    Write the covariance that is reported, (15, 15).

    P + V s s', the uncertain clock offset considered, the slow error and the jumps of fixes, what
    an antenna in another place does to the position and the attitude, and to the latter an IMU's
    scale errors, what motion does not show of the heading, and the other headings that it may have:
    with another one the vehicle is elsewhere about its antenna.
    """
    unpack(nav[COVARIANCE], full)
    s, variance = nav[SENSITIVITY], nav[CLOCK_VARIANCE]
    if variance > 0.0:
        for i in range(N_ERROR):
            for j in range(N_ERROR):
                full[i, j] += variance * s[i] * s[j]
    for i in range(3):
        full[i, i] += nav[SLOW_VARIANCE][i] + nav[PAST_VARIANCE][i] + nav[ANTENNA_VARIANCE][i]
    k = ATTITUDE_COVARIANCE.start
    for i in range(6, 9):
        for j in range(i, 9):
            full[i, j] += nav[k]
            full[j, i] = full[i, j]
            k += 1
    full[8, 8] += nav[HEADING_DOUBT]
    arm, variance = nav[HEADING_ARM], nav[HEADING_CONSIDERED] + nav[HEADING_DOUBT]
    for i in range(2):
        full[i, 8] += variance * arm[i]
        full[8, i] = full[i, 8]
        for j in range(2):
            full[i, j] += variance * arm[i] * arm[j]


def pack(full: Array, packed: Array) -> None:
    """Write the upper triangle ``packed`` (120,) of the mean of ``full`` and its transpose."""
    packed[:] = 0.5 * (full[PACKED_ROWS, PACKED_COLUMNS] + full[PACKED_COLUMNS, PACKED_ROWS])


@dataclass(frozen=True, slots=True)
class NavState:
    """
    The filter's estimate at one instant, by name.

    Attributes
    ----------
    lla : ndarray, shape (3,)
        Latitude [rad], longitude [rad], ellipsoidal height [m] of the IMU.
    velocity_n : ndarray, shape (3,)
        NED velocity [m/s].
    quat_xyzw : ndarray, shape (4,)
        C_nb.
    bias_a, bias_g : ndarray, shape (3,)
        Accelerometer [m/s²] and gyroscope [rad/s] bias, b frame.
    P : ndarray, shape (15, 15)
        Error covariance, in the order of the error state.
    """

    lla: Array
    velocity_n: Array
    quat_xyzw: Array
    bias_a: Array
    bias_g: Array
    P: Array

    @classmethod
    def from_flat(cls, nav: Array) -> NavState:
        """Copy the state out of a flat vector."""
        return cls(
            nav[LLA].copy(),
            nav[VELOCITY].copy(),
            nav[QUAT].copy(),
            nav[BIAS_A].copy(),
            nav[BIAS_G].copy(),
            covariance(nav),
        )

    def to_flat(self) -> Array:
        """Return a flat vector, shape (N_FLAT,), of this state with nothing pending."""
        nav = np.zeros(N_FLAT)
        nav[LLA], nav[VELOCITY], nav[QUAT] = self.lla, self.velocity_n, self.quat_xyzw
        nav[BIAS_A], nav[BIAS_G] = self.bias_a, self.bias_g
        pack(np.asarray(self.P, float), nav[COVARIANCE])
        return nav


def covariance(nav: Array) -> Array:
    """Return P, shape (15, 15), of a flat state."""
    P: Array = nav[COVARIANCE][PLACES]
    return P


def total_std(nav: Array) -> Array:
    """Return the standard deviations, shape (15,), of `unpack_total`."""
    variance: Array = nav[COVARIANCE][DIAGONAL] + nav[CLOCK_VARIANCE] * nav[SENSITIVITY] ** 2
    variance[DP] += nav[SLOW_VARIANCE] + nav[PAST_VARIANCE] + nav[ANTENNA_VARIANCE]
    variance[EPS] += nav[ATTITUDE_COVARIANCE][[0, 3, 5]]
    variance[8] += nav[HEADING_DOUBT]
    variance[:2] += (nav[HEADING_CONSIDERED] + nav[HEADING_DOUBT]) * nav[HEADING_ARM] ** 2
    return np.sqrt(variance)
