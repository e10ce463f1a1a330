"""The guide's worked example runs as printed, with bad input too."""

import inspect
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.paths import ROOT

from hybrid_ins import parameters
from hybrid_ins.core.aiding.measurements import BarometricHeight
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages.conversions import Refused

BLOCKS = 5


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    """What the guide's code blocks define, run one after the other; their asserts hold."""
    text = (ROOT / "docs" / "aiding_sensor.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert len(blocks) == BLOCKS
    # A module's dictionary, for dataclass to look itself up in.
    names: dict[str, Any] = {"__name__": __name__}
    for block in blocks:
        exec(compile(block, "docs/aiding_sensor.md", "exec"), names)
    return names


def message(pressure: float, variance: float = 0.0, sec: int = 1) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=sec, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp), fluid_pressure=pressure, variance=variance
    )


BAD = (
    message(1013.25),
    message(math.nan),
    message(math.inf),
    message(-1.0),
    message(101325.0, sec=0),
    message(101325.0, sec=-5),
)


def test_the_measurement_is_the_one_of_the_package() -> None:
    text = (ROOT / "docs" / "aiding_sensor.md").read_text(encoding="utf-8")

    assert inspect.getsource(BarometricHeight).strip() in text


def test_pressure_falls_by_twelve_pascal_a_metre(example: dict[str, Any]) -> None:
    height = example["barometric_height"](message(101325.0 - 12.01, 144.0), 101325.0, 50.0)

    assert math.isclose(height.height, 51.0, abs_tol=0.01)
    assert math.isclose(height.variance, 1.0, abs_tol=0.01)


@pytest.mark.parametrize("variance", [0.0, -1.0, math.nan, math.inf])
def test_an_unknown_variance_is_replaced(example: dict[str, Any], variance: float) -> None:
    height = example["barometric_height"](message(101325.0, variance), 101325.0, 50.0)

    assert 0.5 < height.variance < 1.0


@pytest.mark.parametrize("bad", BAD)
def test_what_is_no_pressure_is_refused(example: dict[str, Any], bad: SimpleNamespace) -> None:
    assert isinstance(example["barometric_height"](bad, 101325.0, 0.0), Refused)


def test_a_bad_first_reading_is_counted_and_ends_nothing(example: dict[str, Any]) -> None:
    log: list[str] = []
    estimator = example["BarometerEstimator"](
        parameters.defaults(), lambda level, text: log.append(text)
    )

    for bad in (*BAD, message(101325.0), message(101325.0)):  # the last two before any IMU sample
        estimator.handle_pressure(bad)
    estimator.run_periodic()

    assert estimator.inputs.counts["baro: no pressure"] == 4
    assert estimator.inputs.counts["baro: zero stamp"] == 2
    assert any(line.startswith("baro/pressure: ") for line in log)
    assert estimator.reporter.fixes_fused == 0


def test_readings_without_fixes_stay_dead_reckoning(example: dict[str, Any]) -> None:
    """GIVEN a filter without fixes WHEN the barometer goes on THEN it is not GNSS that is fused."""
    estimator, stamped = example["estimator"], example["stamped"]
    start_ns, fused = estimator.navigator.last_ns, estimator.reporter.fixes_fused

    for k in range(1, 100):
        t_ns = start_ns + k * 10**8 + np.arange(-9, 1, dtype=np.int64) * 10**7
        handle_imu_block(estimator, t_ns, np.tile([0.0, 0.0, 9.797], (10, 1)), np.zeros((10, 3)))
        estimator.handle_pressure(
            stamped(int(t_ns[-1]), fluid_pressure=101325.0 - 12.0, variance=13.0)
        )
    estimator.handle_pressure(stamped(int(t_ns[-1]) - 1, fluid_pressure=9e4, variance=13.0))
    estimator.run_periodic()

    status = estimator.status.diagnostics(estimator.navigator.last_ns)[0]
    assert estimator.reporter.fixes_fused == fused
    assert "dead reckoning" in status.text
    assert estimator.inputs.counts["baro: innovation beyond the gate"] == 1
    assert not any(name.startswith("gnss: innovation") for name in estimator.inputs.counts)
