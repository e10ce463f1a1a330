"""The tutorial shows what its commands print today, but for the calibration: see test/research."""

from pathlib import Path

import pytest

from tools import tutorial


@pytest.mark.slow
def test_the_tutorial_shows_what_is_printed_with_its_calibration(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # It runs a dozen programs, ten seconds: the figures that README quotes drifted within a day.
    status = tutorial.main(["--check", "--quick", str(flights)])

    assert status == 0, capsys.readouterr().out


def test_figures_that_drift_fail_the_check(
    flights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "tutorial.md"
    command = "ins_convert quadrotor/Horizontal/path_4 flight"
    monkeypatch.setattr(tutorial, "ROOT", tmp_path)
    monkeypatch.setattr(tutorial, "PAGE", page)

    for samples, status in (("4801", 0), ("4901", 1)):
        printed = f"flight: 40.0 s; {samples} samples of IMU_1.csv at 120 Hz, 201 fixes at 5 Hz, "
        page.write_text(f"```\n$ {command}\n{printed}401 of 401 epochs of truth\n```\n")
        assert tutorial.main(["--check", "--quick", str(flights)]) == status
