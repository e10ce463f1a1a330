"""
``ins_calibrate``: clock offset, lever arm, noise and the rest, from a robot's own recordings.

Needs no truth: what a user has is an IMU and a GNSS receiver. `calibration_fit` finds the
numbers; here are the recordings' way in, the verdicts, and the parameter file's way out.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from hybrid_ins.bags.messages import FIX
from hybrid_ins.bags.messages import VELOCITY as TWIST
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.calibration.fit import (
    Fit,
    Given,
    Pass,
    Run,
    fit,
    mean_rotation,
    offset_name,
    passes,
)
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.innovations import VELOCITY as VELOCITY_KIND
from hybrid_ins.cli import options, program
from hybrid_ins.core.earth import LocalFrame
from hybrid_ins.core.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    rpy_from_quat,
    slerp,
)
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.state import BIAS_A, BIAS_G, COVARIANCE, DIAGONAL, QUAT, VELOCITY
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.parameters import PARAMETERS, to_yaml
from hybrid_ins.plotting import calibration, style
from hybrid_ins.ros import conversions
from hybrid_ins.ros.conversions import FLIP, SWAP, GnssInput, Refused

Array = NDArray[np.float64]

TRUTH_STD = 0.03  # m, of a truth position used as a fix
IDENTIFIED = {"offset": 0.015, "lever": 0.05, "mount": math.radians(1.0)}
USELESS = {"offset": 0.08, "lever_x": 0.4, "lever_y": 0.4, "lever_z": 0.4}
FEWEST_FIXES = 15
SHORTEST = 8.0  # s of fixes
NOSE_SPREAD = math.radians(8.0)
REPEATABILITY = 0.03, 1e-3  # m/s², rad/s: of biases from start to start, as far as is known before
ORDINARY = 0.99  # share of the time in which the regressor reads less than the background
KNOWN_STARTS = 2.0  # recordings that this weighs as much as


@dataclass(frozen=True, slots=True)
class Finding:
    """One calibrated quantity, in the user's frames and units."""

    label: str
    value: str
    sigma: str
    verdict: str  # identified, weak, not identifiable
    note: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """All that ``ins_calibrate`` found."""

    fitted: Fit
    before: list[Pass]
    after: list[Pass]
    findings: list[Finding]
    values: dict[str, Any]  # parameters, as they go into the file
    notes: dict[str, str]  # comment on a parameter, by name


def read_run(
    path: Path,
    values: Mapping[str, Any],
    *,
    imu_topic: str = "/imu/data",
    fix_topic: str = "/gnss/fix",
    velocity_topic: str = "/gnss/velocity",
    use_truth: bool = False,
    longest: float = math.inf,
) -> Run:
    """
    Read one recording.

    Parameters
    ----------
    path : Path
        A bag with IMU and fixes.
    values : mapping
        Checked parameters: mount, covariances' floors and defaults.
    use_truth : bool
        Take the truth's positions for the fixes.
    longest : float
        Only so much of it [s].

    Raises
    ------
    InputError
        A topic is missing, or there is too little to calibrate with.
    """
    with BagReader(path) as bag:
        imu = bag.imu(imu_topic)
        aid: list[tuple[int, int, Array, Array]] = []
        attitude = None
        if use_truth:
            aid, attitude = _truth(bag)
        else:
            fix_topic = bag.require(fix_topic, FIX, "--fix-topic")
            gnss = GnssInput.from_parameters({**values, "gnss.time_offset.value": 0.0})
            for _, _, message in bag.messages(fix_topic):
                fix = gnss.position(message)
                if not isinstance(fix, Refused):
                    aid.append((fix.t_ns, POSITION, fix.lla, fix.covariance_n))
            if bag.topics.get(velocity_topic) == TWIST:
                for _, _, message in bag.messages(velocity_topic):
                    velocity = gnss.velocity(message)
                    if not isinstance(velocity, Refused):
                        aid.append(
                            (
                                velocity.t_ns,
                                VELOCITY_KIND,
                                velocity.velocity_n,
                                velocity.covariance_n,
                            )
                        )
    aid.sort(key=lambda row: row[:2])
    mount = conversions.mount_matrix(values["imu.mount_rpy"])
    stamps = imu.stamp_ns
    samples = np.hstack((imu.specific_force @ mount.T, imu.angular_rate @ mount.T))
    sound = (stamps > 0) & np.all(np.isfinite(samples), axis=1)
    stamps, samples = stamps[sound], samples[sound]
    sound = stamps > np.maximum.accumulate(np.concatenate(([0], stamps[:-1])))
    stamps, samples = stamps[sound], samples[sound]
    if len(stamps) < 100:
        raise InputError(f"{path}: {imu_topic} has {len(stamps)} usable samples: too few")
    stretch = _longest_stretch(stamps, int(values["imu.max_gap"] * 1e9))
    stamps, samples = stamps[stretch], samples[stretch]
    origin = int(stamps[0])
    t = np.asarray((stamps - origin) * 1e-9, float)
    keep = t <= longest
    rows = [row for row in aid if -10.0 < (row[0] - origin) * 1e-9 < min(t[-1], longest) + 10.0]
    positions = [row for row in rows if row[1] == POSITION]
    if len(positions) < FEWEST_FIXES or (positions[-1][0] - positions[0][0]) < SHORTEST * 1e9:
        raise InputError(
            f"{path}: {len(positions)} usable fixes go with {t[-1]:.0f} s of IMU samples: "
            f"calibration needs {FEWEST_FIXES} over {SHORTEST:g} s; are both clocks of one epoch?"
        )
    reference = None
    if attitude is not None:
        reference = np.asarray((attitude[0] - origin) * 1e-9, float), attitude[1]
    return Run(
        path.name,
        t[keep],
        np.ascontiguousarray(samples[keep]),
        np.array([(row[0] - origin) * 1e-9 for row in rows]),
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
        reference,
    )


