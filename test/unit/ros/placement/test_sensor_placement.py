"""Where an antenna is, and how well that is known."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
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


@pytest.mark.parametrize("frame", ["base_link", "/base_link", ""])
def test_a_driver_that_names_the_base_frame_places_nothing(frame: str) -> None:
    placement = placed([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    placement.set_frame("gnss/fix", frame)
    placement.set_frame("imu/data", frame)

    assert not placement.antenna_is_placed and not placement.imu_is_placed


@pytest.mark.parametrize("transforms_first", [True, False])
@pytest.mark.parametrize(
    ("base", "x", "text"),
    [
        (
            "base_link",
            500.0,
            "/tf_static puts 'gnss_link' 500 m from 'base_link': not used; metres",
        ),
        ("rover/base_link", 0.5, "has 'gnss_link' below 'base_link', but no transform to 'rover/"),
    ],
)
def test_a_transform_to_no_possible_place_is_named(
    base: str, x: float, text: str, transforms_first: bool
) -> None:
    """GIVEN millimetres, or no prefix THEN that is named, whatever comes first."""
    lines: list[str] = []
    placement = SensorPlacement(
        {**parameters.defaults(), "base_frame": base},
        InputLog(lambda level, text: lines.append(f"{level}: {text}")),
    )
    message = new_message("tf2_msgs/msg/TFMessage")
    message.transforms = [new_message("geometry_msgs/msg/TransformStamped")]
    message.transforms[0].header.frame_id = "base_link"
    message.transforms[0].child_frame_id = "gnss_link"
    message.transforms[0].transform.translation.x = x
    message.transforms[0].transform.rotation.w = 1.0

    if transforms_first:
        placement.add_transforms(message)
        placement.set_frame("gnss/fix", "gnss_link")
    else:
        placement.set_frame("gnss/fix", "gnss_link")
        placement.add_transforms(message)

    (line,) = (line for line in lines if line.startswith("warn: gnss/fix: "))
    assert text in line
    assert not placement.lever_b.any() and not placement.antenna_is_placed
