"""
Readings of an IMU compared with motions, those over the shortest intervals first.

Readings that seem to fit over short intervals are compared over longer ones, too, and over a longer
window: the fixes' noise hides less there, and the gyroscope's bias explains less.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.antenna import FarAntenna, far_fit, is_far_away
from hybrid_ins.core.imu_axes.explanation import (
    AS_GOOD,
    BETTER,
    FITS,
    MUCH_BETTER,
    ComparedMotion,
    explain,
    hypotheses,
    is_noise,
)
from hybrid_ins.core.imu_axes.faults import AxesFault
from hybrid_ins.core.imu_axes.fit import Fit, Motion, fit
from hybrid_ins.core.imu_axes.motion import is_long
from hybrid_ins.core.imu_axes.tolerance import tolerant_fits

Array = NDArray[np.float64]

AS_GIVEN = ((np.eye(3), np.eye(3)),)


class Outcome(Enum):
    """What a comparison shows where it shows no fault."""

    FITS = "the readings fit as given"
    UNDECIDED = "neither as given nor by other axes do they fit, or the fixes' noise hides it"
    DISPUTED = "they do not fit, and something else than the axes may be the reason"


class MotionComparison:
    """
    Compares readings with motions, one after another.

    Parameters
    ----------
    mount : ndarray, shape (3, 3)
        From the IMU's own axes to b, as given.
    arm : ndarray, shape (3,)
        From the IMU to the antenna [m], in the IMU's own axes, as given.
    antenna : FarAntenna
        Is given the motions that only another place of the antenna explains.

    Attributes
    ----------
    fitting : list of ComparedMotion
        The motions that the readings fit as given.
    """

    def __init__(self, mount: Array, arm: Array, antenna: FarAntenna) -> None:
        self._mount, self._arm, self._antenna = mount, arm, antenna
        self.fitting: list[ComparedMotion] = []
        self._compared: list[ComparedMotion] = []  # those that noise does not hide
        self._tried = 0  # of them, by hypotheses
        self._fits: list[Fit] = []  # by hypotheses, of the last one tried

    def run(self, motions: Sequence[Motion]) -> Generator[None, None, AxesFault | Outcome]:
        """Return what is found, after some milliseconds of work between two yields."""
        as_given = Fit(1.0, np.eye(3), lever_arm=self._arm, given_arm=self._arm)
        for motion in motions:
            if self._is_enough(motion):
                continue
            as_given = fit(motion, as_given)
            yield
            compared = ComparedMotion(motion, float(np.sum(motion.change_n[:, :2] ** 2)), as_given)
            if compared.is_hidden:
                continue
            self._compared.append(compared)
            found = yield from self._judge(compared)
            if isinstance(found, AxesFault) or found is Outcome.DISPUTED:
                return found
            if found is Outcome.UNDECIDED and not any(is_noise(one) for one in self._fits):
                break  # errors that are more than noise only grow with the interval
        return Outcome.FITS if self.fitting else Outcome.UNDECIDED

    def _is_enough(self, motion: Motion) -> bool:
        """Return whether as many motions of this length were compared as are needed."""
        alike = sum(len(one.motion.t) == len(motion.t) for one in self._compared)
        return alike == (1 if is_long(motion) else 2)

    def _judge(self, compared: ComparedMotion) -> Generator[None, None, AxesFault | Outcome]:
        """
        Return what one motion shows.

        Where the readings do not fit it as given, other axes may explain it; but an IMU's ordinary
        errors and an antenna elsewhere are tried before the axes are accused.
        """
        if compared.fits:
            return (yield from self._confirm(compared))
        if not compared.has_turns:
            return AxesFault(AS_GIVEN, self._mount, no_turns=True)
        yield from self._try_hypotheses()
        if self._explain(compared, self._fits) is not None:
            return (yield from self._allow_for_errors(compared))
        far = yield from far_fit(compared.motion, compared.as_given)
        return self._by_antenna(compared, far, Outcome.UNDECIDED)

    def _confirm(self, compared: ComparedMotion) -> Generator[None, None, Outcome]:
        """Return whether a motion that fits as given does not fit much better by the antenna."""
        if is_long(compared.motion) and not compared.is_explained:
            far = yield from far_fit(compared.motion, compared.as_given)
            if _is_elsewhere(compared, far):
                self._antenna.add(compared.motion, far)
                return Outcome.DISPUTED
        self.fitting.append(compared)
        return Outcome.FITS

    def _try_hypotheses(self) -> Generator[None, None, None]:
        """
        Fit the hypotheses to the last motion.

        Of the motions before it, the first one that was not tried sorts out hypotheses.
        """
        fits = self._fits if self._tried else hypotheses(self._arm)
        untried, self._tried = self._compared[self._tried :], len(self._compared)
        for compared in untried[:1] + untried[1:][-1:]:
            starts, fits = fits, []
            for start in starts:
                fits.append(fit(compared.motion, start))
                yield
            self._fits = fits
            fits = [one for one in fits if one.left < AS_GOOD * compared.as_given.left]

    def _allow_for_errors(
        self, compared: ComparedMotion
    ) -> Generator[None, None, AxesFault | Outcome]:
        """Return what a motion that other axes explain shows where ordinary errors are allowed."""
        motion = compared.motion
        best, others = yield from tolerant_fits(motion, compared.as_given, self._fits)
        compared = replace(compared, as_given=best)
        fault = self._explain(compared, others)
        if fault is None and compared.is_explained:
            self.fitting.append(compared)
            return Outcome.FITS
        far = yield from far_fit(motion, best)
        if fault is None:
            return self._by_antenna(compared, far, Outcome.UNDECIDED)
        if is_far_away(far):
            fault = self._explain(replace(compared, as_given=far), others)
        return fault or self._by_antenna(compared, far, Outcome.DISPUTED)

    def _explain(self, compared: ComparedMotion, fits: Sequence[Fit]) -> AxesFault | None:
        return explain(compared, fits, self._mount, is_first=len(self._compared) == 1)

    def _by_antenna(self, compared: ComparedMotion, far: Fit, otherwise: Outcome) -> Outcome:
        """Return that the antenna may be the reason, if only another place of it fits."""
        if not _is_elsewhere(compared, far):
            return otherwise
        self._antenna.add(compared.motion, far)
        return Outcome.DISPUTED


def _is_elsewhere(compared: ComparedMotion, far: Fit) -> bool:
    """Return whether only an antenna far from the given place lets the readings fit."""
    if not is_far_away(far):
        return False
    by_noise = is_long(compared.motion) and is_noise(far)
    if not (by_noise or far.left < FITS * compared.change):
        return False
    return far.left < compared.as_given.left / (BETTER if by_noise else MUCH_BETTER)
