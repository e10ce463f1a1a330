"""
The clock offset that is added to the stamps of fixes: given, estimated while running, or searched.

`hybrid_ins.core.sensor_errors.clock_offset` estimates it from a filter's innovations, and
`hybrid_ins.core.alignment.clock_search` finds it among many hypotheses. This module applies both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hybrid_ins.core.alignment.clock_search import MAX_OFFSET_NS, ClockSearch
from hybrid_ins.core.filter.events import ClockShift
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import ClockOffsetFound
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift, ClockPrior
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import GNSS
from hybrid_ins.ros.messages.conversions import Refused, clock_drift
from hybrid_ins.ros.reporting.diagnostics import imu_disagrees, status
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.reports import Status

CORRECTION_NS = 1_000_000_000  # between two corrections of the offset
USABLE, SETTLED = 0.1, 0.015  # s, standard deviations
SIGNIFICANT_OFFSET = 3.0  # standard deviations from the given one: less is chance
WRONG = 0.03  # s, of an offset that the user should know of
LEAST = 1e-3  # s: a smaller correction changes nothing
LARGEST = 1.0  # s: innovations that show a larger change are of something else
SEARCH_AGAIN_NS = 30_000_000_000  # after a search, before another one on a suspicion
LONGEST_PAUSE_NS = 600_000_000_000  # likewise, after several that have found nothing


class ClockCorrection:
    """
    The offset in force, and its corrections.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
        Searches for the offset.
    inputs : InputLog
        Warns of an offset that seems wrong.

    Attributes
    ----------
    offset : float
        Added to the stamps of fixes [s].
    moved : float
        What estimation has added to the given offset [s].
    leapt : float
        What leaps of the receiver's clock have added to it [s].
    prior : ClockPrior
        Of the offset at the start of the filters: as given, or as found before a restart. One
        that is given with a drift is that of the first fix.
    drift : ClockDrift
        Of the offset, likewise.
    """

    def __init__(self, values: Mapping[str, Any], navigator: Navigator, inputs: InputLog) -> None:
        self._navigator = navigator
        self._inputs = inputs
        self._given = values["gnss.time_offset.value"]
        self._estimate = values["gnss.time_offset.estimate"]
        self.moved = self.leapt = 0.0
        self._settled: ClockPrior | None = None  # by the innovations, once they show it well
        self._axes_are_plausible = True
        self._std = values["gnss.time_offset.std"]
        self._given_drift = clock_drift(values)
        self._found: tuple[ClockPrior, ClockDrift] | None = None
        self.forget()

    @property
    def offset(self) -> float:
        """See above."""
        return float(self._given + self.moved)

    @property
    def _is_calibrated(self) -> bool:
        return bool(self._std > 0.0)

    def change(self, changes: Mapping[str, Any]) -> None:
        """Use checked values of run-time parameters; filters that run follow another offset."""
        before = self.offset
        self._std = changes.get("gnss.time_offset.std", self._std)
        if "gnss.time_offset.value" in changes:
            self._given = changes["gnss.time_offset.value"]
            self.moved, self.leapt, self._settled, self._found = 0.0, 0.0, None, None
            self.drift = self._given_drift
        if changes.keys() & {"gnss.time_offset.value", "gnss.time_offset.std"}:
            self.prior = ClockPrior(self._given, self._std)
        self._estimate = changes.get("gnss.time_offset.estimate", self._estimate)
        if changes.keys() & {"gnss.time_offset.value", "gnss.time_offset.estimate"}:
            self._navigator.open_clock(self._estimate and not self._is_calibrated)
        by = self.offset - before
        if LEAST < abs(by) < LARGEST:
            self._navigator.phases.submit(ClockShift(self._navigator.last_ns, by))

    def leap(self, by: float) -> None:
        """Note that the receiver's clock has leapt: ``by`` [s] more is added, as if given so."""
        self._given += by
        self.leapt += by
        self.prior = _moved(self.prior, by)
        self._settled = self._settled and _moved(self._settled, by)
        self._found = self._found and (_moved(self._found[0], by), self._found[1])
        self._inputs.log(
            "warn",
            f"gnss: the receiver's stamps leapt by {-by:+.0f} s, by which they are corrected from "
            "now on: did it learn the leap seconds of UTC?",
        )

    def keep(self) -> None:
        """Restart, as the filter did, with what it has found: the clocks are the same."""
        if self._found is None:
            self.forget()
            return
        self.prior, self.drift = self._found
        self._navigator.open_clock(False)
        self._begin()

    def forget(self) -> None:
        """Restart, as the filter did, with the given offset."""
        self.moved, self._settled = 0.0, None
        self.distrust()
        self._navigator.open_clock(self._estimate and not self._is_calibrated)

    def distrust(self) -> None:
        """Forget what a filter has found; others run with the offset in force, which stays."""
        self.prior, self.drift = ClockPrior(self._given, self._std), self._given_drift
        self._found = None
        self._begin()

    def _begin(self) -> None:
        """Begin with a filter of which nothing is known yet."""
        self._next_ns = self._searched_ns = 0
        self._pause_ns = SEARCH_AGAIN_NS
        self._contradicted = False

    def on_verdict(self, verdict: Verdict) -> None:
        """Suspect the clock where fixes contradict the state: they do when it jumps."""
        if verdict.inflated and verdict.measurement.sensor == GNSS:
            self._contradicted = True

    def on_found(self, found: ClockOffsetFound) -> None:
        """Use what a search has found."""
        self.moved += found.step
        if not found.is_final:
            return
        if self._searched_ns:
            changed = found.step != 0.0 or abs(found.missing) > WRONG
            again = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            self._pause_ns = SEARCH_AGAIN_NS if changed else again
        self._searched_ns, self._next_ns = self._navigator.last_ns, 0
        self._inputs.log(
            "info",
            f"clock offset found: {self.offset + found.missing:+.3f} ± {found.sigma:.3f} s",
        )

    def run_periodic(self, axes_are_plausible: bool = True) -> None:
        """
        Correct the offset once a second, or warn that it is wrong; call after each fix.

        Wrong axes of the IMU have the effect of a wrong offset: there is no warning of it then.
        While a given heading is being checked, what contradicts the state may be that: the offset
        is left alone.
        """
        self._axes_are_plausible = axes_are_plausible
        if self._given_drift.mean and not self.prior.t_ns:
            self.prior = self.prior._replace(t_ns=self._navigator.last_ns)
        running = self._navigator.filter
        if running is None or running.t_ns < self._next_ns:
            return
        self._next_ns = running.t_ns + CORRECTION_NS
        bank = self._navigator.phase.bank
        checking_heading = bank is not None and bank.heading_open
        clock_open = self._navigator.phases.clock_open
        correcting = self._estimate and not clock_open and not checking_heading
        jumped = abs(running.clock.residual) > max(WRONG, 5.0 * running.clock.sigma)
        if correcting:
            self._correct(running)
        elif not self._estimate and self._given_drift.mean:
            self._shift(running, self.prior.at(running.t_ns, self.drift).mean - self.offset)
        self._note(running)
        fault = self._fault()
        if fault:
            self._inputs.count_and_warn("gnss/fix", Refused("gnss: clock offset", fault))
            self._settled = None
        suspected = jumped or self._contradicted or imu_disagrees(running.noise)
        if correcting and suspected and running.t_ns - self._searched_ns > self._pause_ns:
            self._contradicted = False
            self._navigator.open_clock(True)

    def _correct(self, running: InsFilter) -> None:
        """
        Add to the fixes' stamps what a running filter has found missing.

        The given offset is left only where the innovations contradict it, or a search, which puts
        one of its steps in force, or a drift is given; from then on the prior alone holds what
        chance may do. A step is no better than what is found, however little is known of the
        offset.
        """
        missing, variance = running.clock.missing
        sigma = math.sqrt(variance)
        is_left = self.moved != 0.0 or running.clock.contradiction > SIGNIFICANT_OFFSET
        is_left |= self._given_drift.mean != 0.0
        is_usable = sigma < USABLE or self.moved != 0.0
        if is_usable and abs(missing) > 0.3 * sigma and is_left:
            self._shift(running, missing)
        shown, known = running.clock, self._settled
        if sigma < SETTLED and (known is None or shown.sigma < 0.5 * known.scale):
            self._settled = ClockPrior(self.offset + shown.residual, shown.sigma, running.t_ns)

    def _shift(self, running: InsFilter, by: float) -> None:
        """Add some more [s] to the stamps of fixes."""
        if LEAST < abs(by) < LARGEST:
            self.moved += by
            running.submit(ClockShift(running.t_ns, by))

    def _note(self, running: InsFilter) -> None:
        """Note what a filter has found, for the next one."""
        missing, variance = running.clock.missing
        is_usable = self._estimate and variance < USABLE**2
        if is_usable and not self._navigator.phase.is_provisional:
            clock = running.clock
            prior = ClockPrior(self.offset + missing, math.sqrt(variance), running.t_ns)
            std = min(clock.drift_sigma, self._given_drift.std)
            self._found = prior, ClockDrift(clock.drift, std)

    def found(self) -> tuple[float, float] | None:
        """Return what is missing from the offset in force, and its uncertainty [s]."""
        running, bank = self._navigator.filter, self._navigator.phase.bank
        if isinstance(bank, ClockSearch):
            return bank.clock()
        if running is not None and self._navigator.phases.clock_open:  # the search has not begun
            return 0.0, MAX_OFFSET_NS * 1e-9 / math.sqrt(3.0)
        return None if running is None else (running.clock.residual, running.clock.sigma)

    def _fault(self) -> str:
        """Return what is wrong with the offset, and the remedy; empty where nothing is."""
        running = self._navigator.filter
        if running is None or not self._axes_are_plausible:
            return ""
        missing, sigma = running.clock.residual, running.clock.sigma
        if abs(missing) > LARGEST:
            return ""
        total, limit = self.offset + missing, max(WRONG, 5.0 * sigma)
        if self._estimate:
            settled = self._settled
            if settled is None:
                return ""
            by_now = settled.at(running.t_ns, self._given_drift).mean
            if abs(total - by_now) > max(limit, 5.0 * settled.scale):
                return (
                    f"the clock offset moved from {settled.mean:+.3f} s to {total:+.3f} s: do IMU "
                    "and receiver stamp by one clock?"
                )
        elif abs(missing) > limit:
            return (
                f"gnss.time_offset.value seems to be {total:+.2f} ± {sigma:.2f} s, not "
                f"{self.offset:+.3f} s: run ins_calibrate, or set gnss.time_offset.estimate to true"
            )
        return ""

    def status(self) -> Status:
        """Return the status for diagnostics."""
        found, offset = self.found(), self.offset
        values: dict[str, object] = {"time_offset": offset, "estimated": self._estimate}
        if found is None:
            return status("clock", 0, f"fixes: {offset:+.3f} s, as given", values)
        missing, sigma = found
        values |= {"time_offset_found": offset + missing, "sigma": sigma}
        running = self._navigator.filter
        if running is not None:
            values["velocity_age"], values["velocity_age_sigma"] = running.clock.velocity_age
        fault = self._fault()
        searching = ", the search goes on" if self._navigator.phases.clock_open else ""
        text = fault or (
            f"fixes: {offset:+.3f} s in force, by the innovations "
            f"{offset + missing:+.3f} ± {sigma:.3f} s{searching}"
        )
        return status("clock", int(bool(fault)), text, values)


def _moved(prior: ClockPrior, by: float) -> ClockPrior:
    """Return the prior of an offset that is ``by`` [s] larger."""
    return prior._replace(mean=prior.mean + by)
