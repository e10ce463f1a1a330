"""
The mechanisation against analytic cases and against motions whose truth is exact.

A flight of ten minutes, sampled at 200 Hz and integrated from the true state without any error of
the IMU, ends with what straight lines between its samples leave over: see `FLIGHTS`. The error is
of second order in the sample period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_motion import TEL_AVIV, Series, Truth, Wave, misalignment, travel

from hybrid_ins.core.inertial import earth, propagation
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec, quat_from_rpy
from hybrid_ins.core.inertial.state import LAST_W, LLA, N_NAV, QUAT, VELOCITY, Array
from hybrid_ins.core.inertial.strapdown import half_rotation, mechanise, rotation

MINUTES_10 = 600.0
MECHANISATION_ONLY = 1e9  # s, a covariance interval that is never reached


@dataclass(frozen=True)
class Errors:
    """Largest errors over a run."""

    position: float  # m
    velocity: float  # m/s
    attitude: float  # rad


def integrate(truth: Truth) -> Errors:
    """Integrate a perfect IMU's readings from the true first state."""
    rows = np.empty((len(truth.t) - 1, N_NAV))
    propagation.run(truth.flat(), np.diff(truth.t), truth.readings[1:], MECHANISATION_ONLY, rows)
    metres = earth.curvature_scale(truth.lla[0])
    return Errors(
        *(
            float(np.max(np.linalg.norm(error, axis=1)))
            for error in (
                (rows[:, LLA] - truth.lla[1:]) * metres,
                rows[:, VELOCITY] - truth.velocity_n[1:],
                misalignment(truth.quat_xyzw[1:], rows[:, QUAT]),
            )
        )
    )


def epochs(rate: float, duration: float = MINUTES_10) -> Array:
    return np.arange(int(duration * rate) + 1) / rate


# Standing still


@pytest.mark.parametrize("lat", [-75.0, 0.0, 32.1, 60.0])
@pytest.mark.parametrize("height", [-300.0, 5000.0])
def test_standing_imu_stays_where_it_is(lat: float, height: float) -> None:
    """It reads gravity and the Earth's rate; a wrong one of them moves it within ten minutes.

    1 µm of rounding remains; 1e-5 of the Earth's rate would be 0.2 m, 1 µg of gravity 1.8 m.
    """
    rpy = np.radians([5.0, -8.0, 130.0])
    t = epochs(100.0)
    C_nb = matrix_from_quat(quat_from_rpy(*rpy))
    lla = np.array([np.radians(lat), 0.6, height])
    gravity_n = np.array([1.0, 0.0, 1.0])
    gravity_n[[0, 2]] = earth.normal_gravity(lla[0], lla[2])
    rate_n = earth.EARTH_RATE * np.array([np.cos(lla[0]), 0.0, -np.sin(lla[0])])
    reading = np.concatenate((-gravity_n @ C_nb, rate_n @ C_nb))
    truth = Truth(
        t,
        np.tile(lla, (len(t), 1)),
        np.zeros((len(t), 3)),
        np.tile(quat_from_rpy(*rpy), (len(t), 1)),
        np.tile(reading, (len(t), 1)),
    )

    errors = integrate(truth)

    assert errors.position < 1e-4
    assert errors.velocity < 1e-6
    assert errors.attitude < 1e-10


