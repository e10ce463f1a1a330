"""Headings in words."""

import math

import pytest

from hybrid_ins.core.navigator.notices import HeadingCorrected
from hybrid_ins.ros.reporting import wording


@pytest.mark.parametrize("degrees", [-0.04, 0.0, 0.04, 359.96, -360.0])
def test_north_is_zero(degrees: float) -> None:
    yaw = math.radians(degrees)

    assert wording.describe_heading(yaw, 0.1).startswith("heading 0.0° ±")
    text = wording.describe_correction(HeadingCorrected(yaw, yaw, 0.1))
    assert "heading of 0° ±" in text and "not 0°:" in text
