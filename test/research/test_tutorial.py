"""The tutorial shows what its commands print."""

from pathlib import Path

import pytest

from tools import tutorial


def test_the_tutorial_shows_what_is_printed(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = tutorial.main(["--check", str(flights)])

    assert status == 0, capsys.readouterr().out
