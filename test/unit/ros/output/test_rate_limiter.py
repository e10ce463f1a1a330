"""What is told less often than samples come."""

from hybrid_ins.ros.output.rate_limiter import RateLimiter


def due(cadence: RateLimiter, stamps_ms: list[int]) -> list[int]:
    return [t for t in stamps_ms if cadence.is_due(t * 1_000_000)]


def test_first_stamp_of_each_period() -> None:
    assert due(RateLimiter(10.0), [5, 60, 99, 100, 140, 230, 299, 310]) == [5, 100, 230, 310]


def test_every_stamp_where_no_rate_is_given() -> None:
    assert due(RateLimiter(0.0), [1, 2, 3]) == [1, 2, 3]


def test_time_that_jumps_waits_for_nothing() -> None:
    assert due(RateLimiter(1.0), [5000, 5500, 100, 200, 9100, 9200]) == [5000, 100, 9100]


def test_another_rate_holds_from_the_next_stamp() -> None:
    cadence = RateLimiter(1.0)
    assert due(cadence, [1000, 1100]) == [1000]
    cadence.change(10.0)
    assert due(cadence, [1200, 1250, 1300]) == [1200, 1300]
