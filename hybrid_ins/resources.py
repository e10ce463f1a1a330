"""
Files that the package reads: where its own are installed, and how foreign ones are read safely.

A source checkout keeps the package's files beside it; pip and colcon install them to
``share/hybrid_ins`` of the prefix that holds the package. Both places are found upwards from this
file, so that neither an environment variable nor the working directory matters.
"""

import os
import stat
from pathlib import Path

from hybrid_ins.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def share_path(name: str) -> Path:
    """
    Return the path of a file or folder that is installed with the package.

    Parameters
    ----------
    name : str
        Path below the share directory, such as ``"config/default.yaml"``.

    Raises
    ------
    InputError
        This installation has no such file.
    """
    for folder in _share_folders(_PACKAGE):
        try:
            if (folder / name).exists():
                return folder / name
        except (OSError, ValueError):  # too long for a file name, or a NUL in it
            break
    raise InputError(f"{shortened(name)}: not among the files that are installed with hybrid_ins")


def _share_folders(package: Path) -> list[Path]:
    """Return the places to search, nearest first; `package` is the package's own directory."""
    if (package.parent / "package.xml").is_file():  # a source checkout
        return [package.parent]
    return [prefix / "share" / "hybrid_ins" for prefix in package.parents]


def read_regular_file(path: Path, limit: int, what: str) -> bytes:
    """
    Return the content of a regular file of limited size.

    Devices and pipes are refused without being read: they may never end.

    Parameters
    ----------
    path : Path
        Name of the file.
    limit : int
        Largest size [bytes].
    what : str
        What the file should be, for the error, for example "a parameter file".

    Raises
    ------
    InputError
        The file does not exist, is not a regular file, is larger than `limit`, or cannot be read.
    """
    name = shortened(str(path))
    try:
        # A pipe without a writer blocks when it is opened otherwise.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise InputError(f"{name}: {error.strerror}: give {what}") from None
    except ValueError:  # a NUL in the name
        raise InputError(f"{name!r}: not a file name: give {what}") from None
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise InputError(f"{name}: not a regular file: give {what}")
        size, content = about.st_size, b""
        if size <= limit:
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                content = file.read(limit + 1)
            size = len(content)  # it may have grown meanwhile
    except OSError as error:
        raise InputError(f"{name}: {error.strerror}: give {what}") from None
    finally:
        os.close(descriptor)
    if size > limit:
        raise InputError(
            f"{name}: {size / 1e6:g} MB is larger than {what} may be, {limit / 1e6:g} MB"
        )
    return content


def shortened(text: str, length: int = 100) -> str:
    """Return a text for an error message, without its middle where it is too long."""
    if len(text) <= length:
        return text
    return f"{text[: length // 2]}...{text[-length // 2 :]}"


def printable(name: str) -> str:
    """Return a file's name for texts and pictures, with question marks for what is no UTF-8."""
    return name.encode(errors="replace").decode()
