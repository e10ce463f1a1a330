"""
The way into a workspace whose Python is the system's (PEP 668), and the container that takes it.

The commands that would fetch or build something are stubs that write down how they were called.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from support.paths import ROOT

SCRIPT = ROOT / "tools" / "workspace.sh"
CONTAINER = ROOT / "tools" / "Containerfile"
LOGGED = '#!/bin/sh\nprintf "%s\\n" "$0 $*" >> "$CALLS"\n'
PYTHON = f"""{LOGGED}
case "$*" in
    *"import rclpy"*) exit ${{NO_RCLPY:-0}} ;;
    *"import colcon_core"*) exit ${{NO_COLCON:-0}} ;;
    "-m venv "*)
        [ -z "$NO_VENV" ] || exit 1
        mkdir -p "$4/bin" && cp "$BIN/logged" "$4/bin/pip" && cp "$BIN/python" "$4/bin/python" ;;
    "-m colcon build"*) mkdir -p install && touch install/setup.sh install/setup.bash ;;
esac
"""
SYSTEM_PIP = f"{LOGGED}echo 'error: externally-managed-environment' >&2\nexit 1\n"


class Machine:
    """A machine of stubs with a workspace in which the package lies."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.bin = folder, folder / "bin"
        self.workspace = folder / "ws"
        (self.workspace / "src").mkdir(parents=True)
        (self.workspace / "src" / "hybrid_ins").symlink_to(ROOT)
        self.bin.mkdir()
        for name, text in {
            "python3": PYTHON,
            "python": PYTHON,
            "logged": LOGGED,
            "pip": SYSTEM_PIP,
            "pip3": SYSTEM_PIP,
            "apt-get": LOGGED,
        }.items():
            (self.bin / name).write_text(text)
            (self.bin / name).chmod(0o755)

    def run(self, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        (self.folder / "calls").write_text("")
        return subprocess.run(
            words,
            cwd=self.workspace,
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
            env={
                "PATH": f"{self.bin}:/usr/bin:/bin",
                "BIN": str(self.bin),
                "CALLS": str(self.folder / "calls"),
                **environment,
            },
        )

    def calls(self) -> list[str]:
        """What was called, with paths relative to the workspace."""
        text = (self.folder / "calls").read_text()
        return text.replace(f"{self.workspace}/", "").replace(f"{self.bin}/", "").splitlines()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_all_that_apt_lacks_goes_beside_the_workspace(machine: Machine) -> None:
    """GIVEN a Python that pip must not touch WHEN built THEN only the environment is touched."""
    done = machine.run(str(SCRIPT))

    assert done.returncode == 0, done.stderr
    calls = machine.calls()
    assert not [call for call in calls if call.startswith(("pip ", "pip3 "))]
    assert "python3 -m venv --system-site-packages .venv" in calls
    (install,) = [call for call in calls if call.startswith(".venv/bin/pip install")]
    assert {"numpy<2", "numba", "onnxruntime", "rosbags"} <= set(shlex.split(install))
    assert calls[-1] == ".venv/bin/python -m colcon build --packages-select hybrid_ins"
    assert (machine.workspace / ".venv" / "COLCON_IGNORE").is_file()

    again = machine.run(str(SCRIPT), ".")

    assert again.returncode == 0
    assert not [call for call in machine.calls() if "-m venv" in call]


@pytest.mark.parametrize(
    ("environment", "remedy"),
    [
        ({"NO_RCLPY": "1"}, "source /opt/ros/jazzy/setup.bash"),
        ({"NO_COLCON": "1"}, "apt install python3-colcon-common-extensions"),
        ({"NO_VENV": "1"}, "apt install python3-venv"),
    ],
)
def test_what_is_missing_is_said_with_the_remedy(
    machine: Machine, environment: dict[str, str], remedy: str
) -> None:
    done = machine.run(str(SCRIPT), **environment)

    assert done.returncode == 2
    assert remedy in done.stderr
    assert done.stderr.count("error:") == 1


def steps(word: str) -> list[str]:
    """The Containerfile's instructions of a kind, continued lines joined."""
    text = CONTAINER.read_text().replace("\\\n", " ")
    return re.findall(rf"^{word} (.*)$", text, re.MULTILINE)


def test_the_container_takes_that_way(machine: Machine) -> None:
    """GIVEN stubs for pip and colcon WHEN its steps run in sh THEN each finds what it needs."""
    _, build = steps("RUN")
    (machine.folder / "setup.sh").touch()  # the image's own
    build = build.replace("/opt/ros/jazzy/setup.sh", str(machine.folder / "setup.sh"))

    done = machine.run("/bin/sh", "-e", "-c", build)

    assert steps("WORKDIR") == ["/ros2_ws"]
    assert steps("COPY") == [". src/hybrid_ins"]
    assert done.returncode == 0, done.stderr
    assert machine.calls()[-1] == ".venv/bin/python -m hybrid_ins.kernels"


def test_the_container_starts_a_program_with_its_arguments(machine: Machine) -> None:
    (ros2 := machine.bin / "ros2").write_text(LOGGED)
    ros2.chmod(0o755)
    (machine.workspace / "install").mkdir()
    (machine.workspace / "install" / "setup.bash").touch()
    (entry,), (usual,) = steps("ENTRYPOINT"), steps("CMD")

    assert machine.run(*json.loads(entry), *json.loads(usual)).returncode == 0
    assert machine.calls() == ["ros2 run hybrid_ins ins_node"]
    assert machine.run(*json.loads(entry), "ins_replay", "a bag", "-p", "x:=[1, 2]").returncode == 0
    assert machine.calls() == ["ros2 run hybrid_ins ins_replay a bag -p x:=[1, 2]"]


def test_what_the_container_installs_are_keys_of_the_package(machine: Machine) -> None:
    install, _ = steps("RUN")
    words = [w for w in shlex.split(install.partition("install ")[2]) if re.match(r"[a-z]", w)]
    packages = words[: words.index("rm")]

    assert set(packages) == {
        "python3-colcon-common-extensions",  # of packages.ros.org
        "python3-venv",  # of Ubuntu
        "ros-jazzy-tf2-msgs",  # tf2_msgs in package.xml
    }
    assert "tf2_msgs" in (ROOT / "package.xml").read_text()
    assert os.access(SCRIPT, os.X_OK)
