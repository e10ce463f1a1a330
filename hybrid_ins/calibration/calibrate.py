"""
Calibration of one robot from recordings: parameters, and how well the motion determines them.

Quantities are in the user's frames and units: base_frame (forward, left, up), degrees for angles
in texts, the parameters' own units in values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.clock import (
    IDENTIFIED_OFFSET,
    NO_OFFSET,
    observe_clock,
    observe_delay,
)
from hybrid_ins.calibration.derived import (
    courses,
    mean_rotation,
    next_biases,
    rotations_to_truth,
    travel,
)
from hybrid_ins.calibration.filter_pass import FilterPass, Nominal
from hybrid_ins.calibration.findings import Finding, Findings, Verdict
from hybrid_ins.calibration.fit import CONFIRMED, KEPT, Fit, OnStage, filter_passes, fit
from hybrid_ins.calibration.fix_scatter import SCATTER, scatter_findings
from hybrid_ins.calibration.likelihood import LEVER, POSITION_SCALE, SLOW_SHARE, VELOCITY_SCALE
from hybrid_ins.calibration.loudness import ordinary_levels, read_levels, with_loudness
from hybrid_ins.calibration.misfit import misfits
from hybrid_ins.calibration.noise import noise_findings
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.smoothed_pass import smoothed_pass
from hybrid_ins.calibration.vehicle import vehicle_findings
from hybrid_ins.calibration.wheels import AXES
from hybrid_ins.core.inertial.rotations import quat_from_matrix, rpy_from_quat
from hybrid_ins.core.sensor_errors.lever_arm import PRIOR_STD
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP

Array = NDArray[np.float64]

IDENTIFIED = {  # largest σ
    "offset": IDENTIFIED_OFFSET,
    "lever_x": 0.05,
    "lever_y": 0.05,
    "lever_z": 0.05,
}
IDENTIFIED_MOUNT = math.radians(1.0)  # largest σ
NOT_IDENTIFIABLE = {  # smallest σ
    "offset": NO_OFFSET,
    "lever_x": 0.4,
    "lever_y": 0.4,
    "lever_z": 0.4,
}
MEASURED, NOT_GIVEN = 3.0, 2.0  # σ by which an antenna has to be elsewhere; not given: at the IMU
WEAK = 2.0  # times σ, which is of a model that is only nearly right
LARGEST_BACKWARD = 0.3  # share of the time: what a vehicle does most is forward
COURSE_SPREAD = math.radians(8.0)  # of a vehicle that moves along its nose


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration."""

    fitted: Fit
    before: list[FilterPass]  # with the nominal parameters
    after: list[FilterPass]
    findings: list[Finding]
    values: dict[str, Any]  # all parameters, by name
    notes: dict[str, str]  # comments on parameters, by name
    misfits: list[str]  # why the model is not that of the recordings; empty if it may be


