"""
Axes and units of an IMU, checked against the motion that fixes show.

Where the readings fit the motion with other axes or units, and do not with those given, these are
wrong, see `hybrid_ins.core.imu_axes.comparison`. Where they fit as given, the mount may be wrong:
specific force points up on average, and a vehicle that keeps one angle to its course moves along
its nose.

What fits a little better may do so by chance, and is believed once motion that is half new shows it
again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.health import LEAST_FORCE
from hybrid_ins.core.imu_axes.antenna import FarAntenna
from hybrid_ins.core.imu_axes.comparison import AS_GIVEN, MotionComparison, Outcome
from hybrid_ins.core.imu_axes.course import (
    courses,
    is_winding,
    kinds_of,
    mount_fault,
    moves_along_nose,
)
from hybrid_ins.core.imu_axes.explanation import AS_GOOD, MUCH_BETTER, ComparedMotion, hypothesis_of
from hybrid_ins.core.imu_axes.faults import AxesFault, mount_as_shown, mount_upright
from hybrid_ins.core.imu_axes.fit import Motion, fit
from hybrid_ins.core.imu_axes.level import LevelCheck, Tilt, is_gravity_alone
from hybrid_ins.core.imu_axes.motion import WINDOW, MotionWindow
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY

Array = NDArray[np.float64]

PERIOD_NS, LONGEST_PERIOD_NS = 5_000_000_000, 60_000_000_000  # between two checks
ENOUGH = 4  # checks of one kind of motion, before it is checked once a minute
MOST_MEAN_FORCE = 1.15 * STANDARD_GRAVITY  # of which the direction is that of gravity
CONFIRMATIONS = 2  # checks in a row that find the same

NO_ARM = np.zeros(3)


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
        self._level = LevelCheck(mount)
        self._moved_along_nose = False
        self._upright = 0  # motions with the mount given upright, less those with it turned
        self.reset()

    def reset(self) -> None:
        """Forget the motion so far."""
        self._window = MotionWindow(self._mount)
        self._level.reset()
        self._next_ns = self._rare_ns = 0
        self._checked: Counter[str] = Counter()
        self._work: Generator[None, None, AxesFault | Outcome] | None = None
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
    def tilt(self) -> Tilt | None:
        """How the mount is tilted by the mean specific force, where nothing worse is wrong."""
        return self._level.tilt if self.fault is None else None

    @property
    def antenna_error_b(self) -> tuple[Array, Array] | None:
        """True minus given place of an antenna far from the given one, and its σ, (3,) [m], b."""
        error, std = self._antenna.error, self._antenna.std
        return None if error is None else (self._mount @ error, np.abs(self._mount) @ std)

    def add_samples(self, samples: NDArray[np.void]) -> None:
        """Add samples (``SAMPLE_DTYPE``, in b) that follow the last ones."""
        self._window.add_samples(samples)
        self._level.add_samples(samples)
        if self._level.has_moved_level:
            self._withdraw_what_rest_showed()

    def add_fix(self, t_ns: int, lla: Array) -> None:
        """Add a position fix: stamp [ns], latitude, longitude [rad] and height [m], (3,)."""
        self._window.add_fix(t_ns, lla)
        self._level.add_fix(lla)

    def advance(self, t_ns: int) -> None:
        """Do a share of the work that is due at a stamp [ns]: some milliseconds at most."""
        if self._work is None:
            if t_ns < self._next_ns:
                return
            self._next_ns = t_ns + PERIOD_NS
            short = self._window.motions(WINDOW, 0)
            motions = short or self._window.long_motions()
            if not motions:
                self._on_found(self._by_gravity() or Outcome.UNDECIDED)
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
            is_new = isinstance(end.value, AxesFault) and self.fault is None
            if self._antenna.is_doubtful or is_new:
                self._checked.clear()
            self._on_found(end.value)

    def _on_found(self, found: AxesFault | Outcome) -> None:
        """Use the result of a check: what several in a row have in common counts."""
        if found is Outcome.FITS:
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

    def _withdraw_what_rest_showed(self) -> None:
        """Withdraw what gravity alone has shown of the mount: level motion shows the contrary."""
        if self._found is not None and self._found.at_rest:
            self._times, self._found = 0, None
        if self.fault is not None and self.fault.at_rest:
            self.fault = None

    def _compare(self, motions: Sequence[Motion]) -> Generator[None, None, AxesFault | Outcome]:
        """Return what motions show of axes, units and mount; see `advance`."""
        comparison = MotionComparison(self._mount, self._arm, self._antenna)
        found = yield from comparison.run(motions)
        if found is Outcome.UNDECIDED:
            return self._by_gravity() or found
        return self._judge_mount(comparison.fitting) if found is Outcome.FITS else found

    def _judge_mount(self, fitting: Sequence[ComparedMotion]) -> AxesFault | Outcome:
        """Return what motions that fit as given show of the mount."""
        last = fitting[-1]
        fault = mount_fault(self._mount, last.motion, *AS_GIVEN[0], last.as_given)
        if fault is None and not self._moved_along_nose:
            accelerometer, _ = AS_GIVEN[0]
            self._moved_along_nose = moves_along_nose(
                self._mount, last.motion, accelerometer, last.as_given
            )
        if fault is not None and fault.by_course and self._moved_along_nose:
            return Outcome.FITS  # it reverses, or moves sideways
        is_turned = fault is not None and not fault.by_course
        self._upright += -1 if is_turned else 1
        was_level = self._upright >= 0 or self._level.has_moved_level
        if is_turned and was_level:  # an aircraft that flies loops and rolls, or has hovered
            return Outcome.FITS
        if is_turned and self._may_be_reversed(last):
            return self._by_gravity() or Outcome.FITS
        if fault is None and self._may_be_as_found(fitting[0]):
            return Outcome.UNDECIDED
        return fault or Outcome.FITS

    def _may_be_reversed(self, fitting: ComparedMotion) -> bool:
        """Return whether a motion that fits as given fits reversed specific force about as well."""
        reversed_force = hypothesis_of(-np.eye(3), np.eye(3), self._arm)
        return fit(fitting.motion, reversed_force).left < MUCH_BETTER * fitting.as_given.left

    def _may_be_as_found(self, fitting: ComparedMotion) -> bool:
        """Return whether a motion that fits as given does not contradict an earlier check."""
        found, motion = self._found, fitting.motion
        if found is None or found.at_rest:
            return False
        if found.no_turns:
            return not fitting.has_turns
        if found.turned:
            return found.by_course and not is_winding(courses(motion)[0])
        hypothesis = hypothesis_of(*found.explanations[0], self._arm)
        return fit(motion, hypothesis).left < AS_GOOD * fitting.as_given.left

    def _by_gravity(self) -> AxesFault | None:
        """
        Return how the IMU lies by its mean specific force, if it does not lie as given.

        Without gravity, which a driver may have removed, that says nothing, nor does more than
        gravity: a vehicle that circles, at any bank, has that. A tailsitter that hovers again after
        level motion has not turned its IMU.
        """
        mean_force = None if self._level.has_moved_level else self._window.mean_force()
        force = 0.0 if mean_force is None else float(np.linalg.norm(mean_force))
        if mean_force is None or not LEAST_FORCE < force < MOST_MEAN_FORCE:
            return None
        mount = mount_upright(self._mount, mean_force)
        if mount is None:
            return None
        if is_gravity_alone(force):
            mount = mount_as_shown(self._mount, mean_force)
        return AxesFault(AS_GIVEN, mount, turned=True, at_rest=True)
