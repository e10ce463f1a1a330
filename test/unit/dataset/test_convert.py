"""Flights in CSV files become bags; what is wrong with the files is said, line by line."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.paths import ROOT

from hybrid_ins.bags.flight_bag import EPOCH_NS
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli.convert import main
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_multiply,
    rotvec_from_quat,
    rpy_from_quat,
    skew,
)
from hybrid_ins.dataset.column_map import load_map
from hybrid_ins.dataset.convert import differentiate, pick_epochs
from hybrid_ins.dataset.csv_flight import (
    AttitudeSeries,
    ImuSeries,
    read_attitude,
    read_imu,
    read_position,
)
from hybrid_ins.dataset.csv_table import CsvFormat, Faults, read_table
from hybrid_ins.errors import InputError
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import Truth, sample

MAP = ROOT / "config/datasets/quadrotor.yaml"
ORIGIN = np.array([np.radians(32.8257), np.radians(34.9560), 10.0])
STANDING_N = np.array([0.0, 0.0, -9.795])  # m/s2, specific force at rest
DELAY = 0.045  # s, of the attitude in the map
FLIP = np.array([1.0, -1.0, -1.0])
BEGIN = 14.0  # s, into the simulated flight: like the real ones it starts in the air

IMU_HEADER = "time,Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
GT_HEADER = (
    "time,distance(meters),speed(m/s), compass_heading(degrees), pitch(degrees), roll(degrees),"
    "height_above_takeoff(meters),North,East,Down"
)


# --- a flight whose truth is known, in the dataset's own layout -----------------------------------


def truth_at(times: np.ndarray) -> Truth:
    return sample(quadrotor_flight(60.0, start_lla=ORIGIN, heading=1.0), BEGIN + times)


def ned(truth: Truth) -> np.ndarray:
    return LocalFrame(ORIGIN).position(truth.lla)


def write_csv(path: Path, header: str, rows: np.ndarray, delimiter: str = ",") -> None:
    lines = [delimiter.join(map(repr, row)) for row in rows.tolist()]
    path.write_text("\n".join(([header] if header else []) + lines) + "\n")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    t = np.arange(2401) / 120.0
    truth = truth_at(t)
    flu = rpy_from_quat(truth.quat_xyzw) * FLIP + [0.0, 0.0, 0.4]
    imu = [t[:, None], np.degrees(flu), truth.specific_force_b * FLIP]
    write_csv(
        folder / "IMU_1.csv",
        IMU_HEADER,
        np.hstack([*imu, np.degrees(truth.angular_rate_b * FLIP)]),
    )
    t = np.arange(201) / 10.0
    roll, pitch, heading = np.degrees(rpy_from_quat(truth_at(t - DELAY).quat_xyzw)).T
    filler = np.zeros_like(t)
    columns = [t, filler, filler, heading % 360.0, pitch, roll, filler, *ned(truth_at(t)).T]
    write_csv(folder / "GT.csv", GT_HEADER, np.stack(columns, axis=-1))
    return folder


@pytest.fixture
def flight(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(made, tmp_path / "flight"))


def convert(flight: Path, out: Path, options: str = "") -> Path:
    assert main([str(flight), str(out), *options.split()]) == 0
    return out


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run the program on bad input and return its last line."""
    capsys.readouterr()
    try:
        status: object = main(arguments)
    except SystemExit as leave:
        status = leave.code
    assert status == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def messages(bag: Path, topic: str) -> tuple[np.ndarray, list[Any]]:
    """Stamps [s after the epoch] and messages."""
    with BagReader(bag) as reader:
        found = [m for _, _, m in reader.messages(topic)]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in found]
    return (np.array(stamps, np.int64) - EPOCH_NS) * 1e-9, found


def vectors(parts: list[Any], names: str = "xyz") -> np.ndarray:
    return np.array([[getattr(part, name) for name in names] for part in parts])