def calibrate(
    recordings: Sequence[Recording],
    values: Mapping[str, Any],
    *,
    own_offsets: bool = False,
    search: float = 1.5,
    nose_first: bool = False,
    trust_fixes: bool = False,
    antenna_is_base: bool = False,
    on_stage: OnStage = lambda stage: lambda: None,
    log: Callable[[str, str], None] = lambda level, text: None,
) -> Calibration:
    """
    Calibrate one robot from some of its recordings, jointly.

    Parameters
    ----------
    recordings : sequence of Recording
    values : mapping
        Checked parameters: nominal values, kept where nothing better is found.
    own_offsets : bool
        Every recording has a clock offset of its own.
    search : float
        Clock offsets within this of the nominal one are searched [s].
    nose_first : bool
        The vehicle moves along its nose: its course gives the yaw of the IMU in it.
    trust_fixes : bool
        The covariances of the fixes are right; otherwise a factor on them is estimated, too.
    antenna_is_base : bool
        The antenna is the origin of the base frame, or the positions are the truth's, which are of
        that origin: the lever arm gives the position of the IMU.
    on_stage : callable
        Given a stage's name, returns what to call after every pass of the filter.
    log : callable
        Given level and text of the regressor's messages.
    """
    period = float(np.median([recording.period for recording in recordings]))
    antenna = np.zeros(3) if antenna_is_base else np.array(values["gnss.antenna_position"])
    lever_b = FLIP @ (antenna - values["imu.position"])
    nominal = Nominal(
        values["gnss.time_offset.value"],
        lever_b,
        values["noise.q_accelerometer"] * period,
        values["noise.q_gyroscope"] * period,
        max(values["imu.accelerometer_bias_walk"], 1e-6),
        max(values["imu.gyroscope_bias_walk"], 1e-8),
        *conversions.first_biases(values),
        values["imu.scale_std"],
    )
    is_given = nominal.antenna_is_given
    read = [read_levels(recording, values, log) for recording in recordings]
    fitted = fit(
        with_loudness(recordings, read),
        nominal,
        own_offsets=own_offsets,
        search=search,
        identified_std=IDENTIFIED,
        held=frozenset({POSITION_SCALE, VELOCITY_SCALE, SLOW_SHARE} if trust_fixes else ()),
        probable=dict.fromkeys(LEVER, MEASURED if is_given else NOT_GIVEN),
        on_stage=on_stage,
    )
    before = filter_passes(fitted, nominal, fitted.nominal_x)
    after = filter_passes(fitted, nominal, fitted.x)
    found = Findings(dict(values))
    rows, changed, comment = observe_clock(fitted, own_offsets, values, search)
    found.values.update(changed)
    found.notes["gnss.time_offset.value"] = comment
    found.add(*rows)
    if fitted.drift.value:
        found.values["gnss.time_offset.estimate"] = True
    offsets = [fitted.offset(k) for k in range(len(recordings))]
    delay = observe_delay(recordings, offsets, values["gnss.max_delay"])
    if delay is not None:
        found.add(delay)
    smoothed = [smoothed_pass(fitted, nominal, k, one) for k, one in enumerate(after)]
    C_new_old = add_mount(found, fitted, smoothed, nose_first)
    add_lever_arm(found, fitted, C_new_old, antenna_is_base)
    imu_position = np.array(found.values["imu.position"])
    motion = fitted.recordings, smoothed, offsets
    wrong = [(after, offsets), *_with_errors(fitted, nominal)]
    found.add(*vehicle_findings(*motion, C_new_old, values, imu_position, wrong))
    add_biases(found, after, nominal, C_new_old)
    levels = ordinary_levels(read)
    found.add(*noise_findings(fitted, period, levels, values))
    found.add(*scatter_findings(fitted, values[SCATTER]))
    reasons = misfits(fitted, after, nominal, levels, period)
    if reasons:
        found.values["gnss.time_offset.std"] = 0.0
        found.values[SCATTER] = values[SCATTER]
        found.withdraw_verdicts()
    return Calibration(fitted, before, after, found.rows, found.values, found.notes, reasons)


def _with_errors(fitted: Fit, nominal: Nominal) -> Iterator[tuple[list[FilterPass], list[float]]]:
    """Yield passes and clock offsets with each error of what is held."""
    for error in fitted.errors:
        moved = replace(fitted, x=fitted.x + error)
        offsets = [moved.offset(k) for k in range(len(moved.recordings))]
        yield filter_passes(moved, nominal, moved.x), offsets


def add_mount(found: Findings, fitted: Fit, after: Sequence[FilterPass], nose_first: bool) -> Array:
    """Add the rotation of the IMU in the base frame; return C (3, 3) from the old b to the new."""

    def unknown(why: str) -> Array:
        kept = {"imu.mount_rpy": found.values["imu.mount_rpy"]}
        found.add(Finding("IMU mount", "as given", "", "not identifiable", why, kept))
        return np.eye(3)

    rotations = [
        rotations_to_truth(recording, one)
        for recording, one in zip(fitted.recordings, after, strict=True)
    ]
    quats = np.vstack([one for one in rotations if one is not None] or [np.empty((0, 4))])
    if len(quats) >= 20:
        C_new_old, spread = mean_rotation(quats)
        _set_mount(found, fitted, C_new_old, spread, "from the attitude of the truth")
        return C_new_old
    angles = np.concatenate([courses(one) for one in after])
    if len(angles) < 20:
        return unknown("it needs an attitude (--use-truth), or speed and a known heading")
    mean, spread, backward = travel(angles)
    if spread > COURSE_SPREAD:
        return unknown(
            f"the direction of travel varies in the vehicle (±{math.degrees(spread):.0f}°)"
        )
    if backward > LARGEST_BACKWARD:
        return unknown(
            f"the vehicle travels backward for {100.0 * backward:.0f} % of the time, or forward: "
            "which it is cannot be seen"
        )
    if not nose_first:
        return unknown(
            f"the direction of travel is {math.degrees(-mean):+.1f}° ± "
            f"{math.degrees(spread):.1f}° from the IMU's axis: --nose-first uses it as forward"
        )
    c, s = math.cos(mean), math.sin(mean)
    C_new_old = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    _set_mount(found, fitted, C_new_old, spread, "yaw from the course; roll and pitch as given")
    return C_new_old


