"""A share of ``tools.robustness.mutate_files``; docs/robustness.md has the whole set."""

import subprocess
import sys

MUTATE = [sys.executable, "-m", "tools.robustness.mutate_files", "--count", "20"]


def test_programs_refuse_broken_files_or_read_them() -> None:
    # In a process of its own: its children are forks, and ROS cannot start in those of a process
    # that has used it already, as tests do.
    done = subprocess.run(MUTATE, capture_output=True, text=True, timeout=800)
    assert done.returncode == 0, done.stdout + done.stderr
