"""The node's command line, before ROS reads it."""

from pathlib import Path

import pytest
import yaml

from hybrid_ins.errors import InputError
from hybrid_ins.ros.node_arguments import for_ros, reason_of, unused_files


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ([], []),
        (["--ros-args", "-r", "a:=b"], ["--ros-args", "-r", "a:=b"]),
        (["-p", "odometry_rate:=5.0"], ["--ros-args", "-p", "odometry_rate:=5.0"]),
        (["-r", "a:=b", "--ros-args", "-r", "c:=d"],
         ["--ros-args", "-r", "a:=b", "--ros-args", "-r", "c:=d"]),
        (["-p", "imu.position:=[0.1, 0, 1]"],
         ["--ros-args", "-p", "imu.position:=[0.1, 0.0, 1.0]"]),
        (["-p", "imu.position:=[1, 0, 0]"], ["--ros-args", "-p", "imu.position:=[1, 0, 0]"]),
        (["-p", "map_frame:=[0.1, 0"], ["--ros-args", "-p", "map_frame:=[0.1, 0"]),
    ],
)  # fmt: skip
def test_all_arguments_are_those_of_ros(words: list[str], given: list[str]) -> None:
    with for_ros(words) as arguments:
        assert arguments == given


def test_a_file_is_copied_only_where_lists_mix_types(tmp_path: Path) -> None:
    plain, mixed = tmp_path / "plain.yaml", tmp_path / "mixed.yaml"
    plain.write_text("/**:\n  ros__parameters:\n    imu: {position: [1.0, 0.0, 0.0]}\n")
    mixed.write_text("/**:\n  ros__parameters:\n    imu: {position: [0.1, 0, 0]}\n    n: [1, 2]\n")

    with for_ros(["--params-file", str(plain), "--params-file", str(mixed)]) as arguments:
        _, _, first, _, second = arguments
        read = yaml.safe_load(Path(second).read_text())

    assert first == str(plain)
    values = read["/**"]["ros__parameters"]
    assert repr(values["imu"]["position"]) == "[0.1, 0.0, 0.0]"
    assert repr(values["n"]) == "[1, 2]"
    assert not Path(second).exists()


@pytest.mark.parametrize(
    ("content", "words"), [(None, "No such file"), ("a: [1, 2", "no readable YAML")]
)
def test_a_file_that_cannot_be_read_is_named(
    tmp_path: Path, content: str | None, words: str
) -> None:
    path = tmp_path / "robot.yaml"
    if content is not None:
        path.write_text(content)

    with pytest.raises(InputError, match=words), for_ros(["--params-file", str(path)]):
        pass


def test_a_quoted_number_in_a_list_is_named() -> None:
    with (
        pytest.raises(InputError, match=r"^-p: imu.position: .* mixes numbers and texts"),
        for_ros(["-p", 'imu.position:=[0, 0, "1"]']),
    ):
        pass


def test_an_option_without_value_is_named() -> None:
    with (
        pytest.raises(InputError, match="--params-file: nothing follows"),
        for_ros(["--params-file"]),
    ):
        pass


@pytest.mark.parametrize(
    ("said", "line"),
    [
        (
            "Couldn't parse remap rule: '-r /a//b:=c'. Error: Expecting token or wildcard, "
            "at /project/src/rcl/arguments.c:1222, at /project/src/rcl/arguments.c:380",
            "Couldn't parse remap rule: '-r /a//b:=c'",
        ),
        (
            "Couldn't parse params file: '--params-file a.yaml'. Error: No value at line 3, "
            "at /project/src/parse.c:258, at /project/src/rcl/arguments.c:415",
            "Couldn't parse params file: '--params-file a.yaml': No value at line 3",
        ),
        (
            "error creating node: This Fast DDS version doesn't have the security libraries\n"
            "Please compile Fast DDS, at /src/participant.cpp:364, at /src/rcl/node.c:252",
            "error creating node: This Fast DDS version doesn't have the security libraries "
            "Please compile Fast DDS",
        ),
        (
            "Failed to get logging directory, at /project/src/rcl_logging_spdlog.cpp:138",
            "Failed to get logging directory: set HOME, or ROS_LOG_DIR to a folder that can be "
            "written",
        ),
        (
            "failed to initialize logging: Failed to create log directory '/nobody/.ros/log': 2, "
            "at /project/src/rcl_logging_spdlog.cpp:150",
            "failed to initialize logging: Failed to create log directory '/nobody/.ros/log': 2: "
            "set HOME, or ROS_LOG_DIR to a folder that can be written",
        ),
    ],
)
def test_what_ros_says_is_one_line_without_its_source(said: str, line: str) -> None:
    assert reason_of(RuntimeError(said)) == line


SECTION = "ros__parameters: {gnss.patience: 3.0}"


@pytest.mark.parametrize(
    ("name", "used", "unused"),
    [
        ("/**", ["/ins_node", "/a/b/ins_node"], []),
        ("ins_node", ["/ins_node"], ["/a/ins_node", "/ekf"]),
        ("/a/ins_node", ["/a/ins_node"], ["/ins_node", "/b/ins_node"]),
        ("/*/ins_node", ["/a/ins_node"], ["/ins_node", "/a/b/ins_node"]),
        ("/**/ins_node", ["/ins_node", "/a/b/ins_node"], ["/a/ekf"]),
    ],
)
def test_a_file_without_a_section_for_the_node_is_named(
    tmp_path: Path, name: str, used: list[str], unused: list[str]
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(f"{name}:\n  {SECTION}\nother:\n  {SECTION}\n")
    words = ["--ros-args", "--params-file", str(path), "-r", "a:=b"]

    assert not [line for node in used for line in unused_files(words, node)]
    for node in unused:
        (line,) = unused_files(words, node)
        assert line.startswith(f"{path}: no section for {node}, only for ")
        assert line.endswith(f"write '/**:' or '{node}:'")


def test_nested_namespaces_of_a_file_are_one_name(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(f"a:\n  b:\n    ins_node:\n      {SECTION}\n")
    words = ["--params-file", str(path)]

    assert not list(unused_files(words, "/a/b/ins_node"))
    assert "only for /a/b/ins_node" in next(unused_files(words, "/ins_node"))


def test_an_empty_file_addresses_nobody(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("")

    assert not list(unused_files(["--params-file", str(path)], "/ins_node"))
