"""A share of ``tools.robustness.mutate_files``; docs/robustness.md has the whole set."""

import pytest

from tools.robustness import mutate_files


def test_programs_refuse_broken_files_or_read_them(capfd: pytest.CaptureFixture[str]) -> None:
    status = mutate_files.main(["--count", "20"])
    assert status == 0, capfd.readouterr().out
