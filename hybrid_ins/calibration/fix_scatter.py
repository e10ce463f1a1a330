"""How positions and velocities of a receiver scatter, relative to what they claim."""

from __future__ import annotations

import math
from dataclasses import replace

from hybrid_ins.calibration.findings import SIGNIFICANT, Finding, Verdict
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.likelihood import POSITION_SCALE, SLOW_SHARE, VELOCITY_SCALE
from hybrid_ins.core.noise.slow_error import SLOW_TIME

DEFAULT_STD = "gnss.position_std_default"
SCATTER, SMALLEST_SCATTER, LARGEST_SCATTER = "gnss.position_scatter", 0.2, 10.0
SCALE_IDENTIFIED = 0.3  # largest σ of the logarithm of a covariance's factor
SLOW_IDENTIFIED = 1.5  # likewise, of the variance of the slow error
NOTICEABLE = 0.4  # logarithm of a factor that is mentioned


def scatter_findings(fitted: Fit, given: float) -> list[Finding]:
    """
    Return what was found of the scatter of positions and velocities.

    Empty where the covariances were trusted. ``given`` is the present gnss.position_scatter, which
    is kept where nothing better is found.
    """
    if POSITION_SCALE in fitted.frozen:
        return []
    is_stated = {recording.states_std for recording in fitted.recordings}
    rows = [_positions(fitted, given, is_stated), _slow_error(fitted, _reference(is_stated))]
    if VELOCITY_SCALE not in fitted.frozen:
        row, change = _scale(fitted, VELOCITY_SCALE, "velocities' scatter", "stated σ")
        note = "the receiver's σ of them is too small: gnss.velocity_std_min raises it"
        rows.append(replace(row, note=note) if change > 0 else row)
    return rows


def _reference(is_stated: set[bool]) -> str:
    """Return what the positions' σ is; ``is_stated`` has whether recordings state one."""
    if len(is_stated) > 1:
        return "σ"
    return "stated σ" if is_stated == {True} else "default σ"


def _scale(fitted: Fit, name: str, label: str, reference: str) -> tuple[Finding, int]:
    """Return a scale, and whether it is below or above 1: -1, 1; 0: neither for certain."""
    scale, sigma = fitted.value(name), fitted.sigma(name)
    factor = math.exp(0.5 * scale)
    differs = abs(scale) >= max(SIGNIFICANT * sigma, NOTICEABLE)
    change = int(math.copysign(differs, scale))
    verdict: Verdict = "identified" if sigma < SCALE_IDENTIFIED else "weak"
    value, spread = f"{factor:.3g} × {reference}", f"{0.5 * sigma * factor:.1g}"
    return Finding(label, value, spread, verdict), change


def _positions(fitted: Fit, given: float, is_stated: set[bool]) -> Finding:
    """Return the positions' scatter from fix to fix."""
    row, change = _scale(fitted, POSITION_SCALE, "fixes' scatter", _reference(is_stated))
    verdict = row.verdict
    scale, sigma = fitted.value(POSITION_SCALE), fitted.sigma(POSITION_SCALE)
    if scale + SIGNIFICANT * sigma < 2.0 * math.log(SMALLEST_SCATTER):  # however small it is
        verdict = "identified"
    if len(is_stated) > 1:
        verdict, note = "weak", "the receiver states its σ in some recordings only"
    elif is_stated == {False}:
        note = f"the receiver states no σ: {DEFAULT_STD} is used, set it to the receiver's"
    else:
        note = _of_stated(fitted, change)
    values = {SCATTER: given}
    if change and verdict == "identified":
        factor = round(math.exp(0.5 * scale), 2)
        values[SCATTER] = min(max(factor, SMALLEST_SCATTER), LARGEST_SCATTER)
    return replace(row, verdict=verdict, note=note, values=values)


def _of_stated(fitted: Fit, change: int) -> str:
    """Return what is wrong with the σ that is stated, where the scatter is below or above it."""
    if change >= 0:
        return "the receiver's σ is too small" if change else ""
    total = math.exp(fitted.value(POSITION_SCALE))
    if fitted.sigma(SLOW_SHARE) < SLOW_IDENTIFIED:
        total += math.exp(fitted.value(SLOW_SHARE))
    if math.log(total) < -NOTICEABLE:
        return "the receiver's σ is too large"
    return "from fix to fix; σ is to contain the slow error, too: do not lower it"


def _slow_error(fitted: Fit, reference: str) -> Finding:
    """Return the slow error of positions."""
    value, sigma = fitted.value(SLOW_SHARE), fitted.sigma(SLOW_SHARE)
    verdict: Verdict = "not identifiable"
    note = "smaller than the other errors"
    if sigma < SLOW_IDENTIFIED:
        verdict = "identified"
        note = f"changes within {SLOW_TIME:g} s; the filter finds it while running"
    text, spread = f"{math.exp(0.5 * value):.2f} × {reference}", math.exp(min(0.5 * sigma, 9.0))
    return Finding("fixes' slow error", text, f"×/÷ {spread:.1f}", verdict, note)
