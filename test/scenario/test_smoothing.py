"""Recordings smoothed by ``ins_replay --smooth``: the whole road from bag to bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.runs import moved, through_estimator

from hybrid_ins import parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import simulate
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.noise.heading_information import HeadingInformation
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.result import Result, Scoring
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.replay import replay_bag
from hybrid_ins.ros.estimator.smoothed import SmoothedRun
from hybrid_ins.ros.messages.conversions import FLIP, SWAP
from hybrid_ins.row_file import ObjectFile, RowFile
from hybrid_ins.simulation.motions import car_drive
from hybrid_ins.simulation.sensors import ImuErrors
from tools.paper.runs import Run, Scenario, draw

TOPICS = {"imu_topic": "/imu/data", "fix_topic": "/gnss/fix", "velocity_topic": "/gnss/velocity"}


def simulated(path: Path, *options: str) -> Path:
    assert (
        simulate.main([str(path), "--imu-rate", "200", "--duration", "60", "--seed", "5", *options])
        == 0
    )
    return path


def replayed(source: Path, target: Path, smooth: bool, **changes: object) -> tuple[Path, float]:
    """Return the bag and when its odometry begins, after the first sample [s]."""
    values = parameters.check_all({**parameters.defaults(), **changes})
    replay_bag(source, target, values, TOPICS, smooth=smooth, log=lambda level, text: None)
    with BagReader(source) as bag, BagReader(target) as out:
        first_ns = int(bag.imu().stamp_ns[0])
        _, log_ns, _ = next(iter(out.raw("/odometry")))
    return target, (log_ns - first_ns) * 1e-9


def judged(bag: Path, skip: float) -> Result:
    return evaluate_run(read_run(bag), Scoring(skip=skip))


@pytest.mark.slow
def test_smoothed_outage_is_a_fraction_of_the_filtered_one(tmp_path: Path) -> None:
    # GIVEN a flight with an outage of 10 s, whose heading is not known at the start
    source = simulated(tmp_path / "flight.mcap", "--gnss-rate", "1", "--outage", "35", "10")
    # WHEN it is filtered, and smoothed
    filtered, begins = replayed(source, tmp_path / "filtered.mcap", smooth=False)
    smoothed, smoothed_begins = replayed(source, tmp_path / "smoothed.mcap", smooth=True)
    # THEN the gap at the start is filled
    assert begins > 0.5
    assert smoothed_begins < 0.1
    # AND the errors are smaller, within the outage most of all
    before, after = judged(filtered, 20.0), judged(smoothed, 20.0)
    assert after.prmse < 0.6 * before.prmse
    # AND the covariance is as honest as the filter's
    assert after.nees_position is not None
    assert 0.3 < after.nees_position.per_dof < 3.0


@pytest.mark.slow
def test_verdicts_of_a_smoothed_run_have_the_clock_offset_that_was_found(tmp_path: Path) -> None:
    # GIVEN a flight whose fixes are stamped 0.2 s late, of which the filter is not told
    source = simulated(tmp_path / "flight.mcap", "--time-offset", "0.2", "--gnss-rate", "5")
    unknown = {"gnss.time_offset.estimate": True}
    filtered, _ = replayed(source, tmp_path / "filtered.mcap", smooth=False, **unknown)
    # WHEN it is smoothed
    smooth, _ = replayed(source, tmp_path / "smoothed.mcap", smooth=True, **unknown)
    # THEN the offset of the first fixes is that which the later ones confirmed
    before, after = (read_run(bag).verdicts.time_offset for bag in (filtered, smooth))
    truth = before[-1]
    assert abs(before[0] - truth) > 0.1
    assert np.abs(after - truth).max() < 0.02
    # AND the errors are those of the track, not of the clock that the filter believed in
    assert judged(smooth, 5.0).prmse < 0.6 * judged(filtered, 5.0).prmse


@pytest.mark.slow
def test_smoothing_is_repeatable(tmp_path: Path) -> None:
    source = simulated(tmp_path / "flight.mcap", "--duration", "20")
    one, _ = replayed(source, tmp_path / "one.mcap", smooth=True)
    two, _ = replayed(source, tmp_path / "two.mcap", smooth=True)
    assert one.read_bytes() == two.read_bytes()


def smoothed(run: Run, late: float = 0.0, **values: object) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and odometry (N, 85) of a run whose fixes come ``late`` [s]."""
    record = RunRecord()
    estimator = through_estimator(run, late, record, **{"gnss.max_delay": 1.0, **values})
    blocks = [block for block, _ in SmoothedRun(estimator, record, RowFile).states()]
    return (
        np.concatenate([block.t_ns for block in blocks]),
        np.concatenate([block.in_map for block in blocks]),
    )


