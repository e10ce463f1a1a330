"""The demo ends in a picture and a score, or in one line that says what failed."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")

pytestmark = pytest.mark.live


def demo(*options: object) -> subprocess.CompletedProcess[str]:
    """Run the demo without its set-up step, in the environment of the tests."""
    return subprocess.run(
        [sys.executable, "-m", "tools.demo", *map(str, options)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )


@pytest.mark.slow
def test_recorded_flight_through_the_live_node(flights: Path, tmp_path: Path) -> None:
    flight = flights / "Horizontal" / "path_4"

    result = demo("--flight", flight, "--rate", 8, "--out", tmp_path)

    assert result.returncode == 0, result.stdout + result.stderr
    for figure in ("PRMSE", "PMAE", "NEES", "NIS"):
        assert figure in result.stdout
    assert "clock offset" in result.stdout
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_node_that_dies_is_reported_with_its_last_words(flights: Path, tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text("/**:\n  ros__parameters:\n    noise.mode: magic\n")
    flight = flights / "Horizontal" / "path_4"

    wrong = ["--params-file", tmp_path / "wrong.yaml"]
    result = demo("--flight", flight, "--out", tmp_path, "--time-offset", 0.1, *wrong)

    assert result.returncode == 1
    assert "tools/demo.sh: error: ins_node ended early, with status 2" in result.stderr
    assert "noise.mode" in result.stderr


@pytest.mark.parametrize("option", ["--flight", "--params-file"])
def test_missing_input_is_named(option: str, tmp_path: Path) -> None:
    result = demo(option, tmp_path / "missing", "--out", tmp_path)

    assert result.returncode == 2
    assert f"{option} {tmp_path / 'missing'}: no such" in result.stderr


def test_only_bags_of_an_earlier_demo_are_replaced(flights: Path, tmp_path: Path) -> None:
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "precious").touch()

    result = demo("--out", tmp_path, "--flight", flights / "Horizontal" / "path_4")

    assert result.returncode == 1
    assert "is there and is no bag" in result.stderr
    assert (tmp_path / "flight" / "precious").exists()
