"""What the tests share: the recorded flights, a ROS domain of their own, child processes."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from support.paths import ROOT

from hybrid_ins import kernel_cache
from tools.processes import Processes, isolated_ros

kernel_cache.enable()

# The same examples every time, however busy the machine is.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# Behind `&` a shell leaves Ctrl-C ignored, and programs that the tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Before anything imports rclpy: whatever runs beside these tests neither hears nor disturbs them.
os.environ.update(isolated_ros())


@pytest.fixture(scope="session")
def flights() -> Path:
    """The folder of recorded quadrotor flights (HYBRID_INS_DATA, or shared/ beside the project)."""
    default = ROOT.parent / "shared" / "data" / "quadrotor"
    folder = Path(os.environ.get("HYBRID_INS_DATA", default))
    if not (folder / "Horizontal").is_dir():
        pytest.skip(f"no recorded flights in {folder} (set HYBRID_INS_DATA to where they are)")
    return folder


@pytest.fixture
def processes() -> Iterator[Processes]:
    """Child processes that end with the test."""
    with Processes() as running:
        yield running
