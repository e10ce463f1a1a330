"""Where the files that come with the package are: models, parameter files, dataset maps.

A source checkout keeps them beside the package; pip and colcon install them to
``share/hybrid_ins`` of the prefix that holds the package. Both places are found upwards from this
file, so that neither an environment variable nor the working directory matters.
"""

from pathlib import Path

from hybrid_ins.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def share_path(name: str) -> Path:
    """Find a file or folder that comes with the package.

    Parameters
    ----------
    name
        Path below the share directory, such as ``"config/default.yaml"``.

    Raises
    ------
    InputError
        This installation has no such file.

    """
    for folder in _share_folders(_PACKAGE):
        if (folder / name).exists():
            return folder / name
    raise InputError(f"{name}: not among the files that are installed with hybrid_ins")


def _share_folders(package: Path) -> list[Path]:
    """Return the places to look in, nearest first; `package` is the package's own directory."""
    if (package.parent / "package.xml").is_file():  # a source checkout
        return [package.parent]
    return [prefix / "share" / "hybrid_ins" for prefix in package.parents]
