"""What a smoother says of a run, as odometry and reports: the estimator's, with hindsight."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import (
    ATTITUDE_COVARIANCE,
    HEADING_CONSIDERED,
    PAST_VARIANCE,
    PSD,
)
from hybrid_ins.core.smoothing.constant_errors import LEVER, ConstantErrors
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.smoothing.hindsight import Hindsight
from hybrid_ins.core.smoothing.smoother import Store
from hybrid_ins.ros.estimator.estimator import REPORT_NS, Estimator
from hybrid_ins.ros.estimator.reporter import state_reports
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.output.odometry import OdometrySource
from hybrid_ins.ros.reporting.reports import OdometryBlock, Report, Status

Array = NDArray[np.float64]


class SmoothedRun:
    """
    A run as it is known in the end.

    Parameters
    ----------
    estimator : Estimator
        After the forward run.
    record : RunRecord
        That it filled.
    make_store, progress
        See `Hindsight.smoother`; ``progress`` is called for each sample three times.
    """

    def __init__(
        self,
        estimator: Estimator,
        record: RunRecord,
        make_store: Callable[[int], Store],
        progress: Callable[[int], None] = lambda n: None,
    ) -> None:
        self._estimator = estimator
        self._record = record
        self._make_store = make_store
        self._progress = progress
        self._clocks: list[tuple[NDArray[np.int64], Array]] = []  # of each stretch

    def states(self) -> Iterator[tuple[OdometryBlock, list[tuple[int, Report]]]]:
        """Yield it in order: odometry, and reports of the same samples with their stamps."""
        estimator, source, report_ns = self._estimator, OdometrySource(), 0
        source.map = estimator.odometry.map
        frame = estimator.values["base_frame"]
        for stretch in self._record.finish():
            process = stretch.filters[-1][0].noise.process
            source.restart()
            hindsight = Hindsight(stretch)
            smoother, constants = hindsight.smoother(self._make_store, self._progress)
            smoother.run()
            by_scale, by_noise = hindsight.attitude_by_scale(), hindsight.heading_by_noise()
            past = hindsight.past_positions()
            _report_lever_arm(estimator, constants)
            self._clocks.append(hindsight.clock_offsets(constants.clock_offset))
            # where nobody placed the antenna, what is known is where that was; else it is zero
            arm_b = estimator.placement.arm_b - constants.lever_b
            for t_ns, rows in smoother.states():
                rows[:, ATTITUDE_COVARIANCE] += _in_force(t_ns, *by_scale)
                rows[:, HEADING_CONSIDERED] += _in_force(t_ns, *by_noise)
                rows[:, PAST_VARIANCE] = _in_force(t_ns, *past)
                for part in _parts(rows):
                    levels = process.q(rows[part.start, PSD][:6])
                    block = source.make_block(t_ns[part], rows[part], arm_b, levels[3:])
                    if block is None:
                        continue
                    reports: list[tuple[int, Report]] = []
                    for stamp, row in zip(t_ns[part].tolist(), rows[part], strict=True):
                        if stamp >= report_ns:
                            report_ns = stamp + REPORT_NS
                            made = state_reports(stamp, row, levels, arm_b, frame)
                            reports += [(stamp, report) for report in made]
                    yield block, reports

    def clock_offsets(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the clock offset [s] of fixes by their stamps [ns], after `states`."""
        stamps, offsets = self._clock()
        return np.interp(stamps_ns, stamps, offsets)

    def _clock(self) -> tuple[NDArray[np.int64], Array]:
        """Return the stamps of all fixes [ns], in order, and their offsets [s]."""
        stamps, offsets = (np.concatenate(columns) for columns in zip(*self._clocks, strict=True))
        order = np.argsort(stamps, kind="stable")
        return stamps[order], offsets[order]

    def verdicts(self, filtered: Iterable[tuple[int, Report]]) -> Iterator[tuple[int, Report]]:
        """
        Yield the filter's verdicts (log time [ns], report) with the clock offset known in the end.

        It says which time of the reference each smoothed state belongs to. After `states`.
        """
        stamps, offsets = self._clock()
        for log_ns, report in filtered:
            if len(stamps) and isinstance(report.content, Status):
                values = dict(report.content.values)
                offset = float(np.interp(int(values["stamp"]), stamps, offsets))
                values["time_offset"] = f"{offset:.6g}"
                content = report.content._replace(values=list(values.items()))
                report = replace(report, content=content)
            yield log_ns, report


def _report_lever_arm(estimator: Estimator, found: ConstantErrors) -> None:
    """Say where the antenna is relative to the IMU, if that is not at the IMU."""
    std = np.sqrt(found.covariance.diagonal()[LEVER])
    if np.any(np.abs(found.lever_b) > 3.0 * std):
        place = ", ".join(
            f"{name} {value:.3f} ± {sigma:.3f} m"
            for name, value, sigma in zip(
                ("forward", "left", "up"), FLIP @ found.lever_b, std, strict=True
            )
        )
        estimator.inputs.log(
            "info",
            f"smoothing: the antenna is away from the IMU ({place}), which neither "
            "gnss.antenna_position nor imu.position says: the track and its covariance are those "
            "of the antenna",
        )


def _in_force(t_ns: NDArray[np.int64], since_ns: NDArray[np.int64], values: Array) -> Array:
    """Return those of ``values``, each since a stamp [ns], that hold at other stamps (N,)."""
    last = np.searchsorted(since_ns, t_ns, side="right") - 1
    return np.asarray(values[np.maximum(last, 0)])


def _parts(rows: Array) -> Iterator[slice]:
    """Yield stretches of flat states (N, N_NAV) with the same noise."""
    changes = (np.diff(rows[:, PSD], axis=0) != 0.0).any(axis=1)
    bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(rows)]
    for start, stop in pairwise(bounds):
        yield slice(start, stop)
