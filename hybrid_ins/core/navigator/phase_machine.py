"""
The phase of a navigator with its transitions, and the filters that run in it.

    Aligning -> Searching    alignment found a state for every heading
    Aligning -> Running      alignment found a state for a given heading
    Searching -> Searching   the clock offset is searched for, too
    Searching -> Running     the hypotheses agree, on the heading at least
    Running -> Running       the hypotheses agree on the clock offset, too; a search for it begins
                             or is given up; it or the check of a given heading has an outcome
    Running -> Searching     the motion excludes a given heading, and does not show which is right
    any -> Aligning          `PhaseMachine.align`
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Alignment
from hybrid_ins.core.alignment.clock_search import OFFSET_STD, ClockSearch
from hybrid_ins.core.alignment.multiple_model import Decision, MultipleModelBank
from hybrid_ins.core.filter.events import Change, ClockInflation
from hybrid_ins.core.filter.ins_filter import InsFilter, catch_up, hand_over
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.state import HEADING_DOUBT
from hybrid_ins.core.navigator.clock_comparison import Comparison, compare, is_excluded, lacking_std
from hybrid_ins.core.navigator.heading_check import check, is_contradicted
from hybrid_ins.core.navigator.kept_knowledge import KeptKnowledge
from hybrid_ins.core.navigator.notices import (
    ClockOffsetFound,
    HeadingCorrected,
    HeadingOutdated,
    Notice,
)
from hybrid_ins.core.navigator.phases import (
    Aligning,
    FilterParts,
    Phase,
    Running,
    Searching,
    phase_after_alignment,
    search_clock,
    search_heading_and_clock,
)
from hybrid_ins.core.navigator.stamp_check import ImuStampCheck
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]

PERCEPTIBLE = 0.02  # s, by which a provisional filter is surer of its clock offset than a search


class PhaseMachine:
    """
    Runs the filters of the present phase, and changes the phase.

    Parameters
    ----------
    parts : FilterParts
        Builds what a filter is made of.
    ring : ImuRing
        Recent IMU samples; its owner fills it.
    stamps : ImuStampCheck
        Its ``steady_ns`` follows the filter that runs.
    notices : deque of Notice
        Verdicts and decisions are appended.
    record : RunRecord, optional
        Filled for a smoother.

    Attributes
    ----------
    phase : Aligning, Searching or Running
    filter : InsFilter or None
        The filter while running.
    kept : KeptKnowledge
        What filters have learned for those after them.
    clock_open : bool
        The clock offset of the fixes is to be found: from `open_clock` on until it is.
    """

    def __init__(
        self,
        parts: FilterParts,
        ring: ImuRing,
        stamps: ImuStampCheck,
        notices: deque[Notice],
        record: RunRecord | None,
    ) -> None:
        self._parts = parts
        self._ring = ring
        self._stamps = stamps
        self._notices = notices
        self._record = record
        self.clock_open = False
        self.kept = KeptKnowledge(ring)
        self.phase: Phase
        self.filter: InsFilter | None = None

    def align(self, alignment: Alignment) -> None:
        """Discard all filters, and align."""
        if self._record is not None:
            self._record.begin()
        self.kept.on_restart(self.filter)
        self._enter(Aligning(alignment))

    def _enter(self, phase: Phase) -> None:
        """Change the phase; every transition passes here."""
        ended, self.phase = self.filter, phase
        self.filter = phase.filter  # beside the phase: read at every sample
        self.kept.hand_over(ended, self.filter, self.filters)
        self._stamps.steady_ns = self._stamps.short_ns
        if phase.filter is not None:
            if self._record is not None:
                self._record.follow(phase.filter)
            self._stamps.steady_ns = min(phase.filter.long_step_ns, self._stamps.short_ns)
            phase.filter.nav[HEADING_DOUBT] = 0.0

    @property
    def filters(self) -> list[InsFilter]:
        """All filters that run."""
        running, bank = [] if self.filter is None else [self.filter], self.phase.bank
        return running if bank is None else [*running, *bank.filters]

    # The filters.

    def predict_block(self, samples: NDArray[np.void], rows: Array) -> None:
        """See `InsFilter.predict_block`; the phase must be `Running`."""
        assert self.filter is not None
        self.filter.predict_block(samples, rows)
        self.collect_verdicts(self.filter)

    def measure(self, measurement: Measurement) -> bool:
        """Give a measurement to all filters; False if there is none, or none so old."""
        bank, running = self.phase.bank, self.filter
        self.kept.observe(measurement, self.phase)
        if running is not None:
            running.submit(measurement)
            self.collect_verdicts(running)
        return (bank is not None and bank.measure(measurement)) or running is not None

    def submit(self, event: Change) -> None:
        """Change the noise or the covariance of all filters, see `InsFilter.submit`."""
        for target in (self.phase.bank, self.filter):
            if target is not None:
                target.submit(event)
        if self.filter is not None:
            self.collect_verdicts(self.filter)

    def collect_verdicts(self, decided: InsFilter) -> None:
        """Move a filter's verdicts to the notices."""
        self._notices.extend(decided.verdicts)
        decided.verdicts.clear()

    # From no state to one filter.

    def try_to_align(self) -> None:
        """Try to start filters while aligning."""
        if isinstance(self.phase, Aligning):
            start = self.phase.alignment.attempt()
            self._notices.extend(map(HeadingOutdated, self.phase.alignment.pop_outdated()))
            if start is not None:
                self._enter(phase_after_alignment(start, self._parts, self._ring, self.clock_open))

    def follow_imu(self, t_ns: int) -> None:
        """Let the filters of several headings follow the IMU to a stamp [ns]."""
        if isinstance(self.phase, Searching):
            self._notices.extend(self.phase.bank.advance(self._ring, t_ns))

    def include_clock(self, may_stand: bool, calm: tuple[int, int]) -> None:
        """Search for clock offset and heading, unless the vehicle may stand; see `ImuMonitor`."""
        bank, running = self.phase.bank, self.filter
        if may_stand or bank is None or not self.clock_open or bank.clock_open:
            return
        bank.end_block()
        waiting = bank.filters[0].withdraw()
        n = len(bank.filters)
        headings = np.full(n, 1.0 / n) if running is None else np.exp(bank.log_weights)
        search = search_heading_and_clock(bank.filters, headings, self._parts, self._ring, calm)
        self._enter(Searching(search) if running is None else Running(running, search))
        for measurement in waiting:
            if not search.measure(measurement) and running is None:
                self._notices.append(Verdict.rejected(measurement, "aligning"))

    def open_clock(self, unknown: bool) -> bool:
        """
        Treat the clock offset of the fixes as unknown, or as known; it may have changed.

        Returns whether alignment has to begin again: the filters mix headings and offsets.
        """
        self.clock_open = unknown
        bank = self.phase.bank
        is_mixed = bank is not None and bank.clock_open
        if is_mixed and self.filter is not None:
            self._enter(Running(self.filter))
        return is_mixed and self.filter is None

    def continue_search(self, t_ns: int) -> bool:
        """
        Let the filters beside the running one follow the IMU to a stamp [ns]; see `decide`.

        They do until the next call, a few at each `advance_search`: odometry does not wait.
        """
        if not isinstance(self.phase, Running):
            return False
        if self.phase.bank is not None:
            self.phase.bank.end_block()
            found = self.decide()
            self._check_heading()
            if self.filter is not None and self.phase.bank is not None:
                self.phase.bank.begin_block(self._ring, t_ns)
            return found
        running = self.phase.filter
        if self.clock_open and not running.update.gate.rejects(t_ns):  # the state may be wrong
            self._enter(Running(running, search_clock(running, self._parts, self._ring)))
        return False

    def _check_heading(self) -> None:
        """Report how doubtful the heading is; search for a given one that the motion excludes."""
        bank, running = self.phase.bank, self.filter
        if bank is None or running is None or not bank.heading_open:
            return
        running.nav[HEADING_DOUBT], corrected, _ = check(running, bank)
        if corrected is not None and not self.phase.is_provisional:
            left = bank.take_over(running)
            self._notices.extend([corrected, *(Verdict.rejected(m, "aligning") for m in left)])
            self._enter(Searching(bank))

    def advance_search(self) -> None:
        """Let one or some of the filters beside the running one follow."""
        if self.filter is not None and self.phase.bank is not None:
            self.phase.bank.continue_block(self._stamps.last_ns)

    def decide(self) -> bool:
        """
        Replace the hypotheses by one filter, once they agree.

        Returns whether the clock offset was found: stamps of fixes from now on are others.
        """
        bank = self.phase.bank
        if bank is None or self._keeps_running(bank):
            return False
        decision = bank.decide() or self._decide_on_heading(bank)
        if decision is None:
            return False
        winner, running = decision.filter, self.filter
        catch_up(winner)
        if running is not None and not self.phase.is_provisional:
            if bank.heading_open and is_contradicted(running.state, winner.state):
                self._notices.append(HeadingCorrected.between(running.state, winner.state))
            elif not bank.clock_open:
                self._enter(Running(running))
                return False
        if running is not None:
            winner.verdicts.clear()
            waiting = hand_over(running, winner, round(decision.offset * 1e9))
            reason = "clock offset found" if bank.clock_open else "heading corrected"
            self._notices.extend(Verdict.rejected(m, reason) for m in waiting)
        if isinstance(bank, ClockSearch):
            self.clock_open = decision.at_edge or not decision.is_final
            missing, variance = winner.clock.missing
            found = decision.offset, missing, math.sqrt(variance), decision.is_final
            self._notices.append(ClockOffsetFound(*found))
            bank.in_force_ns += round(decision.offset * 1e9)
        self.collect_verdicts(winner)
        if self._record is not None:
            self._record.follow(winner, decision.offset, bank.heading_open)
        self._enter(Running(winner) if decision.is_final else Running(winner, bank, True))
        return bank.clock_open

    def _keeps_running(self, bank: MultipleModelBank) -> bool:
        """Return whether the filter beside a clock search is kept; see `clock_comparison`."""
        running = self.filter
        if running is None or not isinstance(bank, ClockSearch) or bank.heading_open:
            return False
        comparison = compare(running, bank)
        if comparison is Comparison.CONTRADICTED:
            self._inflate_clock(running, OFFSET_STD)
        elif comparison is Comparison.CONFIRMED:
            self.clock_open = False
            self._enter(Running(running))
            self._notices.append(ClockOffsetFound(0.0, running.clock.residual, running.clock.sigma))
        return comparison is not Comparison.EXCLUDED

    def _inflate_clock(self, running: InsFilter, std: float) -> None:
        """Allow for another clock offset of a filter by ``std`` [s]."""
        running.submit(ClockInflation(running.t_ns, std))
        self.collect_verdicts(running)

    def _decide_on_heading(self, bank: MultipleModelBank) -> Decision | None:
        """Return a filter to run while the clock offset is open, if one is needed; or None."""
        if not isinstance(bank, ClockSearch):
            return None
        if self.filter is not None:
            if not self.phase.is_provisional:
                return None
            if (lacking := lacking_std(self.filter, bank)) > PERCEPTIBLE:
                self._inflate_clock(self.filter, lacking)
            if not is_excluded(self.filter, bank):
                return None
        return bank.decide_on_heading()
