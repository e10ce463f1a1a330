"""The benchmark's section on the node runs: sender, two nodes and taker, for half a minute."""

import subprocess
import sys

import pytest
from support.paths import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")


def test_node_section_runs() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.benchmark.run", "--quick", "--only", "node"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert "latency p99 at 100 Hz" in done.stdout