def fix_positions(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and positions of the fixes, NED [m]."""
    t, found = messages(bag, "/gnss/fix")
    lla = np.array([[*np.radians([m.latitude, m.longitude]), m.altitude] for m in found])
    return t, LocalFrame(ORIGIN).position(lla)


def truth_positions(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and positions of the truth, NED [m]."""
    t, found = messages(bag, "/truth/odometry")
    _, (datum,) = messages(bag, "/truth/datum")
    frame = LocalFrame(np.array([*np.radians([datum.latitude, datum.longitude]), datum.altitude]))
    position = vectors([m.pose.pose.position for m in found])[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return t, LocalFrame(ORIGIN).position(frame.lla(position))


def angle_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rotvec_from_quat(quat_multiply(quat_conjugate(first), second)), axis=-1)


# --- the bag --------------------------------------------------------------------------------------


def test_the_imu_is_written_at_its_own_stamps_in_flu(made: Path, tmp_path: Path) -> None:
    t, imu = messages(convert(made, tmp_path / "bag"), "/imu/data")
    truth = truth_at(t)

    np.testing.assert_allclose(t, np.arange(2401) / 120.0, atol=1e-9)
    force = vectors([m.linear_acceleration for m in imu])
    rate = vectors([m.angular_velocity for m in imu])
    np.testing.assert_allclose(force, truth.specific_force_b * FLIP, atol=1e-9)
    np.testing.assert_allclose(rate, truth.angular_rate_b * FLIP, atol=1e-9)
    assert {m.header.frame_id for m in imu} == {"imu_link"}


def test_fixes_come_in_the_frame_whose_positions_they_are_made_of(
    made: Path, tmp_path: Path
) -> None:
    _, fixes = messages(convert(made, tmp_path / "bag"), "/gnss/fix")

    assert {m.header.frame_id for m in fixes} == {"base_link"}


def test_the_imus_orientation_is_kept_and_its_yaw_is_said_to_be_unknown(
    made: Path, tmp_path: Path
) -> None:
    t, imu = messages(convert(made, tmp_path / "bag"), "/imu/data")
    C_enu_flu = matrix_from_quat(vectors([m.orientation for m in imu], "xyzw"))

    up = np.swapaxes(C_enu_flu, 1, 2) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, -truth_at(t).C_nb[:, 2, :] * FLIP, atol=1e-9)
    covariance = imu[0].orientation_covariance.reshape(3, 3)
    np.testing.assert_allclose(np.diag(covariance)[:2], np.radians(3.0) ** 2)
    assert covariance[2, 2] == pytest.approx(np.pi**2 / 3.0)


def test_fixes_are_every_second_epoch_with_noise_and_say_so(made: Path, tmp_path: Path) -> None:
    t, position = fix_positions(convert(made, tmp_path / "bag"))
    _, fix = messages(tmp_path / "bag", "/gnss/fix")
    error = position - ned(truth_at(t))

    np.testing.assert_allclose(t, np.arange(101) / 5.0, atol=1e-9)
    np.testing.assert_allclose(error.std(0), (0.1, 0.1, 0.02**0.5), rtol=0.25)
    assert np.abs(error.mean(0)).max() < 0.05
    for m in fix:
        covariance = m.position_covariance.reshape(3, 3)
        np.testing.assert_allclose(covariance, np.diag([0.01, 0.01, 0.02]), atol=1e-12)
        assert (m.status.status, m.position_covariance_type) == (0, 2)


def test_truth_is_the_reference_at_every_epoch(made: Path, tmp_path: Path) -> None:
    t, position = truth_positions(convert(made, tmp_path / "bag"))
    _, truth = messages(tmp_path / "bag", "/truth/odometry")
    expected = truth_at(t)

    np.testing.assert_allclose(t, np.arange(201) / 10.0, atol=1e-9)
    np.testing.assert_allclose(position, ned(expected), atol=1e-6)

    C = matrix_from_quat(vectors([m.pose.pose.orientation for m in truth], "xyzw"))
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(C, swap @ expected.C_nb @ np.diag(FLIP), atol=0.01)

    velocity = vectors([m.twist.twist.linear for m in truth])
    expected_b = (np.swapaxes(expected.C_nb, 1, 2) @ expected.velocity_n[..., None])[..., 0]
    error = velocity - expected_b * FLIP
    assert np.sqrt(np.mean(error**2)) < 0.07
    rate = vectors([m.twist.twist.angular for m in truth]) - expected.angular_rate_b * FLIP
    assert np.sqrt(np.mean(rate**2)) < 0.06
    assert {(m.header.frame_id, m.child_frame_id) for m in truth} == {("map", "base_link")}


def test_truths_covariance_is_that_of_the_map(made: Path, tmp_path: Path) -> None:
    _, truth = messages(convert(made, tmp_path / "bag"), "/truth/odometry")
    pose = truth[50].pose.covariance.reshape(6, 6)
    twist = truth[50].twist.covariance.reshape(6, 6)

    np.testing.assert_allclose(
        np.diag(pose), [*np.square([0.02, 0.02, 0.05]), *np.radians([1.5, 1.5, 2.0]) ** 2]
    )
    # Along base_link's axes, which the attitude's error turns against the motion.
    velocity = vectors([truth[50].twist.twist.linear])[0]
    C = matrix_from_quat(vectors([truth[50].pose.pose.orientation], "xyzw")[0])
    turn = skew(velocity) @ C.T
    slope = twist[:3, :3] - turn @ pose[3:, 3:] @ turn.T
    # Of the slope of a cubic through nine positions, doubled.
    std = np.sqrt(np.linalg.eigvalsh(slope))
    np.testing.assert_allclose(std, [0.135, 0.135, 0.338], rtol=0.05)


