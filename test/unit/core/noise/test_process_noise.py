"""Noise models behind the seam: units, fallback and return, innovations, no side effects."""

import copy

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import NoiseChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.state import B_A, B_G, DV, EPS, N_ERROR, N_FLAT, NavState
from hybrid_ins.core.noise.innovation import InnovationNoise
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.process_noise import (
    PAPER_CONSTANTS,
    ConstantNoise,
    Correction,
    LearnedNoise,
    NoiseEstimate,
    NoiseModel,
    ProcessNoise,
)
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.core.update.gate import Gate

Array = NDArray[np.float64]

WALK = np.repeat((1e-12, 1e-14), 3)
Q = np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]) * 1e-4
FALLBACK = np.repeat((4e-4, 4e-6), 3)
REFRESH_NS = 200_000_000


def process(period: float = 0.01, consistent: bool = True) -> ProcessNoise:
    return ProcessNoise(WALK, period, consistent)


def correction(
    z: Array, gain: float = 1.0, interval: float = 0.2, C_nb: Array | None = None
) -> Correction:
    """One that moves velocity by ``gain * z`` and misalignment by a tenth of it."""
    K = np.zeros((N_ERROR, len(z)))
    K[DV], K[EPS] = gain * np.eye(3, len(z)), 0.1 * gain * np.eye(3, len(z))
    return Correction(
        t_ns=1,
        z=z,
        S=np.eye(len(z)),
        H=np.zeros((len(z), N_ERROR)),
        K=K,
        dx=K @ z,
        C_nb=np.eye(3) if C_nb is None else C_nb,
        interval=interval,
        nav=np.zeros(N_FLAT),
        fused=True,
    )


# --- Units ---------------------------------------------------------------------------------------


def test_consistent_density_is_variance_times_period_and_the_printed_one_is_the_variance() -> None:
    assert process(0.005).psd(Q) == pytest.approx(np.concatenate((Q * 0.005, WALK)))
    assert process(0.005, consistent=False).psd(Q) == pytest.approx(np.concatenate((Q, WALK)))


@pytest.mark.parametrize("consistent", [True, False])
def test_levels_and_density_are_inverse(consistent: bool) -> None:
    units = process(0.001, consistent)

    assert units.q(units.psd(Q)[:6]) == pytest.approx(Q)


@pytest.mark.parametrize("rate", [100, 1000])
def test_white_noise_of_one_sample_adds_up_in_the_velocity_as_its_mean_square_does(
    rate: int,
) -> None:
    """A second of N samples of variance q moves the velocity by q dt² N, whatever the rate."""
    ins = still_filter(ConstantNoise(Q), rate)
    grown = np.diag(advance(ins, rate, 1.0).P)

    assert grown[DV][2] == pytest.approx(Q[2] / rate, rel=0.02)
    assert grown[EPS] == pytest.approx(Q[3:] / rate, rel=0.02)
    assert grown[B_A] == pytest.approx(WALK[:3], rel=1e-6)
    assert grown[B_G] == pytest.approx(WALK[3:], rel=1e-6)


def test_paper_constants_are_those_of_the_paper() -> None:
    assert PAPER_CONSTANTS == {"cq1": (0.002, 0.02), "cq2": (0.001, 0.01), "cq3": (0.002, 0.01)}


# --- Constant and learned ------------------------------------------------------------------------


def test_constant_stays_constant() -> None:
    given = Q.copy()
    noise = ConstantNoise(given)
    given[:] = 9.0
    noise.learn(NoiseEstimate(1, 5.0 * Q))
    noise.learn(correction(np.ones(3)))

    assert noise.levels() == pytest.approx(Q)


def test_learned_starts_on_the_fallback_and_says_so() -> None:
    noise = LearnedNoise(FALLBACK)
    noise.learn(NoiseEstimate(0, None))

    assert noise.levels() == pytest.approx(FALLBACK)
    assert noise.on_fallback


def test_an_estimate_is_in_force_at_once() -> None:
    noise = LearnedNoise(FALLBACK)
    noise.learn(NoiseEstimate(10**9, Q))

    assert noise.levels() == pytest.approx(Q)
    assert not noise.on_fallback


def test_an_estimate_of_readings_that_are_cut_off_never_makes_the_noise_less_than_usual() -> None:
    noise = LearnedNoise(FALLBACK)
    read = FALLBACK * [100.0, 1.0, 0.01, 100.0, 1.0, 0.01]

    noise.learn(NoiseEstimate(10**9, read, at_least=True))

    assert noise.levels() == pytest.approx(np.maximum(read, FALLBACK))
    assert not noise.on_fallback


