"""``ins_calibrate``: its compiled pass is the filter's, and it finds what was put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import scene

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.calibrate import Calibration, add_lever_arm, calibrate
from hybrid_ins.calibration.clock import observe_delay
from hybrid_ins.calibration.derived import courses, next_biases
from hybrid_ins.calibration.filter_pass import FilterPass, Nominal
from hybrid_ins.calibration.findings import Finding, Findings
from hybrid_ins.calibration.innovations import (
    N_SAID,
    POSITION,
    empty_states,
    gaussian_scale,
    innovations,
    log_likelihood,
)
from hybrid_ins.calibration.likelihood import LEVER
from hybrid_ins.calibration.loudness import ordinary_levels, read_levels
from hybrid_ins.calibration.placement import antenna_is_base
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.report import table
from hybrid_ins.calibration.smoothed_pass import smoothed_pass
from hybrid_ins.cli.calibrate import main
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec
from hybrid_ins.core.inertial.state import N_NAV, PSD, NavState
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.parameters import parameter_file
from hybrid_ins.ros.messages.conversions import FLIP, first_biases
from hybrid_ins.simulation import motions, sensors

Array = NDArray[np.float64]

RATE = 100.0
LEVER_B = np.array([0.3, -0.2, -0.5])
STD = np.array(sensors.RTK_STD)


def a_run(
    offset: float = 0.0,
    seed: int = 0,
    duration: float = 45.0,
    standing: bool = False,
) -> Recording:
    """A simulated recording whose fixes are stamped ``offset`` early."""
    trajectory = (
        motions.static(duration) if standing else motions.quadrotor_flight(duration, seed=seed)
    )
    fix_times = np.arange(0.37, duration - 0.2, 0.2)
    seen = scene(trajectory, seed=seed, fix_times=fix_times, lever_arm_b=LEVER_B)
    M = len(fix_times)
    return Recording(
        "simulated",
        seen.t,
        np.hstack((seen.force, seen.rate)),
        seen.fix_t - offset,
        np.full(M, POSITION),
        seen.fix_lla,
        np.tile(seen.covariance, (M, 1, 1)),
    )


def run_pass(run: Recording, nav: Array, tail: float = 0.0) -> tuple[Array, Array, Array]:
    M = len(run.aid_t)
    z, S, nis = np.empty((M, 3)), np.empty((M, 3, 3)), np.empty(M)
    innovations(
        nav,
        run.t,
        run.samples,
        np.ones((len(run.t), 2)),
        run.aid_t,
        run.aid_kind,
        run.aid,
        run.aid_R,
        np.zeros((M, 3)),
        LEVER_B,
        0.01 - 1e-6,
        tail,
        z,
        S,
        nis,
        empty_states(),
        np.empty((0, N_SAID)),
    )
    return z, S, nis


def first_state(run: Recording) -> NavState:
    truth = sensors.sample(motions.quadrotor_flight(10.0, seed=0), np.array([0.0]))
    P = np.diag(np.repeat([1.0, 0.25, 0.01, 0.01, 1e-4], 3))
    return NavState(
        truth.lla[0], truth.velocity_n[0], truth.quat_xyzw[0], np.zeros(3), np.zeros(3), P
    )


def test_compiled_pass_is_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    # GIVEN one recording and one first state, and no weights: the pass has its own for outliers
    monkeypatch.setattr("hybrid_ins.core.update.gate.weight", lambda nis, m: 1.0)
    monkeypatch.setattr(Gate, "ordinary_limit", lambda *_: -1.0)  # weights compiled in
    run = a_run(duration=10.0)
    initial = first_state(run)
    psd = np.repeat([4e-6, 4e-8, 1e-6, 1e-8], 3)
    nav = initial.to_flat()
    nav[PSD] = psd
    # WHEN the pass and the filter run over it
    _, _, nis = run_pass(run, nav)
    stamps = np.round(run.t * 1e9).astype(np.int64) + 10**9
    samples = np.zeros(len(stamps), SAMPLE_DTYPE)
    samples["t_ns"], samples["f"], samples["w"] = stamps, run.samples[:, :3], run.samples[:, 3:]
    own = InsFilter(
        initial,
        int(stamps[0]),
        run.samples[0],
        FilterNoise(ConstantNoise(psd[:6]), ProcessNoise(psd[6:], 1.0)),
        Gate(dict.fromkeys((1, 2, 3), 1e9), 3.0),
        ImuRing(),
        FilterSettings(0.01),
    )
    for k in range(len(run.aid_t)):
        own.submit(
            PositionFix(round(run.aid_t[k] * 1e9) + 10**9, run.aid[k], run.aid_R[k], LEVER_B)
        )
    own.predict_block(samples[1:])
    # THEN both judge every fix alike
    expected = np.array([verdict.nis for verdict in own.verdicts])
    np.testing.assert_allclose(nis[: len(expected)], expected, rtol=1e-5)


def test_gaussian_innovations_are_the_likeliest_at_their_own_covariance() -> None:
    z = np.random.default_rng(0).standard_normal((20000, 3))
    scales = np.array([0.9, 0.95, 1.0, 1.05, 1.1])
    for tail in (0.0, 8.0):
        totals = [
            np.sum(
                log_likelihood(
                    z, np.tile(np.eye(3) * s, (len(z), 1, 1)), np.sum(z**2, axis=1) / s, tail
                )
            )
            for s in scales
        ]
        assert scales[int(np.argmax(totals))] == 1.0
    assert gaussian_scale(1e4, 3) == pytest.approx(1e4, rel=1e-2)


@pytest.fixture(scope="module")
def found() -> Calibration:
    return calibrate([a_run(0.23, seed=1), a_run(0.23, seed=2)], parameters.defaults(), search=0.5)


def test_offset_and_lever_arm_are_found(found: Calibration) -> None:
    fitted = found.fitted
    assert abs(fitted.value("offset") - 0.23) < max(0.01, 3.5 * fitted.sigma("offset"))
    for axis, true in zip("xyz", LEVER_B, strict=True):
        name = f"lever_{axis}"
        if name not in fitted.frozen:
            assert abs(fitted.value(name) - true) < 4.0 * fitted.sigma(name) + 0.01
    assert found.findings[0].verdict == "identified"
    assert "identified" in table(found.findings)


def test_fixes_that_arrive_late_are_allowed_for() -> None:
    late = replace(a_run(duration=10.0), delay=np.linspace(0.1, 1.5, 50))
    changed = {"gnss.max_delay": pytest.approx(1.9)}
    assert observe_delay([late], [0.0], 1.0) == Finding(
        "delay of the fixes", "1.49 s", "", "identified", ANY, changed
    )
    assert observe_delay([late], [0.9], 1.0) is None  # the offset is most of it
    assert observe_delay([a_run(duration=10.0)], [0.0], 1.0) is None  # not known
    far = observe_delay([replace(late, delay=np.full(9, 8.0))], [0.0], 1.0)
    assert far is not None and far.verdict == "weak" and far.values["gnss.max_delay"] == 5.0


@pytest.mark.slow
def test_a_measured_antenna_is_kept_where_the_motion_agrees(found: Calibration) -> None:
    # GIVEN a place of the antenna that is right but for half a metre along one axis
    wrong_b = LEVER_B + np.array([0.5, 0.0, 0.0])
    values = {**parameters.defaults(), "gnss.antenna_position": (FLIP @ wrong_b).tolist()}
    # WHEN recordings are calibrated
    fitted = calibrate([a_run(0.23, seed=1), a_run(0.23, seed=2)], values, search=0.5).fitted
    # THEN that axis is found, and the others stay, whose estimates would have scattered
    assert abs(fitted.value("lever_x") - LEVER_B[0]) < 4.0 * fitted.sigma("lever_x") + 0.01
    for axis, measured in zip("yz", LEVER_B[1:], strict=True):
        name = f"lever_{axis}"
        assert fitted.value(name) == pytest.approx(measured, abs=1e-9)
        assert abs(found.fitted.value(name) - measured) > 1e-3


@pytest.mark.slow
def test_a_second_pass_stays_within_the_deviations(found: Calibration) -> None:
    # GIVEN a calibration, WHEN the same recordings are calibrated from its result
    again = calibrate([a_run(0.23, seed=1), a_run(0.23, seed=2)], found.values, search=0.5)
    # THEN clock offset and lever arm stay where they are, as far as they are known
    for name in ("offset", "lever_x", "lever_y", "lever_z"):
        if name not in found.fitted.frozen:
            moved = again.fitted.value(name) - found.fitted.value(name)
            assert abs(moved) < found.fitted.sigma(name), name


def test_smoothing_sharpens_the_direction_of_travel() -> None:
    # GIVEN a car, which moves along its nose, and a filter with known parameters
    motion = motions.car_drive(60.0, seed=3)
    seen = scene(motion, seed=3, fix_times=np.arange(0.37, 59.0, 0.2), lever_arm_b=LEVER_B)
    M = len(seen.fix_t)
    covariance = np.tile(seen.covariance, (M, 1, 1))
    samples = np.hstack((seen.force, seen.rate))
    kind = np.full(M, POSITION)
    run = Recording("car", seen.t, samples, seen.fix_t, kind, seen.fix_lla, covariance)
    found = calibrate([run], parameters.defaults(), search=0.3, nose_first=True)
    fitted = found.fitted
    # WHEN its states are smoothed
    biases = first_biases(parameters.defaults())
    nominal = Nominal(0.0, np.zeros(3), 4e-6, 4e-8, 1e-3, 1e-5, *biases)
    smoothed = smoothed_pass(fitted, nominal, 0, found.after[0])
    # THEN the directions of travel in the vehicle scatter less, and their mean is nearer to zero
    before, after = courses(found.after[0]), courses(smoothed)
    assert after.std() < 0.7 * before.std()
    assert abs(after.mean()) < max(0.7 * abs(before.mean()), 0.002)
    # AND the calibrated mount is that of the smoothed ones
    assert abs(found.values["imu.mount_rpy"][2]) == pytest.approx(abs(after.mean()), abs=2e-3)


def test_the_imu_is_placed_where_the_fixes_are_of_the_base_frame(
    found: Calibration, tmp_path: Path
) -> None:
    # GIVEN a recording whose fixes come in the base frame
    bag = tmp_path / "bag.mcap"
    message = new_message("sensor_msgs/msg/NavSatFix")
    message.header.frame_id = "base_link"
    with BagWriter(bag) as out:
        out.write("/gnss/fix", message, 1)
    values = parameters.defaults()
    assert antenna_is_base([bag], values)
    assert not antenna_is_base([bag], {**values, "gnss.antenna_position": [0.0, 0.0, 0.1]})
    # WHEN the lever arm is added
    report = Findings(dict(values))
    add_lever_arm(report, found.fitted, np.eye(3), antenna_is_base=True)
    # THEN it is the IMU that is away from the base
    arm = np.array(found.values["gnss.antenna_position"])
    np.testing.assert_allclose(report.values["imu.position"], -arm)
    assert report.values["gnss.antenna_position"] == [0.0, 0.0, 0.0]


def test_biases_are_found_for_the_next_start(found: Calibration) -> None:
    # GIVEN recordings of one IMU, its biases here in FLU
    for name, true in (
        ("accelerometer", (0.05, 0.03, -0.04)),
        ("gyroscope", (0.002, 0.003, -0.001)),
    ):
        bias, std = found.values[f"imu.{name}_bias"], found.values[f"imu.{name}_bias_std"]
        # THEN the parameters are nearer to them than the defaults, and say how near
        assert np.all(np.abs(np.subtract(bias, true)) < 3.0 * np.array(std))
        assert np.linalg.norm(np.subtract(bias, true)) < 0.7 * np.linalg.norm(true)
        assert np.max(std) < 0.6 * parameters.defaults()[f"imu.{name}_bias_std"][0]


def test_biases_that_differ_from_start_to_start_are_known_no_better_than_that() -> None:
    def last_state(bias_g: float) -> FilterPass:
        nav = NavState(
            np.zeros(3),
            np.zeros(3),
            np.array([0.0, 0.0, 0.0, 1.0]),
            np.zeros(3),
            np.full(3, bias_g),
            np.diag(np.full(15, 1e-8)),
        ).to_flat()
        return FilterPass(np.zeros((1, 3)), np.eye(3)[None], np.ones(1), nav[None, :N_NAV])

    steady = next_biases([last_state(0.01)] * 6)[1]
    spread = next_biases([last_state(0.01 + d) for d in (-0.004, 0.004, -0.002, 0.002, 0, 0)])[1]

    assert steady[0] == pytest.approx(np.full(3, 0.01))
    assert 4e-4 < steady[1][0] < 1e-3
    assert spread[0] == pytest.approx(np.full(3, 0.01), abs=1e-9)
    assert 2e-3 < spread[1][0] < 4e-3


def test_the_levels_of_ordinary_motion_become_the_background(found: Calibration) -> None:
    run = a_run(0.23, seed=1, duration=20.0)
    values = parameters.defaults()
    quiet = ordinary_levels([read_levels(run, values)])
    run.samples[:, 5] += 0.2 * np.random.default_rng(0).standard_normal(len(run.t))
    shaken = ordinary_levels([read_levels(run, values)])

    # White noise of 0.2 rad/s about the yaw axis is what is read there.
    assert quiet is not None and shaken is not None
    assert shaken[:5] == pytest.approx(quiet[:5])
    assert 0.03 < shaken[5] < 0.08
    assert found.values["noise.background_accelerometer"] == pytest.approx(quiet[:3], rel=0.7)
    assert "noise.model plateau" in found.notes["noise.background_accelerometer"]


def test_parameter_file_is_read_back(found: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(
        parameter_file.to_yaml(found.values, "calibrated", found.notes), encoding="utf-8"
    )
    assert parameter_file.load(path) == found.values
    assert "# identified: clock offset" in path.read_text(encoding="utf-8")


def test_outliers_do_not_move_the_offset() -> None:
    # GIVEN a recording in which every tenth fix is wrong by metres
    run = a_run(0.1, seed=3)
    run.aid[::10, :2] += 5.0 / 6.4e6
    # WHEN it is calibrated
    found = calibrate([run], parameters.defaults(), search=0.3)
    # THEN the offset is that of the others
    assert abs(found.fitted.value("offset") - 0.1) < 0.03


def test_standing_still_tells_nothing_and_says_so() -> None:
    found = calibrate([a_run(0.2, standing=True)], parameters.defaults(), search=0.3)
    assert found.findings[0].verdict == "not identifiable"
    assert found.values["gnss.time_offset.value"] == 0.0
    assert found.values["gnss.antenna_position"] == [0.0, 0.0, 0.0]


def test_a_bag_that_is_not_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main([str(tmp_path / "none.mcap")]) == 2
    assert "ins_calibrate: error:" in capsys.readouterr().err


@pytest.mark.parametrize("given", [[0.0, 0.0, 0.0], [0.3, 0.2, 0.5]])
def test_the_uncertainty_of_an_antenna_is_written_unless_it_was_given(
    found: Calibration, given: list[float]
) -> None:
    # GIVEN a fit in which the antenna's height is weak, and its other axes are identified
    mean = FLIP @ np.array(given)
    prior = tuple(
        replace(p, mean=float(mean["xyz".index(p.name[-1])])) if p.name in LEVER else p
        for p in found.fitted.prior
    )
    std = found.fitted.std.copy()
    for name, sigma in zip(LEVER, (0.01, 0.02, 0.2), strict=True):
        std[found.fitted.names.index(name)] = sigma
    frozen = found.fitted.frozen | {"lever_z"}
    fitted = replace(found.fitted, prior=prior, std=std, frozen=frozen)
    report = Findings(dict(parameters.defaults()))
    # WHEN the lever arm is added
    add_lever_arm(report, fitted, np.eye(3), antenna_is_base=False)
    # THEN a weak axis counts for less than its σ says, and one that was given and kept is exact
    height = 0.0 if any(given) else 0.4
    assert report.values["gnss.antenna_position_std"] == pytest.approx([0.01, 0.02, height])


def test_an_antenna_that_was_given_and_is_kept_does_not_turn_with_the_mount(
    found: Calibration,
) -> None:
    given = [1.0, 0.0, 0.8]
    prior = tuple(
        replace(p, mean=float((FLIP @ given)["xyz".index(p.name[-1])])) if p.name in LEVER else p
        for p in found.fitted.prior
    )
    fitted = replace(found.fitted, prior=prior, frozen=found.fitted.frozen | set(LEVER))
    report = Findings({**parameters.defaults(), "gnss.antenna_position": given})

    add_lever_arm(
        report,
        fitted,
        matrix_from_quat(quat_from_rotvec(np.array([0.0, 0.0, 0.5]))),
        antenna_is_base=False,
    )

    assert report.values["gnss.antenna_position"] == given
