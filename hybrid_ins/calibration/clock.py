"""What the fit of recordings says about the clock of their fixes, and how late they arrive."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.findings import SIGNIFICANT, Finding, Verdict
from hybrid_ins.calibration.fit import CLOCK_KEPT, Fit
from hybrid_ins.calibration.likelihood import VELOCITY_AGE, offset_name
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.sensor_errors.clock_prior import UNKNOWN_DRIFT, ClockDrift
from hybrid_ins.parameters import PARAMETERS
from hybrid_ins.ros.messages.conversions import clock_drift

Array = NDArray[np.float64]

IDENTIFIED_OFFSET, NO_OFFSET = 0.015, 0.08  # s: largest σ, and σ from which nothing is known
SEARCHED_ANYWAY = 0.05  # s: a wider spread between recordings says no more than the search's cell
BETWEEN = 1e-5  # s/s, of the drift from one recording to the next: temperatures differ
MOST_FIXES, DELAY_MARGIN = 0.995, 1.25  # arrive within a time; its multiple is allowed for


def observe_clock(
    fitted: Fit, own: bool, values: Mapping[str, Any], search: float
) -> tuple[list[Finding], dict[str, float], str]:
    """
    Return what was found, the parameters that follow from all of it, and a comment on the offset.

    The offset that is written is the one that antenna, nose and noise were fitted with. Where it is
    weak, or the clock drifts, it has no σ that a filter could trust: that searches from there. With
    a drift it is the offset of the first fix, and need not be the same in another recording.

    Parameters
    ----------
    fitted : Fit
    own : bool
        Every recording has an offset of its own.
    values : mapping
        The given parameters.
    search : float
        How far from the given offset was searched [s].
    """
    rows: list[Finding] = []
    nominal, drift = values["gnss.time_offset.value"], _drift(fitted, clock_drift(values))
    first = [float(one.aid_t[0] - np.mean(one.aid_t)) for one in fitted.recordings]
    found = {
        "gnss.time_offset.value": nominal,
        "gnss.time_offset.std": 0.0,
        "gnss.time_offset.drift": round(1e6 * drift.mean, 1),
        "gnss.time_offset.drift_std": round(1e6 * drift.std, 1),
    }
    count = len(fitted.recordings)
    for k in range(count) if own else [0]:
        name = offset_name(k, fitted.names)
        value, sigma = fitted.value(name), fitted.sigma(name)
        profile = fitted.profile[k] if own else fitted.profile.sum(axis=0)
        second = _second_peak(fitted.grid, profile, value)
        verdict: Verdict
        if name in fitted.frozen and sigma > NO_OFFSET:
            verdict, note = "not identifiable", "the motion is too uniform: drive or fly curves"
        elif name in fitted.frozen:
            verdict, note = "weak", CLOCK_KEPT
        elif abs(value - nominal) > search - 0.15:
            verdict, note = "weak", "at the limit of the search: give a larger --search"
        elif second is not None:
            verdict, note = "weak", f"{second:+.1f} s is nearly as likely"
        elif sigma <= IDENTIFIED_OFFSET:
            verdict, note = "identified", ""
        else:
            verdict, note = "weak", "little change of speed and direction"
        if fitted.drift.value:
            value, sigma = value + drift.mean * first[k], math.hypot(sigma, drift.std * first[k])
            note = "of the first fix; the filter searches for that of another recording"
        label = "clock offset" + (f", {fitted.recordings[k].name}" if own else "")
        rows.append(Finding(label, f"{value:+.4f} s", f"{sigma:.4f} s", verdict, note))
    if fitted.drift.value:
        name = "gnss.time_offset.drift"
        ppm, std = (f"{1e6 * part:.0f} ppm" for part in fitted.drift)
        rows.append(Finding("clock drift", ppm, std, "identified", values={name: found[name]}))
    known = not any(name.startswith("offset") for name in fitted.frozen)
    offsets = [fitted.offset(k) + known * drift.mean * first[k] for k in range(count)]
    text = "; ".join(row.text for row in rows)
    if not drift.mean and all(row.verdict == "identified" for row in rows):
        found["gnss.time_offset.std"] = _std(fitted, offsets)
    if known and VELOCITY_AGE not in fitted.frozen:
        rows.append(_velocity_age(fitted))
    found["gnss.time_offset.value"] = round(float(np.mean(offsets)), 4)
    return rows, found, f"{text}; their mean" if own and count > 1 else text


def _drift(fitted: Fit, given: ClockDrift) -> ClockDrift:
    """Return the drift to expect of another recording: as given where nothing contradicts it."""
    found = fitted.drift
    if found.value:
        return ClockDrift(found.value, math.hypot(found.std, BETWEEN))
    return given if abs(given.mean) < SIGNIFICANT * found.std else UNKNOWN_DRIFT


def _velocity_age(fitted: Fit) -> Finding:
    """Return how much older velocities are than positions with the same stamp."""
    older, sigma = -fitted.value(VELOCITY_AGE), fitted.sigma(VELOCITY_AGE)
    verdict: Verdict = "identified" if sigma <= IDENTIFIED_OFFSET else "weak"
    note = "behind positions with the same stamp; the filter finds it while running"
    return Finding("age of velocities", f"{older:+.3f} s", f"{sigma:.3f} s", verdict, note)


def _std(fitted: Fit, offsets: list[float]) -> float:
    """Return the σ [s] of the offset of another recording of the same robot; 0: not known."""
    sigmas = [fitted.sigma(offset_name(k, fitted.names)) for k in range(len(offsets))]
    spread = float(np.ptp(offsets)) if len(offsets) > 1 else 0.0
    length = max(float(np.ptp(recording.aid_t)) for recording in fitted.recordings)
    by_drift = fitted.drift.std * length / math.sqrt(12.0)
    std = math.hypot(float(np.max(sigmas)), spread, by_drift)
    return round(std, 4) if std < SEARCHED_ANYWAY else 0.0


def _second_peak(grid: Array, profile: Array, value: float) -> float | None:
    """Return another peak of the coarse likelihood if it is nearly as high."""
    away = np.abs(grid - value) > 0.35
    if not np.any(away):
        return None
    other = int(np.argmax(np.where(away, profile, -np.inf)))
    return float(grid[other]) if profile[other] > np.max(profile) - 5.0 else None


def observe_delay(
    recordings: Sequence[Recording], offsets: Sequence[float], given: float
) -> Finding | None:
    """
    Return the delay of the fixes if it takes a larger ``gnss.max_delay`` [s] to let them in.

    Parameters
    ----------
    recordings : sequence of Recording
    offsets : sequence of float
        Clock offset of each [s].
    given : float
        The present ``gnss.max_delay`` [s].
    """
    late = [
        float(np.quantile(recording.delay, MOST_FIXES)) - max(0.0, offset)
        for recording, offset in zip(recordings, offsets, strict=True)
        if len(recording.delay)
    ]
    if not late:
        return None
    worst, largest = max(*late, 0.0), float(PARAMETERS["gnss.max_delay"].high or math.inf)
    needed = math.ceil(10.0 * DELAY_MARGIN * worst) / 10.0
    verdict: Verdict = "identified"
    note = f"{100.0 * MOST_FIXES:g} % arrive within that after their stamp"
    if worst > largest:
        verdict, note = "weak", f"more than gnss.max_delay can be ({largest:g} s): rejected"
    if needed <= given:
        return None
    changed = {"gnss.max_delay": min(needed, largest)}
    return Finding("delay of the fixes", f"{worst:.2f} s", "", verdict, note, changed)