def test_the_maps_origin_is_the_first_fix(made: Path, tmp_path: Path) -> None:
    bag = convert(made, tmp_path / "bag", "--outage 0 3")
    _, fix = messages(bag, "/gnss/fix")
    _, (datum,) = messages(bag, "/truth/datum")

    assert (datum.latitude, datum.longitude, datum.altitude) == (
        fix[0].latitude,
        fix[0].longitude,
        fix[0].altitude,
    )
    with BagReader(bag) as reader:
        log = [log_ns for _, log_ns, _ in reader.raw()]
        assert log == sorted(log)


def test_fixes_without_noise_are_the_reference(made: Path, tmp_path: Path) -> None:
    bag = convert(made, tmp_path / "bag", "--gnss-noise 0 0 0 --gnss-rate 10")
    t, position = fix_positions(bag)
    _, fix = messages(bag, "/gnss/fix")

    np.testing.assert_allclose(position, ned(truth_at(t)), atol=1e-6)
    # No fix is perfect: the reference's own error remains.
    np.testing.assert_allclose(
        np.diag(fix[0].position_covariance.reshape(3, 3)), np.square([0.02, 0.02, 0.05])
    )


def test_time_offset_brings_the_reference_to_the_imus_clock(made: Path, tmp_path: Path) -> None:
    plain = convert(made, tmp_path / "plain")
    moved = convert(made, tmp_path / "moved", "--time-offset -0.37")

    for topic in ("/gnss/fix", "/truth/odometry"):
        np.testing.assert_allclose(
            messages(moved, topic)[0], messages(plain, topic)[0] - 0.37, atol=2e-9
        )
    np.testing.assert_array_equal(messages(moved, "/imu/data")[0], messages(plain, "/imu/data")[0])


def test_seed_and_outages(made: Path, tmp_path: Path) -> None:
    options = ["--seed 3", "--seed 3 --outage 4 2 --outage 10.1 0.2", "--seed 4"]
    bags = [convert(made, tmp_path / str(n), text) for n, text in enumerate(options)]
    (t, whole), (t_left, left), (_, other) = map(fix_positions, bags)

    gone = sorted(set(t.round(6)) - set(t_left.round(6)))
    np.testing.assert_allclose(gone, [*np.arange(4.0, 6.0 - 1e-9, 0.2), 10.2])
    np.testing.assert_array_equal(left, whole[np.isin(t.round(6), t_left.round(6))])
    assert np.abs(other - whole).min() > 0.0


def test_an_outage_without_fixes_is_said(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert(made, tmp_path / "bag", "--outage 1000 10")

    assert "--outage 1000 10: no fix lies in it: the fixes span" in capsys.readouterr().err


def test_same_call_same_bytes(made: Path, tmp_path: Path) -> None:
    first, again = (
        convert(made, tmp_path / f"{n}.mcap", "--gnss-rate 1 --seed 9") for n in range(2)
    )

    assert first.read_bytes() == again.read_bytes()


@pytest.mark.parametrize(("rate", "every"), [(10.0, 1), (5.0, 2), (2.0, 5), (1.0, 10)])
@pytest.mark.parametrize("actual_rate", [10.0, 9.93])
def test_rates_that_divide_use_whole_epochs(rate: float, every: int, actual_rate: float) -> None:
    count = np.arange(1001)
    rows, slots = pick_epochs(7.0 + count / actual_rate + 0.01 * np.sin(count), rate)

    np.testing.assert_array_equal(rows, count[::every])
    np.testing.assert_array_equal(slots, rows / every)


def test_a_missing_epoch_gives_no_fix_and_moves_none() -> None:
    t = np.delete(np.arange(101) / 10.0, [3, 52, 53])
    rows, slots = pick_epochs(t, 5.0)

    np.testing.assert_allclose(t[rows.astype(int)], slots / 5.0)
    assert set(range(51)) - set(slots) == {26}


def test_other_rates_interpolate_but_not_over_a_gap() -> None:
    t = np.delete(np.arange(101) / 10.0, [52, 53])
    rows, slots = pick_epochs(t, 4.0)

    np.testing.assert_allclose(np.interp(rows, np.arange(t.size), t), slots / 4.0, atol=1e-12)
    assert set(range(41)) - set(slots) == {21}
    with pytest.raises(InputError, match="10 epochs a second"):
        pick_epochs(t, 20.0)


@given(st.integers(0, 10_000))
def test_the_derivative_of_a_cubic_is_exact_over_gaps_and_jitter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.choice(np.arange(60), 40, replace=False)) / 10.0 + rng.uniform(0, 0.02, 40)
    coefficients = rng.normal(size=(3, 3))  # a square: the fit drops to it where epochs are few
    position = np.vander(t, 3) @ coefficients
    velocity, gain = differentiate(t, position)

    np.testing.assert_allclose(
        velocity, np.vander(t, 3)[:, 1:] @ (coefficients[:2].T * [2, 1]).T, atol=1e-8
    )
    assert (gain > 0.0).all()


