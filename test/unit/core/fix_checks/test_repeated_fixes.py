"""A driver that publishes every position several times is told from a receiver that rounds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.fix_checks.repeated_fixes import (
    RECENT,
    RUNS,
    RepetitionCheck,
    with_course,
    without_held,
)
from hybrid_ins.core.update.measurements import PositionFix

Array = NDArray[np.float64]


def _refused(series: Array) -> Array:
    """Return which of measurements (N, 3) would be refused."""
    check = RepetitionCheck()
    return np.array([check.is_again(one) and check.repeats for one in series])


@pytest.mark.parametrize("speed", [0.0, 0.3, 20.0])
@pytest.mark.parametrize("times", [2, 5, 10])
@pytest.mark.parametrize("vertical", [1.0, 0.0, np.nan])
def test_each_repeat_is_refused_once_some_runs_have_shown_them(
    speed: float, times: int, vertical: float
) -> None:
    rng = np.random.default_rng(1)
    places = rng.normal(0.0, 0.01, (30, 3)) + speed * np.arange(30.0)[:, None]
    series = np.repeat(places * np.array([1.0, 1.0, vertical]), times, axis=0)

    refused = _refused(series).reshape(30, times)

    assert not refused[:, 0].any(), "the first of each has the right stamp"
    assert refused[RUNS:, 1:].all() and not refused[:RUNS].any()


@pytest.mark.parametrize("unit", [0.003, 0.01, 0.03])
def test_a_rounded_receiver_may_stand_drive_and_stand(unit: float) -> None:
    """GIVEN fixes of 1 cm rounded to ``unit`` WHEN the vehicle stops and goes THEN all are used."""
    rng = np.random.default_rng(2)
    speed = 0.5 * np.maximum(np.sin(np.arange(5000) * 0.02), 0.0)
    track = np.cumsum(speed * 0.2)[:, None] * np.array([0.8, 0.6, 0.02])

    assert not _refused(np.round((track + rng.normal(0.0, 0.01, track.shape)) / unit) * unit).any()
    assert not _refused(np.round(track / unit) * unit).any(), "without any noise"


@pytest.mark.parametrize("rounds", ["speed and course", "north and east"])
@pytest.mark.parametrize("rate", [5, 10])
def test_velocities_that_a_receiver_rounds_are_no_repeats(rounds: str, rate: int) -> None:
    """GIVEN a cruise at 20 m/s by 0.1 kn and 0.1°, or by 1 cm/s."""
    rng = np.random.default_rng(0)
    speed = np.full(600 * rate, 20.0)
    course = np.full(600 * rate, 1.0)
    for k in range(1, len(speed)):
        gusts = rng.normal(0.0, np.array([0.15, 0.003]) / np.sqrt(rate))
        speed[k] = 20.0 + (speed[k - 1] - 20.0) * (1.0 - 0.05 / rate) + gusts[0]
        course[k] = 1.0 + (course[k - 1] - 1.0) * (1.0 - 0.05 / rate) + gusts[1]
    if rounds == "speed and course":
        speed = np.round(speed / 0.0514444) * 0.0514444
        course = np.radians(np.round(np.degrees(course), 1))
    velocity = np.column_stack((speed * np.cos(course), speed * np.sin(course), 0.0 * speed))
    if rounds == "north and east":
        velocity = np.round(velocity / 0.01) * 0.01

    assert not _refused(np.array([with_course(one) for one in velocity])).any()


def test_velocities_that_are_repeated_are_refused() -> None:
    velocity = np.random.default_rng(1).normal([10.0, 5.0, 0.0], 0.1, (100, 3))

    refused = _refused(np.repeat([with_course(one) for one in velocity], 2, axis=0))

    assert refused[20:].mean() == 0.5


def test_new_measurements_end_it() -> None:
    rng = np.random.default_rng(3)
    repeated = np.repeat(rng.normal(size=(10, 3)), 2, axis=0)
    fresh = rng.normal(size=(10, 3))
    stand = np.repeat(rng.normal(size=(1, 3)), 20, axis=0)

    assert not _refused(np.vstack((repeated, fresh, stand)))[len(repeated) :].any()


@pytest.mark.parametrize("speed", [0.0, 0.3])
@pytest.mark.parametrize(("receiver", "driver"), [(4, 5), (8, 10), (1, 1.4)])
def test_a_driver_a_little_faster_than_its_receiver_is_found(
    receiver: float, driver: float, speed: float
) -> None:
    """GIVEN positions of 4 Hz at 5 Hz THEN the repeated ones are refused after a while."""
    rng = np.random.default_rng(4)
    places = rng.normal(0.0, 0.01, (100, 3)) + speed * np.arange(100.0)[:, None]
    of = (np.arange(int(100 * driver / receiver)) * receiver / driver).astype(int)
    is_again = np.concatenate(([False], np.diff(of) == 0))

    refused = _refused(places[of])

    assert not refused[~is_again].any(), "the first of each has the right stamp"
    late = of > RECENT + 2
    assert refused[late & is_again].all()


def _fixes(north: Array, std: float = 1.0) -> list[PositionFix]:
    """Return fixes once a second at distances (N,) [m] north of a place."""
    return [
        PositionFix(k, np.array([0.5 + x / 6.37e6, 1.0, 10.0]), std**2 * np.eye(3), np.zeros(3))
        for k, x in enumerate(north)
    ]


def test_held_positions_are_those_after_which_the_position_jumps() -> None:
    drive, stand = np.arange(0.0, 50.0, 5.0), np.full(20, 50.0)
    held, after = np.full(20, 50.1), np.arange(120.0, 150.0, 5.0)
    fixes = _fixes(np.concatenate((drive, stand, held, after, np.full(9, 150.0))))

    kept = [fix.t_ns for fix in without_held(fixes)]

    assert kept == [*range(31), *range(50, 65)]
    assert len(without_held(_fixes(np.concatenate((held, after)), std=30.0))) == 26
