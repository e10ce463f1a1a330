"""Nothing that the tests and the demo start outlives them, and no two share a ROS domain."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tools.processes import DOMAINS, Processes, claim_ros_domain

SLEEP = [sys.executable, "-c", "import time; print('up', flush=True); time.sleep(60)"]
DEAF = [
    sys.executable,
    "-c",
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
    "print('up', flush=True); time.sleep(60)",
]


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_children_end_with_the_block_even_when_it_fails() -> None:
    with pytest.raises(KeyError), Processes() as processes:
        child = processes.start(SLEEP, subprocess.PIPE)
        assert child.stdout and child.stdout.readline() == "up\n"
        raise KeyError

    assert child.returncode == -signal.SIGTERM
    assert not is_alive(child.pid)


def test_child_that_ignores_sigterm_is_killed() -> None:
    with Processes(patience=0.2) as processes:
        child = processes.start(DEAF, subprocess.PIPE)
        assert child.stdout and child.stdout.readline() == "up\n"

    assert child.returncode == -signal.SIGKILL


def test_stop_returns_the_exit_status(processes: Processes) -> None:
    child = processes.start([sys.executable, "-c", "raise SystemExit(7)"])
    child.wait()

    assert processes.stop(child) == 7


def test_child_ends_when_its_parent_is_killed(processes: Processes) -> None:
    code = (
        "import sys, time; from tools.processes import Processes;"
        f"print(Processes().start({SLEEP!r}).pid, flush=True); time.sleep(60)"
    )
    parent = processes.start(
        [sys.executable, "-c", code], subprocess.PIPE, {"PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert parent.stdout
    pid = next(int(line) for line in parent.stdout if line.strip().isdigit())

    parent.kill()
    parent.wait()

    deadline = time.monotonic() + 10
    while is_alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_alive(pid)


def test_each_claim_is_another_domain() -> None:
    first, second = claim_ros_domain(), claim_ros_domain()

    assert first != second
    assert {first, second, int(os.environ["ROS_DOMAIN_ID"])} <= set(DOMAINS)
