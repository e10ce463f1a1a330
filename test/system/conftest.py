"""Fixtures of tests with real ROS processes."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator

import pytest
from support import interfaces
from support.ros_nodes import ENVIRONMENT, Client


@pytest.fixture(scope="module")
def types(request: pytest.FixtureRequest) -> Iterator[dict[str, str]]:
    """What makes processes find the types that the wheels lack; this one does, too."""
    folder = interfaces.build(request.config.cache)
    sys.path.insert(0, str(folder))
    yield {"PYTHONPATH": os.pathsep.join([str(folder), ENVIRONMENT["PYTHONPATH"]])}
    sys.path.remove(str(folder))


@pytest.fixture
def client() -> Iterator[Client]:
    """A node of this process that asks the others."""
    asking = Client()
    yield asking
    asking.close()
