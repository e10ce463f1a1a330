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


def test_a_constant_that_kernels_import_from_a_module_without_any_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN kernels that are kept WHEN the layout of the state changes THEN they are not used."""
    layout = tmp_path / "core" / "inertial" / "state.py"
    layout.parent.mkdir(parents=True)
    layout.write_text("N_ERROR = 15\n")
    monkeypatch.setattr(kernel_cache, "PACKAGE", tmp_path)
    before = kernel_cache._digest()

    layout.write_text("N_ERROR = 16\n")

    assert kernel_cache._digest() != before