# --- other datasets -------------------------------------------------------------------------------


def pixhawk_example() -> str:
    """The example at the end of the shipped map, its comment signs taken off."""
    _, _, example = MAP.read_text().partition("# --- Example")
    return "\n".join(
        line[2:]
        for line in example.splitlines()
        if line.startswith("# ") and not line.startswith("# ---")
    )


def test_the_maps_example_reads_a_pixhawks_log(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    (tmp_path / "map.yaml").write_text(pixhawk_example())
    t = np.arange(2001) / 100.0
    truth = truth_at(t)
    start = 5_000_000.0  # us since the autopilot's start
    write_csv(
        folder / "log_17_sensor_combined_0.csv",
        "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,"
        "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]",
        np.column_stack([start + 1e6 * t, truth.angular_rate_b, 0 * t, truth.specific_force_b]),
    )
    write_csv(
        folder / "log_17_vehicle_attitude_0.csv",
        "timestamp,q[0],q[1],q[2],q[3]",
        np.column_stack([start + 1e6 * t, truth.quat_xyzw[:, [3, 0, 1, 2]]]),
    )
    t = np.arange(101) / 5.0
    lla = truth_at(t).lla * [1e7 * 180.0 / np.pi, 1e7 * 180.0 / np.pi, 1e3]
    no_fix_yet = np.array([[start - 2e5, 0.0, 0.0, 0.0]])
    write_csv(
        folder / "log_17_vehicle_gps_position_0.csv",
        "timestamp,lat,lon,alt_ellipsoid",
        np.vstack([no_fix_yet, np.column_stack([start + 1e6 * t, np.rint(lla)])]),
    )

    options = f"--map {tmp_path / 'map.yaml'} --gnss-noise 0 0 0 --outage 2 1"
    bag = convert(folder, tmp_path / "bag", options)

    stamps, imu = messages(bag, "/imu/data")
    np.testing.assert_allclose(stamps[0], 5.0)
    force = vectors([m.linear_acceleration for m in imu])
    np.testing.assert_allclose(force, truth.specific_force_b * FLIP, atol=1e-9)
    stamps, position = truth_positions(bag)
    np.testing.assert_allclose(position, ned(truth_at(stamps - 5.0)), atol=0.02)
    _, found = messages(bag, "/truth/odometry")
    velocity = np.linalg.norm(vectors([m.twist.twist.linear for m in found]), axis=1)
    expected = np.linalg.norm(truth_at(stamps - 5.0).velocity_n, axis=1)
    np.testing.assert_allclose(velocity[2:-2], expected[2:-2], atol=0.8)  # at 5 Hz
    fixes, position = fix_positions(bag)
    np.testing.assert_allclose(position, ned(truth_at(fixes - 5.0)), atol=0.02)
    assert not ((fixes > 6.99) & (fixes < 7.99)).any()  # times count from the bag's beginning
    assert fixes.size == 101 - 5


def test_another_layout_without_header_attitude_or_usual_units(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    t = np.arange(1001) / 50.0
    truth = truth_at(t)
    turned = truth.specific_force_b * FLIP @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned_rate = truth.angular_rate_b * FLIP @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    write_csv(
        folder / "imu.txt", "", np.column_stack([1e3 * t + 77, turned / 9.80665, turned_rate]), "\t"
    )
    t = np.arange(201) / 10.0
    enu = ned(truth_at(t))[:, [1, 0, 2]] * [1, 1, -1]
    write_csv(folder / "track.txt", "when x y z", np.column_stack([t, 100.0 * enu]), "  ")
    (tmp_path / "map.yaml").write_text("""
imu:
  file: imu.txt
  delimiter: tab
  header: no
  time: {column: 1, unit: 0.001, starts: at zero}
  specific_force: {columns: [2, 3, 4], unit: g}
  angular_rate: {columns: [5, 6, 7], unit: rad/s}
  axes: [-y, x, z]
position:
  file: track.txt
  delimiter: space
  time: {column: when, unit: s}
  columns: [x, y, z]
  unit: cm
  frame: enu
  origin: [32.8257, 34.9560, 10.0]
  std: [0.02, 0.02, 0.05]
""")
    bag = convert(folder, tmp_path / "bag", f"--map {tmp_path / 'map.yaml'}")

    stamps, imu = messages(bag, "/imu/data")
    assert stamps[0] == 0.0
    force = vectors([m.linear_acceleration for m in imu])
    np.testing.assert_allclose(force, truth.specific_force_b * FLIP, atol=1e-9)
    assert {m.orientation_covariance[0] for m in imu} == {-1.0}
    stamps, position = truth_positions(bag)
    np.testing.assert_allclose(position, ned(truth_at(stamps)), atol=1e-6)
    _, found = messages(bag, "/truth/odometry")
    assert not vectors([m.pose.pose.orientation for m in found], "xyzw").any()  # not known
    assert not vectors([m.twist.twist.linear for m in found]).any()


# --- faulty rows ----------------------------------------------------------------------------------


def edit(path: Path, line: int, change: Callable[[str], str]) -> None:
    lines = path.read_text().split("\n")
    lines[line - 1] = change(lines[line - 1])
    path.write_text("\n".join(lines))


def field(position: int, value: str) -> Callable[[str], str]:
    def change(line: str) -> str:
        fields = line.split(",")
        fields[position] = value
        return ",".join(fields)

    return change


FAULTS = [
    ("IMU_1.csv", lambda line: line[:40], "wrong number of fields: row dropped"),
    ("IMU_1.csv", lambda line: line + ",1", "wrong number of fields: row dropped (11, not 10)"),
    ("IMU_1.csv", field(4, "abc"), "not a number: row dropped ('abc')"),
    ("IMU_1.csv", field(7, ""), "not a number: row dropped ('')"),
    ("IMU_1.csv", field(9, "nan"), "NaN or infinity: row dropped"),
    ("IMU_1.csv", field(0, "inf"), "NaN or infinity: row dropped"),
    ("IMU_1.csv", field(0, "0.025"), "time stamp goes back: row dropped (0.025000 s)"),
    ("IMU_1.csv", field(0, "0.041666666666666664"), "repeated time stamp: row dropped"),
    ("IMU_1.csv", field(0, "1e6"), "time stamp leaps ahead: row dropped"),
    ("IMU_1.csv", field(5, "1e4"), "reading beyond 1000 m/s2 or 100 rad/s: row dropped"),
    ("IMU_1.csv", field(8, "-1e4"), "reading beyond 1000 m/s2 or 100 rad/s: row dropped"),
    ("GT.csv", field(8, "?"), "not a number: row dropped ('?')"),
    ("GT.csv", field(3, "NaN"), "NaN or infinity: row dropped"),
]


@pytest.mark.parametrize(("name", "change", "report"), FAULTS, ids=[f[2] for f in FAULTS])
def test_a_faulty_row_is_named_and_left_out(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    change: Callable[[str], str],
    report: str,
) -> None:
    edit(flight / name, 8, change)

    bag = convert(flight, tmp_path / "bag")

    warnings = capsys.readouterr().err.splitlines()
    place = f"ins_convert: warning: {flight / name}"
    assert warnings[0].startswith(f"{place}:8: {report}")
    assert all(w.startswith((f"{place}:8: gap", f"{place}:9: gap")) for w in warnings[1:])
    imu_t, _ = messages(bag, "/imu/data")
    truth_t, _ = messages(bag, "/truth/odometry")
    assert (np.diff(imu_t) > 0.0).all()
    assert (np.diff(truth_t) > 0.0).all()
    assert imu_t.size == 2401 - (name == "IMU_1.csv")
    # A missing attitude is bridged, a missing position is not made up.
    assert truth_t.size == 201 - ("'?'" in report)


def test_a_skipped_stamp_is_named_and_left_open(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (flight / "IMU_1.csv").read_text().split("\n")
    (flight / "IMU_1.csv").write_text("\n".join(lines[:100] + lines[102:]))

    convert(flight, tmp_path / "bag")

    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.endswith(
        "IMU_1.csv:101: gap before this row: left open (25.0 ms instead of 8.3 ms)"
    )


def test_many_faults_of_a_kind_are_counted(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for line in range(20, 60):
        edit(flight / "IMU_1.csv", line, field(4, "x"))

    convert(flight, tmp_path / "bag")

    warnings = capsys.readouterr().err.splitlines()
    assert len(warnings) == 5 + 1 + 1  # five rows, one gap, and how many rows more
    assert "35 more rows: not a number: row dropped" in warnings[-1]


@given(data=st.data())
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_no_text_breaks_the_reader(tmp_path: Path, data: st.DataObject) -> None:
    """Whatever stands in the file: rows that are read are sound, the others are counted."""
    good = [f"{0.1 * k},{k},{-k}" for k in range(20)]
    junk = data.draw(
        st.lists(
            st.tuples(
                st.integers(0, 19),
                st.one_of(
                    st.text(max_size=30),
                    st.sampled_from(["1,2", "1,2,3,4", "nan,1,2", "0.35,1,1", "0.1,0,0", '"0.1,1']),
                    st.tuples(*[st.floats()] * 3).map(lambda v: ",".join(map(repr, v))),
                ),
            ),
            max_size=10,
        )
    )
    lines = good.copy()
    for place, text in junk:
        lines.insert(place, text)
    path = tmp_path / "table.csv"
    path.write_text("\n".join(["t,a,b", *lines]), encoding="utf-8", errors="replace")
    faults = Faults()

    try:
        table = read_table(path, CsvFormat(), "t", 1.0, ["a", "b"], faults)
    except InputError:
        return

    assert (np.diff(table.t) > 0.0).all()
    assert np.isfinite(table.values).all()
    assert (np.diff(table.line) > 0).all()
    assert table.values.shape == (table.t.size, 2)


@pytest.mark.parametrize("header", [True, False], ids=["header", "no header"])
@pytest.mark.parametrize("first", ["", "# logged by hand", "t,a"])
def test_a_first_line_that_is_too_short_is_named(tmp_path: Path, header: bool, first: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{first}\n0.0,1,2\n0.1,1,2\n" if first else "\n")
    columns: list[str | int] = [2, 3]
    with pytest.raises(InputError, match=r"table\.csv:1: no column 3: the first line has \d field"):
        read_table(path, CsvFormat(has_header=header), 1, 1.0, columns, Faults())


# --- files that are no good at all ----------------------------------------------------------------


def scale(path: Path, columns: slice, factor: float) -> None:
    header, *lines = path.read_text().split() if False else path.read_text().splitlines()
    table = np.array([line.split(",") for line in lines], float)
    table[:, columns] *= factor
    write_csv(path, header, table)


BAD_FILES: list[tuple[str, Callable[[Path], object], str]] = [
    ("gone", lambda f: (f / "GT.csv").unlink(), "GT.csv: No such file"),
    ("no IMU", lambda f: (f / "IMU_1.csv").unlink(), "IMU_1.csv: no such file"),
    ("empty", lambda f: (f / "GT.csv").write_text(""), "no column 'time'; the header has an empty"),
    (
        "two samples",
        lambda f: (f / "IMU_1.csv").write_text(
            "\n".join((f / "IMU_1.csv").read_text().splitlines()[:3]) + "\n"
        ),
        "its 2 usable rows span 0.00833 s, no two epochs of GT.csv: too few",
    ),
    ("header only", lambda f: (f / "GT.csv").write_text(GT_HEADER), "0 usable rows: too few"),
    ("binary", lambda f: (f / "IMU_1.csv").write_bytes(bytes(range(256)) * 50), "IMU_1.csv: no "),
    (
        "column missing",
        lambda f: edit(f / "IMU_1.csv", 1, lambda h: h.replace("Gyr_Y", "Gyr_2")),
        "no column 'Gyr_Y'; the header has time, Euler_X",
    ),
    (
        "column twice",
        lambda f: edit(f / "IMU_1.csv", 1, lambda h: h.replace("Gyr_Y", "Gyr_X")),
        "2 columns are called 'Gyr_X'",
    ),
    ("in g", lambda f: scale(f / "IMU_1.csv", slice(4, 7), 0.102), "check its unit"),
    ("in mg", lambda f: scale(f / "IMU_1.csv", slice(4, 7), 102.0), "units of specific_force"),
    (
        "rad/s",
        lambda f: scale(f / "IMU_1.csv", slice(7, 10), np.pi / 180),
        "0.0175 times as fast as the attitude",
    ),
    (
        "deg/s",
        lambda f: scale(f / "IMU_1.csv", slice(7, 10), 180 / np.pi),
        "57.4 times as fast as the attitude",
    ),
    ("time in ms", lambda f: scale(f / "IMU_1.csv", slice(0, 1), 1e3), "check the unit of time"),
    ("km", lambda f: scale(f / "GT.csv", slice(7, 10), 1e3), "check the units of position"),
]


@pytest.mark.parametrize(
    ("damage", "words"), [b[1:] for b in BAD_FILES], ids=[b[0] for b in BAD_FILES]
)
def test_unusable_files_end_in_one_line_and_no_bag(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[Path], object],
    words: str,
) -> None:
    damage(flight)

    last = refused([str(flight), str(tmp_path / "bag")], capsys)

    assert last.startswith("ins_convert: error: ")
    assert words in last
    assert not (tmp_path / "bag").exists()


def test_wrong_axes_are_noticed(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.yaml").write_text(MAP.read_text().replace("axes: flu", "axes: frd"))

    convert(made, tmp_path / "bag", f"--map {tmp_path / 'map.yaml'}")

    (warning,) = capsys.readouterr().err.splitlines()
    assert re.search(r"specific force is 1[67]\d degrees off the vertical of GT.csv", warning)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("FLIGHT OUT --imu 2", "IMU_2.csv: no such file; there are IMU_1.csv"),
        ("FLIGHT/nowhere OUT", "nowhere: no such directory"),
        ("FLIGHT OUT --gnss-rate 20", "the reference has 10 epochs a second"),
        ("FLIGHT OUT --outage 0 100", "no GNSS fix is left"),
        ("FLIGHT OUT --outage 5 -1", "--outage 5 -1"),
        ("FLIGHT OUT --time-offset 100", "no time in common"),
        ("FLIGHT OUT --time-offset soon", "--time-offset"),
        ("FLIGHT OUT --gnss-noise 1 -1 1", "--gnss-noise"),
        ("FLIGHT OUT --map nowhere.yaml", "nowhere.yaml: No such file"),
        ("FLIGHT OUT --imu one", "--imu"),
        ("FLIGHT FLIGHT", "exists"),
    ],
)
def test_wrong_arguments(
    made: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    words: str,
) -> None:
    given = arguments.replace("FLIGHT", str(made)).replace("OUT", str(tmp_path / "bag"))

    assert words in refused(given.split(), capsys)
    assert not (tmp_path / "bag").exists()
    assert (made / "GT.csv").exists()


# --- column maps ----------------------------------------------------------------------------------


def changed(path: str, value: object) -> dict[str, Any]:
    """The shipped map with one entry set, or taken out (None)."""
    content = yaml.safe_load(MAP.read_text())
    *parents, last = path.split(".")
    place = content
    for name in parents:
        place = place[name]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return dict(content)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("imu", None, "imu is missing"),
        ("imu", "IMU.csv", "imu holds no entries"),
        ("imu.file", None, "imu.file is missing"),
        ("imu.file", 7, "imu.file must be a text"),
        ("imu.fil", "x", "imu.fil is not an entry of a column map; known here: "),
        ("imu.time.unit", None, "imu.time.unit is missing"),
        ("imu.time.unit", "seconds", "imu.time.unit must be a unit of time (s, ms, us, ns)"),
        ("imu.time.unit", -1, "imu.time.unit must be a unit of time"),
        ("imu.angular_rate.unit", "m/s2", "must be a unit of rate (rad/s, deg/s)"),
        ("imu.angular_rate.columns", ["a", "b"], "must be 3 columns, not 2"),
        ("imu.angular_rate.columns", ["a", "b", 0], "must be a list of column names"),
        ("imu.axes", "fru", "imu.axes must be flu, frd, or"),
        ("imu.axes", ["x", "y", "-z"], "right-handed"),
        ("imu.axes", ["x", "x", "z"], "right-handed"),
        ("imu.delimiter", ",,", "imu.delimiter must be one character"),
        ("imu.orientation.std", [1, 2], "imu.orientation.std must be a list of 3"),
        ("imu.orientation.std", [1, 2, "some"], "imu.orientation.std must be a list of 3 numbers"),
        ("imu.orientation.frames", "ned", "'frd in ned' or 'flu in enu'"),
        ("position.frame", "utm", "'ned' or 'enu' or 'lla'"),
        ("position.origin", None, "position.origin is missing"),
        ("position.origin", [132.0, 35.0, 0.0], "position.origin must be latitude [deg]"),
        ("position.std", [0.0, 1.0, 1.0], "position.std must be a list of 3 numbers above zero"),
        ("position.unit", ["m", "m"], "position.unit must be one unit, or a list of 3"),
        ("attitude.delay", "late", "attitude.delay must be a number"),
        ("epoch", True, "epoch must be a number"),
        ("attitudes", {}, "attitudes is not an entry"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path: Path, path: str, value: object, words: str) -> None:
    file = tmp_path / "map.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)))

    with pytest.raises(InputError, match=re.escape(words)) as caught:
        load_map(file)

    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file holds no entries"),
        ("[1, 2]", "the file holds no entries"),
        ("imu: [", "no readable YAML"),
        ("imu: &a {x: *a}", "aliases"),
        ("\x00", "no readable YAML"),
        ("!!python/object/apply:os.getcwd []", "no readable YAML"),
        ("a: 1\n" * 40_000, "larger than"),
    ],
)
def test_what_is_no_map_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "map.yaml").write_text(text)

    with pytest.raises(InputError, match=words):
        load_map(tmp_path / "map.yaml")


