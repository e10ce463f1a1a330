"""What the tests share: the recorded flights, a ROS domain of their own, child processes."""

import fcntl
import gc
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from support.paths import ROOT

from hybrid_ins import kernel_cache
from tools.processes import Processes, isolated_ros

LIVE_LOCK = Path(tempfile.gettempdir()) / f"hybrid_ins-live-tests-{os.getuid()}.lock"

kernel_cache.enable()

# The same examples every time, however busy the machine is.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# Behind `&` a shell leaves Ctrl-C ignored, and programs that the tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Before anything imports rclpy: whatever runs beside these tests neither hears nor disturbs them.
os.environ.update(isolated_ros())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the live tests first: they wait for each other while the rest keeps a processor busy."""
    items.sort(key=lambda item: item.get_closest_marker("live") is None)


def pytest_collection_finish() -> None:
    """Exempt what was imported from garbage collection: it stays, and there is much of it."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Let no two live tests run at once: they would lose messages on a slow machine."""
    if item.get_closest_marker("live") is None:
        return (yield)
    with LIVE_LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (yield)


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
