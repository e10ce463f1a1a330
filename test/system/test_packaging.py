"""What a user installs, by colcon or by pip, is complete and starts."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
from support.paths import ROOT

from tools.processes import program

pytest.importorskip("setuptools.build_meta", reason="builds the package: install the test extra")

PROGRAMS = {
    "ins_calibrate",
    "ins_convert",
    "ins_evaluate",
    "ins_node",
    "ins_play",
    "ins_replay",
    "ins_simulate",
    "ins_status",
}
ROSDEP_KEYS = {
    "mcap": "mcap-ros2-support",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "onnxruntime": "python3-onnxruntime-pip",
    "PyYAML": "python3-yaml",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
    "zstandard": "mcap-ros2-support",  # the mcap that it brings requires it
}
OPTIONAL_MESSAGES = {"gps_msgs", "robot_localization"}  # the node runs without them
SHARED_FILES = sorted(
    str(path.relative_to(ROOT))
    for folder in ("config", "launch", "models")
    for path in (ROOT / folder).rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
)


def run(*command: str | Path, **options: object) -> str:
    """Run a command to its end and return what it printed; fail the test with that otherwise."""
    result = subprocess.run(
        [str(word) for word in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=240,
        **options,  # type: ignore[call-overload]
    )
    assert result.returncode == 0, result.stdout
    return str(result.stdout)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project without what git ignores, for builds that write beside the sources."""
    copy = tmp_path_factory.mktemp("sources") / "hybrid_ins"
    ignored = shutil.ignore_patterns(
        ".*", "__pycache__", "*.egg-info", "build", "install", "log", "dist", "demo"
    )
    shutil.copytree(ROOT, copy, ignore=ignored)
    return copy


@pytest.fixture(scope="module")
def colcon_install(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The install folder of a colcon workspace that holds the package."""
    colcon = shutil.which("colcon", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if colcon is None:
        pytest.skip("no colcon: install the test extra or a ROS 2 desktop")
    workspace = tmp_path_factory.mktemp("workspace")
    prefixes = [sys.prefix, *filter(None, [os.environ.get("AMENT_PREFIX_PATH")])]
    run(
        colcon,
        "build",
        "--base-paths",
        sources,
        "--event-handlers",
        "console_direct+",
        cwd=workspace,
        env=os.environ | {"AMENT_PREFIX_PATH": ":".join(prefixes)},
    )
    return workspace / "install"


@pytest.fixture(scope="module")
def sdist(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    return folder / build("sdist", folder, sources)


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from the sdist alone, so that the sdist is known to be complete."""
    folder = tmp_path_factory.mktemp("wheel")
    run("tar", "-xzf", sdist, "-C", folder)
    return folder / build("wheel", folder, next(folder.glob("hybrid_ins-*")))


def build(kind: str, folder: Path, sources: Path) -> str:
    """Call the build backend as pip does, with the setuptools that is here; return the file."""
    code = f"from setuptools.build_meta import build_{kind}; print(build_{kind}({str(folder)!r}))"
    return run(sys.executable, "-c", code, cwd=sources).splitlines()[-1]


def in_workspace(install: Path, *command: str | Path) -> str:
    """Run a command in a shell that has sourced the workspace, outside the sources."""
    line = '. "$0/setup.sh" && exec "$@"'
    return run("bash", "-c", line, install, *command, cwd=install)


class TestColcon:
    def test_programs_are_where_ros2_run_looks(self, colcon_install: Path) -> None:
        folder = colcon_install / "hybrid_ins" / "lib" / "hybrid_ins"

        assert {path.name for path in folder.iterdir()} == PROGRAMS

    def test_package_is_registered_and_shares_its_files(self, colcon_install: Path) -> None:
        share = colcon_install / "hybrid_ins" / "share"

        assert (share / "ament_index/resource_index/packages/hybrid_ins").is_file()
        for name in ["package.xml", *SHARED_FILES]:
            assert (share / "hybrid_ins" / name).is_file(), name

    def test_installed_package_finds_its_own_files(self, colcon_install: Path) -> None:
        code = "from hybrid_ins.resources import share_path; print(share_path('package.xml'))"

        found = in_workspace(colcon_install, sys.executable, "-c", code)

        assert found.strip() == str(colcon_install / "hybrid_ins/share/hybrid_ins/package.xml")

    def test_installed_node_starts(self, colcon_install: Path) -> None:
        pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")
        node = colcon_install / "hybrid_ins" / "lib" / "hybrid_ins" / "ins_node"

        assert "usage: ins_node" in in_workspace(colcon_install, node, "--help")


class TestPip:
    def test_sdist_holds_what_the_tests_and_builds_need(self, sdist: Path) -> None:
        with tarfile.open(sdist) as archive:
            names = {name.partition("/")[2] for name in archive.getnames()}

        expected = {"package.xml", "LICENSE", "CHANGELOG.rst", "tools/test.sh", "test/conftest.py"}
        assert expected | set(SHARED_FILES) <= names

    def test_wheel_holds_code_and_shared_files_only(self, wheel: Path) -> None:
        with zipfile.ZipFile(wheel) as archive:
            names = archive.namelist()

        modules = {str(path.relative_to(ROOT)) for path in (ROOT / "hybrid_ins").rglob("*.py")}
        assert modules | {"hybrid_ins/py.typed"} <= set(names)
        for name in SHARED_FILES:
            assert any(entry.endswith(f".data/data/share/hybrid_ins/{name}") for entry in names)
        assert {name.split("/")[0].split("-")[0] for name in names} == {"hybrid_ins"}

    def test_wheel_says_what_package_xml_says(self, wheel: Path) -> None:
        manifest = ElementTree.parse(ROOT / "package.xml").getroot()
        with zipfile.ZipFile(wheel) as archive:
            entry = next(name for name in archive.namelist() if name.endswith("/METADATA"))
            metadata = archive.read(entry).decode().splitlines()

        assert f"Version: {manifest.findtext('version')}" in metadata
        assert f"Summary: {manifest.findtext('description')}" in metadata

    def test_every_runtime_dependency_has_its_rosdep_key(self, wheel: Path) -> None:
        manifest = ElementTree.parse(ROOT / "package.xml").getroot()
        keys = {element.text for element in manifest.iter("exec_depend")}
        with zipfile.ZipFile(wheel) as archive:
            entry = next(name for name in archive.namelist() if name.endswith("/METADATA"))
            lines = archive.read(entry).decode().splitlines()
        runtime = {
            line.removeprefix("Requires-Dist: ").partition(">")[0]
            for line in lines
            if line.startswith("Requires-Dist: ") and "extra ==" not in line
        }

        assert runtime == set(ROSDEP_KEYS)
        assert set(ROSDEP_KEYS.values()) <= keys

    def test_every_message_package_is_a_dependency(self) -> None:
        manifest = ElementTree.parse(ROOT / "package.xml").getroot()
        keys = {element.text for element in manifest.iter("exec_depend")}
        imported = {
            package
            for path in (ROOT / "hybrid_ins").rglob("*.py")
            for package in re.findall(r"from (\w+)\.(?:msg|srv) import", path.read_text())
        }

        assert imported - keys == OPTIONAL_MESSAGES

    def test_installed_wheel_has_programs_and_finds_its_files(
        self, wheel: Path, tmp_path: Path
    ) -> None:
        # without --ignore-installed pip would take the package out of the running environment
        offline = ["--ignore-installed", "--no-deps", "--no-index"]
        run(sys.executable, "-m", "pip", "install", *offline, "--prefix", tmp_path, wheel)
        libraries = next(tmp_path.rglob("hybrid_ins/resources.py")).parents[1]
        code = "from hybrid_ins.resources import share_path; print(share_path('package.xml'))"

        found = run(
            sys.executable,
            "-c",
            code,
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(libraries)},
        )

        assert {path.name for path in (tmp_path / "bin").iterdir()} == PROGRAMS
        assert found.strip() == str(tmp_path / "share/hybrid_ins/package.xml")


