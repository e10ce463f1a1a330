"""An antenna high above a ship's IMU: where it is given wrong, it is named, and not the axes."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import Receiver, Vehicle, record
from test.support.ships import ship
from tools.vehicles import judge
from tools.vehicles.drives import Drive, from_simulation

HEIGHT = 20.0  # m


@pytest.fixture(scope="module")
def drive() -> Drive:
    std = (0.02, 0.02, 0.03)
    receiver = Receiver(1.0, std, claimed_std=std, antenna_b=(0.0, 0.0, -HEIGHT))
    vehicle = Vehicle("ship", ship, receiver, ImuErrors(), 50.0, duration=200.0)
    return from_simulation(record(vehicle, 1))


def run(drive: Drive, up: float) -> tuple[judge.Judged, float, str]:
    """Return the estimator, the error of its heading at the end [deg], and its warnings."""
    values = {**parameters.defaults(), "gnss.antenna_position": [0.0, 0.0, up]}
    lines: list[str] = []
    estimator, t_ns, rows = judge.run(drive, values, lambda _, text: lines.append(text))
    _, off, _ = judge._heading_errors(drive, t_ns, rows)
    return estimator, float(np.degrees(off[-1])), "\n".join(lines)


def test_where_it_is_given_right_nothing_is_wrong(drive: Drive) -> None:
    estimator, off, lines = run(drive, HEIGHT)

    assert off < 3.0
    assert "axes" not in lines
    assert "antenna" not in lines
    assert not np.any(estimator.placement.antenna_error_b)


@pytest.mark.parametrize("up", [0.0, -HEIGHT])
def test_where_it_is_given_wrong_it_is_named_and_used(drive: Drive, up: float) -> None:
    estimator, off, lines = run(drive, up)

    assert off < 3.0
    assert "axes" not in lines
    assert "the motion shows the antenna" in lines
    error_b = estimator.placement.antenna_error_b
    assert error_b[2] == pytest.approx(up - HEIGHT, abs=2.0)
    assert np.all(np.abs(error_b[:2]) < 3.0)
    statuses = estimator.status.diagnostics(estimator.navigator.last_ns)
    [found] = [status for status in statuses if "input" in status.name]
    assert found.level == 1
    assert "taken to be there" in found.text
    assert estimator.inputs.counts["gnss: antenna elsewhere"] == 1
