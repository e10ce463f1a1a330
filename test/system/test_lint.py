"""ROS's own linters, where a ROS installation has them (ruff and mypy run in tools/test.sh)."""

import pytest
from support.paths import ROOT

PLACES = [str(ROOT / name) for name in ("hybrid_ins", "launch", "setup.py")]
NOT_INSTALLED = ("test", "tools")
LONGEST = 110  # columns, as in setup.cfg


@pytest.mark.slow
def test_flake8() -> None:
    flake8 = pytest.importorskip("ament_flake8.main", reason="ament_flake8 comes with ROS only")

    code, errors = flake8.main_with_errors(["--config", str(ROOT / "setup.cfg"), *PLACES])

    assert code == 0, "\n".join(errors)


def test_lines_of_what_is_not_installed() -> None:
    """There ruff has all rules of flake8 but this: it lets lines that end in a link be longer."""
    files = [file for place in NOT_INSTALLED for file in (ROOT / place).rglob("*.py")]

    assert len(files) > 100
    assert not [
        f"{file.relative_to(ROOT)}:{number}"
        for file in files
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > LONGEST
    ]


@pytest.mark.slow
def test_pep257() -> None:
    pep257 = pytest.importorskip("ament_pep257.main", reason="ament_pep257 comes with ROS only")
    options = ["--convention", "numpy", "--add-ignore", "D105", "D200", "D401", "--"]

    assert pep257.main([*options, *PLACES]) == 0