def test_environment_of_the_tests_has_every_program() -> None:
    missing = [name for name in sorted(PROGRAMS) if not Path(program(name)).exists()]

    assert not missing, f"{missing} not installed: run tools/setup.sh"


def test_node_without_ros_says_what_to_install() -> None:
    hidden = "import sys; sys.modules['rclpy'] = None; import hybrid_ins.ros.node"

    result = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True)

    assert result.returncode == 1
    assert result.stderr.startswith("ins_node: error: ROS 2 is not installed")
    assert "Traceback" not in result.stderr


ALONE = """
import sys
for name in ("dask", "distributed", "matplotlib", "mcap", "rosbags", "scipy", "tqdm"):
    sys.modules[name] = None
import math
from sensor_msgs.msg import NavSatFix
import hybrid_ins.ros.node
from hybrid_ins import kernels, parameters
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import set_stamp
from hybrid_ins.ros.estimator.estimator import Estimator

kernels.prepare()
given = {"alignment.heading_source": "parameter"}
estimator = Estimator(parameters.check_all(given), lambda level, text: None)
fix = NavSatFix(latitude=32.1, longitude=34.8)
fix.status.status = 0
for k in range(1, 1500):
    noise = 0.02 * math.sin(k * k)
    estimator.handle_imu(ImuFields(k * 10_000_000, (noise, -noise, 9.8), (noise, noise, -noise)))
    estimator.run_periodic()
    if k % 20 == 0:
        set_stamp(fix.header.stamp, k * 10_000_000)
        estimator.handle_fix(fix)
assert estimator.aligned and estimator.reporter.fixes_fused > 10
print([s for s in estimator.status.diagnostics(15 * 10**9) if s.name.endswith("process noise")])
"""


def test_the_node_needs_nothing_of_the_offline_programs() -> None:
    """GIVEN their libraries hidden WHEN the estimator runs THEN it fuses, and learns the noise."""
    pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")

    assert "learned" in run(sys.executable, "-c", ALONE)
