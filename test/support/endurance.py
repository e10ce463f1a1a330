"""What has to hold of the clock offset on any drive."""

from __future__ import annotations

from tools.robustness import endurance


def assert_clock_is_within_three_sigma(
    kind: str, offset: float, seed: int, duration: float = 300.0
) -> None:
    """Drive for so long [s], the fixes stamped early or late by ``offset`` [s]."""
    day = endurance.live(kind, duration, seed, offset, {})

    assert not day.failure
    assert day.clock_excess < 3.0
    assert day.clock_sigma.min() >= 1e-3
    if kind == "standing":
        assert day.clock_sigma.min() > 0.1
    assert day.eigenvalue.min() > 0.0
    assert day.state_offset.max() < 10.0