def test_refused_estimates_fall_back_within_a_second_and_the_next_good_one_counts() -> None:
    # GIVEN a good estimate
    noise = LearnedNoise(FALLBACK)
    noise.learn(NoiseEstimate(0, Q))

    # WHEN every further one is refused
    fallback = []
    for k in range(1, 11):
        noise.learn(NoiseEstimate(k * REFRESH_NS, None))
        fallback.append(noise.on_fallback)

    # THEN one bad window does no harm, the fallback is in force within a second, and goes again
    assert not fallback[0]
    assert fallback[4:] == [True] * 6
    assert noise.levels() == pytest.approx(FALLBACK)
    noise.learn(NoiseEstimate(11 * REFRESH_NS, 2.0 * Q))
    assert noise.levels() == pytest.approx(2.0 * Q)
    assert not noise.on_fallback


def test_only_what_exceeds_the_background_counts_as_more_than_the_constant() -> None:
    # GIVEN a vehicle in whose ordinary motion up to 100 times the noise is read
    noise = LearnedNoise(FALLBACK, 100.0 * FALLBACK)

    def counts(times: float) -> float:
        noise.learn(NoiseEstimate(0, times * FALLBACK))
        ratio = noise.levels() / FALLBACK
        assert np.ptp(ratio) < 1e-9
        return float(ratio[0])

    # THEN ordinary motion is no noise, a quieter stretch is quieter, and far more counts in full
    assert counts(50.0) == counts(100.0) == 1.0
    assert counts(0.2) == pytest.approx(0.2)
    assert counts(1e5) == pytest.approx(1e5, rel=1e-3)
    # AND nothing jumps, nor falls while the level rises, nor exceeds it
    times = np.geomspace(0.1, 1e4, 400)
    counted = np.array([counts(level) for level in times])
    assert np.all(counted <= times * (1.0 + 1e-12))
    assert np.all((np.diff(counted) >= 0.0) & (np.diff(np.log(counted)) < 2.0))


def test_learned_ignores_corrections() -> None:
    noise = LearnedNoise(FALLBACK)
    noise.learn(correction(np.ones(3)))

    assert noise.levels() == pytest.approx(FALLBACK)


# --- Innovation ----------------------------------------------------------------------------------


def test_innovation_levels_are_the_mean_square_correction_over_the_interval() -> None:
    """Eq. (16)-(18): K C K' spread over the interval, as a variance per sample."""
    noise = InnovationNoise(FALLBACK, np.zeros(6), 2, process(0.01))
    first, second = np.array([1.0, 2.0, 3.0]), np.array([3.0, 0.0, -1.0])
    noise.learn(correction(first, gain=0.5))
    assert noise.levels() == pytest.approx(FALLBACK)

    noise.learn(correction(second, gain=0.5))

    mean_square = 0.25 * (first**2 + second**2) / 2.0
    expected = np.concatenate((mean_square, 0.01 * mean_square)) / 0.2 / 0.01
    assert noise.levels() == pytest.approx(expected)


def test_only_the_last_innovations_count() -> None:
    noise = InnovationNoise(FALLBACK, np.zeros(6), 3, process())
    for k in range(10):
        noise.learn(correction(np.full(3, 100.0 if k < 7 else 1.0)))

    assert noise.levels()[:3] == pytest.approx(np.full(3, 1.0 / 0.2 / 0.01))


def test_levels_are_those_of_the_body_axes() -> None:
    forward_is_east = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    noise = InnovationNoise(FALLBACK, np.zeros(6), 1, process())
    noise.learn(correction(np.array([2.0, 0.0, 0.0]), C_nb=forward_is_east))

    # North is the body's down.
    assert noise.levels()[:3] / noise.levels()[:3].max() == pytest.approx([0.0, 0.0, 1.0])


def test_units_of_the_paper_leave_out_the_period() -> None:
    z = np.ones(3)
    levels = []
    for consistent in (True, False):
        noise = InnovationNoise(FALLBACK, np.zeros(6), 1, process(0.01, consistent))
        noise.learn(correction(z))
        levels.append(noise.levels())

    assert levels[0] == pytest.approx(levels[1] / 0.01)


def test_the_literal_form_exceeds_the_stable_one_by_the_samples_in_an_interval() -> None:
    levels = []
    for literal in (False, True):
        noise = InnovationNoise(FALLBACK, np.zeros(6), 1, process(0.01), literal)
        noise.learn(correction(np.ones(3), interval=0.2))
        levels.append(noise.levels())

    assert levels[1] == pytest.approx(20.0 * levels[0])


def test_levels_never_fall_below_the_floor() -> None:
    noise = InnovationNoise(FALLBACK, Q, 1, process())
    noise.learn(correction(np.zeros(3)))

    assert noise.levels() == pytest.approx(Q)


def test_corrections_without_three_components_or_without_time_teach_nothing() -> None:
    noise = InnovationNoise(FALLBACK, np.zeros(6), 1, process())
    noise.learn(correction(np.ones(2)))
    noise.learn(correction(np.ones(3), interval=0.0))

    assert noise.levels() == pytest.approx(FALLBACK)