@pytest.mark.parametrize("name", ["quadrotor.yaml", "quadrotor_extended.yaml"])
def test_shipped_maps_load(name: str) -> None:
    load_map(MAP.with_name(name))


# --- the recorded flights -------------------------------------------------------------------------

SESSIONS = ["Horizontal/path_4", "Horizontal/path_16", "StraightLine/path_1"]


def integral(t: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Integral of samples (N, 3) from their first epoch to given times."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t)[:, None]
    total = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return np.stack([np.interp(at, t, axis) for axis in total.T], axis=-1)


def rates_at_offset(
    imu: ImuSeries, attitude: AttitudeSeries, offset: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gyroscope and attitude, mean rates over the same intervals, for an offset of the clocks."""
    t = attitude.t + offset
    inside = (t[:-1] > imu.t[0]) & (t[1:] < imu.t[-1])
    measured = np.diff(integral(imu.t, imu.angular_rate_b, t), axis=0) / np.diff(t)[:, None]
    return measured[inside], attitude.angular_rate_b[inside]


def clock_offset(imu: ImuSeries, attitude: AttitudeSeries) -> float:
    """IMU clock minus attitude clock [s] at which the rates agree best."""

    def misfit(offset: float) -> float:
        measured, reference = rates_at_offset(imu, attitude, offset)
        return float(np.mean(np.var(measured - reference, axis=0)))

    coarse = min(np.arange(-1.0, 1.0, 0.02), key=misfit)
    return float(min(coarse + np.arange(-0.02, 0.02, 0.002), key=misfit))


@pytest.mark.parametrize("name", SESSIONS)
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_gyroscope_and_accelerometer_agree_with_the_reference(
    flights: Path, name: str, number: int
) -> None:
    """Axes, signs and units: rates against the attitude, forces against the position."""
    layout, faults = load_map(MAP), Faults()
    assert layout.attitude is not None
    imu = read_imu(flights / name, layout.imu, number, faults)
    position = read_position(flights / name, layout.position, faults)
    attitude = read_attitude(flights / name, layout.attitude, faults)  # in the position's clock

    offset = clock_offset(imu, attitude)
    measured, reference = rates_at_offset(imu, attitude, offset)
    for axis in range(3):
        assert np.corrcoef(measured[:, axis], reference[:, axis])[0, 1] > 0.95
    # The matrix between them is that of a mount within a few degrees.
    mount = np.linalg.lstsq(reference, measured - measured.mean(0), rcond=None)[0]
    np.testing.assert_allclose(mount, np.eye(3), atol=0.12)

    quat, _ = attitude.at(imu.t - offset)
    force_n = (matrix_from_quat(quat) @ imu.specific_force_b[..., None])[..., 0]
    t = position.t + offset
    velocity, _ = differentiate(position.t, LocalFrame(ORIGIN).position(position.lla))
    inside = (t[:-10] > imu.t[0]) & (t[10:] < imu.t[-1])
    change = (velocity[10:] - velocity[:-10])[inside]  # over a second
    felt = integral(imu.t, force_n - STANDING_N, t)
    felt = (felt[10:] - felt[:-10])[inside]
    assert np.abs((felt - change).mean(0)).max() < 1.0
    if name == "StraightLine/path_1":  # hardly accelerates
        return
    # The IMU swings about the reference point, some decimetres away from it.
    C_before, C_after = (matrix_from_quat(attitude.at(position.t + d)[0]) for d in (-0.1, 0.1))
    swing = (C_after - C_before) / 0.2
    swing = (swing[10:] - swing[:-10])[inside]
    for axis in range(2):
        model = np.column_stack([change[:, axis], swing[:, axis], np.ones(len(change))])
        (gain, *lever_b, _), (misfit,), _, _ = np.linalg.lstsq(model, felt[:, axis], rcond=None)
        assert gain == pytest.approx(1.0, abs=0.12)
        assert misfit / np.sum(felt[:, axis] ** 2) < 0.05
        assert np.linalg.norm(lever_b) < 0.6


@pytest.mark.slow
def test_every_recorded_flight_converts(flights: Path, tmp_path: Path) -> None:
    folders = sorted(flights.glob("*/path_*"))
    assert len(folders) == 13
    for k, folder in enumerate(folders):
        bag = convert(folder, tmp_path / "bag", f"--imu {k % 4 + 1} --gnss-rate 1 --overwrite")
        with BagReader(bag) as reader:
            seconds = (reader.end_ns - reader.start_ns) * 1e-9
            assert reader.count("/imu/data") == pytest.approx(120.0 * seconds, rel=0.01)
            assert reader.count("/truth/odometry") == pytest.approx(10.0 * seconds, rel=0.01)
            assert reader.count("/gnss/fix") == pytest.approx(seconds, abs=1.5)


def test_the_repeated_stamps_of_flight_4_are_named(
    flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert(flights / "Horizontal/path_4", tmp_path / "bag", "--imu 4")

    warnings = capsys.readouterr().err
    for line in (1308, 1335):
        assert f"IMU_4.csv:{line}: repeated time stamp: row dropped" in warnings
    for line in (1307, 1334):
        assert f"IMU_4.csv:{line}: gap before this row: left open (16.7 ms" in warnings


def test_latitude_and_longitude_give_the_same_flight(flights: Path, tmp_path: Path) -> None:
    folder = flights / "StraightLine/path_1"
    local = convert(folder, tmp_path / "local")
    extended = MAP.with_name("quadrotor_extended.yaml")
    geodetic = convert(folder, tmp_path / "geodetic", f"--map {extended}")

    (t, first), (t_geodetic, second) = truth_positions(local), truth_positions(geodetic)

    np.testing.assert_allclose(t_geodetic, t, atol=1e-6)
    np.testing.assert_allclose(second - second[0], first - first[0], atol=1e-4)
