"""What is held at its given value is not contradicted, and what depends on it knows its error."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import Calibration, calibrate
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import Receiver, record


def calibrated(receiver: Receiver, seed: int) -> Calibration:
    car = ROAD_VEHICLES["road car, smooth"]
    car = replace(car, receiver=receiver, duration=150.0, imu_rate=50.0)
    return calibrate([recording_of(record(car, seed))], parameters.defaults())


def test_a_clock_that_is_hardly_known_is_not_held_where_it_cannot_be() -> None:
    """
    GIVEN fixes that show the clock to 0.12 s only, and that it is 0.8 s away from the given 0
    THEN it is not called as given: the nose, fitted with that, was degrees off.
    """
    found = calibrated(Receiver(1.0, (4.0,) * 3, claimed_std=(4.0,) * 3, offset=0.8), 103)

    sigma = found.fitted.sigma("offset")
    assert sigma > 0.08
    assert found.values["gnss.time_offset.value"] == pytest.approx(0.8, abs=3.0 * sigma)
    assert found.values["gnss.time_offset.std"] == 0.0
    assert found.notes["gnss.time_offset.value"].startswith("weak: clock offset +")


def test_an_antenna_that_is_held_is_in_the_uncertainty_of_the_clock_() -> None:
    """
    GIVEN an antenna 0.7 m behind the IMU, too weakly seen not to be taken to be there
    THEN the clock goes with that, 0.03 s off, and says so: it was sure to 0.009 s.
    """
    receiver = Receiver(5.0, (1.0,) * 3, claimed_std=(1.0,) * 3, offset=-0.3)
    found = calibrated(replace(receiver, antenna_b=(-0.7, 0.0, 0.0)), 105)

    assert "lever_x" in found.fitted.frozen
    sigma = found.fitted.sigma("offset")
    assert 0.02 < abs(found.fitted.value("offset") + 0.3) < 2.0 * sigma < 0.1
    assert 3.0 * found.fitted.sigma("lever_x") > 0.7
    [clock] = [row for row in found.findings if row.label == "clock offset"]
    assert clock.verdict == "weak"
    assert found.values["gnss.time_offset.std"] == 0.0