def antenna_is_base(
    paths: Sequence[Path], values: Mapping[str, Any], fix_topic: str = "/gnss/fix"
) -> bool:
    """Whether the fixes are of base_frame itself, by their frame_id; a given antenna is not."""

    def frame(path: Path) -> str:
        with BagReader(path) as bag:
            return next((str(m.header.frame_id) for *_, m in bag.messages(fix_topic)), "")

    return not any(values["gnss.antenna_position"]) and all(
        frame(path).lstrip("/") == values["base_frame"] for path in paths
    )


def _truth(
    bag: BagReader,
) -> tuple[list[tuple[int, int, Array, Array]], tuple[NDArray[np.int64], Array] | None]:
    """Positions of the truth as fixes, and its attitude: stamps [ns] and C_nb (K, 4)."""
    topic = bag.require("/truth/odometry", "nav_msgs/msg/Odometry", "a bag that holds truth")
    datum = next(bag.messages("/truth/datum"), None)
    if datum is None:
        raise InputError(f"{bag.path}: no /truth/datum: where the truth's map lies is not known")
    place = datum[2]
    frame = LocalFrame(
        np.array([math.radians(place.latitude), math.radians(place.longitude), place.altitude])
    )
    stamps, places, quats = [], [], []
    for _, _, message in bag.messages(topic):
        pose = message.pose.pose
        stamps.append(conversions.stamp_ns(message.header.stamp))
        places.append((pose.position.x, pose.position.y, pose.position.z))
        q = pose.orientation
        quats.append((q.x, q.y, q.z, q.w))
    lla = frame.lla(np.array(places) @ SWAP)
    R = np.eye(3) * TRUTH_STD**2
    aid = [(t, POSITION, row, R) for t, row in zip(stamps, lla, strict=True)]
    norm = np.linalg.norm(quats, axis=1)
    known = np.abs(norm - 1.0) < 0.1
    if not np.any(known):
        return aid, None
    attitudes = np.array([conversions.quat_nb_from_enu(q) for q in np.array(quats)[known]])
    return aid, (np.array(stamps, np.int64)[known], attitudes)


def _longest_stretch(stamps: NDArray[np.int64], max_gap_ns: int) -> slice:
    """Longest stretch of samples without a gap."""
    edges = np.flatnonzero(np.diff(stamps) > max_gap_ns) + 1
    starts, stops = np.concatenate(([0], edges)), np.concatenate((edges, [len(stamps)]))
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]))


