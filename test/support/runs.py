"""Runs drawn by `tools.paper.montecarlo`, changed, and given to a filter or to the estimator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.filter.events import ScatterInForce
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP
from tools.paper.runs import Run

Q = np.repeat([4e-4, 4e-6], 3)


def begin(run: Run, *, q: np.ndarray = Q, **settings: Any) -> InsFilter:
    stamps = run.samples["t_ns"]
    ring = ImuRing()
    ring.extend(run.samples[:1])
    return InsFilter(
        run.start,
        int(stamps[0]),
        np.concatenate((run.samples["f"][0], run.samples["w"][0])),
        FilterNoise(ConstantNoise(q), ProcessNoise(run.bias_walk, 0.01), NoiseMultipleModelBank()),
        Gate({3: 25.0, 6: 35.0}, 3.0),
        ring,
        FilterSettings(max_delay=1.0, **settings),
    )


def fly(
    run: Run, *, late: float = 0.0, q: np.ndarray = Q, scatter: bool = False
) -> tuple[InsFilter, np.ndarray]:
    """
    Run the filter with levels ``q``, and return the factors (M, 3).

    Each fix is given ``late`` [s] after its stamp; with ``scatter`` what they scatter by, and their
    stamps, is in force.
    """
    ins, at, factors = begin(run, q=q), 0, []
    if scatter:
        ins.submit(ScatterInForce(ins.t_ns, PositionJumps()))
    stamps = run.samples["t_ns"]
    for fix in run.fixes:
        stop = int(np.searchsorted(stamps, fix.t_ns + round(late * 1e9), side="right"))
        if stop > at + 1:
            ins.ring.extend(run.samples[at + 1 : stop])
            ins.predict_block(run.samples[at + 1 : stop])
            at = stop - 1
        ins.submit(fix)
        factors.append((*ins.noise.imu_factors, ins.noise.found.fixes))
    if at + 1 < len(stamps):
        ins.ring.extend(run.samples[at + 1 :])
        ins.predict_block(run.samples[at + 1 :])
    return ins, np.array(factors)


def moved(run: Run, change: np.ndarray) -> Run:
    """Move the fixes by so many metres, (M, 3) north, east, down."""
    scale = np.array([1.0 / 6.37e6, 1.0 / 5.35e6, -1.0])
    fixes = tuple(replace(f, lla=f.lla + d * scale) for f, d in zip(run.fixes, change, strict=True))
    return replace(run, fixes=fixes)


def stamped_early(run: Run, by: float) -> Run:
    first = int(run.samples["t_ns"][0])
    fixes = tuple(replace(f, t_ns=f.t_ns - round(by * 1e9)) for f in run.fixes)
    return replace(run, fixes=tuple(f for f in fixes if f.t_ns > first))


def through_estimator(
    run: Run, late: float = 0.0, record: RunRecord | None = None, **values: object
) -> Estimator:
    """Give a run to the node's estimator, each fix ``late`` [s] after its stamp."""
    estimator = Estimator(
        parameters.check_all(
            {
                "alignment.heading_source": "parameter",
                "alignment.yaw_std": 0.5,
                "alignment.yaw": np.pi / 2,
                **values,
            }
        ),
        lambda level, text: None,
        record,
    )
    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.position_covariance_type = 2
    stamps, start = run.samples["t_ns"], 0
    for f in run.fixes:
        stop = int(np.searchsorted(stamps, f.t_ns + round(late * 1e9), side="right"))
        handle_imu_block(
            estimator,
            stamps[start:stop],
            run.samples["f"][start:stop] @ FLIP,
            run.samples["w"][start:stop] @ FLIP,
        )
        start = stop
        conversions.set_stamp(fix.header.stamp, f.t_ns)
        fix.latitude, fix.longitude = np.degrees(f.lla[:2]).tolist()
        fix.altitude = float(f.lla[2])
        fix.position_covariance = np.diag(f.covariance_n.diagonal()[[1, 0, 2]]).ravel()
        estimator.handle_fix(fix)
    return estimator
