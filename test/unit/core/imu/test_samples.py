"""Arrays of IMU samples."""

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SPAN, sample_period


@pytest.mark.parametrize("count", [2, 3, 9, 200, 201])
def test_period_is_the_median_over_spans(count: int) -> None:
    rng = np.random.default_rng(count)
    t_ns = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 10_000_000, count))
    span = min(SPAN, max(count // 4, 1))

    period = sample_period(t_ns)

    assert period == float(np.median(t_ns[span:] - t_ns[:-span])) / span * 1e-9
