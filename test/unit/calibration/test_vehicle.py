"""Nose and axle of a vehicle from the states of calibrated recordings."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.calibration.derived import travel
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Finding
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.vehicle import findings_of, observe_nose, vehicle_findings
from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.constraints.constraint_observer import ConstraintObserver
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_from_rpy,
)
from hybrid_ins.core.inertial.state import N_NAV, NavState
from hybrid_ins.simulation.sensors import to_body
from hybrid_ins.simulation.vehicles import Recording as Drive
from hybrid_ins.simulation.vehicles import record
from tools.vehicles.outages import every_vehicle

MOUNT = (0.0, 0.05, -0.08)  # rad, pitch and yaw of the IMU's axes in the car's
AXLE_B, SCALE = (-1.2, -0.1, 0.3), 1.01  # m; of wheels
Array = NDArray[np.float64]
ZERO = np.zeros(3)
HEADING_STD = 0.004  # rad, errors that last for 20 s


def wheels(found: Drive, rng: np.random.Generator, faster: float) -> tuple[BodyVelocity, ...]:
    """Return speeds of the rear axle at 10 Hz, which is nominally at the IMU."""
    truth = found.truth
    velocity_b = to_body(truth.C_nb, truth.velocity_n) + np.cross(truth.angular_rate_eb_b, AXLE_B)
    readings = []
    for k in range(5, len(truth.t), 5):
        speed = velocity_b[k, 0] / SCALE + 0.05 * rng.standard_normal()
        speed *= faster if 2 * k > len(truth.t) else 1.0
        readings.append(
            BodyVelocity(
                round(truth.t[k] * 1e9),
                np.array([speed, np.nan, np.nan]),
                0.05**2 * np.eye(3),
                np.zeros(3),
            )
        )
    return tuple(readings)


def drive(name: str, seed: int, faster: float = 1.0) -> tuple[Recording, FilterPass]:
    """
    Return a recording of an IMU that is not aligned, and states as good as a filter's.

    The wheels read 1 % too little, and ``faster`` in its second half.
    """
    found = record(replace(every_vehicle()[name], duration=300.0, imu_rate=50.0), seed)
    rng = np.random.default_rng(seed)
    C_bs = matrix_from_quat(quat_from_rpy(*MOUNT))
    truth = found.truth
    count = len(found.fix_t)
    states = np.empty((count, N_NAV))
    P = np.diag(np.repeat([0.02, 0.03, HEADING_STD, 0.02, 0.001], 3) ** 2)
    heading = 0.0
    for k, at in enumerate(np.searchsorted(truth.t, found.fix_t)):
        heading = 0.95 * heading + 0.31 * HEADING_STD * rng.standard_normal()
        C = matrix_from_quat(quat_from_rotvec(np.array([0.0, 0.0, heading])))
        C = C @ truth.C_nb[at] @ C_bs
        velocity = truth.velocity_n[at] + 0.03 * rng.standard_normal(3)
        state = NavState(truth.lla[at], velocity, quat_from_matrix(C), np.zeros(3), np.zeros(3), P)
        states[k] = state.to_flat()[:N_NAV]
    samples = np.hstack((truth.specific_force_b @ C_bs, truth.angular_rate_b @ C_bs))
    recording = Recording(
        name,
        truth.t,
        samples,
        truth.t[np.searchsorted(truth.t, found.fix_t)],
        np.full(count, POSITION, np.int64),
        found.fix_lla,
        np.tile(np.eye(3), (count, 1, 1)),
        body_velocity=wheels(found, rng, faster),
    )
    return recording, FilterPass(
        np.empty((count, 3)), np.empty((count, 3, 3)), np.ones(count), states
    )


def findings(observer: ConstraintObserver, slip_std: float, moved: Array = ZERO) -> list[Finding]:
    return findings_of(observer, np.eye(3), [0.5, 0.0, 0.2], moved, np.full(2, slip_std))


@pytest.mark.parametrize("seed", [2, 4])
def test_nose_of_a_car_is_found_to_three_tenths_of_a_degree(seed: int) -> None:
    """
    GIVEN two drives of a car whose IMU is turned by degrees and 1.2 m ahead of the rear axle
    WHEN its motion is observed
    THEN nose and axle are found, and the parameters turn the nose as the mount does.
    """
    drives = [drive("road car", seed), drive("road car", seed + 100)]

    observer = observe_nose([d[0] for d in drives], [d[1] for d in drives], [0.0, 0.0])

    assert observer is not None
    assert observer.holds
    # The car's nose in the IMU's axes.
    nose = matrix_from_quat(quat_from_rpy(*MOUNT)).T @ np.array([1.0, 0.0, 0.0])
    off = np.degrees(np.arccos(np.clip(nose @ observer.nose.forward, -1.0, 1.0)))
    assert off < 0.3
    nose_row, axle, slip = findings(observer, 0.1)
    values = nose_row.values
    assert values["vehicle.kind"] == "ground"
    assert values["vehicle.nose"][0] == pytest.approx(-np.arctan2(nose[1], nose[0]), abs=0.005)
    assert values["vehicle.nose"][1] == pytest.approx(-np.arcsin(nose[2]), abs=0.005)
    assert nose_row.label == "nose"
    assert axle.verdict in ("identified", "weak")
    assert axle.values["vehicle.axle_position"][0] == pytest.approx(0.5 - 1.2, abs=0.35)
    left, up = (float(text) for text in slip.value.removesuffix(" m/s").split(", "))
    assert 0.01 < left < 0.15  # true: 0.04, 0.06 m/s
    assert 0.02 < up < 0.15
    assert not slip.values
    # AND who slips more than the constraint allows for has to show it again in another drive
    nose_row, *_ = findings(observer, 0.5 * left)
    assert "vehicle.kind" not in nose_row.values
    assert nose_row.note.endswith("not surely on wheels: vehicle.kind as given")
    # AND nose and axle are known no better than what they were found with
    nose_row, axle, _ = findings(observer, 0.1, np.array([0.02, 0.03, 0.4]))
    assert nose_row.values["vehicle.nose_std"] == pytest.approx(0.03, rel=0.1)
    assert axle.values["vehicle.axle_position_std"] == pytest.approx(0.4, rel=0.1)


def test_a_reverse_is_no_other_direction_of_travel() -> None:
    angles = 0.3 + np.random.default_rng(1).normal(0.0, 0.05, 1000)
    angles[::5] += np.pi

    angle, spread, backward = travel(np.angle(np.exp(1j * angles)))

    assert angle == pytest.approx(0.3, abs=0.01)
    assert spread == pytest.approx(0.05, rel=0.1)
    assert backward == pytest.approx(0.2)
    assert travel(angles + 3.0).angle == pytest.approx(3.3 - 2.0 * np.pi, abs=0.01)


def test_a_car_on_ice_has_no_nose() -> None:
    found = drive("car on ice", 2)

    observer = observe_nose([found[0]], [found[1]], [0.0])

    assert observer is not None
    assert not observer.holds


def test_a_vehicle_that_never_moves_shows_nothing() -> None:
    recording, states = drive("road car", 2)
    still = np.flatnonzero(recording.aid_t < 8.0)
    states = replace(states, nis=np.where(np.arange(len(states.nis)) <= still[-1], 1.0, np.nan))

    assert observe_nose([recording], [states], [0.0]) is None


def wheel_rows(found: tuple[Recording, FilterPass]) -> dict[str, tuple[str, float, float, str]]:
    """Return value, number, σ and verdict of what is found of the wheels, by label."""
    C = matrix_from_quat(quat_from_rpy(*MOUNT))  # from the IMU's axes to the car's
    rows = vehicle_findings([found[0]], [found[1]], [0.0], C, parameters.defaults(), np.zeros(3))
    return {
        row.label: (
            row.value,
            float(row.value.split()[0]),
            float(row.sigma.split()[0]),
            row.verdict,
        )
        for row in rows
        if row.label.startswith("wheel")
    }


@pytest.mark.parametrize("seed", [2, 4])
def test_scale_and_place_of_wheels_are_found(seed: int) -> None:
    """
    GIVEN a drive with wheels that read 1 % too little, 1.2 m behind the IMU and 0.1 m aside
    WHEN their readings are compared with the motion
    THEN scale and place aside are identified, and the place ahead is not: no axis shows it.
    """
    rows = wheel_rows(drive("road car", seed))

    _, scale, scale_std, verdict = rows["wheel scale"]
    assert verdict == "identified"
    assert abs(scale - SCALE) < min(3.0 * scale_std, 0.003)
    _, left, left_std, verdict = rows["wheels left"]
    assert verdict == "identified"
    assert abs(left - 0.1) < min(3.0 * left_std, 0.1)
    assert rows["wheels forward"][3] == "not identifiable"


def test_wheels_that_do_not_fit_are_named_and_nothing_is_written() -> None:
    found = drive("road car", 2, faster=1.3)

    rows = vehicle_findings(
        [found[0]], [found[1]], [0.0], np.eye(3), parameters.defaults(), np.zeros(3)
    )

    mine = [row for row in rows if row.label.startswith("wheel")]
    assert mine[0].verdict == "does not fit"
    assert "the scale changes" in mine[0].note
    assert not any(row.values for row in mine)
