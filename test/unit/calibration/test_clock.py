"""What a calibration says of the clock: no more than the motion shows, and of each kind of fix."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import Calibration, calibrate
from hybrid_ins.calibration.clock import observe_clock
from hybrid_ins.calibration.drift import Drift
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import VEHICLES, Receiver, Vehicle, record


def recorded(vehicle: Vehicle, seed: int) -> Recording:
    return recording_of(record(vehicle, seed))


def verdict(found: Calibration, label: str) -> str:
    [one] = [row.verdict for row in found.findings if row.label == label]
    return one


def test_a_cruise_shows_no_clock_offset() -> None:
    """
    GIVEN a shaken IMU on a motorway, precise fixes, and a clock that is wrong by 0.1 s
    THEN nothing is claimed of it: the likelihood is sure to 4 ms of -0.34 s, by chance.
    """
    motorway = replace(VEHICLES["car on a motorway, clock -0.1 s"], duration=100.0)
    found = calibrate([recorded(motorway, 3)], parameters.defaults(), search=0.5)

    assert verdict(found, "clock offset") == "not identifiable"
    assert verdict(found, "antenna forward") != "identified"  # it depends on the offset
    assert found.values["gnss.time_offset.value"] == 0.0
    assert found.values["gnss.time_offset.std"] == 0.0


def test_velocities_older_than_positions_do_not_draw_the_offset() -> None:
    receiver = Receiver(5.0, offset=0.05, velocity_std=0.03, velocity_age=0.12)
    car = replace(VEHICLES["car"], receiver=receiver, duration=80.0)
    found = calibrate([recorded(car, 3)], parameters.defaults(), search=0.3)

    fitted = found.fitted
    for name, true in (("offset", 0.05), ("velocity_age", -0.12)):
        assert abs(fitted.value(name) - true) < min(0.02, 4.0 * fitted.sigma(name)), name
    assert verdict(found, "age of velocities") == "identified"


def test_a_shaken_imu_does_not_draw_the_offset() -> None:
    """
    GIVEN vibration whose likelihood is rough from one sample of the offset to the next
    THEN the offset is still found: an ascent alone stopped 35 ms off and was sure to 3 ms.
    """
    receiver = Receiver(20.0, offset=-0.03, velocity_std=0.05)
    car = replace(ROAD_VEHICLES["road car, smooth"], receiver=receiver, duration=120.0)
    recording = recorded(replace(car, rest=5.0, imu_rate=200.0), 101)
    noise = np.random.default_rng(101).normal(0.0, 4.0, (len(recording.t) + 2, 3))
    vibration = np.diff(noise, 2, axis=0) / math.sqrt(6.0)  # it moves nothing
    shaken = recording.samples + np.hstack((vibration, np.zeros_like(vibration)))

    found = calibrate([replace(recording, samples=shaken)], parameters.defaults())

    assert verdict(found, "clock offset") == "identified"
    assert found.values["gnss.time_offset.value"] == pytest.approx(-0.03, abs=0.003)


def standing_then_turning(standing: float, turning: float) -> Recording:
    """Return fixes of a vehicle that stands, then drives circles of 10 m at 5 m/s."""
    t = np.arange(0.0, standing + turning, 0.2)
    angle = 0.5 * np.maximum(t - standing, 0.0)
    noise = np.random.default_rng(0).normal(0.0, 0.02, (len(t), 3))
    track = np.stack((10.0 * np.sin(angle), 10.0 * (1.0 - np.cos(angle)), 0.0 * t), axis=1) + noise
    origin = np.array([0.8, 0.1, 50.0])
    return Recording(
        "circles",
        t,
        np.zeros((len(t), 6)),
        t,
        np.full(len(t), POSITION),
        origin + track / curvature_scale(origin),
        np.tile(np.eye(3), (len(t), 1, 1)),
    )


def test_the_coarse_search_looks_where_the_vehicle_moves() -> None:
    assert standing_then_turning(0.0, 200.0).begin_of_motion(90.0) == 0.0
    assert standing_then_turning(20.0, 100.0).begin_of_motion(90.0) == 0.0
    begin = standing_then_turning(200.0, 60.0).begin_of_motion(90.0)
    assert 165.0 <= begin <= 202.0  # all of the motion is within


def test_of_a_long_recording_the_part_in_motion_is_used() -> None:
    whole = standing_then_turning(200.0, 60.0)
    whole = replace(whole, rows=7 + np.arange(len(whole.t)))
    assert whole.part_in_motion(300.0) is whole

    part = whole.part_in_motion(90.0)

    shift = part.begin
    assert 165.0 <= shift <= 170.0
    used = (whole.t > shift - 0.1) & (whole.t < shift + 90.1)
    np.testing.assert_allclose(part.t + shift, whole.t[used])
    assert part.t[-1] == pytest.approx(90.0)
    np.testing.assert_array_equal(part.rows, 7 + np.flatnonzero(used))
    # Fixes up to 10 s before and after are kept: by another clock they may belong to it.
    near = (whole.aid_t > shift - 10.1) & (whole.aid_t < shift + 100.1)
    np.testing.assert_allclose(part.aid_t + shift, whole.aid_t[near])
    np.testing.assert_array_equal(part.aid, whole.aid[near])


def observed(fitted: Fit, **given: float) -> dict[str, float]:
    """Return the last parts of the names of the clock's parameters that are written, and these."""
    values = {**parameters.defaults(), **{f"gnss.time_offset.{k}": v for k, v in given.items()}}
    written = observe_clock(fitted, own=False, values=values, search=0.5)[1]
    return {name.rpartition(".")[2]: value for name, value in written.items()}


