"""When filters of several headings have become one."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.ins_filter import FilterSettings
from hybrid_ins.core.multiple_model import N_HEADINGS, MultipleModelBank
from hybrid_ins.core.state import N_ERROR, NavState

SECOND = 1_000_000_000


def begin(state: NavState, settings: FilterSettings) -> Any:
    return SimpleNamespace(nav=state.to_flat(), t_ns=SECOND, verdicts=deque())


@pytest.fixture
def bank() -> MultipleModelBank:
    """Return filters of several headings, of which one is left: it knows its own to 3°."""
    level = NavState(
        np.array([0.5, 0.1, 0.0]),
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        0.05**2 * np.eye(N_ERROR),
    )
    found = MultipleModelBank([level] * N_HEADINGS, begin, FilterSettings())
    assert found.heading_open
    return found


def decided(bank: MultipleModelBank, seconds: float) -> bool:
    """Let the filters go on for a while; return whether they are one filter at its end."""
    decision = None
    for _ in range(round(10.0 * seconds)):
        for one in bank.filters:
            one.t_ns += SECOND // 10
        decision = bank.decide()
    return decision is not None


def test_at_rest_no_heading_is_known(bank: MultipleModelBank) -> None:
    assert not decided(bank, 20.0)


def test_a_heading_counts_as_known_from_the_first_motion_on(bank: MultipleModelBank) -> None:
    # GIVEN a vehicle that has stood for long, and begins to move
    decided(bank, 20.0)
    bank.motion.moves = True
    assert not decided(bank, 1.5)
    # WHEN the motion has lasted THEN what was known meanwhile has lasted, too
    bank.motion.shown = True
    assert decided(bank, 0.1)


def test_a_stand_before_does_not_count(bank: MultipleModelBank) -> None:
    decided(bank, 20.0)
    bank.motion.moves = bank.motion.shown = True
    assert not decided(bank, 0.5)
    assert decided(bank, 1.0)


def test_without_an_open_heading_one_filter_is_enough(bank: MultipleModelBank) -> None:
    bank.heading_open = False
    assert decided(bank, 0.1)
