"""Recordings that do not suffice for calibration are refused with what is missing."""

from pathlib import Path

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.calibration.admission import check_fixes, check_imu, check_rest, check_stamps
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.cli import calibrate, simulate
from hybrid_ins.errors import InputError

T = np.arange(0.0, 20.0, 0.02)
G = 9.80665


def readings(*, force: float = 1.0, rate: float = 1.0, of: float = 0.0) -> np.ndarray:
    """Return samples of a vehicle that rolls fast to and fro, in units of one's own."""
    roll = 2.0 * np.sin(2.0 * T)
    samples = np.zeros((len(T), 6))
    samples[:, 1], samples[:, 2] = -G * np.sin(roll), -G * np.cos(roll)
    samples[:, 3] = 4.0 * np.cos(2.0 * T)
    samples[:, :3] *= force
    samples[:, 3:] *= rate
    samples += 0.001 * np.random.default_rng(0).standard_normal(samples.shape)
    samples[:, 2] += of
    return samples


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (readings(force=1.0 / G), "unit seems to be g: multiply by 9.80665"),
        (readings(force=0.0), "gravity seems to be removed"),
        (readings(rate=57.3), "degrees per second"),
    ],
)
def test_an_imu_with_wrong_units_is_named(samples: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=f"^bag: /imu/data: .*{words}"):
        check_imu(T, samples, "bag: /imu/data")


def test_a_fall_of_some_seconds_is_no_fault() -> None:
    samples = readings()
    samples[300:600, :3] = 0.0

    check_imu(T, samples, "bag")


def test_stamps_that_nobody_set_are_the_imus_fault() -> None:
    stamps = np.arange(1, 500)
    check_stamps(stamps, "bag")
    with pytest.raises(
        InputError, match=r"bag: header.stamp is zero or negative in 499 of 499 samples"
    ):
        check_stamps(0 * stamps, "bag")


@pytest.mark.parametrize(
    ("fixes", "others", "length", "words"),
    [
        (np.arange(0.0, 1.0, 0.1), 0, 1.0, "samples span 1.0 s without a gap: calibration needs 8"),
        (np.arange(0.0, 10.0), 0, 10.0, "10 usable fixes .* needs 15; record"),
        (np.arange(0.0, 10.0), 30, 10.0, "needs 15, and 30 more .* do both clocks have one epoch"),
        (np.arange(0.0, 5.0, 0.2), 0, 30.0, "25 usable fixes span 4.8 s of 30 s .* needs 8 s"),
    ],
)
def test_what_is_too_little_is_said(
    fixes: np.ndarray, others: int, length: float, words: str
) -> None:
    with pytest.raises(InputError, match=words) as raised:
        check_fixes(fixes, others, length, "bag")
    assert ("epoch" in str(raised.value)) == bool(others)


def test_the_bounds_of_the_options_are_said_and_suffice() -> None:
    def left(length: float, search: float) -> np.ndarray:
        fixes = np.arange(0.0, length, 1.0)
        return fixes[(fixes >= search) & (fixes <= length - search)]

    with pytest.raises(InputError, match="give --longest at least 19"):
        check_rest(left(5.0, 1.5), 5.0, 1.5, True, "bag")
    check_rest(left(19.0, 1.5), 19.0, 1.5, True, "bag")
    with pytest.raises(InputError, match="give --search at most 12"):
        check_rest(left(40.0, 15.0), 40.0, 15.0, False, "bag")
    check_rest(left(40.0, 12.0), 40.0, 12.0, False, "bag")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("flights") / "flight.mcap"
    assert simulate.main([str(bag), "--duration", "20", "--imu-rate", "50"]) == 0
    return bag


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--longest", "1"], "give --longest at least 12"),
        (["--longest", "5"], "give --longest at least 12"),
        (["--search", "100"], "give --search at most 5."),
    ],
)
def test_options_that_leave_too_little_end_in_one_line(
    flight: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    assert calibrate.main([str(flight), *options, "--out", str(flight.parent / "out.yaml")]) == 2

    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"ins_calibrate: error: {flight}: ")
    assert words in last
    assert not (flight.parent / "out.yaml").exists()


def test_a_recording_of_a_second_is_only_short(tmp_path: Path) -> None:
    bag = tmp_path / "short.mcap"
    assert simulate.main([str(bag), "--duration", "1"]) == 0

    with pytest.raises(InputError, match="record half a minute or more") as raised:
        read_recording(bag, parameters.defaults())
    assert "epoch" not in str(raised.value)
