"""The noise model does not know every IMU's rate: the log says so, once."""

import pytest

from hybrid_ins import parameters
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields


@pytest.mark.parametrize(("rate_hz", "told"), [(2000, 1), (50, 0)])
def test_a_rate_that_the_model_does_not_know_is_said_once(rate_hz: int, told: int) -> None:
    log: list[str] = []
    estimator = Estimator(parameters.defaults(), lambda level, text: log.append(text))
    for k in range(8 * rate_hz):
        stamp_ns = 1_700_000_000_000_000_000 + k * 10**9 // rate_hz
        estimator.handle_imu(ImuFields(stamp_ns, (0.01 * (k % 7), 0.0, 9.81), (0.0, 0.0, 0.0)))
        estimator.run_periodic()

    about_noise = [text for text in log if "noise.q_*" in text]
    assert len(about_noise) == told
    assert all(f"{rate_hz} Hz: the noise model plateau reads 25 to" in t for t in about_noise)
