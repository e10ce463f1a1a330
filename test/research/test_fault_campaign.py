"""A few faults of ``tools.robustness.fault_campaign``; docs/fault_campaign.md has all of them."""

import pytest

from tools.robustness import fault_campaign
from tools.robustness.faults import FAULTS


def test_the_campaign_is_as_large_as_it_says() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(names) == len(set(names)) >= 40
    assert set(fault_campaign.LIVE) | set(fault_campaign.QUICK) <= set(names)
    assert len(fault_campaign.LIVE) >= 10


def test_a_few_faults_are_survived(capfd: pytest.CaptureFixture[str]) -> None:
    assert fault_campaign.main(["--quick", "--jobs", "1"]) == 0, capfd.readouterr().out