# --- In the filter -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "noise",
    [LearnedNoise(FALLBACK), InnovationNoise(FALLBACK, np.zeros(6), 2, process())],
    ids=["learned", "innovation"],
)
def test_a_shallow_copy_is_a_snapshot(noise: NoiseModel) -> None:
    """The filter keeps copies to rewind to: what comes later must not reach them."""
    noise.learn(NoiseEstimate(10**9, Q))
    for _ in range(2):
        noise.learn(correction(np.ones(3)))
    snapshot = copy.copy(noise)
    before = snapshot.levels().copy()

    noise.learn(NoiseEstimate(2 * 10**9, 7.0 * Q))
    for _ in range(3):
        noise.learn(correction(np.full(3, 5.0)))
    noise.learn(NoiseEstimate(9 * 10**9, None))

    assert snapshot.levels() == pytest.approx(before)


@pytest.mark.parametrize(
    ("imu_factors", "slow_std"), [((50.0, 1.0), 0.0), ((1.0, 50.0), 0.0), ((0.8, 1.0), 3.0)]
)
def test_what_the_fallback_needed_is_dropped_once_there_is_an_estimate(
    imu_factors: tuple[float, float], slow_std: float
) -> None:
    restarts: list[bool] = []

    class Factors(NoiseMultipleModelBank):
        def restart(self, *, keep_weights: bool) -> None:
            restarts.append(keep_weights)

    factors, model = Factors(), LearnedNoise(FALLBACK)
    noise = FilterNoise(model, process(), factors)
    noise.learn_estimate(NoiseEstimate(0, Q))
    noise.learn_estimate(NoiseEstimate(10**9, None))
    assert model.on_fallback and not restarts
    noise.learn_estimate(NoiseEstimate(2 * 10**9, Q))
    assert not model.on_fallback and not restarts  # no factor was above 1

    noise.learn_estimate(NoiseEstimate(3 * 10**9, None))
    factors.found = NoiseFactors(*imu_factors, slow_height_std=slow_std)
    noise.learn_estimate(NoiseEstimate(4 * 10**9, Q))

    assert not model.on_fallback and restarts == [False]


def test_innovations_from_before_a_restart_are_dropped() -> None:
    noise = FilterNoise(InnovationNoise(FALLBACK, np.zeros(6), 2, process()), process())
    noise.learn_correction(correction(np.full(3, 100.0)))
    noise.restart(keep_weights=True)
    noise.learn_correction(correction(np.ones(3)))
    assert noise.levels() == pytest.approx(FALLBACK)
    noise.learn_correction(correction(np.ones(3)))

    assert noise.levels()[:3] == pytest.approx(np.full(3, 1.0 / 0.2 / 0.01))


def test_an_estimate_reaches_the_covariance_at_its_stamp_also_when_it_comes_late() -> None:
    rate = 100
    in_time, late = (still_filter(LearnedNoise(FALLBACK), rate) for _ in range(2))
    estimate = NoiseEstimate(10**9 + 500_000_000, 100.0 * Q)
    in_time.submit(estimate)
    result = advance(in_time, rate, 1.0)
    advance(late, rate, 1.0)
    late.submit(estimate)

    np.testing.assert_allclose(late.state.P, result.P, rtol=1e-9)
    assert result.P[5, 5] == pytest.approx(0.5 * (FALLBACK[2] + 100.0 * Q[2]) / rate, rel=0.05)


def test_another_model_takes_over_without_touching_the_state() -> None:
    rate = 100
    ins = still_filter(ConstantNoise(Q), rate)
    before = advance(ins, rate, 0.5)
    ins.submit(NoiseChange(ins.t_ns, FilterNoise(ConstantNoise(4.0 * Q), process(1.0 / rate))))
    at_change = ins.state
    after = advance(ins, rate, 0.5)

    assert at_change.lla.tolist() == before.lla.tolist()
    assert at_change.quat_xyzw.tolist() == before.quat_xyzw.tolist()
    assert at_change.P.tolist() == before.P.tolist()
    assert after.P[5, 5] - before.P[5, 5] == pytest.approx(4.0 * before.P[5, 5], rel=0.05)


def still_filter(noise: NoiseModel, rate: int) -> InsFilter:
    """A filter that knows everything at its start, one second after the epoch."""
    state = NavState(
        np.array([0.56, 0.61, 100.0]),
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        np.zeros((N_ERROR, N_ERROR)),
    )
    return InsFilter(
        state,
        10**9,
        np.array([0.0, 0.0, -9.8, 0.0, 0.0, 0.0]),
        FilterNoise(noise, process(1.0 / rate)),
        Gate({3: 30.0}, 3.0),
        ImuRing(),
        FilterSettings(),
    )


def advance(ins: InsFilter, rate: int, duration: float) -> NavState:
    samples = np.zeros(round(rate * duration), SAMPLE_DTYPE)
    samples["t_ns"] = ins.t_ns + 10**9 // rate * np.arange(1, len(samples) + 1)
    samples["f"][:, 2] = -9.8
    ins.ring.extend(samples)
    ins.predict_block(samples)
    return ins.state
