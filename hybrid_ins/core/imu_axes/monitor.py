"""
Axes and units of an IMU, checked against the motion that fixes show.

Where the readings fit the motion with other axes or units, and do not with those given, these are
wrong, see `hybrid_ins.core.imu_axes.fit`. Where they fit as given, the mount may be wrong:
specific force points up on average, and a vehicle that keeps one angle to its course moves along
its nose.

Readings that seem to fit over short intervals are compared over longer ones, too, and over a longer
window: the fixes' noise hides less there, and the gyroscope's bias explains less. What fits a
little better may do so by chance, and is believed once motion that is half new shows it again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.health import LEAST_FORCE
from hybrid_ins.core.imu_axes.antenna import FarAntenna, far_fit, is_far_away
from hybrid_ins.core.imu_axes.course import courses, is_winding, kinds_of, mount_fault
from hybrid_ins.core.imu_axes.faults import (
    DEGREES,
    EXPLANATIONS,
    AxesFault,
    mount_upright,
    to_hypothesis,
)
from hybrid_ins.core.imu_axes.fit import Fit, Motion, fit
from hybrid_ins.core.imu_axes.motion import WINDOW, MotionWindow, is_long
from hybrid_ins.core.imu_axes.tolerance import times_by_chance, tolerant_fits
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY

Array = NDArray[np.float64]

FITS, FITS_OTHER = 0.01, 0.3  # shares of the changes' squares left over as given, by other axes
NOISE = 0.25  # correlation of successive errors, up to which they are the fixes' noise
BETTER, MUCH_BETTER = 1.5, 4.0  # times less is left over: noise alone, and more than noise
AS_GOOD = 2.0  # times more is left over than by the best
PERIOD_NS, LONGEST_PERIOD_NS = 5_000_000_000, 60_000_000_000  # between two checks
ENOUGH = 4  # checks of one kind of motion, before it is checked once a minute
MOST_MEAN_FORCE = 1.15 * STANDARD_GRAVITY  # of which the direction is that of gravity
CONFIRMATIONS = 2  # checks in a row that find the same

AS_GIVEN = ((np.eye(3), np.eye(3)),)
NO_ARM = np.zeros(3)


def _hypotheses(arm: Array) -> list[Fit]:
    """
    Return the fits to try, of readings from an IMU whose antenna is at an arm (3,) [m].

    Several explanations may be one hypothesis: the arm is in the axes of the most ordinary.
    """
    found: list[Fit] = []
    for pair in EXPLANATIONS:
        one = _hypothesis(*pair, arm)
        if not any(f.sign == one.sign and np.allclose(f.gyroscope, one.gyroscope) for f in found):
            found.append(one)
    return found


def _hypothesis(accelerometer: Array, gyroscope: Array, arm: Array) -> Fit:
    """Return the start of a fit by an explanation, with the antenna at an arm (3,) [m]."""
    sign, factor = to_hypothesis(accelerometer, gyroscope)
    turned = sign * accelerometer.T @ arm
    return Fit(sign, factor, lever_arm=turned, given_arm=turned)


class ImuAxesCheck:
    """
    Gathers the last seconds of motion, and finds out whether the IMU's axes and units fit it.

    Parameters
    ----------
    mount : ndarray, shape (3, 3)
        From the IMU's own axes to b, as given.
    lever_b : ndarray, shape (3,)
        From the IMU to the antenna [m], b, as given.

    Attributes
    ----------
    fault : AxesFault or None
        What is wrong.
    """

    def __init__(self, mount: Array, lever_b: Array = NO_ARM) -> None:
        self._mount, self._arm = mount, mount.T @ lever_b
        self.fault: AxesFault | None = None
        self._antenna = FarAntenna()
        self._upright = 0  # motions with the mount given upright, less those with it turned
        self.reset()

    def reset(self) -> None:
        """Forget the motion so far."""
        self._window = MotionWindow(self._mount)
        self._next_ns = self._rare_ns = 0
        self._checked: Counter[str] = Counter()
        self._work: Generator[None, None, AxesFault | bool] | None = None
        self._found: AxesFault | None = None
        self._times = 0
        self._concluded = False
        self._antenna.reset()

    @property
    def doubtful(self) -> bool:
        """Something seems wrong, or nothing is known yet."""
        is_found = self._found is not None or self._antenna.is_doubtful
        return is_found or not self._concluded

    @property
    def antenna_error_b(self) -> tuple[Array, Array] | None:
        """True minus given place of an antenna far from the given one, and its σ, (3,) [m], b."""
        error, std = self._antenna.error, self._antenna.std
        return None if error is None else (self._mount @ error, np.abs(self._mount) @ std)

    def add_samples(self, samples: NDArray[np.void]) -> None:
        """Add samples (``SAMPLE_DTYPE``, in b) that follow the last ones."""
        self._window.add_samples(samples)

    def add_fix(self, t_ns: int, lla: Array) -> None:
        """Add a position fix: stamp [ns], latitude, longitude [rad] and height [m], (3,)."""
        self._window.add_fix(t_ns, lla)

    def advance(self, t_ns: int) -> None:
        """Do a share of the work that is due at a stamp [ns]: some milliseconds at most."""
        if self._work is None:
            if t_ns < self._next_ns:
                return
            self._next_ns = t_ns + PERIOD_NS
            short = self._window.motions(WINDOW, 0)
            motions = short or self._window.long_motions()
            if not motions:
                self._on_found(self._by_gravity())
                return
            kinds = kinds_of(motions[0])
            if t_ns < self._rare_ns and all(self._checked[kind] >= ENOUGH for kind in kinds):
                return
            self._rare_ns = t_ns + LONGEST_PERIOD_NS
            self._checked.update(kinds)
            self._work = self._compare([*short, *self._window.long_motions()])
        try:
            next(self._work)
        except StopIteration as end:
            self._work, self._concluded = None, True
            if self._antenna.is_doubtful or (
                isinstance(end.value, AxesFault) and self.fault is None
            ):
                self._checked.clear()
            self._on_found(end.value)

    def _on_found(self, found: AxesFault | bool) -> None:
        """Use the result of a check: what several in a row have in common counts."""
        if found is True:
            self._times, self._found, self.fault = 0, None, None
            self._antenna.is_doubtful = False
        if not isinstance(found, AxesFault):
            return
        last = self._found
        both = None if last is None else last.in_common(found)
        if last is None or both is None:
            self._times, self._found = 1, found
        else:
            self._times += last.is_confirmed_by(found)
            self._found = both
        if self._times < CONFIRMATIONS:
            return
        if self.fault is None or not self.fault.same(self._found):
            self.fault = self._found

    def _compare(self, motions: list[Motion]) -> Generator[None, None, AxesFault | bool]:
        """
        Return what is wrong by motions, the one over the shortest intervals first; see `advance`.

        True: nothing is. False: no hypothesis fits, or the fixes' noise hides the motion.
        """
        one = np.eye(3)
        as_given = Fit(1.0, one, lever_arm=self._arm, given_arm=self._arm)
        fits: list[Fit] = []
        passed: list[tuple[Motion, Fit]] = []
        fitting: list[tuple[Motion, Fit]] = []
        tried = 0
        for motion in motions:
            most = 1 if is_long(motion) else 2
            if sum(len(m.t) == len(motion.t) for m, _ in passed) == most:
                continue
            change = float(np.sum(motion.change_n[:, :2] ** 2))
            as_given = fit(motion, as_given)
            yield
            if as_given.correlation < NOISE and as_given.left > FITS_OTHER * change:
                continue
            passed.append((motion, as_given))
            if as_given.left < FITS * change or as_given.correlation < NOISE:
                if is_long(motion) and as_given.left > FITS * change:
                    far = yield from far_fit(motion, as_given)
                    if _is_elsewhere(motion, change, as_given, far):
                        self._antenna.add(motion, far)
                        return False
                fitting.append(passed[-1])
                continue
            if not np.any(np.ptp(motion.turn, axis=0)):
                return AxesFault(AS_GIVEN, self._mount, no_turns=True)
            if not tried:
                fits = _hypotheses(self._arm)
            untried, tried = passed[tried:], len(passed)
            fits = yield from _fit_all(fits, untried[:1] + untried[1:][-1:])
            found = self._explain(motion, change, as_given, fits, len(passed) == 1)
            best = as_given
            if found is not None:
                best, others = yield from tolerant_fits(motion, as_given, fits)
                found = self._explain(motion, change, best, others, len(passed) == 1)
                if found is None and best.left < FITS * change:
                    fitting.append((motion, best))
                    continue
            far = yield from far_fit(motion, best)
            is_accused = found is not None
            if is_accused and is_far_away(far):
                found = self._explain(motion, change, far, others, len(passed) == 1)
            if found is not None:
                return found
            if _is_elsewhere(motion, change, best, far):
                self._antenna.add(motion, far)
                return False
            if is_accused:
                return False
            if not any(one.correlation < NOISE for one in fits):
                break  # errors that are more than noise only grow with the interval
        if not fitting:
            return self._by_gravity()
        motion, as_given = fitting[-1]
        fault = mount_fault(self._mount, motion, one, one, as_given)
        is_turned = fault is not None and not fault.by_course
        self._upright += -1 if is_turned else 1
        if is_turned:
            if self._upright >= 0:  # an aircraft that flies loops and rolls
                return True
            reversed_force = fit(motion, _hypothesis(-one, one, self._arm))
            if reversed_force.left < MUCH_BETTER * as_given.left:
                return self._by_gravity() or True
        return fault or not self._may_be_as_found(*fitting[0])

    def _may_be_as_found(self, motion: Motion, as_given: Fit) -> bool:
        """Return whether a motion that fits as given does not contradict an earlier check."""
        found = self._found
        if found is None or found.at_rest:
            return False
        if found.no_turns:
            return not np.any(np.ptp(motion.turn, axis=0))
        if found.turned:
            return found.by_course and not is_winding(courses(motion)[0])
        hypothesis = _hypothesis(*found.explanations[0], self._arm)
        return fit(motion, hypothesis).left < AS_GOOD * as_given.left

    def _by_gravity(self) -> AxesFault | bool:
        """
        Return how the IMU lies by its mean specific force, if it does not lie as given.

        Without gravity, which a driver may have removed, that says nothing, nor does more than
        gravity: a vehicle that circles, at any bank, has that.
        """
        mean_force = self._window.mean_force()
        if mean_force is None or not LEAST_FORCE < np.linalg.norm(mean_force) < MOST_MEAN_FORCE:
            return False
        mount = mount_upright(self._mount, mean_force)
        return False if mount is None else AxesFault(AS_GIVEN, mount, turned=True, at_rest=True)

    def _explain(
        self, motion: Motion, change: float, as_given: Fit, fits: list[Fit], is_first: bool
    ) -> AxesFault | None:
        """
        Return the fault if hypotheses fit much better than the readings as given.

        Where a motion was compared before, only the fixes' noise may be left over by the best.
        Rates in degrees turn the vehicle 57 times too far, and do not fit as given at all. Of those
        that fit, the most ordinary explanation by gravity and course is chosen.
        """
        is_excluded = as_given.left > FITS_OTHER * change
        most = as_given.left / MUCH_BETTER if is_excluded else 0.0
        fits = [f for f in fits if f.left < most or not _is_slow(f)]
        if not fits:
            return None
        best = min(fits, key=lambda one: one.left)
        is_noise = best.correlation < NOISE
        if not (is_noise or is_first):
            return None
        times = max(BETTER, times_by_chance(motion)) if is_noise else MUCH_BETTER
        if best.left > min(FITS_OTHER * change, as_given.left / times):
            return None
        most = max(AS_GOOD * best.left, best.left + FITS * change)
        fitting = [one for one in fits if one.left < most]
        with_mount: list[AxesFault] = []
        plain: list[tuple[Array, Array]] = []
        for accelerometer, gyroscope in EXPLANATIONS:
            sign, factor = to_hypothesis(accelerometer, gyroscope)
            found = [f for f in fitting if f.sign == sign and np.allclose(f.gyroscope, factor)]
            if not found:
                continue
            fault = mount_fault(self._mount, motion, accelerometer, gyroscope, found[0])
            if fault is None:
                plain.append((accelerometer, gyroscope))
            else:
                with_mount.append(fault)
        fault = AxesFault(tuple(plain), self._mount) if plain else next(iter(with_mount), None)
        if fault is None or best.left < as_given.left / MUCH_BETTER:
            return fault
        return replace(fault, shown_by=(float(motion.fix_t[0]), float(motion.fix_t[-1])))


def _fit_all(
    hypotheses: list[Fit], motions: list[tuple[Motion, Fit]]
) -> Generator[None, None, list[Fit]]:
    """Return fits of the last motion, by hypotheses that fit those before as if as given."""
    fits: list[Fit] = []
    for motion, as_given in motions:
        fits = []
        for hypothesis in hypotheses:
            fits.append(fit(motion, hypothesis))
            yield
        hypotheses = [f for f in fits if f.left < AS_GOOD * as_given.left]
    return fits


def _is_elsewhere(motion: Motion, change: float, as_given: Fit, far: Fit) -> bool:
    """Return whether only an antenna far from the given place lets the readings fit."""
    if not is_far_away(far):
        return False
    is_noise = is_long(motion) and far.correlation < NOISE
    if not (is_noise or far.left < FITS * change):
        return False
    return far.left < as_given.left / (BETTER if is_noise else MUCH_BETTER)


def _is_slow(hypothesis: Fit) -> bool:
    """Return whether rates were in degrees: without turns this fits, and hides the bias, too."""
    return bool(np.allclose(hypothesis.gyroscope, DEGREES * np.eye(3)))
