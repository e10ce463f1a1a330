"""The launch files say what they start, where launch is installed."""

import importlib.util
from pathlib import Path

import pytest
from conftest import ROOT

FILES = sorted((ROOT / "launch").glob("*.launch.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_is_described(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch_ros comes with ROS only")
    spec = importlib.util.spec_from_file_location("launch_file", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    description = module.generate_launch_description()

    for argument in description.get_launch_arguments():
        assert argument.description, argument.name
