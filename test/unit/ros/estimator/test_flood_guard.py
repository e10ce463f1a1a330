"""More messages than any receiver sends are refused, topic by topic."""

from hybrid_ins.ros.estimator.flood_guard import MOST, FloodGuard

SECOND = 1_000_000_000


def test_a_receiver_at_fifty_hertz_is_never_refused() -> None:
    guard = FloodGuard()
    assert not any(guard.check("gnss/fix", SECOND + k * SECOND // 50, k) for k in range(1000))


def test_a_flood_is_cut_and_ends_with_the_second() -> None:
    guard = FloodGuard()
    admitted = sum(guard.check("gnss/fix", 5 * SECOND + k, 0) is None for k in range(6 * MOST))

    assert admitted == MOST
    assert guard.check("gnss/velocity", 5 * SECOND + 9999, 0) is None
    assert guard.check("gnss/fix", 6 * SECOND + 1, 0) is None
    assert guard.check("gnss/fix", 1, 0) is None  # the clock went back


def test_fixes_beside_an_imu_that_gives_nothing_usable_are_no_flood() -> None:
    guard = FloodGuard()
    assert not any(guard.check("gnss/fix", 0, k * SECOND // 5) for k in range(1000))
    admitted = sum(guard.check("gnss/fix", 0, 300 * SECOND) is None for _ in range(6 * MOST))
    assert admitted == MOST


def test_fixes_after_the_end_of_the_imu_are_no_flood() -> None:
    guard = FloodGuard()
    stamps = [5 * SECOND + k * SECOND // 5 for k in range(1000)]
    ended = 7 * SECOND + SECOND // 2  # within a second that has begun
    assert not any(guard.check("gnss/fix", min(stamp, ended), stamp) for stamp in stamps)
    admitted = sum(guard.check("gnss/fix", ended, stamps[-1]) is None for _ in range(6 * MOST))
    assert admitted <= MOST
