"""What two motions show of a far antenna counts where they agree and are not the same motion."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.imu_axes.antenna import FarAntenna, is_far_away
from hybrid_ins.core.imu_axes.fit import Fit, Motion

GIVEN = np.array([0.0, 0.0, 1.0])


def motion(begin: float, end: float) -> Motion:
    nothing = np.empty((0, 3))
    t = np.array([begin, end])
    return Motion(t, nothing, nothing, t, np.zeros((2, 3)), np.empty((0, 3), np.intp))


def fit(up: float, std: float = 0.5) -> Fit:
    arm = GIVEN - [0.0, 0.0, up]
    return Fit(1.0, np.eye(3), lever_arm=arm, given_arm=GIVEN, arm_std=np.full(3, std))


def shown(*motions: tuple[float, float, float]) -> FarAntenna:
    antenna = FarAntenna()
    for begin, end, up in motions:
        antenna.add(motion(begin, end), fit(up))
    return antenna


def test_two_motions_that_agree_show_it() -> None:
    antenna = shown((0.0, 20.0, 19.0), (10.0, 30.0, 21.0))

    np.testing.assert_allclose(antenna.error, [0.0, 0.0, -20.0])
    assert antenna.std[2] == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    "motions",
    [
        [(0.0, 20.0, 20.0)],
        [(0.0, 20.0, 20.0), (9.0, 29.0, 20.0)],  # less than half of it is new
        [(0.0, 20.0, 20.0), (10.0, 30.0, 12.0)],
        [(0.0, 20.0, 20.0), (10.0, 30.0, -20.0)],
    ],
)
def test_less_shows_nothing(motions: list[tuple[float, float, float]]) -> None:
    antenna = shown(*motions)

    assert antenna.error is None
    assert antenna.is_doubtful


def test_what_disagreed_between_does_not_matter() -> None:
    antenna = shown((0.0, 20.0, 20.0), (5.0, 25.0, -9.0), (10.0, 30.0, 20.0))

    np.testing.assert_allclose(antenna.error, [0.0, 0.0, -20.0])


def test_an_antenna_is_far_away_where_the_motion_determines_its_place() -> None:
    assert is_far_away(fit(20.0))
    assert not is_far_away(fit(3.5, 0.1))
    assert not is_far_away(fit(20.0, 5.0))
