"""Where an antenna is, and how well that is known."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting.input_log import InputLog


def placed(position: list[float], std: list[float]) -> SensorPlacement:
    values = {"gnss.antenna_position": position, "gnss.antenna_position_std": std}
    return SensorPlacement({**parameters.defaults(), **values}, InputLog(lambda level, text: None))


def test_an_antenna_that_is_given_has_the_uncertainty_that_is_given() -> None:
    placement = placed([1.0, 0.2, 0.5], [0.01, 0.02, 0.3])

    np.testing.assert_allclose(placement.lever_b, [1.0, -0.2, -0.5])
    assert placement.antenna_std.tolist() == [0.01, 0.02, 0.3]


@pytest.mark.parametrize(("std", "is_placed"), [([0.0, 0.0, 0.0], False), ([0.1, 0.1, 0.1], True)])
def test_an_antenna_at_the_origin_is_placed_by_its_uncertainty(
    std: list[float], is_placed: bool
) -> None:
    assert placed([0.0, 0.0, 0.0], std).antenna_is_placed is is_placed
