"""The guide's worked example does what the guide says."""

import math
import re
from types import SimpleNamespace
from typing import Any

import pytest
from support.paths import ROOT

from hybrid_ins.ros.conversions import Refused


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    """What the guide's code blocks define, run one after the other; their asserts hold."""
    text = (ROOT / "docs" / "aiding_sensor.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    # A module's dictionary, for dataclass to look itself up in.
    names: dict[str, Any] = {"__name__": __name__}
    for block in blocks:
        exec(compile(block, "docs/aiding_sensor.md", "exec"), names)
    assert len(blocks) == 4
    return names


def message(pressure: float, variance: float = 0.0, sec: int = 1) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=sec, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp), fluid_pressure=pressure, variance=variance
    )


def test_pressure_falls_by_twelve_pascal_a_metre(example: dict[str, Any]) -> None:
    height = example["barometric_height"](message(101325.0 - 12.01, 144.0), 101325.0, 50.0)

    assert math.isclose(height.height, 51.0, abs_tol=0.01)
    assert math.isclose(height.variance, 1.0, abs_tol=0.01)


@pytest.mark.parametrize("bad", [message(1013.25), message(math.nan), message(101325.0, sec=0)])
def test_what_is_no_pressure_is_refused(example: dict[str, Any], bad: SimpleNamespace) -> None:
    assert isinstance(example["barometric_height"](bad, 101325.0, 0.0), Refused)
