"""The tree of fixed transforms: chains, directions, nonsense."""

from types import SimpleNamespace as Namespace

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.placement.static_transforms import (
    LONGEST_NAME,
    MOST_FRAMES,
    TOO_MANY,
    StaticTransforms,
    without_tf2,
)


def transform(parent, child, xyz=(0.0, 0.0, 0.0), quat=(0.0, 0.0, 0.0, 1.0)):
    return Namespace(
        header=Namespace(frame_id=parent),
        child_frame_id=child,
        transform=Namespace(
            translation=Namespace(**dict(zip("xyz", xyz, strict=True))),
            rotation=Namespace(**dict(zip("xyzw", quat, strict=True))),
        ),
    )


def tree(*transforms):
    known = StaticTransforms()
    known.add(Namespace(transforms=transforms))
    return known


def test_chain_up_and_down_composes() -> None:
    quarter = quat_from_rpy(0.0, 0.0, np.pi / 2)
    known = tree(
        transform("base_link", "plate", (1.0, 0.0, 0.0), quarter),
        transform("plate", "imu", (1.0, 0.0, 0.5)),
        transform("base_link", "mast", (0.0, 0.0, 2.0)),
    )

    C, p = known.find("base_link", "imu")
    assert p == pytest.approx([1.0, 1.0, 0.5])
    np.testing.assert_allclose(C, matrix_from_quat(quarter), atol=1e-12)
    C, p = known.find("mast", "imu")
    assert p == pytest.approx([1.0, 1.0, -1.5])
    C, p = known.find("imu", "base_link")
    assert C @ [1.0, 1.0, 0.5] + p == pytest.approx(np.zeros(3))


def test_frames_of_another_tree_are_not_found() -> None:
    known = tree(transform("base_link", "imu"), transform("arm", "hand"))
    assert known.find("base_link", "hand") is None
    assert known.find("base_link", "nowhere") is None


def test_leading_slash_and_the_frame_itself() -> None:
    known = tree(transform("/base_link", "/imu", (1.0, 2.0, 3.0)))
    assert known.find("base_link", "imu")[1] == pytest.approx([1.0, 2.0, 3.0])
    C, p = known.find("imu", "imu")
    assert np.array_equal(C, np.eye(3)) and not p.any()


@pytest.mark.parametrize(("parent", "child"), [("", "imu"), ("/", "imu"), ("imu", "")])
def test_a_transform_without_a_frame_moves_nothing(parent: str, child: str) -> None:
    known = tree(transform("base_link", "imu", (1.0, 2.0, 3.0)))

    (fault,) = known.add(Namespace(transforms=[transform(parent, child)]))

    assert "without header.frame_id or child_frame_id is left out" in fault.text
    assert known.find("base_link", "imu")[1] == pytest.approx([1.0, 2.0, 3.0])
    assert known.find("base_link", "") is None


@pytest.mark.parametrize(
    "bad",
    [
        transform("base_link", "imu", quat=(0.0, 0.0, 0.0, 0.0)),
        transform("base_link", "imu", quat=(np.nan, 0.0, 0.0, 1.0)),
        transform("base_link", "imu", xyz=(np.inf, 0.0, 0.0)),
    ],
)
def test_a_transform_that_is_none_is_left_out(bad) -> None:
    known = StaticTransforms()

    (fault,) = known.add(Namespace(transforms=[bad]))

    assert "from 'base_link' to 'imu' is left out: its quaternion has norm" in fault.text
    assert known.find("base_link", "imu") is None


@pytest.mark.parametrize("frame", ["a", "c"])
def test_a_transform_that_closes_a_loop_is_left_out(frame) -> None:
    known = tree(transform("base_link", "a", (1.0, 0.0, 0.0)), transform("a", "c"))

    (fault,) = known.add(Namespace(transforms=[transform(frame, "base_link")]))

    assert "closes a loop" in fault.text and f"from '{frame}' to 'base_link'" in fault.text
    assert known.find("base_link", "c")[1] == pytest.approx([1.0, 0.0, 0.0])


def test_a_later_transform_takes_the_place_of_an_earlier_one() -> None:
    known = tree(transform("base_link", "imu", (1.0, 0.0, 0.0)))
    known.add(Namespace(transforms=[transform("base_link", "imu", (2.0, 0.0, 0.0))]))
    assert known.find("base_link", "imu")[1] == pytest.approx([2.0, 0.0, 0.0])


def test_the_tree_does_not_grow_without_bound() -> None:
    known = tree(transform("base_link", "imu", (1.0, 0.0, 0.0)))

    refused = sum(
        len(known.add(Namespace(transforms=[transform("base_link", f"frame_{k}")])))
        for k in range(MOST_FRAMES + 50)
    )
    long_name = known.add(Namespace(transforms=[transform("imu", "x" * (LONGEST_NAME + 1))]))
    known.add(Namespace(transforms=[transform("base_link", "imu", (2.0, 0.0, 0.0))]))

    assert (refused, long_name) == (51, [TOO_MANY])
    assert known.find("base_link", "imu")[1] == pytest.approx([2.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        ({}, ["info", "warn"]),
        ({"publish_tf": False}, ["warn"]),
        ({"imu.mount_rpy": [0.1, 0.0, 0.0]}, ["info", "warn"]),  # where the sensors are is unknown
        ({"imu.position": [0.1, 0.0, 0.0]}, ["info", "info"]),
        ({"gnss.antenna_position": [0.0, 0.0, 1.0]}, ["info", "info"]),
        ({"publish_tf": False, "use_tf_static": False}, []),
    ],
)
def test_without_tf2_a_warning_asks_for_the_places_that_nobody_gives(values, levels) -> None:
    found = list(without_tf2({**parameters.defaults(), **values}))

    assert [level for level, _ in found] == levels
    for text in (text for level, text in found if level == "warn"):
        assert "/tf_static is not read" in text and "install tf2_msgs" in text
        assert "imu.position" in text and "gnss.antenna_position" in text
