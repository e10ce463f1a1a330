"""What is claimed of the estimate: good, coasting, lost."""

from types import SimpleNamespace

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DIAGONAL,
    HEADING_DOUBT,
    N_FLAT,
    PAST_VARIANCE,
)
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.ros.aids.validity import Validity, ValidityMonitor

GOOD, COASTING, LOST = Validity.GOOD, Validity.COASTING, Validity.LOST
WAITING = Validity.WAITING
NO_PHASE = SimpleNamespace(filter=None, nav=None)
SECOND = 1_000_000_000


class Fixes(FixWatch):
    """Fixes that come until a time."""

    def __init__(self, until: float) -> None:
        super().__init__()
        self._fix_ns = round(until * SECOND)


def monitor(
    position: float, velocity: float, heading: float, fixes_until: float
) -> ValidityMonitor:
    nav = np.zeros(N_FLAT)
    sigma = np.repeat([position, velocity, heading, 0.1, 0.1], 3)
    packed = nav[COVARIANCE]
    packed[DIAGONAL] = sigma**2
    phase = SimpleNamespace(filter=SimpleNamespace(nav=nav), nav=nav)
    navigator = SimpleNamespace(phase=phase)
    return ValidityMonitor(parameters.defaults(), navigator, Fixes(fixes_until))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sigma", "fixes_until", "expected"),
    [
        ((1.0, 0.1, 0.02), 99.0, (GOOD, GOOD, GOOD)),
        ((1.0, 0.1, 0.02), 90.0, (COASTING, COASTING, COASTING)),
        ((50.0, 0.1, 0.02), 90.0, (LOST, COASTING, COASTING)),
        ((1.0, 5.0, 0.02), 99.0, (GOOD, LOST, GOOD)),
        ((1.0, 0.1, 1.0), 99.0, (GOOD, GOOD, LOST)),
    ],
)
def test_each_part_is_judged_by_its_sigma_and_the_fixes(
    sigma: tuple[float, float, float], fixes_until: float, expected: tuple[Validity, ...]
) -> None:
    watched = monitor(*sigma, fixes_until)

    assert watched.judge(100 * SECOND)[0] == expected
    assert watched.status(100 * SECOND).level == max(
        [GOOD, COASTING, LOST].index(v) for v in expected
    )


@pytest.mark.parametrize(
    ("axis", "part", "limit"),
    [(0, 0, 10.0), (1, 0, 10.0), (3, 1, 1.0), (4, 1, 1.0), (8, 2, 0.2)],
)
def test_every_horizontal_axis_and_the_heading_count_from_their_limit_on(
    axis: int, part: int, limit: float
) -> None:
    watched = monitor(0.1, 0.1, 0.1, 99.0)
    variances = watched._navigator.phase.nav[COVARIANCE]
    place = np.arange(len(variances))[DIAGONAL][axis]

    variances[place] = (0.99 * limit) ** 2
    assert watched.judge(100 * SECOND)[0] == (GOOD, GOOD, GOOD)
    variances[place] = (1.01 * limit) ** 2
    judged, sigma = watched.judge(100 * SECOND)
    assert [one is LOST for one in judged] == [part == k for k in range(3)]
    assert sigma[part] == pytest.approx(1.01 * limit)


def test_what_the_filter_only_considers_counts_as_in_the_odometry() -> None:
    """Jumps of fixes, other headings: neither is part of the covariance that the filter uses."""
    watched = monitor(0.1, 0.1, 0.1, 99.0)
    nav = watched._navigator.phase.nav
    assert nav is not None
    nav[PAST_VARIANCE] = 11.0**2
    assert watched.judge(100 * SECOND)[0] == (LOST, GOOD, GOOD)
    nav[PAST_VARIANCE], nav[HEADING_DOUBT] = 0.0, 0.2**2

    judged, sigma = watched.judge(100 * SECOND)

    assert judged == (GOOD, GOOD, LOST)
    assert sigma[2] == pytest.approx(np.hypot(0.1, 0.2))


def test_height_climb_and_tilt_do_not_count() -> None:
    watched = monitor(0.1, 0.1, 0.1, 99.0)
    variances = watched._navigator.phase.nav[COVARIANCE]
    variances[np.arange(len(variances))[DIAGONAL][[2, 5, 6, 7]]] = 1e4

    assert watched.judge(100 * SECOND)[0] == (GOOD, GOOD, GOOD)


def test_before_the_first_alignment_all_waits_and_after_it_all_is_lost() -> None:
    watched = monitor(1.0, 0.1, 0.1, 99.0)
    running, watched._navigator.phase = watched._navigator.phase, NO_PHASE  # type: ignore[assignment,misc]

    waiting = watched.status(100 * SECOND)
    assert waiting.text == "position waiting, velocity waiting, heading waiting"
    assert waiting.level == 1
    assert not any(key.startswith("sigma") for key, _ in waiting.values)

    watched._navigator.phase = running  # type: ignore[misc]
    watched.judge(100 * SECOND)
    watched._navigator.phase = NO_PHASE  # type: ignore[assignment,misc]
    assert watched.judge(100 * SECOND)[0] == (LOST, LOST, LOST)
    assert watched.status(100 * SECOND).level == 2


def test_while_the_heading_is_searched_for_the_position_is_good_and_the_heading_waits() -> None:
    watched = monitor(1.0, 5.0, 0.1, 99.0)
    running = watched._navigator.phase
    searching = SimpleNamespace(filter=None, nav=running.nav)

    watched._navigator.phase = searching  # type: ignore[assignment,misc]
    assert watched.judge(100 * SECOND)[0] == (GOOD, WAITING, WAITING)
    watched._navigator.phase = running  # type: ignore[misc]
    assert watched.judge(100 * SECOND)[0] == (GOOD, LOST, GOOD)
    watched._navigator.phase = searching  # type: ignore[assignment,misc]
    assert watched.judge(100 * SECOND)[0] == (GOOD, LOST, LOST)


def test_only_changes_are_reported() -> None:
    watched = monitor(1.0, 0.1, 0.02, 99.0)

    first = watched.changed(100 * SECOND)
    assert first is not None
    assert first.text == "position good, velocity good, heading good"
    assert watched.changed(101 * SECOND) is None
    later = watched.changed(110 * SECOND)
    assert later is not None
    assert later.text == "position coasting, velocity coasting, heading coasting"


def test_without_imu_samples_what_there_was_is_lost() -> None:
    watched = monitor(1.0, 0.1, 0.02, 99.0)
    first, silent = watched.changed(99 * SECOND), watched.changed(100 * SECOND, is_silent=True)

    assert first is not None and silent is not None
    assert silent.text == "position lost, velocity lost, heading lost"
    assert silent.level == 2
    assert not any(key.startswith("sigma") for key, _ in silent.values)
    assert watched.changed(101 * SECOND, is_silent=True) is None
    back = watched.changed(101 * SECOND)
    assert back is not None and back.text == first.text
