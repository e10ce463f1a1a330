"""Outages of GNSS on wheels: the constraint bridges them, and only where the motion shows it."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.outage_drives import calibrated, drive, recording

from hybrid_ins import parameters
from hybrid_ins.core.constraints.constraint_observer import ConstraintObserver
from hybrid_ins.core.constraints.near_standstill import NearStandstillDetector
from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.navigator.fix_watch import OUTAGE_NS
from hybrid_ins.noise_regressor.slip import SlipReader
from hybrid_ins.ros.aids.vehicle_input import VehicleInput
from hybrid_ins.simulation.road_vehicles import MEASURED, MEMS, ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import VEHICLES, Vehicle, record
from tools.robustness.endurance import smooth_drive
from tools.vehicles.constraint import row
from tools.vehicles.drives import from_simulation
from tools.vehicles.judge import Judged, run
from tools.vehicles.outages import End, ends, gusty, with_scale_errors


@cache
def found(name: str, kind: str) -> tuple[End, ...]:
    return tuple(ends(drive(name), calibrated(**{"vehicle.kind": kind})))


def test_constraint_bridges_an_outage() -> None:
    """
    GIVEN a car whose axle slips and whose springs travel, and two minutes of fixes
    WHEN fixes are missing for 60 s
    THEN the error stays below 3 % of the distance, a fifth of that without the constraint.
    """
    with_it, without = found("road car", "auto"), found("road car", "other")

    assert [end.after for end in with_it] == [30.0, 60.0]
    assert all(end.error < 0.03 * end.distance for end in with_it)
    assert all(end.nees < 4.0 for end in with_it)
    assert with_it[-1].error < 0.2 * without[-1].error


def states(name: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, bool, bool]]:
    """Return time [s], whether the constraint holds, and whether it is fused."""
    seen: list[tuple[float, bool, bool]] = []
    run_periodic = VehicleInput.run_periodic
    whole = drive(name)
    start_ns = int(whole.imu_ns[0])

    def observed(self: VehicleInput, t_ns: int) -> None:
        run_periodic(self, t_ns)
        if self.observer is not None:
            seen.append(((t_ns - start_ns) * 1e-9, self.observer.holds, self.fused))

    monkeypatch.setattr(VehicleInput, "run_periodic", observed)
    run(whole, calibrated(**{"vehicle.kind": kind}))
    return seen


def test_constraint_is_not_used_where_the_motion_does_not_show_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """
    GIVEN a car that slides on ice all the time
    WHEN it is navigated with the default of vehicle.kind
    THEN the constraint never holds.
    """
    assert parameters.defaults()["vehicle.kind"] == "auto"

    assert not any(holds for _, holds, _ in states("car on ice", "auto", monkeypatch))


@pytest.mark.parametrize(
    "name",
    ["car, then on a ferry", pytest.param("car, later on ice", marks=pytest.mark.slow)],
)
def test_constraint_ends_when_the_motion_contradicts_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """
    GIVEN a car that has shown the constraint
    WHEN it is carried by a ferry, or slides, from 150 s on
    THEN the constraint is off some seconds after that has begun.
    """
    seen = states(name, "auto", monkeypatch)
    before = [holds for t, holds, _ in seen if 130.0 < t < 150.0]
    after = [holds for t, holds, _ in seen if t > 205.0]

    assert np.mean(before) > 0.9
    assert np.mean(after) < 0.2
    assert not any(fused for *_, fused in seen)  # no outage


def test_the_constraint_has_the_variances_that_the_samples_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """
    GIVEN a car that has shown the constraint
    WHEN fixes are missing from 150 to 170 s
    THEN its answers, scaled by what was shown before, are fused then and only then, and the status
    says so.
    """
    asked: list[tuple[int, np.ndarray]] = []
    fused: list[tuple[int, np.ndarray, np.ndarray]] = []
    read, measurement = SlipReader.read, ConstraintObserver.measurement

    def reading(self: SlipReader, ring: ImuRing, nose: Nose, t_ns: int) -> np.ndarray:
        covariance = read(self, ring, nose, t_ns)
        asked.append((t_ns, covariance))
        return covariance

    def measuring(self: ConstraintObserver, *args: Any) -> NonHolonomic:
        fused.append((args[0], args[-1], self.ratio.covariance))
        return measurement(self, *args)

    monkeypatch.setattr(SlipReader, "read", reading)
    monkeypatch.setattr(ConstraintObserver, "measurement", measuring)
    whole = drive("road car", duration=172.0)
    t = (whole.arrival_ns - whole.imu_ns[0]) * 1e-9
    estimator, *_ = run(whole.thinned(t < 150.0), calibrated())

    times = np.array([t_ns - int(whole.imu_ns[0]) for t_ns, *_ in fused]) * 1e-9
    assert len(times) > 20 and times.min() > 152.0
    assert len(asked) > 2 * len(fused)
    answers = dict(asked)
    for t_ns, covariance, ratio in fused:
        np.testing.assert_array_equal(covariance, answers[t_ns] * ratio)
        np.testing.assert_array_equal(ratio, fused[0][2])  # an outage shows nothing of it
    assert not np.allclose(fused[0][2], np.eye(2), rtol=0.05)
    assert len({covariance[0, 0] for _, covariance, _ in fused}) > len(fused) / 2
    values = dict(estimator.aids.vehicle.status().values)
    assert values["slip_source"] == "learned (slip)"
    assert float(values["slip_std_left_used"]) == pytest.approx(fused[-1][1][0, 0] ** 0.5, rel=1e-4)


def near_standstills(vehicle: Vehicle, seed: int, begin: float = 100.0) -> tuple[list[float], End]:
    """
    Return what comes of an outage of 60 s, which begins at a time [s], with wheels.

    The true speeds [m/s] while a stand is fused, and the error at its end.
    """
    made = record(replace(vehicle, duration=begin + 67.0), seed)
    whole, speed = from_simulation(made), np.linalg.norm(made.truth.velocity_n, axis=1)
    seen: list[float] = []
    run_periodic = VehicleInput.run_periodic

    def observed(self: VehicleInput, t_ns: int) -> None:
        run_periodic(self, t_ns)
        if self.near_standstill:
            seen.append(float(speed[int(np.searchsorted(whole.imu_ns, t_ns))]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VehicleInput, "run_periodic", observed)
        found = ends(whole, calibrated(**{"vehicle.kind": "ground"}), starts=np.array([begin]))
    return seen, found[-1]


def test_a_stand_with_the_engine_on_bounds_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    GIVEN cars that stand for some seconds of an outage of 60 s with their engine on
    THEN they are found to stand then and only then, and their errors at the end are smaller for it.
    """
    seeds, car = (1, 3, 5, 9), ROAD_VEHICLES["road car"]
    fused = []
    for seed in seeds:
        speeds, end = near_standstills(car, seed)
        assert len(speeds) > 10
        assert max(speeds) < 0.3
        fused.append(end.error)

    monkeypatch.setattr(NearStandstillDetector, "distinguishes", False)
    without = []
    for seed in seeds:
        speeds, end = near_standstills(car, seed)
        assert not speeds
        without.append(end.error)
    assert sum(fused) < 0.5 * sum(without)


