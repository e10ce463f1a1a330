"""An antenna 1.5 m from the IMU that nobody has placed is found, and taken to be there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.alignment.clock_search import ClockSearch
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.navigator import phase_machine
from hybrid_ins.core.navigator.clock_comparison import Comparison
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.simulation.vehicles import VEHICLES, record
from tools.vehicles import judge
from tools.vehicles.drives import Drive, from_simulation

ANTENNA_B = np.array([1.2, 0.0, -0.9])  # m
ALL_PLACED = {"gnss.antenna_position": [1.2, 0.0, 0.9]}
ELSEWHERE = {"gnss.antenna_position": [0.3, 0.0, 0.0]}


@pytest.fixture(scope="module")
def drive() -> Drive:
    car = VEHICLES["car"]
    receiver = replace(car.receiver, antenna_b=tuple(ANTENNA_B.tolist()))
    return from_simulation(record(replace(car, receiver=receiver, duration=150.0), 1))


class Ends:
    """What a replay came to: in its last minute, [m] and [deg]."""

    def __init__(self, drive: Drive, given: dict[str, list[float]]) -> None:
        lines: list[str] = []
        values = {**parameters.defaults(), **given}
        self.estimator, t_ns, rows = judge.run(drive, values, lambda _, text: lines.append(text))
        self.lines = "\n".join(lines)
        late = drive.truth_ns > drive.imu_ns[-1] - 60_000_000_000
        _, horizontal, _, P = judge._position_errors(drive, t_ns, rows)
        self.horizontal = float(np.median(np.linalg.norm(horizontal[late], axis=1)))
        self.std = float(np.sqrt(np.median(np.trace(P[late], axis1=1, axis2=2))))
        moved = rows.copy()
        moved[:, :3] -= matrix_from_quat(rows[:, 3:7]) @ (ANTENNA_B * [1.0, -1.0, -1.0])
        _, of_antenna, _, _ = judge._position_errors(drive, t_ns, moved)
        self.of_antenna = float(np.median(np.linalg.norm(of_antenna[late], axis=1)))
        yaw_ns, off, _ = judge._heading_errors(drive, t_ns, rows)
        self.heading = float(np.degrees(np.median(off[yaw_ns > drive.imu_ns[-1] - 60_000_000_000])))
        error_b = self.estimator.placement.antenna_error_b
        self.missing = float(np.linalg.norm(error_b - ANTENNA_B))


def test_the_odometry_of_an_imu_that_is_placed_becomes_its_own(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SensorPlacement, "imu_is_placed", True)  # by /tf_static

    ends = Ends(drive, {})

    assert ends.missing < 0.5
    assert ends.horizontal < 0.5 and ends.heading < 1.5
    assert ends.horizontal < 3.0 * ends.std
    assert ends.lines.count("the motion shows the antenna") == 1


def test_where_nothing_is_placed_the_odometry_remains_that_of_the_antenna(drive: Drive) -> None:
    """Its covariance says that it may be that of another place; the attitude is right."""
    ends = Ends(drive, {})

    assert ends.missing < 0.5
    assert ends.of_antenna < 0.15 and ends.heading < 1.5
    assert ends.horizontal == pytest.approx(1.2, abs=0.2)
    assert 0.7 < ends.std < 2.5


def test_a_search_for_the_clock_offset_that_never_ends_does_not_delay_it(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN a clock that the motion does not show, as that of a slow vehicle, THEN it is moved."""
    monkeypatch.setattr(ClockSearch, "_is_known", lambda search: False)
    monkeypatch.setattr(phase_machine, "compare", lambda running, search: Comparison.NOTHING)

    ends = Ends(drive, {})

    phase = ends.estimator.navigator.phase
    assert phase.bank is not None and phase.bank.clock_open
    assert ends.missing < 0.5 and ends.of_antenna < 0.15 and ends.heading < 1.5


def test_an_antenna_that_was_placed_stays(drive: Drive) -> None:
    wrong, right = Ends(drive, ELSEWHERE), Ends(drive, ALL_PLACED)

    assert not wrong.estimator.placement.antenna_error_b.any()
    assert "the antenna is about" in wrong.lines and "taken to be there" not in wrong.lines
    assert "antenna" not in right.lines
    assert right.horizontal < 0.1
