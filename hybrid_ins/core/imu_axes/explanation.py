"""
Which other axes or units explain a motion that the readings of an IMU do not fit as given.

Several explanations may be one hypothesis, that is one fit: a mirrored accelerometer moves like a
mirrored gyroscope. What tells them apart is gravity and the course over ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.course import mount_fault
from hybrid_ins.core.imu_axes.faults import DEGREES, EXPLANATIONS, AxesFault, to_hypothesis
from hybrid_ins.core.imu_axes.fit import Fit, Motion
from hybrid_ins.core.imu_axes.tolerance import times_by_chance

Array = NDArray[np.float64]

FITS, FITS_OTHER = 0.01, 0.3  # shares of the changes' squares left over as given, by other axes
NOISE = 0.25  # correlation of successive errors, up to which they are the fixes' noise
BETTER, MUCH_BETTER = 1.5, 4.0  # times less is left over: noise alone, and more than noise
AS_GOOD = 2.0  # times more is left over than by the best


@dataclass(frozen=True, slots=True, eq=False)
class ComparedMotion:
    """
    A motion, and how the readings fit it with axes and units as given.

    Attributes
    ----------
    motion : Motion
    change : float
        Sum of the squares of its changes of horizontal velocity [m²/s²].
    as_given : Fit
    """

    motion: Motion
    change: float
    as_given: Fit

    @property
    def fits(self) -> bool:
        """Nothing is wrong: what is left over is little, or the fixes' noise."""
        return self.is_explained or is_noise(self.as_given)

    @property
    def is_explained(self) -> bool:
        """Little of the changes is left over."""
        return self.as_given.left < FITS * self.change

    @property
    def is_excluded(self) -> bool:
        """So much is left over that the readings say nothing of the motion."""
        return self.as_given.left > FITS_OTHER * self.change

    @property
    def is_hidden(self) -> bool:
        """The fixes' noise hides the motion."""
        return is_noise(self.as_given) and self.is_excluded

    @property
    def has_turns(self) -> bool:
        """The gyroscope shows a change of the angular rate."""
        return bool(np.any(np.ptp(self.motion.turn, axis=0)))


def is_noise(fitted: Fit) -> bool:
    """Return whether what a fit leaves over is the fixes' noise."""
    return fitted.correlation < NOISE


def hypothesis_of(accelerometer: Array, gyroscope: Array, arm: Array) -> Fit:
    """Return the start of a fit by an explanation, with the antenna at an arm (3,) [m]."""
    sign, factor = to_hypothesis(accelerometer, gyroscope)
    turned = sign * accelerometer.T @ arm
    return Fit(sign, factor, lever_arm=turned, given_arm=turned)


def hypotheses(arm: Array) -> list[Fit]:
    """
    Return the fits to try, of readings from an IMU whose antenna is at an arm (3,) [m].

    Where several explanations are one hypothesis, the arm is in the axes of the most ordinary.
    """
    found: list[Fit] = []
    for explanation in EXPLANATIONS:
        if not any(_is_by(one, *to_hypothesis(*explanation)) for one in found):
            found.append(hypothesis_of(*explanation, arm))
    return found


def explain(
    compared: ComparedMotion, fits: Sequence[Fit], mount: Array, is_first: bool
) -> AxesFault | None:
    """
    Return the fault if hypotheses fit much better than the readings as given.

    Parameters
    ----------
    compared : ComparedMotion
    fits : sequence of Fit
        Of the motion, by hypotheses.
    mount : ndarray, shape (3, 3)
        From the IMU's own axes to b, as given.
    is_first : bool
        No motion was compared before. Otherwise the best hypothesis may only leave noise over.
    """
    fits = _possible(compared, fits)
    best = min(fits, key=lambda one: one.left, default=None)
    if best is None or not (is_first or is_noise(best)) or not _is_better(best, compared):
        return None
    most = max(AS_GOOD * best.left, best.left + FITS * compared.change)
    fault = _most_ordinary(compared.motion, [one for one in fits if one.left < most], mount)
    if fault is None or best.left < compared.as_given.left / MUCH_BETTER:
        return fault
    t = compared.motion.fix_t
    return replace(fault, shown_by=(float(t[0]), float(t[-1])))


def _possible(compared: ComparedMotion, fits: Sequence[Fit]) -> list[Fit]:
    """
    Return the fits without that of rates in degrees, where these are out of the question.

    They turn the vehicle 57 times too far, and do not fit as given at all. Without turns such a fit
    is good in any case, and hides the bias, too.
    """
    most = compared.as_given.left / MUCH_BETTER if compared.is_excluded else 0.0
    return [one for one in fits if one.left < most or not _is_slow(one)]


def _is_better(best: Fit, compared: ComparedMotion) -> bool:
    """Return whether a hypothesis fits, and so much better than as given that it is no chance."""
    times = max(BETTER, times_by_chance(compared.motion)) if is_noise(best) else MUCH_BETTER
    return best.left <= min(FITS_OTHER * compared.change, compared.as_given.left / times)


def _most_ordinary(motion: Motion, fits: Sequence[Fit], mount: Array) -> AxesFault | None:
    """Return the explanations that gravity and course allow; else one with another mount."""
    plain: list[tuple[Array, Array]] = []
    with_mount: list[AxesFault] = []
    for explanation in EXPLANATIONS:
        found = [one for one in fits if _is_by(one, *to_hypothesis(*explanation))]
        if not found:
            continue
        fault = mount_fault(mount, motion, *explanation, found[0])
        if fault is None:
            plain.append(explanation)
        else:
            with_mount.append(fault)
    return AxesFault(tuple(plain), mount) if plain else next(iter(with_mount), None)


def _is_by(fitted: Fit, sign: float, gyroscope: Array) -> bool:
    """Return whether a fit is that of a hypothesis."""
    return fitted.sign == sign and np.allclose(fitted.gyroscope, gyroscope)


def _is_slow(fitted: Fit) -> bool:
    """Return whether a fit is that of rates in degrees."""
    return bool(np.allclose(fitted.gyroscope, DEGREES * np.eye(3)))
