"""The benchmark: it runs unattended, and its contenders fly the same flight."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from tools.benchmark.table import Figure, Section, number, plain


@pytest.mark.slow
def test_quick_run_of_kernel_and_replay(tmp_path: Path) -> None:
    """GIVEN --quick THEN every figure is there, and careful NumPy errs as the filter does."""
    data, report = tmp_path / "benchmark.json", tmp_path / "benchmark.md"

    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tools.benchmark.run",
            "--quick",
            "--only",
            "kernel",
            "replay",
            "--json",
            data,
            "--report",
            report,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )

    assert done.returncode == 0, done.stdout + done.stderr
    kernel, replay = json.loads(data.read_text())["sections"]
    assert all(np.isfinite(figure["median"]) for figure in kernel["figures"])
    [(_, rows)] = kernel["tables"]
    errors = {row[0]: float(row[3]) for row in rows[1:]}
    assert errors["live step"] == errors["batch step"] < 1.0
    # The contender does not iterate the first corrections.
    assert errors["careful NumPy"] == pytest.approx(errors["live step"], rel=0.02)
    assert replay["figures"][0]["median"] > 0.0
    assert "## Filter kernel" in report.read_text()


@pytest.mark.parametrize(
    ("values", "higher", "verdict"),
    [
        ([5.0, 6.0, 7.0], True, "stretch"),
        ([4.0], True, "yes"),
        ([2.0], True, "NO"),
        ([2.0], False, "stretch"),
        ([4.0], False, "NO"),
    ],
)
def test_verdicts(values: list[float], higher: bool, verdict: str) -> None:
    figure = Figure("speed", "×", values, 3.0, 5.0 if higher else 2.5, higher)

    assert figure.verdict == verdict
    assert "speed" in plain(Section("", [figure]).rows())


def test_numbers_have_three_digits() -> None:
    assert [number(v) for v in (0.1234, 12.34, 1234.5, float("nan"))] == [
        "0.123",
        "12.3",
        "1234",
        "-",
    ]