def calibrate(
    runs: Sequence[Run],
    values: Mapping[str, Any],
    *,
    own_offsets: bool = False,
    search: float = 1.5,
    nose_first: bool = False,
    trust_fixes: bool = False,
    antenna_is_base: bool = False,
    tell: Callable[[str], Callable[[], None]] = lambda stage: lambda: None,
) -> Calibration:
    """
    Calibrate some recordings of one robot jointly.

    Parameters
    ----------
    runs : sequence of Run
    values : mapping
        Checked parameters: where the search starts, and what stays where nothing is found.
    own_offsets : bool
        Every recording has a clock offset of its own.
    search : float
        Clock offsets within this of the given one are searched [s].
    nose_first : bool
        The vehicle moves where it points: its course tells how the IMU is turned about its axis.
    trust_fixes : bool
        The fixes' covariances are right; else a factor on them is found, too.
    antenna_is_base : bool
        The antenna is the base frame's origin: the lever arm tells where the IMU is.
    tell : callable
        Given a stage's name, returns what to call with every run of the filter.
    """
    period = float(np.median([run.period for run in runs]))
    lever_b = FLIP @ np.subtract(values["gnss.antenna_position"], values["imu.position"])
    given = Given(
        values["gnss.time_offset.value"],
        lever_b,
        values["noise.q_accelerometer"] * period,
        values["noise.q_gyroscope"] * period,
        max(values["imu.accelerometer_bias_walk"], 1e-6),
        max(values["imu.gyroscope_bias_walk"], 1e-8),
        *conversions.first_biases(values),
    )
    fitted = fit(
        runs,
        given,
        own_offsets=own_offsets,
        search=search,
        useless=USELESS,
        held=frozenset({"gnss_scale"} if trust_fixes else ()),
        tell=tell,
    )
    before, after = passes(fitted, given, fitted.first), passes(fitted, given, fitted.x)
    report = _Report(fitted, given, after, dict(values), period)
    report.offsets(own_offsets, search)
    turn = report.mount(runs, nose_first)
    report.lever(turn, antenna_is_base)
    report.biases(turn)
    report.noise()
    report.background(runs)
    report.scatter()
    return Calibration(fitted, before, after, report.findings, report.values, report.notes)


