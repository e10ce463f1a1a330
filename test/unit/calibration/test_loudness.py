"""Noise that varies in a recording is told from the random walks of the biases."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import Calibration, calibrate
from hybrid_ins.calibration.loudness import Levels, ordinary_levels, read_levels, with_loudness
from hybrid_ins.calibration.noise import noise_findings
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import Recording as Drive
from hybrid_ins.simulation.vehicles import record

DURATION = 300.0  # s
WALK = 1e-3  # m/s²/√s, that of the simulated accelerometer


@pytest.fixture(scope="module")
def drive() -> Drive:
    """A car whose noise is that of the road: it grows with the speed."""
    return record(replace(ROAD_VEHICLES["road car"], duration=DURATION), 101)


@pytest.fixture(scope="module")
def run(drive: Drive) -> Recording:
    return recording_of(drive)


@pytest.fixture(scope="module")
def found(run: Recording) -> Calibration:
    return calibrate([run], parameters.defaults())


def test_noise_that_varies_is_followed(found: Calibration) -> None:
    fitted = found.fitted

    assert fitted.value("follow_a") > 3.0 * fitted.sigma("follow_a")
    assert abs(fitted.value("follow_a") - 1.0) < 3.0 * fitted.sigma("follow_a")
    assert "goes with noise.model" in found.notes["noise.q_accelerometer"]


def test_the_walk_that_is_written_is_the_root_of_its_mean_square(found: Calibration) -> None:
    fitted = found.fitted
    likeliest, sigma = fitted.value("walk_a"), fitted.sigma("walk_a")

    assert abs(likeliest - math.log(WALK)) < 3.0 * sigma
    draws = np.exp(likeliest + sigma * np.random.default_rng(0).standard_normal(1_000_000))
    written = found.values["imu.accelerometer_bias_walk"]
    assert written == pytest.approx(np.sqrt(np.mean(draws**2)), rel=0.03)
    assert "root mean square" in found.notes["imu.accelerometer_bias_walk"]


def test_a_walk_that_is_not_identifiable_stays_as_given(found: Calibration) -> None:
    unknown = replace(found.fitted, std=np.array([p.std for p in found.fitted.prior]))
    given = parameters.defaults()

    rows = noise_findings(unknown, 0.01, None, given)

    for row in rows:
        assert row.verdict == "not identifiable"
        assert all(row.values[name] == given[name] for name in row.values)


def test_loudness_is_that_of_the_instant(drive: Drive, run: Recording) -> None:
    [heard] = with_loudness([run], [read_levels(run, parameters.defaults())])
    speed = np.linalg.norm(drive.truth.velocity_n, axis=1)

    driving, standing = (heard.loudness[where].mean(axis=0) for where in (speed > 8.0, speed < 0.1))

    assert driving[0] - standing[0] > math.log(10.0)
    assert driving[1] - standing[1] > math.log(2.0)


def test_a_recording_that_no_regressor_reads_is_equally_loud(run: Recording) -> None:
    nothing = Levels(np.empty(0), np.empty((0, 6)))

    [kept] = with_loudness([run], [nothing])

    assert np.all(kept.noise(1.0, 1.0) == 1.0)
    assert ordinary_levels([nothing]) is None