@pytest.mark.slow
def test_a_ferry_that_sets_off_is_no_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    GIVEN a car that stands on a ferry, without fixes since it boarded
    WHEN the ferry sets off as smoothly as its engine runs
    THEN the stand ends, and errors are far smaller than if it had never been fused, and claims are
    right where they were.
    """
    ferry, seeds = ROAD_VEHICLES["car, then on a ferry"], (1, 3, 5, 7, 9)
    fused = []
    for seed in seeds:
        speeds, end = near_standstills(ferry, seed, 140.0)
        assert len(speeds) > 10
        assert max(speeds) < 1.0
        fused.append(end)

    monkeypatch.setattr(NearStandstillDetector, "distinguishes", False)
    without = [near_standstills(ferry, seed, 140.0)[1] for seed in seeds]
    assert sum(end.error for end in fused) < 0.6 * sum(end.error for end in without)
    pairs = zip(fused, without, strict=True)
    assert all(one.nees < max(1.5, 1.02 * other.nees) for one, other in pairs)


SMOOTH_DRIVE = Vehicle("smooth drive", smooth_drive, MEASURED, MEMS)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", [VEHICLES["slow rover"], SMOOTH_DRIVE], ids=lambda v: v.name)
def test_what_drives_as_smoothly_as_it_stands_is_not_found_to_stand(vehicle: Vehicle) -> None:
    """
    GIVEN wheels that a road does not shake, slow ones, and a car that brakes steadily
    WHEN fixes are missing for 60 s
    THEN no stand is fused.
    """
    speeds, _ = near_standstills(vehicle, 5)

    assert not speeds


def test_the_wind_is_for_vehicles_that_are_said_to_be_planes() -> None:
    for kind in ("auto", "ground", "multirotor", "other"):
        assert Judged(calibrated(**{"vehicle.kind": kind})).aids.vehicle.wind is None
    plane = Judged(calibrated(**{"vehicle.kind": "fixed_wing"})).aids.vehicle

    assert plane.observer is None
    found = dict(plane.status().values)
    assert float(found["wind_north"]) == 0.0 and float(found["wind_north_std"]) == 5.0


@pytest.mark.slow
def test_a_plane_bridges_an_outage_by_the_wind() -> None:
    """
    GIVEN a fixed wing in wind and gusts, with a minute of fixes in the air
    WHEN fixes are missing for 60 s
    THEN its error at the end is at most 0.7 of that without the constraint.
    """
    plane = replace(gusty(), duration=210.0, receiver=replace(gusty().receiver, offset=0.0))
    whole = from_simulation(record(plane, 2))
    clock = {"gnss.time_offset.estimate": False}
    without, with_it = (
        ends(whole, calibrated(**clock, **{"vehicle.kind": kind}), starts=np.array([145.0]))[-1]
        for kind in ("other", "fixed_wing")
    )

    assert with_it.after == 60.0
    assert with_it.error < 0.7 * without.error
    assert with_it.nees < 4.0


def test_the_new_vehicles_move_as_they_say() -> None:
    """The axle of a car slips by centimetres a second, on ice by decimetres; it turns about it."""
    across = {}
    for name in ("road car", "car on ice"):
        vehicle = replace(ROAD_VEHICLES[name], duration=120.0)
        truth = record(vehicle, 3).truth
        velocity_b = np.einsum("nji,nj->ni", truth.C_nb, truth.velocity_n)
        velocity_b += np.cross(truth.angular_rate_eb_b, [-1.2, -0.1, 0.3])
        across[name] = velocity_b[np.abs(velocity_b[:, 0]) > 3.0, 1].std()

    assert 0.01 < across["road car"] < 0.1
    assert across["car on ice"] > 0.4


@pytest.mark.slow
def test_the_table_says_for_how_long_the_constraint_was_held() -> None:
    rolling, sliding = row(drive("road car")), row(drive("car on ice"))

    assert float(rolling.split("|")[2].removesuffix(" % ")) > 50.0
    assert "| 0 % | 0 | - |" in sliding


def test_the_height_is_not_in_doubt_for_what_scale_errors_have_done_to_the_nose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """
    GIVEN a car whose gyroscope across reads 2 % of the rate of its turns, which tilts the attitude
    WHEN fixes are missing for a minute
    THEN the constraint holds the height by a nose that was tilted as well, within its σ: half of
    that without knowing what has tilted the nose.
    """
    made = recording("road car", 230.0, 5)
    rate = made.imu.angular_rate.copy()
    rate[:, 1] += 0.02 * rate[:, 2]
    whole = from_simulation(replace(made, imu=replace(made.imu, angular_rate=rate)))
    t = (whole.arrival_ns - whole.imu_ns[0]) * 1e-9
    kind = {"noise.mode": "learned", "imu.scale_std": 0.02, "vehicle.kind": "ground"}
    observe = ConstraintObserver.observe

    def unaware(self: ConstraintObserver, *args: Any, **options: Any) -> None:
        observe(self, *args, **{**options, "by_scale": None})

    errors, sigmas = [], []
    for observing in (observe, unaware):
        monkeypatch.setattr(ConstraintObserver, "observe", observing)
        estimator, t_ns, rows = run(whole.thinned(t < 160.0), calibrated(**kind))
        assert estimator.odometry.map is not None
        truth = LocalFrame(estimator.odometry.map.datum_lla).position(whole.truth_lla[2200])
        at = int(np.searchsorted(t_ns, whole.truth_ns[2200]))
        errors.append(rows[at, 2] + truth[2])
        sigmas.append(np.sqrt(rows[at, 7 + 14]))

    assert abs(errors[0]) < 2.5 * sigmas[0]
    assert sigmas[0] < 0.6 * sigmas[1]


def test_scale_errors_do_not_count_twice_in_an_outage() -> None:
    """
    GIVEN an IMU with errors of 1.5 % and a rate that the noise model does not read, whose
        innovations hide that it is less noisy than assumed
    WHEN fixes are missing, and scale errors are part of the covariance by themselves
    THEN the noise is that of innovations without them; with fixes, that of what they are.
    """
    whole = from_simulation(with_scale_errors(recording("road car", 230.0, 5), 5, 0.015))
    t = (whole.arrival_ns - whole.imu_ns[0]) * 1e-9
    values = calibrated(**{"imu.scale_std": 0.015, "noise.mode": "learned", "noise.model": "paper"})
    for end in (200.0, 240.0):
        estimator, *_ = run(whole.thinned(t < end), values)
        running = estimator.navigator.filter
        assert running is not None and running.noise.factors is not None
        with_fixes = running.noise.factors.found[:2]
        if end == 200.0:
            assert running.noise.imu_factors[1] < 0.6 * with_fixes[1]
        else:
            assert running.noise.imu_factors == with_fixes


def test_scale_errors_change_covariances_in_outages_alone() -> None:
    """
    GIVEN a drive in which fixes are missing from 100 to 120 s
    WHEN scale errors are considered, and when they are not
    THEN odometry is the same to the last bit until the outage, and the covariance larger in it.
    """
    whole = drive("road car", duration=122.0)
    t = (whole.arrival_ns - whole.imu_ns[0]) * 1e-9
    thinned = whole.thinned(t < 100.0)
    free = {"vehicle.kind": "other"}
    considered, ignored = (
        run(thinned, calibrated(**free, **{"imu.scale_std": std})) for std in (0.01, 0.0)
    )

    since = int(np.searchsorted(ignored[1], thinned.fix_ns[-1] + OUTAGE_NS))
    np.testing.assert_array_equal(considered[2][:since], ignored[2][:since])
    assert since > 1000
    variance = [rows[-1, 7] + rows[-1, 14] for _, _, rows in (considered, ignored)]
    assert variance[0] > 1.2 * variance[1]