class _Report:
    """Turns a fit into findings, parameters and comments."""

    def __init__(
        self, fitted: Fit, given: Given, after: list[Pass], values: dict[str, Any], period: float
    ) -> None:
        self.fitted, self.given, self.after, self.period = fitted, given, after, period
        self.values = values
        self.findings: list[Finding] = []
        self.notes: dict[str, str] = {}

    def _add(
        self, label: str, value: str, sigma: str, verdict: str, note: str, *names: str
    ) -> None:
        self.findings.append(Finding(label, value, sigma, verdict, note))
        for name in names:
            spread = f" {sigma if sigma.startswith('×') else '± ' + sigma}" if sigma else ""
            text = f"{verdict}: {label} {value}{spread}"
            self.notes[name] = text + (f"; {note}" if note else "")

    def offsets(self, own: bool, search: float) -> None:
        """Clock offset, one or one for each recording."""
        fitted = self.fitted
        rows = range(len(fitted.runs)) if own else [0]
        for k in rows:
            name = offset_name(k, fitted.names)
            value, sigma = fitted.value(name), fitted.sigma(name)
            profile = fitted.profile[k] if own else fitted.profile.sum(axis=0)
            rival = _rival(fitted.grid, profile, value)
            if name in fitted.frozen:
                verdict, note = "not identifiable", "the motion is too steady: fly or drive curves"
            elif abs(value - self.given.time_offset) > search - 0.15:
                verdict, note = "weak", "at the edge of the search: give a larger --search"
            elif rival is not None:
                verdict, note = "weak", f"{rival:+.1f} s would be nearly as likely"
            elif sigma <= IDENTIFIED["offset"]:
                verdict, note = "identified", ""
            else:
                verdict, note = "weak", "little change of speed and direction"
            label = "clock offset" + (f", {fitted.runs[k].name}" if own else "")
            self._add(label, f"{value:+.4f} s", f"{sigma:.4f} s", verdict, note)
        value = float(np.mean([fitted.offset(k) for k in range(len(fitted.runs))]))
        self.values["gnss.time_offset.value"] = round(value, 4)
        self.notes["gnss.time_offset.value"] = "; ".join(
            f"{f.verdict}: {f.label} {f.value} ± {f.sigma}" for f in self.findings
        ) + ("; the mean of them" if own and len(fitted.runs) > 1 else "")

    def mount(self, runs: Sequence[Run], nose_first: bool) -> Array:
        """Rotation of the IMU in the base frame; returns what turns the old b into the new."""
        turns = [
            _turn_to_truth(run, rows, self.fitted.offset(k))
            for k, (run, rows) in enumerate(zip(self.fitted.runs, self.after, strict=True))
        ]
        quats = np.vstack([turn for turn in turns if turn is not None] or [np.empty((0, 4))])
        if len(quats) >= 20:
            turn, spread = mean_rotation(quats)
            self._set_mount(turn, spread, "roll, pitch, yaw against the attitude given")
            return turn
        course = np.concatenate([_courses(rows) for rows in self.after])
        if len(course) < 20:
            self._no_mount("it takes an attitude (--use-truth), or speed and a known heading")
            return np.eye(3)
        mean = math.atan2(np.mean(np.sin(course)), np.mean(np.cos(course)))
        spread = float(np.sqrt(np.mean(np.angle(np.exp(1j * (course - mean))) ** 2)))
        if spread > NOSE_SPREAD:
            self._no_mount(
                f"the vehicle does not move where it points (±{math.degrees(spread):.0f}"
                "° about its axes)"
            )
            return np.eye(3)
        if not nose_first:
            self._no_mount(
                f"it moves {math.degrees(-mean):+.1f}° from the IMU's axis within "
                f"±{math.degrees(spread):.1f}°: --nose-first takes this for its nose"
            )
            return np.eye(3)
        c, s = math.cos(mean), math.sin(mean)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        self._set_mount(turn, spread, "yaw from the course (--nose-first); roll, pitch as given")
        return turn

    def _set_mount(self, turn: Array, spread: float, note: str) -> None:
        old = conversions.mount_matrix(self.values["imu.mount_rpy"])
        rpy = rpy_from_quat(quat_from_matrix(FLIP @ turn @ old))
        sigma = spread / math.sqrt(max(len(self.fitted.runs) * 4.0, 1.0))
        self.values["imu.mount_rpy"] = [round(float(a), 4) for a in rpy]
        self._add(
            "IMU mount",
            "[" + ", ".join(f"{math.degrees(a):+.1f}" for a in rpy) + "]°",
            f"{math.degrees(sigma):.1f}°",
            "identified" if sigma < IDENTIFIED["mount"] else "weak",
            note,
            "imu.mount_rpy",
        )

    def _no_mount(self, why: str) -> None:
        self._add("IMU mount", "as given", "", "not identifiable", why, "imu.mount_rpy")

    def lever(self, turn: Array, antenna_is_base: bool) -> None:
        """Antenna in the base frame; or the IMU, where the antenna is that frame's origin."""
        lever_b = np.array([self.fitted.value(f"lever_{axis}") for axis in "xyz"])
        arm = FLIP @ turn @ lever_b
        sensor, parameter, place = (
            ("IMU", "imu.position", -arm)
            if antenna_is_base
            else ("antenna", "gnss.antenna_position", np.add(self.values["imu.position"], arm))
        )
        words = []
        for k, axis in enumerate("xyz"):
            name = f"lever_{axis}"
            sigma = self.fitted.sigma(name)
            label = f"{sensor} " + ("forward", "left", "up")[k]
            if name in self.fitted.frozen:
                verdict = "not identifiable"
                note = (
                    "roll and pitch hardly change"
                    if axis == "z"
                    else "too few turns for its swing to show"
                )
            elif sigma <= IDENTIFIED["lever"]:
                verdict, note = "identified", ""
            else:
                verdict, note = "weak", "few turns" if axis != "z" else "little roll and pitch"
            self._add(label, f"{place[k]:+.3f} m", f"{sigma:.3f} m", verdict, note)
            words.append(f"{label} {place[k]:+.3f} ± {sigma:.3f} ({verdict})")
        self.values[parameter] = [round(float(a), 3) for a in place]
        self.notes[parameter] = "; ".join(words)

    def biases(self, turn: Array) -> None:
        """Biases at the next start, by those at the end of each recording."""
        (bias_a, std_a), (bias_g, std_g) = next_biases(self.after)
        for sensor, unit, b, std, prior, places in (
            ("accelerometer", "m/s²", bias_a, std_a, self.given.bias_a_std, 3),
            ("gyroscope", "rad/s", bias_g, std_g, self.given.bias_g_std, 5),
        ):
            mean = FLIP @ turn @ b
            known = std < 0.6 * prior
            verdict = (
                "identified" if np.all(known) else "weak" if np.any(known) else "not identifiable"
            )
            note = (
                ""
                if np.all(known)
                else "/".join(
                    axis for axis, k in zip(("forward", "left", "up"), known, strict=True) if not k
                )
                + " not separable from tilt with this motion"
            )
            text = ", ".join(f"{v:+.{places}f}" for v in mean)
            name = f"imu.{sensor}_bias"
            self._add(
                f"{sensor} bias",
                f"[{text}] {unit}",
                f"{np.max(std):.{places}f}",
                verdict,
                note,
                name,
                f"{name}_std",
            )
            if np.any(known):
                self.values[name] = [round(float(v), places + 1) for v in mean]
                self.values[f"{name}_std"] = [
                    float(f"{s:.2g}") for s in np.sqrt((FLIP @ turn) ** 2 @ std**2)
                ]

    def noise(self) -> None:
        """Noise floor, bias walks, and how far the fixes scatter."""
        for name, parameter, label, power, scale, unit in (
            (
                "psd_a",
                "noise.q_accelerometer",
                "accelerometer noise",
                1.0,
                1.0 / self.period,
                "(m/s²)²",
            ),
            ("psd_g", "noise.q_gyroscope", "gyroscope noise", 1.0, 1.0 / self.period, "(rad/s)²"),
            (
                "walk_a",
                "imu.accelerometer_bias_walk",
                "accelerometer bias walk",
                1.0,
                1.0,
                "m/s²/√s",
            ),
            ("walk_g", "imu.gyroscope_bias_walk", "gyroscope bias walk", 1.0, 1.0, "rad/s/√s"),
        ):
            log_value, sigma = self.fitted.value(name), self.fitted.sigma(name)
            prior = next(p for p in self.fitted.prior if p.name == name)
            value = math.exp(log_value) ** power * scale
            if sigma < 0.35 * prior.std:
                verdict, note = "identified", ""
            elif sigma < 0.75 * prior.std:
                verdict, note = "weak", "order of magnitude only"
            else:
                verdict = "not identifiable"
                note = (
                    "smaller than the rest of the errors"
                    if name.startswith("psd")
                    else f"would take longer than {self.fitted.runs[0].t[-1]:.0f} s"
                )
                value = math.exp(prior.mean) ** power * scale
            self.values[parameter] = float(f"{value:.3g}")
            self._add(
                label,
                f"{value:.2g} {unit}",
                f"×/÷ {math.exp(min(sigma, 9.0)):.1f}",
                verdict,
                note,
                parameter,
            )

    def background(self, runs: Sequence[Run]) -> None:
        """Levels that the regressor hardly exceeds in motion whose noise is now known."""
        levels = ordinary_levels(runs, self.values)
        if levels is None:
            return
        for sensor, unit, background in (
            ("accelerometer", "(m/s²)²", levels[:3]),
            ("gyroscope", "(rad/s)²", levels[3:]),
        ):
            name = f"noise.background_{sensor}"
            self.values[name] = [float(f"{level:.3g}") for level in background]
            text = ", ".join(f"{level:.2g}" for level in background)
            self._add(
                f"{sensor} background",
                f"[{text}] {unit}",
                "",
                "identified",
                f"noise.model {self.values['noise.model']} reads less for "
                f"{100.0 * ORDINARY:g} % of the time",
                name,
            )

    def scatter(self) -> None:
        """How far the fixes scatter."""
        if "gnss_scale" in self.fitted.frozen:
            return
        scale, sigma = self.fitted.value("gnss_scale"), self.fitted.sigma("gnss_scale")
        factor = math.exp(0.5 * scale)
        note = (
            ""
            if abs(scale) < max(3.0 * sigma, 0.4)
            else "raise gnss.position_std_min"
            if scale > 0
            else "the receiver is better than it says"
        )
        self._add(
            "fixes' scatter",
            f"{factor:.2f} × claimed σ",
            f"{0.5 * sigma * factor:.2f}",
            "identified" if sigma < 0.3 else "weak",
            note,
        )


