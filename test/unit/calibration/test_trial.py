"""Parameters are compared at fixes that the filter was not given."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.reader import BagReader, InputTopics
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.trial import Trial, compare, run_trial
from hybrid_ins.cli import simulate

ARM = [1.5, 0.0, 0.4]
TOPICS: InputTopics = {
    "imu_topic": "/imu/data",
    "fix_topic": "/gnss/fix",
    "velocity_topic": "/gnss/velocity",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with the antenna ahead of the IMU, and fixes of centimetres."""
    path = tmp_path_factory.mktemp("trial") / "drive"
    drive = "--trajectory car --duration 60 --seed 2 --imu-rate 50"
    options = f"{drive} --gnss-rate 5 --gnss-noise 0.02 0.02 0.04"
    assert simulate.main([str(path), *options.split()]) == 0
    return path


def trial(bag: Path, **values: Any) -> Trial:
    return run_trial(bag, {**parameters.defaults(), **values}, TOPICS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "objection"),
    [(0.25, "withheld fixes are"), (0.5, "the filter is aligned for")],  # with 0.5 s it is later
)
def test_withheld_fixes_are_met_with_the_right_parameters_and_missed_with_wrong_ones(
    bag: Path, offset: float, objection: str
) -> None:
    right = trial(bag)
    assert 60 < len(right.error) < 80  # of 300, a quarter
    assert np.nanmedian(right.error) < 0.15
    assert 0.4 < np.nanmean(right.nis) < 2.0
    assert right.used > 0.98

    wrong = trial(bag, **{"gnss.time_offset.value": offset, "gnss.time_offset.estimate": False})
    comparison = compare([right], [wrong])
    assert comparison.rms[1] > 3.0 * comparison.rms[0]
    assert objection in comparison.objection
    assert compare([wrong], [right]).objection == ""


@pytest.mark.slow
def test_a_lever_arm_is_a_part_of_what_is_compared(bag: Path) -> None:
    """The true arm is zero: one of 1.5 m is wrong where the vehicle turns, and only there."""
    arm = trial(bag, **{"gnss.antenna_position": ARM})
    assert compare([trial(bag)], [arm]).rms[1] / compare([trial(bag)], [arm]).rms[0] > 1.2
    assert np.nanmedian(arm.error) < 1.0  # the antenna is compared with the antenna


@pytest.mark.slow
def test_fixes_without_height_are_compared_horizontally(bag: Path, tmp_path: Path) -> None:
    """A height of NaN made every error 0, and any parameters good."""
    flat = tmp_path / "flat.mcap"
    with BagReader(bag) as source, BagWriter(flat) as out:
        for topic, log_ns, message in source.messages("/imu/data", "/gnss/fix"):
            if topic == "/gnss/fix":
                message.altitude = math.nan
            out.write(topic, message, log_ns)

    right, wrong = trial(flat), trial(flat, **{"gnss.antenna_position": [4.0, 3.0, 0.0]})

    assert 0.01 < np.nanmedian(right.error) < 0.15
    assert 0.4 < np.nanmean(right.nis) < 2.0
    assert "withheld fixes are" in compare([right], [wrong]).objection


NEVER = Trial(np.full(20, np.nan), np.full(20, np.nan), 0.0)
NONE_WITHHELD = Trial(np.empty(0), np.empty(0), 1.0)


@pytest.mark.parametrize("one", [NEVER, NONE_WITHHELD])
def test_parameters_that_cannot_be_compared_are_objected_to(one: Trial) -> None:
    compared = compare([one], [one])

    assert "not compared with the given parameters" in compared.objection
    assert "no withheld fix could be compared" in compared.text()
    assert "nan" not in compared.text()


def test_what_counts_as_worse() -> None:
    good = Trial(np.full(20, 0.5), np.ones(20), 1.0)
    late = Trial(np.where(np.arange(20) < 10, np.nan, 0.5), np.ones(20), 1.0)
    picky = Trial(np.full(20, 0.5), np.ones(20), 0.9)
    off = Trial(np.where(np.arange(20) < 1, 50.0, 0.5), np.ones(20), 1.0)
    assert "aligned for 50.0 %" in compare([good], [late]).objection
    assert "90.0 % of the fixes are used" in compare([good], [picky]).objection
    assert compare([good], [Trial(np.full(20, 0.52), np.ones(20), 1.0)]).objection == ""
    assert compare([off], [off]).rms == pytest.approx((0.5, 0.5))  # an outlier is nobody's fault
    assert compare([NEVER], [good]).objection == ""
    text = compare([NEVER], [good]).text()
    assert "no withheld fix could be compared" in text
    assert "aligned for 0.0 % -> 100.0 % of the time" in text
