"""Slow errors of a receiver are told from the noise of the IMU, and of its fixes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import Calibration, calibrate
from hybrid_ins.calibration.fix_scatter import scatter_findings
from hybrid_ins.calibration.likelihood import POSITION_SCALE, SLOW_SHARE, VELOCITY_SCALE
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import Receiver, record

WHITE, SLOW, CLAIMED = 0.1, 2.0, 2.5  # m
RECEIVER = Receiver(5.0, (WHITE,) * 3, (SLOW,) * 3, 100.0, (CLAIMED,) * 3)


def calibrated(receiver: Receiver) -> Calibration:
    car = replace(ROAD_VEHICLES["road car, smooth"], receiver=receiver, duration=200.0)
    return calibrate([recording_of(record(car, 107))], parameters.defaults())


@pytest.fixture(scope="module")
def found() -> Calibration:
    return calibrated(RECEIVER)


def verdicts(found: Calibration) -> dict[str, str]:
    return {row.label: row.verdict for row in found.findings}


def test_white_and_slow_part_are_found(found: Calibration) -> None:
    fitted = found.fitted

    assert found.misfits == []  # the noise of the IMU was 1000 times what its readings show
    for name, expected in ((POSITION_SCALE, WHITE / CLAIMED), (SLOW_SHARE, SLOW / CLAIMED)):
        value, sigma = 0.5 * fitted.value(name), 0.5 * fitted.sigma(name)
        assert sigma < 0.1
        assert abs(value - math.log(expected)) < 3.0 * sigma
    assert verdicts(found)["fixes' slow error"] == "identified"


def test_fixes_without_slow_error_show_none() -> None:
    found = calibrated(replace(RECEIVER, slow_std=(0.0,) * 3))

    assert math.exp(0.5 * found.fitted.value(SLOW_SHARE)) * CLAIMED < 0.2 * SLOW
    assert verdicts(found)["fixes' slow error"] == "not identifiable"
    assert math.exp(0.5 * found.fitted.value(POSITION_SCALE)) == pytest.approx(0.04, rel=0.1)


def test_velocities_have_a_scale_of_their_own() -> None:
    """
    GIVEN positions that claim 25 times their scatter, and velocities that claim theirs
    THEN these count for what they claim: as 2 mm/s they were explained by 300 times the noise that
    the accelerometers' readings show.
    """
    found = calibrated(replace(RECEIVER, velocity_std=0.05))

    [velocities] = [row for row in found.findings if row.label == "velocities' scatter"]
    assert abs(found.fitted.value(VELOCITY_SCALE)) < 0.2
    assert (velocities.verdict, velocities.note) == ("identified", "")
    read = found.values["noise.background_accelerometer"]
    assert found.values["noise.q_accelerometer"] < 3.0 * max(read)


def test_a_receiver_is_not_told_to_claim_less_than_its_slow_error(found: Calibration) -> None:
    slower = replace(found.fitted, x=found.fitted.x.copy())
    slower.x[slower.names.index(SLOW_SHARE)] = 2.0 * math.log(3.5)
    none = replace(slower, x=found.fitted.x.copy())
    none.x[none.names.index(SLOW_SHARE)] = 2.0 * math.log(0.1)

    row, _ = scatter_findings(slower, 1.0)
    row_of_none, _ = scatter_findings(none, 1.0)

    assert "do not lower it" in row.note and row.values == {"gnss.position_scatter": 0.2}
    assert row_of_none.note == "the receiver's σ is too large"
