"""What a filter learns of the receiver's noise beside its banks of hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.core.filter.filter_noise import SUSPICION_NS, FilterNoise
from hybrid_ins.core.inertial.state import N_ERROR, N_FLAT, Array
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank, StateCorrection
from hybrid_ins.core.noise.position_scatter import PositionScatter
from hybrid_ins.core.noise.process_noise import ConstantNoise, Correction, ProcessNoise
from hybrid_ins.core.noise.slow_error import SlowError
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix

SECOND = 1_000_000_000
BEGIN_NS = 100 * SECOND


class Told(NoiseMultipleModelBank):
    """A bank that finds what it is told, whatever the innovations."""

    def update(self, correction: Correction, psd: Array) -> StateCorrection | None:
        return None

    def tell(self, **found: float) -> None:
        self.found = NoiseFactors(**found)


@pytest.fixture
def bank() -> Told:
    return Told()


@pytest.fixture
def noise(bank: Told) -> FilterNoise:
    process = ProcessNoise(np.full(6, 1e-6), 0.01)
    return FilterNoise(ConstantNoise(np.full(6, 1e-3)), process, bank)


def position(t_ns: int, height: float = 50.0) -> PositionFix:
    return PositionFix(t_ns, np.array([0.5, 0.1, height]), 1e-4 * np.eye(3), np.zeros(3))


def correction(t_ns: int) -> Correction:
    """Return a correction by a position that is 5 m off, and claims a centimetre."""
    S, H, K = 1e-3 * np.eye(3), np.eye(3, N_ERROR), np.zeros((N_ERROR, 3))
    z, none = np.array([5.0, 0.0, 0.0]), np.zeros(N_ERROR)
    return Correction(t_ns, z, S, H, K, none, np.eye(3), 0.2, np.zeros(N_FLAT), True)


def surprise(noise: FilterNoise) -> None:
    """Let a position surprise a filter that was believed."""
    verdict = Verdict(
        position(BEGIN_NS), True, "", 0.0, 100.0, 16.0, np.full(3, 0.01), surprises=True
    )
    noise.learn_verdict(verdict, correction(BEGIN_NS), 1e-4 * np.eye(3))


@pytest.mark.parametrize(("after", "is_learned"), [(0.2, True), (2.8, True), (3.6, False)])
def test_a_slow_error_that_follows_a_surprise_soon_shows_a_jump(
    noise: FilterNoise, bank: Told, after: float, is_learned: bool
) -> None:
    surprise(noise)
    for k in range(1, 30):
        t_ns = BEGIN_NS + k * SECOND // 5
        bank.tell(slow_probability=0.95 if t_ns >= BEGIN_NS + round(after * SECOND) else 0.5)
        noise.learn_correction(correction(t_ns))

    assert (noise.jumps.count == 1.0) == is_learned
    if is_learned:  # that of the surprise
        assert noise.jumps.t_ns == BEGIN_NS
    assert 2.8 < SUSPICION_NS / SECOND < 3.4


def test_a_state_that_was_changed_since_shows_no_jump(noise: FilterNoise, bank: Told) -> None:
    surprise(noise)
    noise.restart(keep_weights=True)
    bank.tell(slow_probability=0.95)

    noise.learn_correction(correction(BEGIN_NS + SECOND))

    assert noise.jumps.count == 0.0


@pytest.mark.parametrize("is_faulty", [False, True])
def test_what_state_and_receiver_disagreed_by_is_published_unless_the_imu_was_faulty(
    noise: FilterNoise, is_faulty: bool
) -> None:
    if is_faulty:
        noise.on_imu_fault(BEGIN_NS - SECOND)
    noise.split_of(position(BEGIN_NS), PositionScatter())
    verdict = Verdict(
        position(BEGIN_NS), True, "", 0.0, 100.0, 16.0, np.full(3, 0.01), is_ambiguous=True
    )
    noise.learn_verdict(verdict, correction(BEGIN_NS), 1e-4 * np.eye(3))

    variance = noise.past_variance(np.zeros(3), BEGIN_NS, is_running=True)

    assert variance[:2].sum() == pytest.approx(0.0 if is_faulty else 25.0)
    assert noise.slow_error.stds == (0.0, 0.0)  # the filter follows the fixes as before


def test_of_past_errors_what_exceeds_the_present_one_is_published(
    noise: FilterNoise, bank: Told
) -> None:
    noise.slow_error = SlowError(past=(2.0, 2.0), t_ns=BEGIN_NS)

    variance = noise.past_variance(np.array([1.0, 1.0, 25.0]), BEGIN_NS, is_running=True)

    assert variance == pytest.approx([3.0, 3.0, 0.0])


@pytest.mark.parametrize(
    ("height", "found", "is_kept"),
    [
        (np.nan, {"heights": 9.0, "fixes": 4.0}, False),
        (np.nan, {"slow_std": 0.3, "slow_height_std": 1.0}, False),
        (np.nan, {"slow_std": 1.0, "slow_height_std": 1.0, "fixes": 4.0}, True),
        (50.0, {"heights": 9.0}, True),
    ],
)
def test_a_position_without_a_height_ends_what_was_found_of_heights(
    noise: FilterNoise, bank: Told, height: float, found: dict[str, float], is_kept: bool
) -> None:
    bank.tell(**found)

    noise.split_of(position(BEGIN_NS, height), PositionScatter())

    assert bank.found == (NoiseFactors(**found) if is_kept else NoiseFactors())


def test_new_heights_show_no_slow_error_of_their_own_for_a_minute() -> None:
    """Nor before heading and clock are known: a search looks like one."""
    used: list[Array] = []

    class Seen(NoiseMultipleModelBank):
        def _update(
            self, correction: Correction, psd: Array, hypotheses: Array, weigh: bool
        ) -> bool:
            used.append(hypotheses)
            return False

    bank = Seen()
    one = replace(correction(BEGIN_NS), of_stamp=np.zeros((3, 3)))
    bank.update(one, np.zeros(12))
    bank.forget_heights(BEGIN_NS + SECOND)
    for seconds in (1.2, 60.9, 61.1):
        bank.update(replace(one, t_ns=BEGIN_NS + round(seconds * SECOND)), np.zeros(12))
    bank.update(replace(one, t_ns=BEGIN_NS + 70 * SECOND, of_stamp=None), np.zeros(12))

    with_them, without = used[0], used[1]
    assert [hypotheses is with_them for hypotheses in used] == [True, False, False, True, False]
    assert np.count_nonzero(without[5]) < np.count_nonzero(with_them[5])
