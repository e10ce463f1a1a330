"""More messages than any receiver sends are refused, topic by topic."""

from hybrid_ins.ros.flood_guard import MOST, FloodGuard

SECOND = 1_000_000_000


def test_a_receiver_at_fifty_hertz_is_never_refused() -> None:
    guard = FloodGuard()
    assert not any(guard.check("gnss/fix", SECOND + k * SECOND // 50) for k in range(1000))


def test_a_flood_is_cut_and_ends_with_the_second() -> None:
    guard = FloodGuard()
    admitted = sum(guard.check("gnss/fix", 5 * SECOND + k) is None for k in range(6 * MOST))

    assert admitted == MOST
    assert guard.check("gnss/velocity", 5 * SECOND + 9999) is None
    assert guard.check("gnss/fix", 6 * SECOND + 1) is None
    assert guard.check("gnss/fix", 1) is None  # the clock went back