def test_imu_that_does_not_turn_in_space_turns_against_the_ground() -> None:
    """A gyroscope at rest in inertial space: the ground turns under it at the Earth's rate."""
    t = epochs(100.0)
    nav = travel(t[:2], Series(), Series()).flat()
    nav[LAST_W] = 0.0
    gravity_n = np.array([0.0, 0.0, earth.normal_gravity(*TEL_AVIV[[0, 2]])[1]])
    w_ie = earth.C_en(TEL_AVIV).T @ [0.0, 0.0, earth.EARTH_RATE]
    turned = matrix_from_quat(quat_from_rotvec(-np.outer(t, w_ie)))  # C_nb(t)
    readings = np.hstack((-np.einsum("i,nij->nj", gravity_n, turned), np.zeros((len(t), 3))))

    rows = np.empty((len(t) - 1, N_NAV))
    propagation.run(nav, np.diff(t), readings[1:], MECHANISATION_ONLY, rows)

    np.testing.assert_allclose(
        misalignment(rows[:, QUAT], np.array([0.0, 0.0, 0.0, 1.0])),
        np.outer(t[1:], w_ie),
        atol=1e-9,
    )
    assert MINUTES_10 * np.linalg.norm(w_ie) > 0.04  # rad, what is seen


# Constant velocity


@pytest.mark.parametrize("east", [-240.0, 240.0])
def test_flight_along_a_parallel(east: float) -> None:
    """
    GIVEN a level flight east or west, whose readings are constant
    WHEN it is integrated for ten minutes
    THEN longitude has advanced by v t / (R_N + h) cos(lat) and nothing else has changed.

    Coriolis and transport terms amount to kilometres here; what remains is below a millimetre.
    """
    t = epochs(100.0)
    lla = np.array([np.radians(48.0), 0.3, 10e3])
    velocity_n = np.array([0.0, east, 0.0])
    _, transverse = earth.radii(lla[0])
    w_ie = earth.EARTH_RATE * np.array([np.cos(lla[0]), 0.0, -np.sin(lla[0])])
    w_en = east / (transverse + lla[2]) * np.array([1.0, 0.0, -np.tan(lla[0])])
    north, down = earth.normal_gravity(lla[0], lla[2])
    f_n = np.cross(2.0 * w_ie + w_en, velocity_n) - [north, 0.0, down]
    quat = quat_from_rpy(0.1, 0.05, 1.5)
    C_nb = matrix_from_quat(quat)
    places = lla + np.outer(t, [0.0, east / ((transverse + lla[2]) * np.cos(lla[0])), 0.0])
    still = np.ones((len(t), 1))
    readings = still * np.concatenate((f_n @ C_nb, (w_ie + w_en) @ C_nb))

    errors = integrate(Truth(t, places, still * velocity_n, still * quat, readings))

    assert errors.position < 1e-3
    assert errors.velocity < 1e-5
    assert errors.attitude < 1e-9


# Ten minutes of flight

MANOEUVRES = Series(waves=[Wave((40, 40, 5), 0.03, (0, 1.57, 0)), Wave((8, 5, 2), 0.11, (1, 2, 3))])
SWAY = Series(waves=[Wave((0.2, 0.2, 0), 0.11, (0, 1, 0)), Wave((0, 0, 1.5), 0.03)])
SCULLING = Wave((0.25e-3, 0.25e-3, 0.25e-3), 20.0, (0, 1.57, 0))  # 3.9 m/s²
CONING = Wave((1e-3, 1e-3, 0.5e-3), 20.0, (0, 1.57, 0))  # 0.13 rad/s

FLIGHTS = {
    "airliner": (
        Series(rate=(180, 150, -5), waves=[Wave((300, 300, 100), 0.02)]),
        Series(waves=[Wave((0.5, 0.1, 1.0), 0.02)]),
    ),
    "quadrotor": (MANOEUVRES, SWAY),
    "vibrating quadrotor": (
        Series(waves=[*MANOEUVRES.waves, SCULLING]),
        Series(waves=[*SWAY.waves, CONING]),
    ),
    "rolling": (Series(), Series(rate=(1.0, 0.0, 0.0))),
}


