"""The kept machine code, when another version of the package clears up meanwhile."""

from pathlib import Path

import pytest

from hybrid_ins import kernel_cache


def test_a_folder_that_another_version_removed_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "_directory", lambda: tmp_path / "kernels-of-old")

    with kernel_cache.exclusive(lambda: None):
        assert (tmp_path / "kernels-of-old").is_dir()
        (tmp_path / "kernels-of-old" / kernel_cache.LOCK).unlink()
        (tmp_path / "kernels-of-old").rmdir()
        kernel_cache.mark_complete("filter")

    assert kernel_cache.is_complete("filter")


def test_without_a_home_there_is_still_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home(_path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", no_home)

    assert list(kernel_cache._places())[-1] == kernel_cache._temporary_place()
