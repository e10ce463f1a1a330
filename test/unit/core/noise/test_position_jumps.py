"""Jumps of positions that their receiver does not claim: what is learned, how it fades."""

import numpy as np
import pytest

from hybrid_ins.core.navigator.restart import RESETS, ResetCount
from hybrid_ins.core.noise.position_jumps import DOUBTED_NS, JUMP_MEMORY, PositionJumps
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix

SECOND = 1_000_000_000
CLAIMED = np.diag([0.02**2, 0.02**2, 0.04**2])
S = 4.0 * CLAIMED


def _after(*jumps: tuple[float, tuple[float, ...]]) -> PositionJumps:
    """Return what jumps at a time [s] teach."""
    found = PositionJumps()
    for t, z in jumps:
        m = len(z)
        found = found.learned(np.array(z), S[:m, :m], CLAIMED[:m, :m], round(t * SECOND))
    return found


def test_nothing_is_known_before_the_first() -> None:
    found = PositionJumps()

    assert found.variance(SECOND) == pytest.approx(np.zeros(3)) and found.size == 0.0


def test_the_first_one_covers_itself() -> None:
    found = _after((10.0, (0.6, -0.8, 0.1)))

    assert found.size == pytest.approx(np.sqrt(1.01)) and found.claimed_std == pytest.approx(0.02)
    # The square of each horizontal axis is half of that of both; the height is known no better.
    assert found.variance(10 * SECOND) == pytest.approx(np.full(3, 0.5), rel=0.01)


def test_the_last_one_and_the_mean_of_all_are_covered() -> None:
    small, large = (0.1, 0.1, 0.2), (1.0, 1.0, 0.2)

    assert _after((1.0, small), (2.0, large)).variance(2 * SECOND)[0] > 0.99
    rare = _after(*((float(t), large) for t in range(9)), (9.0, small)).variance(9 * SECOND)
    assert 0.85 < rare[0] < 0.95


def test_what_the_state_explains_is_no_jump() -> None:
    found = _after((10.0, (0.0, 0.0, 30.0)))

    assert found.variance(10 * SECOND) == pytest.approx([0.0, 0.0, 900.0], rel=1e-4)


def test_what_a_position_claims_is_no_jump() -> None:
    sigma = np.sqrt(np.trace(CLAIMED))  # of the distance

    assert _after((10.0, (1.9 * sigma, 0.0, 0.0))).count == 0.0
    assert _after((10.0, (2.1 * sigma, 0.0, 0.0))).count == 1.0


def test_it_fades_while_none_jumps_and_is_none_below_the_claim() -> None:
    found = _after((10.0, (0.5, 0.5)))

    first = found.variance(10 * SECOND)
    assert found.variance(round((10.0 + JUMP_MEMORY) * SECOND)) == pytest.approx(first / np.e)
    assert not found.variance(round((10.0 + 10.0 * JUMP_MEMORY) * SECOND)).any()


def test_none_is_learned_soon_after_a_fault_of_the_imu() -> None:
    faulty = PositionJumps().doubted(SECOND)

    assert faulty.learned(np.ones(3), S, CLAIMED, 2 * SECOND) is faulty
    assert faulty.learned(np.ones(3), S, CLAIMED, SECOND + DOUBTED_NS).count == 1.0


def test_a_filter_goes_on_with_what_an_earlier_one_has_learned() -> None:
    few, many = _after((1.0, (1.0, 1.0))), _after((1.0, (2.0, 2.0)), (2.0, (2.0, 2.0)))

    assert few.or_earlier(many, 3 * SECOND) is many and many.or_earlier(few, 3 * SECOND) is many
    assert few.or_earlier(many, SECOND) is few, "the stamps went back"


def _reset(t: float, jumped: bool) -> Verdict:
    fix = PositionFix(round(t * SECOND), np.zeros(3), CLAIMED, np.zeros(3))
    sigma = np.full(3, 0.02)
    return Verdict(fix, True, "", 0.0, 1.0, 2.0, sigma, inflated=True, receiver_jumped=jumped)


@pytest.mark.parametrize(("jumped", "needed"), [(False, RESETS), (True, 2 * RESETS)])
def test_resets_by_jumps_of_the_fixes_count_half(jumped: bool, needed: int) -> None:
    count = ResetCount()

    found = [count.add(_reset(4.0 * k, jumped), 5.0) for k in range(needed)]

    assert found == [False] * (needed - 1) + [True]
    assert not ResetCount().add(_reset(0.0, jumped), 5.0)