def next_biases(after: Sequence[Pass]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """
    Biases to expect at the next start of the same IMU, from filters over earlier recordings.

    Every recording tells them at its end with the filter's uncertainty; from start to start they
    differ by a variance that the recordings tell, too (method of moments), together with what is
    expected before any, ``REPEATABILITY``.

    Returns
    -------
    (bias_a, std_a), (bias_g, std_g)
        Means and standard deviations, shape (3,) each, b [m/s², rad/s].
    """
    last = [rows.rows[np.isfinite(rows.nis)][-1] for rows in after]
    variances = np.array([row[COVARIANCE][DIAGONAL[9:15]] for row in last])
    found = []
    for part, axes, repeatability in (
        (BIAS_A, slice(0, 3), REPEATABILITY[0]),
        (BIAS_G, slice(3, 6), REPEATABILITY[1]),
    ):
        bias = np.array([row[part] for row in last])
        weight = 1.0 / variances[:, axes]
        mean = np.sum(weight * bias, axis=0) / np.sum(weight, axis=0)
        beyond = np.sum(np.maximum((bias - mean) ** 2 - variances[:, axes], 0.0), axis=0)
        between = (KNOWN_STARTS * repeatability**2 + beyond) / (KNOWN_STARTS + len(last) - 1)
        weight = 1.0 / (variances[:, axes] + between)
        mean = np.sum(weight * bias, axis=0) / np.sum(weight, axis=0)
        found.append((mean, np.sqrt(between + 1.0 / np.sum(weight, axis=0))))
    return found[0], found[1]


def ordinary_levels(runs: Sequence[Run], values: Mapping[str, Any]) -> Array | None:
    """Levels (6,) below which the node would read ``ORDINARY`` of all; None if it reads none."""
    reader = NoiseReader(values, np.eye(3), _say)
    levels = []
    for run in runs:
        samples = np.zeros(len(run.t), SAMPLE_DTYPE)
        samples["t_ns"] = np.round((run.t + 1.0) * 1e9)
        samples["f"], samples["w"] = run.samples[:, :3], run.samples[:, 3:]
        ring = ImuRing()
        count = max(1, round(values["noise.refresh_period"] / run.period))
        for start in range(0, len(samples), count):
            ring.extend(samples[start : start + count])
            q = reader.read(ring, 0).q
            if q is not None:
                levels.append(q)
    return np.quantile(levels, ORDINARY, axis=0) if levels else None


def _rival(grid: Array, profile: Array, value: float) -> float | None:
    """Another peak of the coarse likelihood that is nearly as high."""
    away = np.abs(grid - value) > 0.35
    if not np.any(away):
        return None
    other = int(np.argmax(np.where(away, profile, -np.inf)))
    return float(grid[other]) if profile[other] > np.max(profile) - 5.0 else None


def _turn_to_truth(run: Run, after: Pass, offset: float) -> Array | None:
    """Rotations (K, 4) from the b of the samples to the truth's, where both are known."""
    if run.attitude is None:
        return None
    t, quats = run.attitude
    known = np.isfinite(after.nis) & (_heading_std(after) < math.radians(3.0))
    known &= (run.aid_t > t[0]) & (run.aid_t < t[-1])
    if not np.any(known):
        return None
    at = run.aid_t[known]
    right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    fraction = (at - t[right - 1]) / (t[right] - t[right - 1])
    truth = slerp(quats[right - 1], quats[right], fraction)
    return quat_multiply(quat_conjugate(truth), after.rows[known][:, QUAT])


def _courses(after: Pass) -> Array:
    """Direction of travel about b's down axis [rad], where speed and heading are known."""
    known = np.isfinite(after.nis) & (_heading_std(after) < math.radians(5.0))
    rows = after.rows[known]
    velocity = np.einsum("kji,kj->ki", matrix_from_quat(rows[:, QUAT]), rows[:, VELOCITY])
    velocity = velocity[np.hypot(velocity[:, 0], velocity[:, 1]) > 1.0]
    courses: Array = np.arctan2(velocity[:, 1], velocity[:, 0])
    return courses


def _heading_std(after: Pass) -> Array:
    std: Array = np.sqrt(after.rows[:, COVARIANCE][:, DIAGONAL[8]])
    return std


def table(findings: Sequence[Finding]) -> str:
    """Lay the findings out for a terminal."""
    rows = [
        ("", "value", "σ", "verdict"),
        *(
            (f.label, f.value, f.sigma, f.verdict + (f": {f.note}" if f.note else ""))
            for f in findings
        ),
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), row[1].rjust(widths[1]), row[2].rjust(widths[2]), row[3]]
        ).rstrip()
        for row in rows
    )