@pytest.mark.slow
def test_late_fixes_are_smoothed_as_those_in_time() -> None:
    # GIVEN a run, WHEN its fixes come in time, and 0.4 s after their stamps
    run = draw(Scenario("late", rate=100.0, duration=30.0), 1)
    # with a given clock offset: when a search for it ends depends on when fixes come
    given = {"gnss.time_offset.estimate": False}
    (stamps, in_time), (late_stamps, late) = smoothed(run, **given), smoothed(run, 0.4, **given)
    # THEN the last 19 s differ by less than half a deviation: the filter started one fix later
    assert np.array_equal(stamps, late_stamps)
    apart = np.abs(in_time[1100:, :3] - late[1100:, :3]).max()
    assert apart < 0.5 * np.sqrt(in_time[1100:, 7].max())


@pytest.mark.slow
def test_positions_are_smoothed_with_their_scatter_and_the_slow_rest_is_reported() -> None:
    # GIVEN fixes that scatter by 0.1 m, and the same that claim 1 m
    run = draw(Scenario("claims", rate=100.0, duration=60.0), 1)
    claims = tuple(replace(fix, covariance_n=np.eye(3)) for fix in run.fixes)
    given = {"gnss.time_offset.estimate": False}
    # WHEN both are smoothed
    _, right = smoothed(run, **given)
    _, claimed = smoothed(replace(run, fixes=claims), **given)
    # THEN the tracks are close, also where the filter has not learned the scatter yet
    apart = np.linalg.norm((claimed - right)[1000:, :3], axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.033  # 0.040 with the claimed covariance
    # AND what is reported holds what the receiver may be off by
    variance = claimed[1000:, [7, 14, 21]]
    assert variance.min() > 0.5 and variance.max() < 1.5


@pytest.mark.slow
def test_a_smoothed_attitude_is_as_uncertain_as_the_scale_errors_of_the_imu_make_it() -> None:
    # GIVEN cars whose gyroscope reads 1 % too much
    gnss = {"gnss.time_offset.estimate": False}
    errors, nees = ImuErrors(gyroscope_scale=0.01), []
    for seed in (1, 2, 3):
        run = draw(Scenario("scale", car_drive, 100.0, 180.0, errors=errors), seed)
        # WHEN they are smoothed
        t_ns, odometry = smoothed(run, **gnss)
        # THEN the errors of the attitude are as large as the covariance says
        at = np.searchsorted(t_ns, run.samples["t_ns"][run.scored][5:])
        truth = Rotation.from_matrix(SWAP @ matrix_from_quat(run.quat_xyzw[5:]) @ FLIP)
        error = (truth * Rotation.from_quat(odometry[at, 3:7]).inv()).as_rotvec()
        P = odometry[at, 7:43].reshape(-1, 6, 6)[:, 3:, 3:]
        nees.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)) / 3.0)
    assert 0.2 < np.mean(nees) < 1.5  # 2.6 by the smoother alone


def test_a_smoothed_heading_is_as_uncertain_as_motion_left_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # GIVEN a filter that is surer of its heading than motion, by 0.3 rad
    monkeypatch.setattr(HeadingInformation, "considered", lambda found, nav: 0.3**2)
    run = draw(Scenario("heading", rate=100.0, duration=20.0), 1)
    # WHEN it is smoothed
    _, odometry = smoothed(run, **{"gnss.time_offset.estimate": False})
    # THEN the heading has that, too, and no other angle
    roll, pitch, yaw = np.sqrt(odometry[:, [28, 35, 42]]).T
    assert yaw.min() > 0.29 and yaw[1000:].max() < 0.4
    assert max(roll.max(), pitch.max()) < 0.1


