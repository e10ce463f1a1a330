"""
Robust weighting of innovations, with covariance inflation after sustained disagreement.

A GNSS measurement with a large innovation is fused with a larger R, as if its errors had
Student's t distribution, [2]_. No threshold separates used from unused, so that a covariance that
is a little too small costs some weight, never a run of valid fixes. Rejected is only what no error
of an INS explains: a jump.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4.
.. [2] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
       distribution", Journal of the American Statistical Association 84, 1989.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.update import chi_square
from hybrid_ins.core.update.linalg import log_determinant
from hybrid_ins.core.update.measurements import GNSS, Measurement
from hybrid_ins.core.update.rejections import (
    Innovation,
    Rejections,
    are_consistent,
    has_jumped,
    is_jump,
    is_of_receiver,
    settled,
)

Array = NDArray[np.float64]

MARGINAL = 0.5  # of the threshold: a NIS above it, after consistent rejections, is no agreement
TAIL_DOF = 6.0  # degrees of freedom of the t distribution, [2]_
TAIL_EXPONENT = 1.5  # its weights have 1; more protects better from single outliers
ORDINARY = {m: chi_square.quantile(0.95, m) for m in (1, 2, 3)}  # NIS that keeps the full weight
CERTAIN = 50.0  # NIS that errors of an INS that agreed with the fixes hardly make
SCALE_LENGTH = 4.0  # fused measurements that the scale of innovations is averaged over
UNREMARKABLE = 1.5  # a scale that is forgotten
UNCONFIRMED = "innovation beyond the gate after a pause: waits for a fix that agrees"
LEAST_PATIENCE_NS = 1_000_000_000  # with a state that rests on one fix
LONG_SINCE_NS = -(2**62)


@dataclass(frozen=True, slots=True)
class Verdict:
    """
    The decision on one measurement.

    Attributes
    ----------
    measurement : Measurement
        The one that was decided on.
    accepted : bool
        It was fused.
    reason : str
        Why it was rejected, or what was done besides fusing; empty for a plain fusion.
    age : float
        How far it lay behind the IMU when it was decided on [s].
    nis : float
        Normalised innovation squared; NaN where it was not computed.
    threshold : float
        Largest NIS of a measurement that agrees with the state.
    sigma : ndarray, shape (m,)
        Standard deviations used for the measurement, NED [m or m/s].
    log_det : float
        Logarithm of the determinant of the innovation's covariance.
    inflated : bool
        The covariance was inflated for this measurement, see `Gate`.
    jump : bool
        It is rejected, in a run of rejections that began with a jump: no error of an INS grows
        that fast.
    receiver_jumped : bool
        The receiver's positions have jumped, or glided within seconds: the state agreed with them
        until then, no error of an INS grows that fast, and they stayed there. Either the covariance
        was inflated for that, or it is the second large innovation, and no larger than the first:
        an error of an INS that made that would have grown by now.
    is_ambiguous : bool
        The covariance was inflated for a position, the state was believed and agreed with the
        positions until then, and no jump shows that it was the receiver: either is wrong.
    surprises : bool
        It is a position with a NIS that no ordinary error makes of a state that is believed and
        agreed with the fixes until then: that state is wrong, or the receiver has jumped.
    disagrees : bool
        A jump that does not show the same error as the one before: evidence on the fixes.
    weight : float
        At most 1; R is divided by it.
    """

    measurement: Measurement
    accepted: bool
    reason: str
    age: float
    nis: float
    threshold: float
    sigma: Array
    log_det: float = 0.0
    inflated: bool = False
    jump: bool = False
    receiver_jumped: bool = False
    is_ambiguous: bool = False
    surprises: bool = False
    disagrees: bool = False
    weight: float = 1.0

    @classmethod
    def rejected(cls, measurement: Measurement, reason: str, age: float = np.nan) -> Verdict:
        """Return the verdict on a measurement that was not compared with the state."""
        return cls(measurement, False, reason, age, np.nan, np.nan, np.empty(0))


class Gate(ShallowCopy):
    """
    Weight of a measurement by its innovation, with a limit on the duration of disagreement.

    GNSS measurements are weighted; jumps among them, and other measurements above the threshold,
    are rejected. Measurements that are above the threshold without interruption for ``patience``
    seconds, and are consistent with each other, are assumed right and the state wrong: for the
    next one the covariance is inflated (`Verdict.inflated`). Inconsistent ones have to wait three
    times as long. Where the covariance has grown meanwhile until such a measurement is just below
    the threshold, the state is as wrong, and the covariance is inflated as well.

    Measurements that do not come show nothing: a run of those above the threshold ends with them.

    A state is believed no longer than it has been confirmed for: after a pause one measurement
    decides where it is, and if that was the outlier, the following ones need to agree for as long
    as it was followed, not for ``patience``. One above the threshold has to wait then for another
    one that agrees with it, for which the covariance is inflated unless it is a jump: it was too
    small during the pause, and would lay the innovation to attitude and biases.

    A jump is out of proportion to what the measurement claims, even where it scatters by less, and
    to the innovations before it: a receiver that claims centimetres and scatters by decimetres does
    not jump at every fix. The scale, the mean of NIS / m of those that were fused last, is counted
    from the first above the threshold until it is ordinary again. It does not count where two in a
    row show one error of the state.

    Parameters
    ----------
    thresholds : mapping of int to float
        Largest NIS of a measurement that agrees with the state, by the number of components.
    patience : float
        [s].
    """

    def __init__(self, thresholds: Mapping[int, float], patience: float) -> None:
        self._thresholds = thresholds
        self._patience_ns = int(patience * 1e9)
        self._confirmed_since_ns = LONG_SINCE_NS
        self._rejections: dict[str, Rejections] = {}  # replaced, never changed in place
        self._scales: dict[str, float] = {}  # likewise; 1 where there is none

    def replaced_by(self, other: Gate) -> Gate:
        """Return a gate with the limits of ``other`` that knows what this one has seen."""
        twin = self.__copy__()
        twin._thresholds, twin._patience_ns = other._thresholds, other._patience_ns
        return twin

    def threshold(self, components: int) -> float:
        """Return the largest NIS of a measurement that agrees, by its number of components."""
        return self._thresholds[components]

    def ordinary_limit(self, kind: str, components: int, interval: float) -> float:
        """
        Return the NIS up to which `judge` accepts a GNSS measurement by its NIS alone.

        -1 after rejections, large innovations and a pause: more than its NIS counts then.
        """
        is_pause = interval * 1e9 > self._patience_ns
        if kind in self._rejections or kind in self._scales or is_pause:
            return -1.0
        return self._thresholds.get(components, -1.0)

    def rejects(self, t_ns: int) -> bool:
        """Return whether measurements of a kind are rejected as jumps at a stamp [ns]."""
        return any(
            run.jump and not run.has_ended(t_ns, self._patience_ns)
            for run in self._rejections.values()
        )

    def judge(
        self,
        measurement: Measurement,
        z: Array,
        R: Array,
        S: Array,
        nis: float,
        age: float,
        interval: float = np.inf,
        claimed: Array | None = None,
    ) -> Verdict:
        """
        Decide by the innovation z (m,), its NIS, and the covariances R and S, (m, m).

        ``interval`` is the time since the last correction [s], ``claimed`` the covariance that the
        measurement claims where R is its scatter, which may be less.
        """
        last = self._rejections.get(measurement.kind)
        if last and last.has_ended(measurement.t_ns, self._patience_ns):
            self._end_run(measurement.kind)
            last = None
        rejected_ns = measurement.t_ns - last.first_ns if last else 0  # that is no pause
        is_pause = interval * 1e9 - rejected_ns > self._patience_ns
        plain = Verdict(
            measurement,
            True,
            "",
            age,
            nis,
            self._thresholds[len(R)],
            np.sqrt(R.diagonal()),
            log_determinant(S),
            weight=weight(nis, len(R)) if measurement.sensor == GNSS else 1.0,
        )
        claimed = R if claimed is None else claimed
        verdict = self._decide(plain, Innovation(z, R, claimed, interval, is_pause))
        if verdict.accepted and measurement.sensor == GNSS:
            self._learn_scale(verdict)
            if is_pause:
                self._confirmed_since_ns = measurement.t_ns
        return verdict

    def _learn_scale(self, verdict: Verdict) -> None:
        kind, m = verdict.measurement.kind, len(verdict.sigma)
        if kind not in self._scales and verdict.nis <= verdict.threshold:
            return
        scale = self._scales.get(kind, 1.0)
        scale += (verdict.nis / m - scale) / SCALE_LENGTH
        others = {k: one for k, one in self._scales.items() if k != kind}
        is_remarkable = scale > UNREMARKABLE and not verdict.inflated
        self._scales = {**others, kind: scale} if is_remarkable else others

    def _decide(self, plain: Verdict, seen: Innovation) -> Verdict:
        """Return ``plain``, or what the measurements of its kind before it make of it."""
        measurement, (z, R, *_) = plain.measurement, seen
        kind, t_ns, is_gnss = measurement.kind, measurement.t_ns, measurement.sensor == GNSS
        last = self._rejections.get(kind)
        first_ns = last.first_ns if last else t_ns
        consistent_ns = last.consistent_ns if last and are_consistent(last.z, z, R) else t_ns
        patience_ns = min(self._patience_ns, self._confirmed_ns(first_ns))
        long_consistent = t_ns - consistent_ns > patience_ns // 3
        is_confirmed = seen.is_pause and last is not None and not last.jump
        is_confirmed = is_confirmed and consistent_ns != t_ns
        if plain.nis <= plain.threshold:
            marginal = plain.nis > MARGINAL * plain.threshold and long_consistent
            if not (marginal and is_gnss):
                self._end_run(kind)
                return plain
        elif not is_gnss or not (
            is_confirmed
            or t_ns - consistent_ns >= patience_ns
            or t_ns - first_ns >= 3 * patience_ns
        ):
            return self._continue_run(plain, seen, consistent_ns)
        self._end_run(kind)
        seconds = (t_ns - first_ns) * 1e-9
        reason = f"disagreed for {seconds:.1f} s: covariance inflated, then accepted"
        jumped = ambiguous = False
        if kind == "position" and last is not None and self._was_believed(first_ns):
            has_stayed = t_ns - consistent_ns >= patience_ns // 3
            jumped = has_stayed and is_of_receiver(last, seen, t_ns)
            ambiguous = not jumped and last.first_interval * 1e9 <= self._patience_ns
        return replace(
            plain,
            reason=reason,
            inflated=True,
            receiver_jumped=jumped,
            is_ambiguous=ambiguous,
            weight=1.0,
        )

    def _continue_run(self, plain: Verdict, seen: Innovation, consistent_ns: int) -> Verdict:
        """Note one more measurement above the threshold; return its weight or its rejection."""
        z, R, claimed, interval, is_pause = seen
        measurement, kind = plain.measurement, plain.measurement.kind
        last = self._rejections.get(kind)
        of_state = last is not None and consistent_ns == last.consistent_ns
        scale = 1.0 if of_state else self._scales.get(kind, 1.0)
        expected = max(scale * float(np.trace(R)), float(np.trace(claimed)))
        jump = is_jump(kind, z, expected, interval) or (last is not None and last.jump)
        run = Rejections(
            last.first_ns if last else measurement.t_ns,
            measurement.t_ns,
            last.first_interval if last else interval,
            consistent_ns,
            *settled(last, z, measurement.t_ns),
            z,
            last.count + 1 if last else 1,
            plain.nis > CERTAIN and (last.certain if last else kind not in self._scales),
            jump,
            last.began_with_jump if last else jump,
        )
        self._rejections = {**self._rejections, kind: run}
        if measurement.sensor != GNSS or jump:
            reason, disagrees = "innovation beyond the gate", jump and not of_state
            return replace(plain, accepted=False, reason=reason, jump=jump, disagrees=disagrees)
        if is_pause:
            return replace(plain, accepted=False, reason=UNCONFIRMED, jump=True)
        jumped, surprises = False, False
        if kind == "position" and run.certain and self._was_believed(run.first_ns):
            surprises = run.count == 1
            if last is not None and run.count == 2:
                jumped = has_jumped(last.z, z, R, interval)
        reason = "large innovation"
        return replace(plain, reason=reason, receiver_jumped=jumped, surprises=surprises)

    def _end_run(self, kind: str) -> None:
        """Forget the measurements of a kind above the threshold."""
        self._rejections = {k: run for k, run in self._rejections.items() if k != kind}

    def _confirmed_ns(self, t_ns: int) -> int:
        """Return for how long [ns] the state at a stamp [ns] had been confirmed."""
        return max(t_ns - self._confirmed_since_ns, LEAST_PATIENCE_NS)

    def _was_believed(self, t_ns: int) -> bool:
        """Return whether the state at a stamp [ns] had been confirmed for long enough."""
        return self._confirmed_ns(t_ns) >= self._patience_ns


def weight(nis: float, m: int) -> float:
    """
    Return the weight of a GNSS measurement with ``m`` components by its NIS, [2]_.

    It is 1 for 95 % of ordinary measurements, so that their fusion stays optimal.
    """
    return float(min(1.0, (TAIL_DOF + ORDINARY[m]) / (TAIL_DOF + nis)) ** TAIL_EXPONENT)