def _set_mount(found: Findings, fitted: Fit, C_new_old: Array, spread: float, note: str) -> None:
    old = conversions.mount_matrix(found.values["imu.mount_rpy"])
    rpy = rpy_from_quat(quat_from_matrix(FLIP @ C_new_old @ old))
    sigma = spread / math.sqrt(max(len(fitted.recordings) * 4.0, 1.0))
    found.add(
        Finding(
            "IMU mount",
            "[" + ", ".join(f"{math.degrees(a):+.1f}" for a in rpy) + "]°",
            f"{math.degrees(sigma):.1f}°",
            "identified" if sigma < IDENTIFIED_MOUNT else "weak",
            note,
            {"imu.mount_rpy": [round(float(a), 4) for a in rpy]},
        )
    )


def add_lever_arm(found: Findings, fitted: Fit, C_new_old: Array, antenna_is_base: bool) -> None:
    """
    Add the antenna in the base frame, or the IMU where the antenna is the frame's origin.

    What was given is exact where it is kept.
    """
    is_given = any(prior.mean for prior in fitted.prior if prior.name in LEVER)
    arm = FLIP @ C_new_old @ fitted.model.lever_b
    if is_given:  # in the base frame: it does not turn with the mount
        antenna = np.zeros(3) if antenna_is_base else found.values["gnss.antenna_position"]
        given = np.subtract(antenna, found.values["imu.position"])
        if {"lever_x", "lever_y"} <= set(fitted.frozen):
            arm[:2] = given[:2]
        if "lever_z" in fitted.frozen:
            arm[2] = given[2]
    if antenna_is_base:
        sensor, parameter, position = "IMU", "imu.position", -arm
        together = "taken to be at the antenna"
    else:
        sensor, parameter, together = "antenna", "gnss.antenna_position", "taken to be at the IMU"
        position = np.add(found.values["imu.position"], arm)
    position = np.round(position, 3) + 0.0  # which leaves no negative zero
    comments, std = [], np.zeros(3)
    for k, (axis, name) in enumerate(zip("xyz", LEVER, strict=True)):
        sigma = fitted.sigma(name)
        if name not in fitted.frozen or not is_given:
            std[k] = sigma if sigma <= IDENTIFIED[name] else min(WEAK * sigma, PRIOR_STD)
        label = f"{sensor} {AXES[k]}"
        verdict: Verdict
        if name in fitted.frozen and sigma > NOT_IDENTIFIABLE[name]:
            verdict = "not identifiable"
            note = "roll and pitch hardly change" if axis == "z" else "too few turns"
            note += f": {KEPT if is_given else together}"
        elif name in fitted.frozen and sigma > IDENTIFIED[name]:
            verdict, note = "weak", KEPT if is_given else together
        elif name in fitted.frozen:
            verdict, note = "identified", CONFIRMED if is_given else together
        elif sigma <= IDENTIFIED[name]:
            verdict, note = "identified", ""
        else:
            verdict, note = "weak", "few turns" if axis != "z" else "little roll and pitch"
        found.add(Finding(label, f"{position[k]:+.3f} m", f"{sigma:.3f} m", verdict, note))
        comments.append(f"{label} {position[k]:+.3f} ± {sigma:.3f} ({verdict})")
    found.values[parameter] = position.tolist()
    found.notes[parameter] = "; ".join(comments)
    if not antenna_is_base and position.any():
        in_base = np.sqrt((FLIP @ C_new_old) ** 2 @ std**2)
        found.values["gnss.antenna_position_std"] = [float(f"{s:.2g}") for s in in_base]


def add_biases(
    found: Findings, after: Sequence[FilterPass], nominal: Nominal, C_new_old: Array
) -> None:
    """Add the biases to expect at the next start."""
    (bias_a, std_a), (bias_g, std_g) = next_biases(after)
    for sensor, unit, b, std, prior, places in (
        ("accelerometer", "m/s²", bias_a, std_a, nominal.bias_a_std, 3),
        ("gyroscope", "rad/s", bias_g, std_g, nominal.bias_g_std, 5),
    ):
        mean = FLIP @ C_new_old @ b
        known = std < 0.6 * prior
        verdict: Verdict
        if np.all(known):
            verdict, note = "identified", ""
        else:
            verdict = "weak" if np.any(known) else "not identifiable"
            unknown = "/".join(axis for axis, k in zip(AXES, known, strict=True) if not k)
            note = f"{unknown} not separable from tilt with this motion, or another at each start"
        text = ", ".join(f"{v:+.{places}f}" for v in mean)
        names = f"imu.{sensor}_bias", f"imu.{sensor}_bias_std"
        values = {name: found.values[name] for name in names}
        if np.any(known):
            in_base = np.sqrt((FLIP @ C_new_old) ** 2 @ std**2)
            values[names[0]] = [round(float(v), places + 1) for v in mean]
            values[names[1]] = [float(f"{s:.2g}") for s in in_base]
        sigma = f"{np.max(std):.{places}f}"
        found.add(Finding(f"{sensor} bias", f"[{text}] {unit}", sigma, verdict, note, values))