def test_a_smoothed_position_is_as_uncertain_as_the_place_that_is_given_of_the_antenna() -> None:
    # GIVEN a short flight, and a height of its antenna that is hardly known
    run = draw(Scenario("antenna", rate=100.0, duration=12.0), 1)
    std = (0.0, 0.0, 0.5)
    common = {"gnss.time_offset.estimate": False, "gnss.antenna_position": [0.0, 0.0, 0.4]}
    # WHEN it is smoothed
    exact = smoothed(run, **common)[1]
    given = smoothed(run, **common, **{"gnss.antenna_position_std": list(std)})[1]
    # THEN so is its height, and nothing else
    assert np.sqrt(exact[:, 21]).max() < 0.3
    assert np.sqrt(given[:, 21]).min() > 0.3
    assert np.abs(given[:, 2] - exact[:, 2]).max() < 0.02
    assert np.sqrt(given[:, 7]).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 4])
def test_noise_of_the_imu_is_no_evidence_on_the_clock(seed: int) -> None:
    # GIVEN a car whose accelerometers are shaken, so that no fix shows how it accelerates
    errors = ImuErrors(accelerometer_std=4.0)
    run = draw(Scenario("shaken", car_drive, 100.0, 60.0, errors=errors), seed)
    # WHEN it is smoothed, its clock being right, and known to be or not
    stamps, known = smoothed(run, **{"gnss.time_offset.estimate": False})
    t_ns, unknown = smoothed(run)
    # THEN the track is as uncertain as the clock, which was 0.2 s off, known to 0.016
    _, first, second = np.intersect1d(stamps, t_ns, return_indices=True)
    apart = np.abs(unknown[second, :2] - known[first, :2])
    assert np.all(apart < 3.0 * np.sqrt(unknown[second][:, [7, 14]]))


@pytest.mark.slow
def test_what_jumps_show_of_the_fixes_is_in_the_smoothed_covariance_on_both_sides() -> None:
    # GIVEN fixes that jump by 5 m after half a minute, which their receiver does not claim
    run = draw(Scenario("jump", rate=100.0, duration=60.0), 2)
    t = np.array([fix.t_ns - run.fixes[0].t_ns for fix in run.fixes]) * 1e-9
    # WHEN they are smoothed
    t_ns, odometry = smoothed(moved(run, np.outer(t > 30.0, [4.0, -3.0, 1.0])))
    # THEN positions after that are as uncertain, and those before: which are right is not known
    seconds, std = (t_ns - run.fixes[0].t_ns) * 1e-9, np.sqrt(odometry[:, [7, 14]]).mean(axis=1)
    assert np.all(std[seconds > 35.0] > 2.0)
    assert np.all(std[(seconds > 20.0) & (seconds < 30.0)] > 2.0)
    assert np.all(std[(seconds > 3.0) & (seconds < 6.0)] < 2.0)  # that fades


@pytest.mark.slow
def test_stretches_between_restarts_are_smoothed_each_by_itself() -> None:
    # GIVEN a run without IMU samples for 5 s
    run = draw(Scenario("gap", rate=100.0, duration=60.0), 2)
    stamps = run.samples["t_ns"]
    kept = (stamps < stamps[2500]) | (stamps > stamps[3000])
    # WHEN it is smoothed
    t_ns, _ = smoothed(replace(run, samples=run.samples[kept]))
    # THEN there is a state at nearly each sample, and none in the gap
    assert np.isin(t_ns, stamps[kept]).all()
    assert np.mean(np.isin(stamps[kept], t_ns)) > 0.98
    assert np.all(np.diff(t_ns) > 0)


def test_rows_of_a_file_are_those_that_were_kept() -> None:
    rows = RowFile(3)
    rows[1] = np.array([1.0, 2.0, 3.0])
    rows[0] = np.array([4.0, 5.0, 6.0])
    assert rows[1].tolist() == [1.0, 2.0, 3.0]
    assert rows[0].tolist() == [4.0, 5.0, 6.0]
    with pytest.raises(IndexError):
        rows[2]


def test_objects_of_a_file_are_those_that_were_kept(tmp_path: Path) -> None:
    kept, objects = ObjectFile(tmp_path), [(1, "one"), (2, None)]
    for item in objects:
        kept.append(item)
    assert list(kept) == objects
    assert list(kept) == objects
    assert not list(tmp_path.iterdir())
