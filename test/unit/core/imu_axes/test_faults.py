"""When a second check is evidence of its own."""

import numpy as np
import pytest

from hybrid_ins.core.imu_axes.faults import AxesFault

REVERSED = ((np.eye(3), np.diag([1.0, -1.0, 1.0])),)


def fault(shown_by: tuple[float, float] | None) -> AxesFault:
    return AxesFault(REVERSED, np.eye(3), shown_by=shown_by)


@pytest.mark.parametrize(
    ("first", "second", "confirmed"),
    [
        ((170.0, 228.0), (176.0, 233.0), False),
        ((170.0, 228.0), (200.0, 258.0), True),
        ((2.0, 15.0), (2.0, 20.0), False),
        ((2.0, 15.0), (6.0, 25.0), True),
        ((170.0, 228.0), (170.0, 228.0), False),
    ],
)
def test_what_may_be_chance_is_confirmed_by_motion_of_which_half_is_new(
    first: tuple[float, float], second: tuple[float, float], confirmed: bool
) -> None:
    assert fault(first).is_confirmed_by(fault(second)) is confirmed


@pytest.mark.parametrize("other", [None, (5.0, 63.0)])
def test_what_is_clear_needs_no_other_motion(other: tuple[float, float] | None) -> None:
    assert fault(None).is_confirmed_by(fault(other))
    assert fault(other).is_confirmed_by(fault(None))
