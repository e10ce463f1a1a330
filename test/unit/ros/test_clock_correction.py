"""The clock offset in force: chance leaves the given one, evidence moves it, also back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.clock_offset import ClockOffsetObserver
from hybrid_ins.core.clock_prior import ClockPrior
from hybrid_ins.core.events import ClockShift
from hybrid_ins.core.state import N_FLAT
from hybrid_ins.ros.clock_correction import ClockCorrection
from hybrid_ins.ros.input_log import InputLog

GIVEN, STD = 0.05, 0.004


class Running:
    """A filter of which only the clock matters."""

    def __init__(self) -> None:
        self.clock = ClockOffsetObserver(0.5, ClockPrior(0.0, STD))
        self.noise = SimpleNamespace(imu_factors=(1.0, 1.0))
        self.t_ns = 0

    def submit(self, event: Any) -> None:
        assert isinstance(event, ClockShift)
        self.clock.shift(event.by, np.zeros(N_FLAT))

    def show(self, offset: float, in_force: float) -> None:
        """Let the innovations show an offset [s] to 4 ms."""
        self.clock.set_estimate(offset - in_force, 0.004)
        self.t_ns += 2_000_000_000


@pytest.fixture
def running() -> Running:
    return Running()


@pytest.fixture
def clock(running: Running) -> ClockCorrection:
    phase = SimpleNamespace(bank=None)
    navigator: Any = SimpleNamespace(
        filter=running,
        phase=phase,
        phases=SimpleNamespace(clock_open=False),
        last_ns=0,
        open_clock=lambda unknown: None,
    )
    values = {
        **parameters.defaults(),
        "gnss.time_offset.value": GIVEN,
        "gnss.time_offset.std": STD,
    }
    return ClockCorrection(values, navigator, InputLog(lambda level, text: None))


def test_chance_does_not_move_a_given_offset(clock: ClockCorrection, running: Running) -> None:
    for offset in (GIVEN + 0.01, GIVEN - 0.01):
        running.show(offset, clock.offset)
        clock.run_periodic()
    assert clock.offset == GIVEN


def test_an_offset_that_was_moved_returns_when_the_innovations_do(
    clock: ClockCorrection, running: Running
) -> None:
    running.show(GIVEN - 0.03, clock.offset)
    clock.run_periodic()
    assert clock.offset == pytest.approx(GIVEN - 0.03, abs=0.005)

    running.show(GIVEN + 0.002, clock.offset)
    clock.run_periodic()

    assert clock.offset == pytest.approx(GIVEN, abs=0.003)
