"""The state that nothing has aided is that of the IMU alone, since four to eight seconds."""

import numpy as np

from hybrid_ins.core.aiding.unaided import SPAN_NS, UnaidedState
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.state import COVARIANCE, NAVIGATION, VELOCITY, NavState

SECOND, STEP_NS, INTERVAL = 1_000_000_000, 10_000_000, 0.01
FORCE, RATE = (0.5, 0.0, -9.8), (0.0, 0.0, 0.02)


def state() -> np.ndarray:
    return NavState(
        np.array([0.6, 0.6, 100.0]),
        np.array([5.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        0.01 * np.eye(15),
    ).to_flat()


def test_what_moves_the_filter_does_not_move_it() -> None:
    """
    GIVEN a filter whose velocity a sensor moves once a second
    WHEN a state follows it unaided
    THEN that is the filter's of four to eight seconds before, moved by the samples alone.
    """
    nav = state()
    ring, unaided, kept, t_ns = ImuRing(), UnaidedState(), {}, 0
    ages = []
    for k in range(2000):
        t_ns += STEP_NS
        ring.push(t_ns, *FORCE, *RATE)
        propagation.step(nav, STEP_NS * 1e-9, *FORCE, *RATE, INTERVAL)
        if k % 100 == 50:
            nav[VELOCITY][0] += 1.0
        if k % 10 == 0:
            propagation.propagate_covariance(nav)
            kept[t_ns] = nav.copy()
            found = unaided.follow(nav, t_ns, ring, INTERVAL)
            ages.append(t_ns - unaided.since_ns)

    assert max(ages) < 2 * SPAN_NS <= max(ages) + 10 * STEP_NS
    assert min(ages[50:]) == SPAN_NS
    expected = kept[unaided.since_ns]
    for _ in range((t_ns - 9 * STEP_NS - unaided.since_ns) // STEP_NS):
        propagation.step(expected, STEP_NS * 1e-9, *FORCE, *RATE, INTERVAL)
    propagation.propagate_covariance(expected)
    np.testing.assert_allclose(found[NAVIGATION], expected[NAVIGATION], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[COVARIANCE], expected[COVARIANCE], rtol=1e-6, atol=1e-12)
    assert abs(found[VELOCITY][0] - nav[VELOCITY][0]) > 3.5


def test_it_begins_anew_behind_a_gap_of_the_samples() -> None:
    nav, ring, unaided = state(), ImuRing(), UnaidedState()
    for t_ns in (0, STEP_NS, 2 * STEP_NS, 60 * STEP_NS):
        ring.push(SECOND + t_ns, *FORCE, *RATE)
        nav[VELOCITY][0] += 1.0
        found = unaided.follow(nav, SECOND + t_ns, ring, INTERVAL)

    assert unaided.since_ns == SECOND + 60 * STEP_NS
    np.testing.assert_array_equal(found, nav)
