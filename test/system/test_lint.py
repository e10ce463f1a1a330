"""ROS's own linters, where a ROS installation has them (ruff and mypy run in tools/test.sh)."""

import pytest
from support.paths import ROOT

PLACES = [str(ROOT / name) for name in ("hybrid_ins", "launch", "test", "tools", "setup.py")]


def test_flake8() -> None:
    flake8 = pytest.importorskip("ament_flake8.main", reason="ament_flake8 comes with ROS only")

    code, errors = flake8.main_with_errors(["--config", str(ROOT / "setup.cfg"), *PLACES])

    assert code == 0, "\n".join(errors)


def test_pep257() -> None:
    pep257 = pytest.importorskip("ament_pep257.main", reason="ament_pep257 comes with ROS only")
    options = ["--convention", "numpy", "--add-ignore", "D105", "D200", "D401", "--"]

    assert pep257.main([*options, *PLACES[:2], PLACES[-1]]) == 0
