"""The package's files are found in a checkout and in every kind of installation."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hybrid_ins import resources
from hybrid_ins.errors import InputError

SOURCES = Path(resources.__file__).parent


def found_from(package: Path, name: str) -> str:
    """Let a copy of the package in `package` find `name`, in a process of its own."""
    package.mkdir(parents=True)
    for module in ("__init__.py", "errors.py", "resources.py"):
        shutil.copy(SOURCES / module, package)
    code = (
        f"import sys; sys.path.insert(0, {str(package.parent)!r});"
        f"from hybrid_ins.resources import share_path; print(share_path({name!r}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/")
    return result.stdout.strip() or result.stderr


@pytest.mark.parametrize(
    ("package", "share"),
    [
        ("hybrid_ins", "."),
        ("lib/python3.12/site-packages/hybrid_ins", "share/hybrid_ins"),
        ("local/lib/python3.12/dist-packages/hybrid_ins", "local/share/hybrid_ins"),
        ("hybrid_ins", "share/hybrid_ins"),
    ],
    ids=["source checkout", "virtual environment or colcon", "Debian", "pip --target"],
)
def test_found_in_every_layout(tmp_path: Path, package: str, share: str) -> None:
    wanted = tmp_path / share / "models" / "some.onnx"
    wanted.parent.mkdir(parents=True)
    wanted.touch()
    if share == ".":
        (tmp_path / "package.xml").touch()

    assert found_from(tmp_path / package, "models/some.onnx") == str(wanted)


def test_checkout_wins_over_what_an_editable_installation_copied(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "share" / "hybrid_ins"):
        (folder / "config").mkdir(parents=True)
        (folder / "config" / "default.yaml").touch()
    (tmp_path / "package.xml").touch()

    found = found_from(tmp_path / "hybrid_ins", "config/default.yaml")

    assert found == str(tmp_path / "config" / "default.yaml")


def test_missing_file_is_named() -> None:
    with pytest.raises(InputError, match=r"models/none\.onnx: not among the files"):
        resources.share_path("models/none.onnx")