def test_an_ambiguous_clock_is_written_as_all_else_was_fitted_with_it(found_fit: Fit) -> None:
    profile = np.where(np.abs(found_fit.grid - 0.4) < 0.05, 0.0, -2.0)[None]
    ambiguous = replace(found_fit, grid=found_fit.grid + 0.4, profile=profile)
    given = parameters.defaults()

    [row, *_], written, comment = observe_clock(ambiguous, own=False, values=given, search=0.5)

    assert "nearly as likely" in row.note
    assert written["gnss.time_offset.value"] == pytest.approx(float(row.value.split()[0]), abs=1e-4)
    assert written["gnss.time_offset.std"] == 0.0  # the filter searches from there
    assert comment == f"weak: clock offset {row.value} ± {row.sigma}"


def test_a_clock_that_drifts_is_written_as_it_was_at_the_start(found_fit: Fit) -> None:
    drifting = replace(found_fit, drift=Drift(1e-3, 4e-5))
    since = float(np.mean(found_fit.recordings[0].aid_t) - found_fit.recordings[0].aid_t[0])

    steady, at_start = observed(found_fit), observed(drifting)

    assert steady["std"] > 0.0 and (steady["drift"], steady["drift_std"]) == (0.0, 100.0)
    assert at_start["value"] == pytest.approx(steady["value"] - 1e-3 * since, abs=2e-4)
    assert at_start["std"] == 0.0  # another day it is another one
    # AND the drift is that of another day, too, but for the crystals' temperature
    assert at_start["drift"] == pytest.approx(1000.0)
    assert at_start["drift_std"] == pytest.approx(math.hypot(40.0, 10.0), abs=0.1)
    # AND the user is told the same offset, with what is not known of the drift in its σ
    offset, drift, *_ = observe_clock(
        drifting, own=False, values=parameters.defaults(), search=0.5
    )[0]
    assert float(offset.value.split()[0]) == pytest.approx(at_start["value"], abs=2e-4)
    expected = math.hypot(found_fit.sigma("offset"), 1e-6 * at_start["drift_std"] * since)
    assert float(offset.sigma.split()[0]) == pytest.approx(expected, abs=2e-4)
    assert (drift.label, drift.value, drift.sigma) == ("clock drift", "1000 ppm", "40 ppm")


def test_a_given_drift_is_kept_unless_the_recording_contradicts_it(found_fit: Fit) -> None:
    given = {"drift": 300.0, "drift_std": 20.0}
    fits = {std: replace(found_fit, drift=Drift(0.0, std)) for std in (5e-5, 2e-4, math.inf)}

    contradicted, weak, not_sought = (observed(fitted, **given) for fitted in fits.values())

    assert (contradicted["drift"], contradicted["drift_std"]) == (0.0, 100.0)
    assert contradicted["std"] > 0.0
    for kept in (weak, not_sought):
        assert (kept["drift"], kept["drift_std"], kept["std"]) == (300.0, 20.0, 0.0)


def test_a_drift_that_is_found_is_in_the_file() -> None:
    car = replace(VEHICLES["car"], receiver=Receiver(5.0, offset=0.03, drift=2e-3), duration=80.0)
    found = calibrate([recorded(car, 3)], parameters.defaults(), search=0.3)

    assert verdict(found, "clock drift") == "identified"
    std = found.values["gnss.time_offset.drift_std"]
    assert abs(found.values["gnss.time_offset.drift"] - 2000.0) < 4.0 * std < 1500.0
    assert found.values["gnss.time_offset.value"] == pytest.approx(0.03, abs=0.02)
    assert found.notes["gnss.time_offset.drift"].startswith("identified: clock drift")


@pytest.fixture(scope="module")
def found_fit() -> Fit:
    car = replace(VEHICLES["car"], duration=60.0)
    return calibrate([recorded(car, 3)], parameters.defaults(), search=0.2).fitted