def innovation_lines(calibration: Calibration) -> str:
    """Say what calibration does to the innovations."""

    def figures(passes: Sequence[Pass]) -> tuple[float, float]:
        z = np.concatenate([p.z[np.isfinite(p.nis)] for p in passes])
        nis = np.concatenate([p.nis[np.isfinite(p.nis)] for p in passes])
        return float(np.sqrt(np.nanmean(z**2))), float(np.median(nis))

    before, after = figures(calibration.before), figures(calibration.after)
    return (
        f"innovations: rms {before[0]:.3f} -> {after[0]:.3f} m, "
        f"median NIS {before[1]:.1f} -> {after[1]:.1f} (2.4 expected)"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "ins_calibrate",
        "Find from recordings of IMU and GNSS what is otherwise guessed: the offset between\n"
        "their clocks, the antenna's lever arm, the noise levels, with the uncertainty of each\n"
        "and whether the motion told it at all. Writes a parameter file for ins_node and\n"
        "ins_replay. Record half a minute or more with curves, speeding up and braking.",
        "ins_calibrate flight1.mcap flight2.mcap --out params.yaml --plot calibration.png",
    )
    parser.add_argument("bags", metavar="BAG", nargs="+", help="recordings of one robot")
    parser.add_argument("--out", metavar="F", help="parameter file to write (YAML)")
    parser.add_argument(
        "--plot",
        metavar="F",
        help="picture to write (.png or .svg): likelihood "
        "against offset, innovations before and after",
    )
    options.add_parameters(
        parser, "what is known: mount, antenna, GNSS floors; the search starts there"
    )
    parser.add_argument(
        "--offset-per-bag", action="store_true", help="each recording has a clock offset of its own"
    )
    parser.add_argument(
        "--search",
        type=options.positive,
        default=1.5,
        metavar="S",
        help="clock offsets within ±S s are searched (default: %(default)s)",
    )
    parser.add_argument(
        "--longest",
        type=options.positive,
        default=300.0,
        metavar="S",
        help="use the first S s of each recording (default: %(default)g)",
    )
    parser.add_argument(
        "--nose-first",
        action="store_true",
        help="the vehicle moves where it points: find the IMU's yaw in it",
    )
    parser.add_argument(
        "--use-truth",
        action="store_true",
        help="take /truth/odometry for fixes and attitude (for comparison)",
    )
    options.add_topics(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace the output files")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    values = options.parameter_values(args)
    if args.out:
        options.check_new(Path(args.out), args.overwrite)
    if args.plot:
        style.check(Path(args.plot))
    runs = [
        read_run(
            Path(bag),
            values,
            **options.topics(args),
            use_truth=args.use_truth,
            longest=args.longest,
        )
        for bag in args.bags
    ]
    with _Bar() as bar:
        found = calibrate(
            runs,
            values,
            own_offsets=args.offset_per_bag and len(runs) > 1,
            search=args.search,
            nose_first=args.nose_first,
            trust_fixes=args.use_truth,
            tell=bar.stage,
            antenna_is_base=antenna_is_base(list(map(Path, args.bags)), values, args.fix_topic),
        )
    print(table(found.findings))
    print(innovation_lines(found))
    if args.out:
        chosen = {
            name: value
            for name, value in found.values.items()
            if name in found.notes or value != PARAMETERS[name].default
        }
        title = "Written by ins_calibrate from " + ", ".join(run.name for run in runs)
        Path(args.out).write_text(to_yaml(chosen, title, found.notes), encoding="utf-8")
        print(f"{args.out}: for ins_node --ros-args --params-file, ins_replay --params-file")
    if args.plot:
        style.save(calibration.figure(found), Path(args.plot))
    return 0


def _say(level: str, text: str) -> None:
    tqdm.write(f"ins_calibrate: {level}: {text}", file=sys.stderr)


class _Bar:
    """A progress bar that counts runs of the filter."""

    def __init__(self) -> None:
        self._bar: tqdm[Any] | None = None

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def stage(self, name: str) -> Callable[[], None]:
        if self._bar is not None:
            self._bar.close()
        self._bar = tqdm(desc=name, unit="run", disable=None, leave=False)
        return lambda: self._bar.update() and None  # type: ignore[union-attr]
