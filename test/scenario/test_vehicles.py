"""Vehicles that are no quadrotor: valid fixes are used, and show motion."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.wander import smooth_wander

from hybrid_ins import parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import total_std
from hybrid_ins.core.noise.hypotheses import drifts_beyond_claim
from hybrid_ins.ros.messages.conversions import stamp_ns
from hybrid_ins.simulation.sensors import Tone
from hybrid_ins.simulation.vehicles import VEHICLES, Receiver, city_car, record
from tools.vehicles import calibrated, campaign
from tools.vehicles.drives import from_simulation
from tools.vehicles.judge import Score, run, score


def drive(name: str, seed: int, **values: Any) -> Score:
    run = from_simulation(record(VEHICLES[name], seed))
    return score(run, {**parameters.defaults(), **values})


def test_valid_fixes_of_a_car_are_used_at_every_turn() -> None:
    """
    GIVEN a car with RTK at 1 Hz, vibration, and streets that cross at right angles
    WHEN it is navigated by the default parameters
    THEN no fix is rejected, the covariance is never inflated, and position is accurate.
    """
    found = drive("car", 1)

    assert found.used > 0.999
    assert found.resets == 0
    assert found.rmse < 0.085
    assert found.nees < 2.0


@pytest.mark.parametrize(("name", "seed"), [("car", 1), ("car", 4), ("quadrotor", 1)])
def test_a_claim_that_is_far_too_small_does_not_draw_the_clock(name: str, seed: int) -> None:
    """
    GIVEN a receiver that scatters by 0.5 m, and claims the 0.02 m that its driver was given
    THEN the clock is right: it was 0.2 to 0.4 s off, sure to 0.05, by when each filter had learned
    the scatter.
    """
    receiver = Receiver(5.0, (0.5, 0.5, 0.5), claimed_std=(0.02, 0.02, 0.02))
    vehicle = replace(VEHICLES[name], receiver=receiver, rest=2.0, duration=60.0)

    estimator, _, _ = run(from_simulation(record(vehicle, seed)), parameters.defaults())

    assert abs(estimator.clock.offset) < 0.02


def test_heights_that_wander_beyond_their_claim_are_not_blamed_on_the_accelerometers() -> None:
    """
    GIVEN a receiver that claims 0.8 m, and whose heights wander by 4 m within half a minute
    THEN the published height contains that: its noise was taken for 80 times as large, and nothing
    of the heights was published.
    """
    receiver = Receiver(5.0, (0.3, 0.3, 0.3), (0.4, 0.4, 4.0), 30.0, (0.8, 0.8, 0.8))
    vehicle = replace(VEHICLES["car"], receiver=receiver, duration=100.0)

    estimator, _, _ = run(from_simulation(record(vehicle, 1)), parameters.defaults())

    assert estimator.navigator.filter is not None
    noise = estimator.navigator.filter.noise
    across, upward = noise.split.unclaimed_stds
    assert across < 1.2 and 2.5 < upward < 8.0
    assert noise.found.accelerometer < 20.0
    drifts = drifts_beyond_claim(noise.slow_error, noise.split.claimed_stds)
    assert drifts == pytest.approx((0.0, upward), abs=1.0)


@pytest.mark.parametrize("seed", [3, 6])
def test_a_vehicle_that_is_shaken_at_rest_shows_no_heading(seed: int) -> None:
    """
    GIVEN a car whose engine idles for two minutes, and RTK with a wander of a centimetre
    THEN its heading is as unknown as before: it was known to 46 and 28 degrees, and later wrong.
    """
    antenna_b = 0.4, 0.1, -1.2
    vehicle = replace(
        VEHICLES["car"],
        motion=partial(city_car, rest=1000.0),
        receiver=Receiver(
            5.0,
            slow_std=(0.01, 0.01, 0.02),
            slow_time=200.0,
            claimed_std=(0.015, 0.015, 0.03),
            antenna_b=antenna_b,
        ),
        errors=replace(VEHICLES["car"].errors, tones=(Tone(27.0, 0.42, 0.004),)),
        duration=120.0,
    )
    values = {**parameters.defaults(), "gnss.antenna_position": [0.4, 0.1, 1.2]}

    estimator, _, _ = run(from_simulation(record(vehicle, seed)), values)

    bank = estimator.navigator.phase.bank
    assert bank is not None and bank.clock_open
    assert bank.heading()[1] > np.radians(90.0)


def test_a_stand_under_a_roof_shows_neither_heading_nor_clock() -> None:
    """
    GIVEN a car that stands for 40 s while its fixes wander by 8 m, claim 1.5 m, and are right later
    THEN their wander is no motion: the heading was accepted 22 degrees off, silently.
    """
    rest, rate = 40.0, 4.0
    vehicle = replace(
        VEHICLES["car"],
        motion=partial(city_car, rest=rest),
        rest=rest,
        engine_time=0.0,
        receiver=Receiver(
            rate, (0.05, 0.05, 0.1), (0.5, 0.5, 0.8), 60.0, (1.5, 1.5, 2.2), offset=-0.1
        ),
        duration=100.0,
    )
    made = record(vehicle, 1)
    rng = np.random.default_rng([1, 5])
    wander = smooth_wander(rng, (len(made.fix_t), 3), 1.0 / rate, 8.0, 15.0) * [1.0, 1.0, 1.5]
    wander *= np.clip((rest + 6.0 - made.fix_t) / 4.0, 0.0, 1.0)[:, None]
    lla = made.fix_lla + wander / curvature_scale(made.fix_lla[0])

    found = score(from_simulation(replace(made, fix_lla=lla)), parameters.defaults())

    assert found.silent == 0.0
    assert not found.heading_at_start > 10.0  # or it is not known yet
    assert found.resets == 0


@pytest.mark.slow
def test_velocities_older_than_positions_do_not_draw_the_clock() -> None:
    """
    GIVEN a fixed wing whose receiver's velocities are 0.1 s older than its positions
    THEN the clock offset is that of the positions: it was -0.05 s, and the RMSE 2.1 m.
    """
    vehicle = replace(VEHICLES["fixed wing, velocities 0.1 s old"], duration=110.0)
    found = score(from_simulation(record(vehicle, 1)), parameters.defaults())

    assert found.offset == pytest.approx(-0.2, abs=0.03)
    assert found.rmse < 1.5


def test_what_contradicts_a_wrong_heading_is_not_blamed_on_a_known_clock() -> None:
    """
    GIVEN a heading wrong by half a turn, and a clock offset that is known from a calibration
    WHEN the car moves
    THEN the heading is corrected: the check of it ended when the clock came under suspicion.
    """
    row = campaign.one(27, clock_given=True)

    assert (row["motion"], row["given"]) == ("car", "wrong")
    assert row["offset"] == pytest.approx(row["true_offset"], abs=0.02)
    assert row["heading"] < 2.0 and row["rmse"] < 0.05 and row["silent"] == 0.0


def test_what_sets_off_from_a_stand_is_aligned_within_its_first_steps() -> None:
    """
    GIVEN a pedestrian who has stood, and of whom neither heading nor clock offset is known
    WHEN he walks
    THEN both are known after some seconds: the search began in motion, with a tilt of 0.1 rad and
    3 m/s to be found out, and needed 17 s.
    """
    row, walk = campaign.draw(95)
    found = score(
        from_simulation(record(replace(walk, duration=walk.rest + 12.0), 95)), parameters.defaults()
    )

    assert (row["motion"], row["given"]) == ("pedestrian", "nothing")
    assert found.aligned < 7.0
    assert found.heading_at_start < 3.0


@pytest.mark.slow
def test_a_slow_vehicle_is_aligned_once_its_heading_is_known_to_17_degrees() -> None:
    """
    GIVEN a rover at walking pace, whose fixes of 2 m at 1 Hz show its heading slowly
    THEN one filter goes on with what they have shown, and covers its error: known to 12° it was
    after 50 s, and until then its noise was sought beside each heading.
    """
    row, rover = campaign.draw(451)
    found = score(from_simulation(record(rover, 451)), parameters.defaults())

    assert (row["motion"], row["receiver"], row["given"]) == ("slow rover", "consumer", "nothing")
    assert found.aligned < 30.0
    assert found.heading < 20.0
    assert found.silent == 0.0 and found.nees < 2.0


@pytest.mark.slow
def test_a_right_clock_is_kept_on_a_cruise() -> None:
    """
    GIVEN a motorway drive that hardly shows the clock, which is right
    THEN it is not moved: chance moved it by -0.39 s, 7 m, until evidence had to last.
    """
    row = campaign.one(5)

    assert (row["motion"], row["true_offset"]) == ("car on a motorway", 0.0)
    assert abs(row["offset"]) < 0.05
    assert row["rmse"] < 1.0 and row["silent"] == 0.0


@pytest.mark.slow
def test_the_noise_of_a_shaken_50_hz_imu_is_no_evidence_on_the_clock() -> None:
    """
    GIVEN a car that sets off and goes on at 30 m/s, with a 50 Hz IMU that the road shakes
    THEN its noise is read in its samples: with the constants it had found -0.53 ± 0.06 s for -0.19,
    and was 9 m off with 1.2 m claimed.
    """
    row = campaign.one(2037)

    assert (row["motion"], row["imu_rate"]) == ("car on a motorway", 50.0)
    assert abs(row["offset"] - row["true_offset"]) < 0.2
    assert row["rmse"] < 6.0 and row["nees"] < 4.0 and row["silent"] == 0.0


@pytest.mark.slow
def test_the_nose_holds_the_heading_where_fixes_do_not_show_it() -> None:
    """
    GIVEN a car on a motorway whose IMU is shaken, with a consumer receiver
    WHEN it is known to roll
    THEN it knows where it points: it was 20° off, and 54° in the end.
    """
    _, vehicle = campaign.draw(48)
    vehicle = replace(vehicle, duration=vehicle.rest + 150.0)
    values = {**parameters.defaults(), "vehicle.kind": "ground"}

    found = score(from_simulation(record(vehicle, 48)), values)

    assert found.heading < 5.0
    assert found.silent == 0.0


def test_a_clock_found_at_the_edge_of_the_search_is_not_taken_back_on_a_cruise() -> None:
    """
    GIVEN a motorway drive whose clock is wrong by the largest offset that is tried
    WHEN the first search has found that, and the second one sees only the cruise
    THEN the offset is kept: the given one, 0.6 s away, was put back without evidence, 18 m off.
    """
    receiver = Receiver(5.0, (0.12, 0.12, 0.2), (0.7, 0.7, 1.0), 100.0, (1.2, 1.2, 1.8), -0.6)
    motorway = VEHICLES["car on a motorway, clock -0.1 s"]
    vehicle = replace(motorway, receiver=receiver, imu_rate=50.0, duration=75.0)
    found = score(from_simulation(record(vehicle, 3)), parameters.defaults())

    assert found.offset == pytest.approx(-0.6, abs=0.1)
    assert found.rmse < 4.0 and found.silent == 0.0


@pytest.mark.slow
def test_a_receiver_without_corrections_is_off_by_more_than_it_scatters() -> None:
    """
    GIVEN a walk whose consumer receiver scatters as it claims, and is slowly off by as much
    THEN the covariance holds it: NEES/2 was 41.
    """
    row = campaign.one(18)

    assert (row["motion"], row["receiver"]) == ("pedestrian", "consumer")
    assert row["rmse"] > 2.0 and row["silent"] == 0.0
    assert row["nees"] < 4.0


def test_the_bag_of_a_drive_holds_what_its_node_is_given(tmp_path: Path) -> None:
    vehicle = replace(VEHICLES["fixed wing, velocities 0.1 s old"], duration=70.0)
    drive = from_simulation(record(vehicle, 3), delay=0.2)
    calibrated.write_bag(drive, tmp_path / "drive.mcap")

    with BagReader(tmp_path / "drive.mcap") as bag:
        imu = bag.imu("/imu/data")
        fixes = list(bag.messages("/gnss/fix"))
        [velocity, *_] = [message for *_, message in bag.messages("/gnss/velocity")]

    assert np.array_equal(imu.stamp_ns, drive.imu_ns)
    assert np.array_equal(imu.specific_force, drive.force)
    assert [log_ns for _, log_ns, _ in fixes] == drive.arrival_ns.tolist()
    assert [stamp_ns(message.header.stamp) for *_, message in fixes] == drive.fix_ns.tolist()
    assert fixes[9][2].position_covariance[::4] == pytest.approx(drive.fix_std[9] ** 2)
    assert drive.velocity_enu is not None
    linear = velocity.twist.twist.linear
    assert [linear.x, linear.y, linear.z] == drive.velocity_enu[0].tolist()


@pytest.mark.parametrize("is_given", [False, True])
def test_an_antenna_that_is_not_where_it_is_said_to_be_is_named(is_given: bool) -> None:
    """
    GIVEN a car whose antenna is 1.2 m ahead of its IMU and 0.9 m above it
    WHEN that is not given, and it turns at some corners
    THEN the log and the diagnostics say where it seems to be, and the covariance of the position
    contains it; where it is given, neither.
    """
    vehicle = replace(VEHICLES["car"], duration=150.0)
    receiver = replace(vehicle.receiver, antenna_b=(1.2, 0.0, -0.9))
    drive = from_simulation(record(replace(vehicle, receiver=receiver), 1))
    position = [1.2, 0.0, 0.9] if is_given else [0.0, 0.0, 0.0]
    log: list[str] = []

    values = {**parameters.defaults(), "gnss.antenna_position": position}
    estimator, _, _ = run(drive, values, lambda level, text: log.append(text))

    told = [line for line in log if "the antenna is about" in line]
    status = next(s for s in estimator.status.diagnostics(0) if s.name.endswith("input"))
    if is_given:
        assert told == [] and status.level == 0
        assert max(total_std(estimator.navigator.filter.nav)[:2]) < 0.3
        return
    running = estimator.navigator.filter
    left_b, std, _, _ = running.lever_arm
    error_b = left_b + estimator.placement.antenna_error_b
    np.testing.assert_array_less(np.abs(error_b - [1.2, 0.0, -0.9]), 4.0 * std)
    assert std[0] < 0.4
    assert 0.9 < np.linalg.norm(total_std(running.nav)[:2]) < 2.0
    assert (
        "m forward" in told[0] and "of where imu.position and gnss.antenna_position put" in told[0]
    )
    assert status.level == 1 and "the antenna is about" in status.text
