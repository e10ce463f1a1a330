"""
The smoothed states of a recording with calibrated parameters.

What is read off the states (the mount by a reference's attitude or the direction of travel, nose
and axle, wheels) is known better with the measurements after them, too. What is found by the
likelihood of the innovations is not: its gradient is that of the smoothed residuals already
(Fisher's identity, [1]_).

References
----------
.. [1] O. Cappé, E. Moulines, T. Rydén, *Inference in Hidden Markov Models*, 2005, section 10.1.3.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.filter_pass import (
    INTERVAL,
    TAIL,
    FilterPass,
    Nominal,
    first_state,
    initial_state,
    scaled_covariances,
    slow_variance,
)
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.likelihood import YAW_STD
from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.core.inertial.state import NavState
from hybrid_ins.core.noise.position_scatter import Split
from hybrid_ins.core.smoothing.segments import SmootherStart, Update
from hybrid_ins.core.smoothing.smoother import Smoother
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

Array = NDArray[np.float64]

TIME_ZERO_NS = 1_000_000_000_000  # of the recordings' time zero
LONG_STEP = 3.5  # median steps between samples, above which there is a gap


def smoothed_pass(fitted: Fit, nominal: Nominal, k: int, passed: FilterPass) -> FilterPass:
    """
    Return the filter's pass over recording ``k`` with smoothed states, after each measurement.

    Parameters
    ----------
    fitted : Fit
    nominal : Nominal
    k : int
        Number of the recording.
    passed : FilterPass
        Of the filter with the fitted parameters; its weights of outliers are kept.
    """
    recording, offset, model = fitted.recordings[k], fitted.offset(k), fitted.model
    first = first_state(recording, offset, nominal)
    nav = initial_state(first, model.lever_b, fitted.yaws[k], YAW_STD)
    t_ns = TIME_ZERO_NS + np.rint(recording.t * 1e9).astype(np.int64)
    samples = as_samples(t_ns, recording.samples[:, :3], recording.samples[:, 3:])
    start = SmootherStart(
        int(samples["t_ns"][first.sample]),
        recording.samples[first.sample],
        NavState.from_flat(nav),
        model.psd,
    )
    times = recording.measured_at(offset, model.velocity_age)
    stamps = TIME_ZERO_NS + np.rint(times * 1e9).astype(np.int64)
    order = np.argsort(stamps, kind="stable")
    fused = order[np.isfinite(passed.nis[order])]
    R, slow = scaled_covariances(recording, model), slow_variance(recording, model)
    last_ns = start.t_ns
    noise = recording.noise(*model.follow)
    sample = np.searchsorted(recording.t[:-1], times)
    updates = []
    for row in fused:
        there = model.psd * np.repeat([*noise[sample[row]], 1.0, 1.0], 3)
        make = PositionFix if recording.aid_kind[row] == POSITION else VelocityFix
        measurement = make(int(stamps[row]), recording.aid[row], R[row], model.lever_b)
        size = float(np.isfinite(recording.aid[row]).sum())
        outlying = max(1.0, (TAIL + float(passed.nis[row])) / (TAIL + size))
        split = None
        if recording.aid_kind[row] == POSITION:
            split = Split(R[row], slow[row], (int(stamps[row]) - last_ns) * 1e-9)
            last_ns = int(stamps[row])
        updates.append(Update(int(stamps[row]), there, measurement, outlying, split=split))
    gap_ns = round(LONG_STEP * recording.period * 1e9)
    smoother = Smoother(start, samples, updates, INTERVAL, gap_ns, {}, {})
    smoother.run()
    t_ns, rows = map(np.concatenate, zip(*smoother.states(), strict=True))
    at = np.clip(np.searchsorted(t_ns, stamps), 0, len(t_ns) - 1)
    return replace(passed, states=rows[at])
