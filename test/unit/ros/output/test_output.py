"""The numbers of messages, where the flat state's are not theirs."""

import numpy as np
import pytest

from hybrid_ins.core.inertial.state import N_ERROR, NavState
from hybrid_ins.ros.output.output import N_FIX, fix_values


@pytest.mark.parametrize("beyond", [1e-5, -1e-5])
def test_longitudes_stay_within_180_degrees_across_the_date_line(beyond: float) -> None:
    """The longitude of a filter goes on where a ship crosses it; receivers' begins anew."""
    lla, zero = np.array([0.3, np.pi + beyond, 5.0]), np.zeros(3)
    level = np.array([0.0, 0.0, 0.0, 1.0])
    nav = NavState(lla, zero, level, zero, zero, np.eye(N_ERROR)).to_flat()
    fix = np.empty(N_FIX)

    fix_values(nav, zero, fix)

    assert fix[1] == pytest.approx(np.degrees(beyond) - np.copysign(180.0, beyond), abs=1e-9)
