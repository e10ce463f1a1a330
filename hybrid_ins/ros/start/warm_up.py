"""
A short run through everything that happens at the IMU's rate, before the first message.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import NewMessage
from hybrid_ins.ros.messages.type_names import FIX, TWIST
from hybrid_ins.ros.output.message_types import encode


def warm_up(new: NewMessage, values: Mapping[str, Any]) -> None:
    """
    Run an estimator on a hundred samples and some fixes; see also `hybrid_ins.kernels.prepare`.

    Parameters
    ----------
    new : callable
        Given the name of a type, returns an empty message of it.
    values : mapping
        Checked parameters: those of the noise are used, so that no other model is loaded.
    """
    noise = {name: value for name, value in values.items() if name.startswith("noise.")}
    values = {
        **parameters.defaults(),
        **noise,
        "alignment.heading_source": "parameter",
        "alignment.window": 0.05,
    }
    estimator = Estimator(values, lambda level, text: None)
    fix = new(FIX)
    fix.status.status = conversions.STATUS_FIX
    fix.latitude = 1.0
    velocity = new(TWIST)
    for k in range(1, 101):
        t_ns = k * 10_000_000
        estimator.handle_imu(ImuFields(t_ns, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))
        estimator.run_periodic()
        if k % 20 == 0:
            for message in (fix, velocity):
                conversions.set_stamp(message.header.stamp, t_ns)
            estimator.handle_fix(fix)
            estimator.handle_velocity(velocity)
    stamps = 1_000_000_000 + 10_000_000 * np.arange(1, 6)
    handle_imu_block(estimator, stamps, np.tile([0.0, 0.0, 9.8], (5, 1)), np.zeros((5, 3)))
    for report in estimator.pop_reports():
        encode(report)
    if not estimator.reporter.ever_aligned:
        raise RuntimeError("the warm-up run did not reach the filter")
