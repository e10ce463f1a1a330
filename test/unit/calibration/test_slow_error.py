"""Slow errors of a receiver are told from the noise of the IMU, and of its fixes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.findings import Calibration, calibrate
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
    for name, expected in (("gnss_scale", WHITE / CLAIMED), ("gnss_slow", SLOW / CLAIMED)):
        value, sigma = 0.5 * fitted.value(name), 0.5 * fitted.sigma(name)
        assert sigma < 0.1
        assert abs(value - math.log(expected)) < 3.0 * sigma
    assert verdicts(found)["fixes' slow error"] == "identified"


def test_fixes_without_slow_error_show_none() -> None:
    found = calibrated(replace(RECEIVER, slow_std=(0.0,) * 3))

    assert math.exp(0.5 * found.fitted.value("gnss_slow")) * CLAIMED < 0.2 * SLOW
    assert verdicts(found)["fixes' slow error"] == "not identifiable"
    assert math.exp(0.5 * found.fitted.value("gnss_scale")) == pytest.approx(0.04, rel=0.1)
