"""Ways to break a file: bytes flipped, cut, repeated and made up; words and lines of YAML."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

ODD_WORDS = (
    "nan",
    ".nan",
    "1e999",
    "-1",
    "[",
    "]",
    "{",
    "}",
    "&a",
    "*a",
    "<<: *a",
    "!!python/name:os",
    "null",
    "~",
    "'",
    '"',
    "\t",
    ": :",
    "- -",
    "0x10",
    "1_000",
    "yes",
    "# ",
    "\0",
    "é",
    "!!binary aGk=",
    "2001-01-01",
    "9" * 400,
    "a" * 5000,
    "? ",
    "|",
    ">",
    "%YAML 9.9",
)
Draw = np.random.Generator


def flip_bits(data: bytes, rng: Draw) -> bytes:
    """Flip a few bits."""
    changed = bytearray(data)
    for at in rng.integers(0, len(data), int(rng.integers(1, 30))):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncate(data: bytes, rng: Draw) -> bytes:
    """End early; now and then at once."""
    return data[: int(rng.integers(0, len(data)) * rng.choice([0.0, 0.01, 1.0, 1.0]))]


def erase(data: bytes, rng: Draw) -> bytes:
    """Fill a stretch with one value."""
    start = int(rng.integers(0, len(data)))
    length = min(int(rng.integers(1, 5000)), len(data) - start)
    return data[:start] + bytes([int(rng.choice([0, 255]))]) * length + data[start + length :]


def cut_out(data: bytes, rng: Draw) -> bytes:
    """Lose a stretch."""
    start = int(rng.integers(0, len(data)))
    return data[:start] + data[start + int(rng.integers(1, 3000)) :]


def repeat(data: bytes, rng: Draw) -> bytes:
    """Say a stretch twice."""
    start = int(rng.integers(0, len(data)))
    stop = start + int(rng.integers(1, 3000))
    return data[:stop] + data[start:]


def inflate(data: bytes, rng: Draw) -> bytes:
    """Write a huge number over some bytes: lengths and counts become absurd."""
    changed = bytearray(data)
    for at in rng.integers(0, max(len(data) - 8, 1), int(rng.integers(1, 6))):
        changed[at : at + 8] = b"\xff" * int(rng.choice([4, 7, 8]))
    return bytes(changed[: len(data)])


def noise(data: bytes, rng: Draw) -> bytes:
    """Keep nothing but the first bytes."""
    return data[: int(rng.integers(0, 64))] + rng.bytes(len(data) // 4)


BYTES: tuple[Callable[[bytes, Draw], bytes], ...] = (
    flip_bits,
    truncate,
    erase,
    cut_out,
    repeat,
    inflate,
    noise,
)


def odd_words(data: bytes, rng: Draw) -> bytes:
    """Put odd words in the place of some others."""
    words = data.decode().split(" ")
    for at in rng.integers(0, len(words), int(rng.integers(1, 6))):
        words[at] = str(rng.choice(ODD_WORDS))
    return " ".join(words).encode()


def shuffle_lines(data: bytes, rng: Draw) -> bytes:
    """Bring the lines into another order."""
    lines = data.splitlines()
    rng.shuffle(lines)
    return b"\n".join(lines)


def made_up_yaml() -> dict[str, bytes]:
    """Return files that nobody writes by accident."""
    laughs = "a: &a [x, x]\n" + "".join(
        f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(9)
    )
    head = "/**:\n  ros__parameters:\n"
    return {
        "billion laughs": laughs.encode(),
        "refers to itself": b"&a [*a]\n",
        "merges itself": b"&a {<<: *a, x: 1}\n",
        "deep": b"[" * 50_000,
        "deep mapping": "".join(f"{' ' * k}a:\n" for k in range(900)).encode(),
        "huge": (head + "    gnss.patience: 1.0\n" * 200_000).encode(),
        "python object": b"!!python/object/apply:os.system ['true']\n",
        "empty": b"",
        "binary": bytes(range(256)) * 10,
        "number": b"42\n",
        "list": b"- 1\n- 2\n",
        "keys that are no text": (head + "    1: 2\n    ? [a]\n    : 3\n").encode(),
        "wrong types": (head + "    gnss: 5\n    datum: {a: b}\n").encode(),
        "not a number": (head + "    gnss:\n      patience: .nan\n").encode(),
        "no section": b"other_node:\n  ros__parameters: {}\n",
        "tab": b"/**:\n\tros__parameters: {}\n",
        "long name": (head + "    " + "a" * 100_000 + ": 1\n").encode(),
    }
