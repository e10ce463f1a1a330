"""The compiled step against the readable reference that it is generated from."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.reference_filter import (
    NO_ROWS,
    difference_to_reference,
    flight,
    propagated,
    some_covariance,
    start,
)

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, as_numbers, steps_since
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial._covariance_step import covariance_step
from hybrid_ins.core.inertial.error_model import process_noise, system_matrix
from hybrid_ins.core.inertial.propagation import MEAN_TIME
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    COVARIANCE,
    N_ERROR,
    N_FLAT,
    N_NAV,
    NAVIGATION,
    PRODUCTS,
    covariance,
    pack,
)
from tools import generate_covariance


def test_generated_file_is_current() -> None:
    assert generate_covariance.main(["--check"]) == 0


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.floats(1e-4, 0.05))
def test_covariance_step_is_phi_p_phi_plus_q(seed: int, dt: float) -> None:
    rng = np.random.default_rng(seed)
    F = np.zeros((N_ERROR, N_ERROR))
    lla = np.array([rng.uniform(-1.3, 1.3), 0.0, rng.uniform(-300.0, 10e3)])
    C, f_n = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(0.0, 10.0, 3)
    system_matrix(lla, rng.normal(0.0, 100.0, 3), f_n, C.ravel(), F)
    psd = rng.uniform(0.1, 1.0, 12)
    P = some_covariance(seed)
    expected = propagated(P, F, C, psd, dt)

    packed = np.empty(120)
    pack(P, packed)
    s, u = rng.normal(size=(2, N_ERROR))
    s_expected, u_expected = ((np.eye(N_ERROR) + F * dt) @ vector for vector in (s, u))
    work = np.full(N_FLAT, np.nan)[PRODUCTS]
    covariance_step(packed, s, u, F, dt, *process_noise(C.ravel(), psd, dt), work)

    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    error = np.abs(packed - expected[np.triu_indices(N_ERROR)]) / unit[np.triu_indices(N_ERROR)]
    assert np.max(error) < 1e-14
    np.testing.assert_allclose(s, s_expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(u, u_expected, rtol=1e-12, atol=1e-12)


def test_a_minute_equals_the_reference() -> None:
    """State and covariance to 1e-9 of their size after 6 000 steps of the compiled kernel."""
    assert difference_to_reference(100.0, 60.0) < 1e-9


def test_the_mean_acceleration_is_that_of_the_motion() -> None:
    truth = flight(200.0, 4.0)
    nav, steps = start(truth), np.diff(truth.t)
    found = []
    for dt, reading in zip(steps, truth.readings[1:], strict=True):
        propagation.step(nav, dt, *reading, 0.01)
        found.append(nav[ACCELERATION].copy())
    late = round(MEAN_TIME * 200.0)
    expected = np.gradient(truth.velocity_n, truth.t, axis=0)[1:-late]

    settled = slice(round(6 * MEAN_TIME * 200.0), None)
    error = (np.array(found)[late:] - expected)[settled]
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert error.std() < 0.1 * expected[settled].std()


def test_step_and_run_are_the_same() -> None:
    truth = flight(200.0, 2.0)
    live, batch = start(truth), start(truth)
    steps, readings = np.diff(truth.t), truth.readings[1:]
    rows = np.empty((len(steps), N_NAV))

    propagation.run(batch, steps, readings, 0.01, rows)
    for k, (dt, reading) in enumerate(zip(steps, readings, strict=True)):
        propagation.step(live, dt, *reading, 0.01)
        np.testing.assert_array_equal(live[:N_NAV], rows[k])

    np.testing.assert_array_equal(live[:N_NAV], batch[:N_NAV])


def test_samples_are_run_up_to_the_first_gap() -> None:
    truth, gap = flight(200.0, 2.0), 250
    by_steps, by_samples = start(truth), start(truth)
    samples = np.zeros(len(truth.t), SAMPLE_DTYPE)
    samples["t_ns"] = np.round(truth.t * 1e9)
    samples["f"], samples["w"] = truth.readings[:, :3], truth.readings[:, 3:]
    samples["t_ns"][gap:] += 100_000_000
    steps = steps_since(0, samples["t_ns"])[1:gap] * 1e-9
    rows, others = np.empty((gap - 1, N_NAV)), np.zeros((len(samples) - 1, N_NAV))

    propagation.run(by_steps, steps, truth.readings[1:gap], 0.01, rows)
    numbers = as_numbers(samples[1:])
    first_ns, integers = int(samples["t_ns"][0]), numbers.view(np.int64)
    ran = propagation.run_samples(by_samples, first_ns, numbers, integers, 20_000_000, 0.01, others)

    assert ran == gap - 1
    np.testing.assert_array_equal(by_samples, by_steps)
    np.testing.assert_array_equal(others[:ran], rows)
    assert not others[ran:].any()


@pytest.mark.parametrize("interval", [0.01, 0.05])
def test_coarser_covariance_differs_by_little_and_the_state_not_at_all(interval: float) -> None:
    """At 1 kHz, after ten seconds of flight: each sigma to 2 % of itself even at 50 ms."""
    truth = flight(1000.0, 10.0)
    fine, coarse = start(truth), start(truth)

    for nav, pending in ((fine, 0.0), (coarse, interval)):
        propagation.run(nav, np.diff(truth.t), truth.readings[1:], pending, NO_ROWS)
        propagation.propagate_covariance(nav)

    np.testing.assert_array_equal(coarse[NAVIGATION], fine[NAVIGATION])
    sigma, exact = (np.sqrt(np.diag(covariance(nav))) for nav in (coarse, fine))
    np.testing.assert_allclose(sigma, exact, rtol=0.4 * interval)


def test_flush_propagates_what_is_pending_and_only_once() -> None:
    truth = flight(200.0, 0.1)
    nav, every = start(truth), start(truth)
    propagation.run(nav, np.diff(truth.t), truth.readings[1:], 1e9, NO_ROWS)
    propagation.run(every, np.diff(truth.t), truth.readings[1:], 0.0, NO_ROWS)
    before = nav[COVARIANCE].copy()

    propagation.propagate_covariance(nav)
    once = nav[COVARIANCE].copy()
    propagation.propagate_covariance(nav)

    np.testing.assert_array_equal(before, start(truth)[COVARIANCE])
    np.testing.assert_array_equal(nav[COVARIANCE], once)
    np.testing.assert_allclose(np.diag(covariance(nav)), np.diag(covariance(every)), rtol=0.02)