@pytest.mark.parametrize(
    ("name", "rate", "achieved"),
    [
        ("airliner", 200.0, Errors(0.038, 1.2e-4, 5.0e-8)),
        ("quadrotor", 200.0, Errors(0.43, 1.8e-3, 1.4e-5)),
        ("vibrating quadrotor", 200.0, Errors(355.0, 1.8, 2.5e-3)),
        pytest.param(
            "vibrating quadrotor",
            1000.0,
            Errors(14.6, 0.071, 1.1e-4),
            marks=pytest.mark.slow,
        ),
        ("rolling", 200.0, Errors(4.1, 0.015, 4.2e-8)),
    ],
)
def test_ten_minutes(name: str, rate: float, achieved: Errors) -> None:
    """
    The errors achieved stand above, at most a tenth larger than measured.

    They are those of the readings between the samples, as if the IMU had a bias: 0.2 °/h and
    0.3 µg (quadrotor), 0.8 °/h (vibrating, at 1 kHz), 2 µg (rolling).
    """
    errors = integrate(travel(epochs(rate), *FLIGHTS[name]))

    assert errors.position < 1.1 * achieved.position
    assert errors.velocity < 1.1 * achieved.velocity
    assert errors.attitude < 1.1 * achieved.attitude


@pytest.mark.parametrize("name", FLIGHTS)
def test_half_the_sample_period_leaves_a_quarter_of_the_error(name: str) -> None:
    coarse, fine = (integrate(travel(epochs(rate, 60.0), *FLIGHTS[name])) for rate in (200, 400))

    assert coarse.attitude / fine.attitude == pytest.approx(4.0, rel=0.05)
    assert coarse.position / fine.position > 3.0  # sub-millimetre effects of height are linear


# One interval


@settings(max_examples=30)
@given(*[st.tuples(*[st.floats(-s, s)] * 3).map(np.array) for s in (15.0, 15.0, 0.5, 0.5)])
def test_one_interval_follows_a_straight_course_of_the_readings(
    f0: Array, f1: Array, w0: Array, w1: Array
) -> None:
    """
    Readings that change linearly are integrated with their coning and sculling.

    Those amount to as much as 6e-6 rad and 2e-4 m/s in this interval.
    """
    dt = 0.01
    start = travel(np.zeros(1), Series(rate=(30, -20, 5)), Series((0.3, 0.2, 1.0))).flat()
    C, f_n = np.empty(9), np.empty(3)

    def integrated(pieces: int) -> Array:
        nav = start.copy()
        at = np.linspace(0.0, 1.0, pieces + 1)
        f, w = f0 + np.outer(at, f1 - f0), w0 + np.outer(at, w1 - w0)
        for k in range(pieces):
            mechanise(
                nav[LLA],
                nav[VELOCITY],
                nav[QUAT],
                f[k],
                w[k],
                f[k + 1],
                w[k + 1],
                dt / pieces,
                C,
                f_n,
            )
        return nav

    once, finely = integrated(1), integrated(10)

    assert np.max(np.abs(misalignment(finely[QUAT], once[QUAT]))) < 2e-8
    assert np.max(np.abs(finely[VELOCITY] - once[VELOCITY])) < 2e-6


@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.1, 0.25])
def test_half_rotation_is_exact_to_rounding(size: float) -> None:
    vector = size * np.array([0.48, -0.6, 0.64])

    scale, cosine = half_rotation(*vector)

    np.testing.assert_allclose([*(scale * vector), cosine], quat_from_rotvec(vector), rtol=1e-15)


def test_rotation_writes_the_matrix_of_a_quaternion() -> None:
    quat = quat_from_rpy(0.3, -0.8, 2.5)
    C = np.empty(9)

    rotation(quat, C)

    np.testing.assert_allclose(C.reshape(3, 3), matrix_from_quat(quat), atol=1e-16)


def test_quaternion_keeps_unit_length() -> None:
    rng = np.random.default_rng(0)
    nav = travel(np.zeros(1), Series(), Series()).flat()
    readings = rng.normal(0.0, 5.0, (100_000, 6))

    propagation.run(nav, np.full(100_000, 0.01), readings, MECHANISATION_ONLY, np.empty((0, N_NAV)))

    assert np.linalg.norm(nav[QUAT]) == pytest.approx(1.0, abs=1e-15)
