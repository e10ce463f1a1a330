"""What outlasts a gap in the IMU's samples."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.inertial.state import HEADING_DOUBT, N_ERROR, NavState
from hybrid_ins.core.navigator.restart import heading_after


def running(doubt: float) -> Any:
    """Return a filter with a heading of 0.5 ± 0.1 rad, and another part of its σ [rad]."""
    quat, zero = quat_from_rpy(0.0, 0.0, 0.5), np.zeros(3)
    nav = NavState(zero, zero, quat, zero, zero, 0.01 * np.eye(N_ERROR)).to_flat()
    nav[HEADING_DOUBT] = doubt**2
    return SimpleNamespace(flat_state=lambda: nav)


def test_a_heading_outlasts_a_gap_as_uncertain_as_it_is_reported() -> None:
    assert heading_after(0.2, None, False) is None
    assert heading_after(0.2, running(0.0), False) == pytest.approx((0.5, np.hypot(0.1, 0.1)))
    doubtful = heading_after(0.2, running(0.2), False)
    assert doubtful == pytest.approx((0.5, np.sqrt(0.1**2 + 0.1**2 + 0.2**2)))
    assert heading_after(0.2, running(1.0), False) is None


def test_a_vehicle_that_stood_has_turned_by_less() -> None:
    stood = heading_after(3.0, running(0.0), True)
    assert stood == pytest.approx((0.5, np.hypot(0.1, 0.15)))
    assert heading_after(3.0, running(0.0), False) is None
