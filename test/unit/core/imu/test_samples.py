"""Arrays of IMU samples."""

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SPAN, sample_period, usual_pause


@pytest.mark.parametrize("count", [2, 3, 9, 200, 201])
def test_period_is_the_median_over_spans(count: int) -> None:
    rng = np.random.default_rng(count)
    t_ns = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 10_000_000, count))
    span = min(SPAN, max(count // 4, 1))

    period = sample_period(t_ns)

    assert period == float(np.median(t_ns[span:] - t_ns[:-span])) / span * 1e-9


@pytest.mark.parametrize(("together", "pause"), [(1, 5), (4, 20), (10, 50)])
def test_the_usual_pause_is_that_between_bursts(together: int, pause: int) -> None:
    k = np.arange(256)
    steps_ns = np.where(k % together == 0, pause * 1_000_000 - 50_000 * (together - 1), 50_000)
    steps_ns[[40, 90]] = 2_000_000_000  # gaps

    found = usual_pause(1_700_000_000_000_000_000 + np.cumsum(steps_ns))

    assert found == pytest.approx(pause * 1e-3, abs=1e-3)


def test_few_stamps_show_no_pause() -> None:
    assert usual_pause(np.arange(20) * 5_000_000) == 0.0
