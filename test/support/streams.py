"""Streams as a shell makes them: a reader that went away, a terminal of another encoding."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def closed_pipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Within the block, standard output is a pipe that nobody reads, as after ``| head``."""
    reader, writer = os.pipe()
    os.close(reader)
    with (
        os.fdopen(writer, "w", buffering=1, encoding="utf-8") as stream,
        monkeypatch.context() as m,
    ):
        m.setattr(sys, "stdout", stream)
        yield


@contextmanager
def latin_1(monkeypatch: pytest.MonkeyPatch) -> Iterator[io.BytesIO]:
    """Within the block, standard output has an encoding without Greek letters."""
    data = io.BytesIO()
    stream = io.TextIOWrapper(data, encoding="latin-1", write_through=True)
    with monkeypatch.context() as m:
        m.setattr(sys, "stdout", stream)
        yield data
    stream.detach()
