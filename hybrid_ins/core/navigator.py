"""
From the first IMU sample to a running filter, and back when the IMU goes away.

Owns the ring of samples, the alignment, and the filter once there is one; owns no topic and no
message. Bad stamps are named results, not exceptions.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment import Alignment, AlignmentSettings
from hybrid_ins.core.gate import Gate, Verdict
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter, NoiseChange, NoiseEstimate
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.noise import NoiseModel, ProcessNoise
from hybrid_ins.core.samples import ImuRing

Array = NDArray[np.float64]

ATTEMPT_NS = 100_000_000  # between two attempts to align


class Navigator:
    """
    Aligns, then filters; starts over after a gap or when told to.

    Parameters
    ----------
    alignment, settings : AlignmentSettings, FilterSettings
        See there.
    make_process : callable
        Given the IMU's sample period [s], returns the way from levels to Qc.
    make_noise : callable
        Given that, returns a fresh noise model for a new filter.
    make_gate : callable
        Returns a fresh gate.
    max_gap : float
        Longest pause between IMU samples that dead reckoning bridges [s].

    Attributes
    ----------
    filter : InsFilter or None
        None while aligning.
    counts : Counter
        Refused samples and restarts, by name.
    verdicts : deque of Verdict
        Decided since the owner last emptied it.
    """

    def __init__(
        self,
        alignment: AlignmentSettings,
        settings: FilterSettings,
        make_process: Callable[[float], ProcessNoise],
        make_noise: Callable[[ProcessNoise], NoiseModel],
        make_gate: Callable[[], Gate],
        max_gap: float,
    ) -> None:
        self.ring = ImuRing()
        self.filter: InsFilter | None = None
        self.counts: Counter[str] = Counter()
        self.verdicts: deque[Verdict] = deque()
        self._alignment_settings = alignment
        self._settings = settings
        self._make_noise = make_noise
        self._make_process = make_process
        self._make_gate = make_gate
        self.max_gap_ns = int(max_gap * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counters, and align anew."""
        self.ring.clear()
        self.filter = None
        self.last_ns = 0
        self._attempt_ns = 0
        self.alignment = Alignment(self._alignment_settings, self.ring)

    @property
    def waiting_for(self) -> str:
        """What alignment lacks; empty once a filter runs."""
        return "" if self.filter else self.alignment.waiting_for

    def imu(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> bool:
        """
        Take a sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b frame.

        Returns False when its stamp makes it useless; ``counts`` says why.
        """
        if not 0 < t_ns - self.last_ns <= self.max_gap_ns and not self._admit(t_ns):
            return False
        self.last_ns = t_ns
        self.ring.push(t_ns, fx, fy, fz, wx, wy, wz)
        if self.filter is not None:
            self.filter.process_imu(t_ns, fx, fy, fz, wx, wy, wz)
        elif t_ns >= self._attempt_ns:
            self._attempt(t_ns)
        return True

    def imu_block(self, samples: NDArray[np.void], rows: Array) -> None:
        """Take samples whose stamps rise without gap while the filter runs, as `imu` would."""
        assert self.filter is not None
        self.ring.extend(samples)
        self.last_ns = int(samples["t_ns"][-1])
        self.filter.process_imu_block(samples, rows)

    def _admit(self, t_ns: int) -> bool:
        """Deal with a stamp that does not follow the last one closely."""
        if self.ring.count == 0:
            return True
        if t_ns == self.last_ns:
            self.counts["imu: repeated stamp"] += 1
            return False
        if t_ns < self.last_ns:
            if self.last_ns - t_ns < self.max_gap_ns:
                self.counts["imu: stamp out of order"] += 1
                return False
            self.counts["restart: IMU stamps jumped back"] += 1
        else:
            self.counts["restart: gap in the IMU stamps"] += 1
        self.reset()
        return True

    def _attempt(self, t_ns: int) -> None:
        self._attempt_ns = t_ns + ATTEMPT_NS
        start = self.alignment.attempt()
        if start is None:
            return
        stamps = self.ring.latest(256)["t_ns"]
        period = float(np.median(np.diff(stamps))) * 1e-9
        process = self._make_process(period)
        self.filter = InsFilter(
            start.state, start.t_ns, start.sample, self._make_noise(process), process,
            self._make_gate(), self.ring, self._settings)
        self.filter.verdicts = self.verdicts

    def measure(self, measurement: Measurement) -> None:
        """Take an aiding measurement; its verdict appears in ``verdicts``."""
        if self.filter is None:
            self.alignment.observe(measurement)
            self.verdicts.append(Verdict.refused(measurement, "aligning"))
        elif measurement.t_ns - self.last_ns > self.max_gap_ns + 1_000_000_000:
            self.verdicts.append(Verdict.refused(
                measurement, "stamped ahead of the IMU", self.filter.age(measurement)))
        else:
            self.filter.submit(measurement)

    def change_noise(self, event: NoiseEstimate | NoiseChange) -> None:
        """Take a regressor's estimate or another noise model."""
        if self.filter is not None:
            self.filter.submit(event)


