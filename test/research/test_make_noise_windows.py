"""The data-set program writes what it says, the same every time, and refuses what it cannot."""

from pathlib import Path

import numpy as np
import pytest

from tools.regressor import make_noise_windows

SHORT = ["--duration", "8"]


def made(path: Path, *words: str) -> dict[str, np.ndarray]:
    assert make_noise_windows.main([*words, "--out", str(path)]) == 0
    with np.load(path) as file:
        return dict(file)


def test_the_papers_set_is_split_at_random(tmp_path: Path) -> None:
    data = made(tmp_path / "a.npz", "--set", "paper", *SHORT)
    sizes = [len(data[f"{part}_variance"]) for part in ("train", "test")]

    assert sum(sizes) == 6 * 15 * 6 * 4
    assert sizes[0] == round(0.8 * sum(sizes))
    assert data["train_readings"].shape == (sizes[0], 200)
    assert data["train_readings"].dtype == np.float32


def test_a_whole_trajectory_is_held_out(tmp_path: Path) -> None:
    words = ["--set", "paper", "--held-out", "agile", "--variances", "0.5", "1e-7", *SHORT]
    data = made(tmp_path / "a.npz", *words)
    agile = data["trajectories"].tolist().index("agile")

    assert set(data["test_group"]) == {agile}
    assert agile not in set(data["train_group"])
    assert set(data["train_variance"]) == {0.5, 1e-7}


def test_the_same_options_give_the_same_bytes(tmp_path: Path) -> None:
    words = ["--set", "randomised", "--count", "300", "--window", "128"]
    one, two = made(tmp_path / "a.npz", *words), made(tmp_path / "b.npz", *words)
    other = made(tmp_path / "c.npz", *words, "--seed", "2")

    assert one["train_readings"].shape == (240, 128)
    assert all(np.array_equal(one[key], two[key]) for key in one)
    assert not np.array_equal(one["train_readings"], other["train_readings"])


@pytest.mark.parametrize(
    "words",
    [
        ["--set", "paper", "--window", "10"],
        ["--set", "paper", "--duration", "1"],
        ["--set", "randomised", "--held-out", "agile"],
        ["--set", "randomised", "--count", "0"],
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert make_noise_windows.main([*words, "--out", str(tmp_path / "a.npz")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("make_noise_windows: error: --")
    assert said.count("\n") == 1
    assert not (tmp_path / "a.npz").exists()


def test_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "nowhere" / "a.npz"
    assert make_noise_windows.main(["--set", "paper", *SHORT, "--out", str(out)]) == 2
    assert str(out) in capsys.readouterr().err
