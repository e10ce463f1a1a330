"""
Run the commands that `docs/tutorial.md` shows, and write or check what it shows as their output.

    python -m tools.tutorial [--check [--quick]] DATASET

DATASET is the folder of the quadrotor dataset. Numbers may differ by 1 % and by one in their last
digit, since processors round differently; everything else has to be the same. Without `--check` the
page, its picture and the calibrated parameters are written, and the figures that `README.md` quotes
from the page. With `--quick` these parameters are used as they are instead of calibrating anew,
which takes most of the time: so a test can check the rest.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from hybrid_ins.cli import options
from hybrid_ins.cli import program as shell
from hybrid_ins.errors import InputError
from tools import generate_docs

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorial.md"
CALIBRATED = ROOT / "docs" / "my_robot.yaml"
PICTURE = ("tuned.png", ROOT / "docs" / "figures" / "flight.png")
DATASET = "quadrotor"  # what the page calls the dataset's folder
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
BLOCK = re.compile(r"^```\n(\$ .*?)^```$", re.MULTILINE | re.DOTALL)


def run(command: str, folder: Path) -> str:
    """Return what a command prints in a folder, both streams in the order of the terminal."""
    name, *arguments = shlex.split(command)
    program = importlib.import_module(f"hybrid_ins.cli.{name.removeprefix('ins_')}")
    printed, before = io.StringIO(), Path.cwd()
    os.environ["COLUMNS"] = "200"
    os.chdir(folder)
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            status = program.main(arguments)
    finally:
        os.chdir(before)
    if status:
        raise RuntimeError(f"{command}: status {status}: {printed.getvalue()}")
    # The first run on a machine says that it compiles.
    lines = printed.getvalue().splitlines(keepends=True)
    return "".join(line for line in lines if "info: compiling the filter" not in line)


def steps(block: str) -> Iterator[tuple[str, str]]:
    """Yield each command of a block with the output that the page shows."""
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command, output


def written_anew(page: str, folder: Path, quick: bool) -> str:
    """Return the page with the output that its commands print now."""

    def output_of(block: re.Match[str]) -> str:
        parts = []
        for command, shown in steps(block[1]):
            if quick and command.startswith("ins_calibrate"):
                shutil.copy(CALIBRATED, folder)
                printed = shown
            else:
                printed = run(command, folder)
            parts.append(f"$ {command}\n{printed}")
        return "```\n" + "".join(parts) + "```"

    return BLOCK.sub(output_of, page)


def differences(shown: str, printed: str) -> list[str]:
    """Return the lines that a page shows and that are printed differently now."""
    old, new = shown.splitlines(), printed.splitlines()
    if len(old) != len(new):
        return [f"{len(old)} lines shown, {len(new)} lines now"]
    return [f"- {a}\n+ {b}" for a, b in zip(old, new, strict=True) if not same(a, b)]


def same(shown: str, printed: str) -> bool:
    """Return whether two lines differ by rounding only."""
    if " ".join(NUMBER.sub("#", shown).split()) != " ".join(NUMBER.sub("#", printed).split()):
        return False
    return all(
        abs(float(a) - float(b)) <= 0.01 * abs(float(a)) + 1.001 * last_digit(a)
        for a, b in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    )


def last_digit(number: str) -> float:
    """Return what one in the last digit of a decimal number is worth."""
    mantissa, _, exponent = number.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(exponent or 0) - decimals))


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page, or with ``--check`` print where it differs."""
    parser = shell.parser("tutorial", __doc__ or "")
    parser.add_argument("dataset", type=options.path, help="folder of the quadrotor dataset")
    parser.add_argument("--check", action="store_true", help="write nothing, fail if out of date")
    parser.add_argument("--quick", action="store_true", help=f"use {CALIBRATED.name} as it is")
    return shell.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    if not (args.dataset / "Horizontal").is_dir():
        raise InputError(f"{args.dataset}: holds no Horizontal: is this the quadrotor dataset?")
    page = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / DATASET).symlink_to(args.dataset.resolve())
        text = written_anew(page, folder, args.quick)
        if not args.check:
            PAGE.write_text(text, encoding="utf-8")
            shutil.copy(folder / PICTURE[0], PICTURE[1])
            shutil.copy(folder / CALIBRATED.name, CALIBRATED)
            return generate_docs.main([])
    found = differences(page, text)
    if found:
        print(f"{PAGE.relative_to(ROOT)} is out of date: run python -m tools.tutorial DATASET")
        print("\n".join(found))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
