"""
The statuses on ``/diagnostics`` and ``gnss/verdict``, and their wording.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Need
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.inertial.rotations import UNKNOWN_ANGLE_STD
from hybrid_ins.core.inertial.state import CLOCK_VARIANCE, W_G, total_std
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.phases import Aligning
from hybrid_ins.core.noise.hypotheses import drifts_beyond_claim
from hybrid_ins.core.noise.innovation import InnovationNoise
from hybrid_ins.core.noise.process_noise import LearnedNoise
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrors
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import clock_offset_ns
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting import wording
from hybrid_ins.ros.reporting.input_log import ORDINARY, InputLog
from hybrid_ins.ros.reporting.reports import Status

Array = NDArray[np.float64]

NOT_MOVED = np.zeros(3)  # m
MOVED = "; until then it is taken to be there"
DEAD_RECKONING_AFTER = 2.0  # s without a fused fix
DISAGREEMENT = 3.0  # factor on the noise of gyroscopes or fixes that the user should know of
ORDINARY_SCALE_ERROR, MOTION_TIME = 0.01, 1.0  # of a gyroscope, and s that a turn lasts
RECENT = 4096  # samples
IMU_CONTENTS = (Need.USABLE_IMU, Need.ORIENTATION)  # what only other messages of the IMU end
CHANNELS = ("ax", "ay", "az", "gx", "gy", "gz")


def status(name: str, level: int, text: str, values: Mapping[str, object]) -> Status:
    """Return a status; level 0 OK, 1 WARN, 2 ERROR."""
    words = [(key, _word(value)) for key, value in values.items()]
    return Status(level, f"hybrid_ins: {name}", text, words)


def _word(value: object) -> str:
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def verdict_status(verdict: Verdict) -> Status:
    """Return what became of one fix."""
    measurement = verdict.measurement
    offset_ns = clock_offset_ns(measurement)
    sigma = dict(zip(("sigma_n", "sigma_e", "sigma_u"), verdict.sigma, strict=False))
    text = (verdict.reason or "fused") if verdict.accepted else f"refused: {verdict.reason}"
    if not verdict.accepted and math.isfinite(verdict.nis):
        text += f" (NIS {verdict.nis:.1f} > {verdict.threshold:.1f})"
    elif verdict.weight < 1.0:
        text += f", weight {verdict.weight:.2g} (NIS {verdict.nis:.1f})"
    values = {
        "stamp": measurement.t_ns - offset_ns,
        "kind": measurement.kind,
        "accepted": verdict.accepted,
        "reason": verdict.reason,
        **_test(verdict),
        "sigma_e": sigma.get("sigma_e", math.nan),
        "sigma_n": sigma.get("sigma_n", math.nan),
        "sigma_u": sigma.get("sigma_u", math.nan),
        "time_offset": offset_ns * 1e-9,
        "age": verdict.age,
        "weight": verdict.weight,
    }
    return status("gnss", int(not verdict.accepted or verdict.inflated), text, values)


def aiding_verdict_status(verdict: Verdict) -> Status:
    """Return what became of one reading of an aiding sensor."""
    measurement = verdict.measurement
    text = "fused" if verdict.accepted else f"refused: {verdict.reason}"
    values = {
        "stamp": measurement.t_ns,
        "kind": measurement.kind,
        "accepted": verdict.accepted,
        **_test(verdict),
        **{f"sigma_{k}": float(s) for k, s in enumerate(verdict.sigma)},
        "age": verdict.age,
    }
    return status(measurement.sensor, int(not verdict.accepted), text, values)


def _test(verdict: Verdict) -> dict[str, object]:
    """Return the chi-square test of a verdict."""
    return {"nis": verdict.nis, "dof": len(verdict.sigma), "threshold": verdict.threshold}


def filter_status(
    navigator: Navigator, t_ns: int, fused_ns: int, fixes_fused: int, waiting_for: str
) -> Status:
    """
    Return how the filter is at a stamp [ns].

    ``fused_ns`` is the stamp of the last fix that was fused, or 0 where the filter just started
    from one; ``waiting_for`` is what alignment lacks.
    """
    running = navigator.filter
    if running is None:
        return _alignment_status(navigator, waiting_for)
    since = (t_ns - fused_ns) * 1e-9 if fused_ns else 0.0
    sigma = total_std(running.nav)
    outage = since > DEAD_RECKONING_AFTER
    text = (
        f"dead reckoning for {since:.0f} s, position σ {max(sigma[:2]):.1f} m"
        if outage
        else "aligned, GNSS fused"
    )
    return status(
        "filter",
        int(outage),
        text,
        {
            "state": "dead reckoning" if outage else "aligned",
            "since_last_fix": since,
            "sigma_position_horizontal": float(math.hypot(*sigma[:2])),
            "sigma_position_vertical": float(sigma[2]),
            "sigma_heading_deg": math.degrees(sigma[8]),
            "fixes_fused": fixes_fused,
            "standing": navigator.monitor.standing,
            "imu_samples": navigator.ring.count,
        },
    )


def silent_status(navigator: Navigator, silent: float, fixes_fused: int) -> Status:
    """Return how the filter is without IMU samples for ``silent`` [s]: nothing propagates σ."""
    values = {
        "state": "no IMU samples",
        "since_last_imu_sample": silent,
        "fixes_fused": fixes_fused,
        "imu_samples": navigator.ring.count,
    }
    text = f"no IMU samples for {silent:.0f} s: nothing can be estimated until they come"
    return status("filter", 2, text, values)


def _alignment_status(navigator: Navigator, waiting: str) -> Status:
    state = wording.state_of(navigator)
    values: dict[str, object] = {"state": state, "waiting_for": waiting}
    bank = navigator.phase.bank
    if bank is not None:
        heading_std = min(bank.heading()[1], UNKNOWN_ANGLE_STD)
        values["sigma_heading_deg"] = math.degrees(heading_std)
        values["hypotheses"] = len(bank.filters)
    nav = navigator.phase.nav
    if nav is not None:
        values["sigma_position_horizontal"] = float(math.hypot(*total_std(nav)[:2]))
    return status("filter", 1, f"aligning, {state}: it needs {waiting}", values)


def input_status(
    navigator: Navigator,
    inputs: InputLog,
    t_ns: int,
    axes_fault: Refused | None = None,
    moved_b: Array = NOT_MOVED,
    tilt: Refused | None = None,
) -> Status:
    """Return what was refused until a stamp [ns], and what is wrong with the IMU now."""
    fault, new = navigator.monitor.fault, inputs.new_in_last_seconds(t_ns)
    values = {**inputs.receiver, **dict(sorted(inputs.counts.items())), **inputs.notes}
    if fault is None and axes_fault is not None:
        return status("input", 2, f"{axes_fault.name}: {axes_fault.text}", values)
    if fault is not None:
        text = f"{wording.name_of_fault(fault)}: {wording.describe_fault(fault)}"
        return status("input", 2, text, values)
    if tilt is not None:
        return status("input", 1, f"{tilt.name}: {tilt.text}", values)
    for found in antenna_conditions(navigator, moved_b).values():
        return status("input", 1, found, values)
    refused = sum(n for name, n in inputs.counts.items() if name not in ORDINARY)
    text = "all input used" if refused == 0 else f"{refused} messages refused or remarkable"
    if refused:
        text += f", {new} of them new"
    return status("input", int(new > 0), text, values)


def noise_status(navigator: Navigator, reader: NoiseReader | None, mode: str) -> Status:
    """Return the noise levels in force, and where they come from."""
    running = navigator.filter
    source = _source(running.noise) if running else "none"
    if source == "learned" and reader is not None:
        source = f"learned ({reader.regressor.name})"
    levels = running.noise.levels() if running else np.full(6, np.nan)
    factors = _factors(running.noise) if running else {}
    conditions = noise_conditions(navigator)
    text = "; ".join([f"source: {source}", *conditions.values()])
    if reader is not None and reader.fault and running is not None:
        text += f"; last estimate refused: {reader.fault}"
    refusals = {} if reader is None else reader.refusals
    return status(
        "process noise",
        int(source == "fallback" or bool(conditions)),
        text,
        {
            "source": source,
            "mode": mode,
            **factors,
            **({} if running is None else _errors_of_fixes(running.noise)),
            **({} if running is None else _scale_errors(running.scale_errors)),
            **{f"refused: {why}": n for why, n in sorted(refusals.items())},
            **{f"q_{c}": float(value) for c, value in zip(CHANNELS, levels, strict=True)},
        },
    )


def _errors_of_fixes(noise: FilterNoise) -> dict[str, float]:
    """Return the standard deviations of what fixes do not claim, as the innovations show it."""
    return {
        "slow_error_of_fixes": max(noise.split.unclaimed_stds),
        "stamp_scatter_of_fixes": noise.found.stamp_std,
        "age_of_velocities": noise.found.age_std,
    }


def _scale_errors(found: ScaleErrors) -> dict[str, float]:
    """Return the errors of the scale factors along and about the axes of ``base_frame``."""
    values: dict[str, float] = {}
    sensors = ("accelerometer", found.M_a, found.std_a), ("gyroscope", found.M_g, found.std_g)
    for sensor, M, std in sensors:
        for i, axis in enumerate("xyz"):
            values[f"{sensor}_scale_error_{axis}"] = float(M[i, i])
            values[f"{sensor}_scale_error_{axis}_sigma"] = float(std[i, i])
    return values


def noise_conditions(navigator: Navigator) -> dict[str, str]:
    """Return what the innovations ask for besides the noise that is known: names, texts."""
    running, found = navigator.filter, {}
    if running is None:
        return {}
    if _rates_disagree(navigator, running.noise):
        found["the angular rates disagree with GNSS"] = (
            "the angular rates disagree with GNSS by more than their noise: check "
            "gnss.antenna_position, then the scale, resolution and range of the gyroscopes"
        )
    factors = _factors(running.noise)
    for key, what in ("factor_fixes", "fixes"), ("factor_heights", "the heights of fixes"):
        if factors.get(key, 1.0) > DISAGREEMENT:
            found[f"{what} scatter by more than they claim"] = (
                f"{what} scatter by more than they claim: check the receiver, gnss.position_std_min"
            )
            break
    innovations = running.noise.found
    clock_std = math.sqrt(running.nav[CLOCK_VARIANCE])  # an unknown offset looks like a scatter
    if innovations.stamp_probability > 0.5 and innovations.stamp_std > clock_std:
        found["stamps of fixes scatter"] = (
            f"the stamps of fixes scatter by about {innovations.stamp_std:.2g} s, and count for "
            "so much less along the motion: let the driver stamp them with the time of validity, "
            "not that of their arrival"
        )
    jumps = running.noise.jumps
    if jumps.variance(running.t_ns).any():
        claim = f"they claim {jumps.claimed_std:.2g} m"
        found["fixes jump by more than they claim"] = (
            f"fixes jumped by {jumps.size:.2g} m although {claim}: the published covariance "
            "contains such jumps until there was none for minutes; check the receiver and its "
            "corrections"
        )
    claimed_stds = running.noise.split.claimed_stds
    across, upward = drifts_beyond_claim(running.noise.slow_error, claimed_stds)
    if across or upward:
        of_fixes, of_heights = claimed_stds
        what, drift, claimed = (
            ("fixes", across, of_fixes) if across else ("the heights of fixes", upward, of_heights)
        )
        size = f"{drift:.1f}" if drift >= 0.1 else f"{drift:.1g}"
        found["fixes drift by more than they claim"] = (
            f"{what} drift by about {size} m although they claim {claimed:.2g} m: the "
            "published covariance contains what changes within minutes; check the receiver, its "
            "corrections and gnss.antenna_position, or set gnss.position_std_min"
        )
    return found


def _rates_disagree(navigator: Navigator, noise: FilterNoise) -> bool:
    """Return whether angular rates need more noise than ordinary errors of their scale make."""
    factor = noise.imu_factors[1]
    if factor <= DISAGREEMENT:
        return False
    mean_square = np.square(navigator.ring.latest(RECENT)["w"]).sum(axis=1).mean()
    ordinary = ORDINARY_SCALE_ERROR**2 * mean_square * MOTION_TIME
    return bool((1.0 - 1.0 / factor) * noise.psd()[W_G].max() > ordinary)


def alignment_conditions(navigator: Navigator) -> dict[str, str]:
    """Return what alignment lacks in the messages of the IMU: a name and a text, or nothing."""
    phase = navigator.phase
    if not isinstance(phase, Aligning) or phase.alignment.waiting.need not in IMU_CONTENTS:
        return {}
    return {"aligning": f"aligning: it needs {wording.waiting_for(navigator)}"}


def antenna_conditions(navigator: Navigator, moved_b: Array) -> dict[str, str]:
    """
    Return what is wrong with the antenna's place: a name and a text, or nothing.

    By the innovations, and by ``moved_b`` (3,) [m], b: where it is taken to be, less where given.
    """
    running = navigator.filter
    if running is None:
        return {}
    error_b, std, _, is_certain = running.lever_arm
    is_moved = bool(np.any(moved_b))
    if not (is_certain or is_moved):
        return {}
    place = wording.place_of(error_b + moved_b, std, digits=2)
    return {
        "the antenna is elsewhere": f"the antenna is about {place} of where imu.position and "
        "gnss.antenna_position put it: measure it, or run ins_calibrate"
        f"{MOVED if is_moved else ''}"
    }


def imu_disagrees(noise: FilterNoise) -> bool:
    """Return whether the innovations ask for much more noise of the IMU than it shows."""
    return max(noise.imu_factors) > DISAGREEMENT


def _source(noise: FilterNoise) -> str:
    """Return where the variances in force come from."""
    if isinstance(noise.model, LearnedNoise):
        return "fallback" if noise.model.on_fallback else "learned"
    return "innovation" if isinstance(noise.model, InnovationNoise) else "constant"


def _factors(noise: FilterNoise) -> dict[str, float]:
    """Return what the innovations multiply the noise by; empty where they do not."""
    if noise.factors is None:
        return {}
    accelerometer, gyroscope = noise.imu_factors
    found, (across, upward) = noise.found, noise.split.excess
    return {
        "factor_accelerometer": accelerometer,
        "factor_gyroscope": gyroscope,
        "factor_fixes": found.fixes * across,
        "factor_heights": found.fixes * found.heights * upward,
        "factor_velocities_horizontal": found.horizontal_velocity,
        "factor_velocities_vertical": found.vertical_velocity,
    }
