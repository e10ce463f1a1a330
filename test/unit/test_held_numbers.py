"""Whatever an object holds is found, and what grows is told from what does not."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from tools.robustness.held_numbers import growing, held_numbers


class Node:
    __slots__ = ("stamps",)

    def __init__(self) -> None:
        self.stamps: list[int] = []


class Filter:
    def __init__(self) -> None:
        self.node = Node()
        self.variances = {"offset": np.array([1e-6, 4.0]), "drift": -np.inf}
        self.recent: deque[float] = deque([3.0, -5.0])
        self.twin: Any = self
        self.learn = self.node.__init__


def test_every_number_is_found_with_its_range() -> None:
    held = held_numbers(Filter())

    assert held["Filter.variances"] == (1e-6, 4.0, False)
    assert held["Filter.recent"] == (-5.0, 3.0, True)
    assert held["len(Filter.recent)"] == (2.0, 2.0, True)
    assert held["len(Node.stamps)"] == (0.0, 0.0, True)


def test_growth_is_told_from_bounds_and_from_time() -> None:
    t = np.arange(1.0, 25.0) * 3600.0
    history = {
        "bounded": 5.0 + np.sin(t),
        "sum": 9.8 * t,
        "late": np.where(t > 20.0 * 3600.0, 1.0, 0.0),
        "variance": np.exp(t / 3600.0),
        "stamp": 1e9 * t + 1e9,
    }

    assert sorted(growing(t, history)) == ["late", "sum", "variance"]
    assert growing(t[:1], {"sum": t[:1]}) == {}
