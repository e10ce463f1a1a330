"""Parameters: values, names and files from users are checked, and refused in one line."""

import os
from pathlib import Path

import pytest
import yaml

from hybrid_ins import parameters, yaml_reader
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import parameter_file
from hybrid_ins.parameters.declared import PARAMETERS
from hybrid_ins.resources import read_regular_file
from hybrid_ins.ros.node_arguments import for_ros

DEFAULTS = parameters.defaults()


def refused(**given: object) -> str:
    """Return the one line with which values are refused; double underscores stand for dots."""
    with pytest.raises(InputError) as caught:
        parameters.check_all({name.replace("__", "."): value for name, value in given.items()})
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 600
    return text


def read_by_node(path: Path) -> None:
    """Read a parameter file as the node does, before ROS reads it."""
    with for_ros(["--params-file", str(path)]):
        pass


class TestValues:
    @pytest.mark.parametrize("name", PARAMETERS)
    def test_defaults_are_valid(self, name: str) -> None:
        assert PARAMETERS[name].check(DEFAULTS[name]) == DEFAULTS[name]

    @pytest.mark.parametrize("value", ["1e-6", "1.0e-06", ".000001", 1e-6])
    def test_numbers_that_ros2_sends_as_texts(self, value: object) -> None:
        assert PARAMETERS["noise.q_accelerometer"].check(value) == 1e-6

    @pytest.mark.parametrize("value", ["[0.1, 0, 0]", [0.1, 0, 0], (0.1, 0, 0), ["1e-1", 0, 0]])
    def test_lists_that_ros2_sends_as_texts(self, value: object) -> None:
        assert PARAMETERS["imu.position"].check(value) == [0.1, 0.0, 0.0]

    def test_a_number_for_all_axes(self) -> None:
        assert PARAMETERS["imu.gyroscope_bias_std"].check(1) == [1.0]

    def test_a_text_stays_one(self) -> None:
        assert PARAMETERS["map_frame"].check("1e-6") == "1e-6"

    def test_nothing_is_an_empty_text(self) -> None:
        assert PARAMETERS["vehicle.slip_model"].check(None) == ""

    @pytest.mark.parametrize(
        "value", [5e-324, 1e-300, 0.0099, -1.0, 1e5, float("nan"), float("inf"), "nan", True, None]
    )
    def test_a_rate_is_zero_or_sensible(self, value: object) -> None:
        assert "parameter odometry_rate: " in refused(odometry_rate=value)
        assert PARAMETERS["odometry_rate"].check(0) == 0.0
        assert PARAMETERS["odometry_rate"].check(50) == 50.0

    @pytest.mark.parametrize(
        ("name", "value", "wanted"),
        [
            ("publish_tf", 1, "true or false"),
            ("imu.position", [1.0], "a list of 3 numbers"),
            ("imu.position", [1.0, 2.0, "x"], "a list of 3 numbers"),
            ("imu.position", [1.0, 2.0, 1e9], "in the range -1000 … 1000 m"),
            ("imu.position", "[1, 2", "a list of 3 numbers"),
            ("noise.innovation_window", 2.5, "a whole number"),
            ("noise.mode", "guess", "one of learned, constant, cq1"),
            ("map_frame", 3, "a text"),
            ("map_frame", "m" * 5_000_000, "a text of at most 255 characters"),
            ("noise.model", "x\0y", "a text of at most"),
            ("gnss.patience", -1.0, "in the range 0 … 3600 s"),
            ("gnss.gate_probability", 1.0, "1.0 is not in the range 0.5 … 0.999999999999"),
        ],
    )
    def test_what_is_wanted_is_said(self, name: str, value: object, wanted: str) -> None:
        assert wanted in refused(**{name: value})

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            ({"base_frame": "map"}, "'map' is also map_frame"),
            ({"odom_frame": "base_link"}, "'base_link' is also odom_frame"),
            ({"map_frame": "/map"}, "without a leading slash"),
            ({"map_frame": ""}, "is not a frame"),
            ({"map_frame": "my map"}, "is not a frame"),
            ({"gnss__position_std_min": 50.0, "gnss__position_std_max": 1.0}, "greater than"),
            ({"noise__q_gyroscope_min": 10.0, "noise__q_gyroscope_max": 1.0}, "greater than"),
            ({"datum": [91.0, 0.0, 0.0]}, "latitude"),
            ({"gnss__antenna_position": [0.0, 0.0, 1000.0]}, "-200 … 200 m"),
        ],
    )
    def test_values_that_contradict_each_other(self, given: dict[str, object], said: str) -> None:
        assert said in refused(**given)

    @pytest.mark.parametrize(
        "given",
        [
            {"gnss__patiense": 1.0, "noise__mode": "guess", "imu__position": [1.0]},
            {"map_frame": "my map", "gnss__position_std_min": 60.0, "gnss__position_std_max": 1.0},
        ],
    )
    def test_all_faults_are_told_at_once(self, given: dict[str, object]) -> None:
        told = refused(**given)

        faults = [name.replace("__", ".") for name in given if not name.endswith("_max")]
        assert all(f"parameter {name}: " in told for name in faults)

    def test_of_many_faults_some_are_told_and_the_others_counted(self) -> None:
        given = {f"name_{k}": 1 for k in range(9)}

        assert refused(**given).endswith("; and 5 more")


class TestNames:
    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("gnss.patiense", "did you mean gnss.patience?"),
            ("max_gap", "did you mean imu.max_gap?"),
            ("gnss.time_offset", "did you mean gnss.time_offset.value, gnss.time_offset.std,"),
            ("imu_topic", "remap the topic imu/data"),
            ("fix_topic", "remap the topic gnss/fix"),
            ("frequency", "odometry_rate"),
            ("wheel_radius", "ros2 param list"),
            ("x" * 1_000_000, "ros2 param list"),
        ],
    )
    def test_suggestions(self, name: str, said: str) -> None:
        assert said in refused(**{name: 1})

    def test_ros_own_parameters_are_none_of_ours(self) -> None:
        given = {"use_sim_time": True, "qos_overrides./imu/data.subscription.depth": 5}

        assert parameters.check_all(given) == DEFAULTS

    def test_a_start_only_parameter_may_be_set_to_what_it_is(self) -> None:
        assert parameters.check_change(DEFAULTS, {"imu.max_gap": "2.0"}) == {"imu.max_gap": 2.0}
        with pytest.raises(InputError, match="takes effect only at the start"):
            parameters.check_change(DEFAULTS, {"imu.max_gap": 1.0})


class TestFiles:
    def read(self, path: Path, text: str) -> parameters.Values:
        path = path / "robot.yaml"
        path.write_text(text, encoding="utf-8")
        return parameter_file.load(path)

    def test_written_file_reads_back_in_every_reader(self, tmp_path: Path) -> None:
        values = {**DEFAULTS, "map_frame": "yes", "noise.model": 'a "b"/ü.onnx', "datum": [1, 2, 3]}

        text = parameter_file.to_yaml(values, "A robot", {"map_frame": "A note."})

        assert self.read(tmp_path, text) == values
        strict = parameter_file._flatten(
            yaml.safe_load(text)["/**"]["ros__parameters"], tmp_path
        )  # as `ros2 param load` reads it
        assert strict == values

    def test_no_group_is_written_twice(self) -> None:
        keys = [
            line
            for line in parameter_file.to_yaml(DEFAULTS, "").splitlines()
            if line.endswith(":") and line.startswith("    ") and line[4] != " "
        ]

        assert len(keys) == len(set(keys))

    def test_what_ros2_param_dump_writes(self, tmp_path: Path) -> None:
        dump = yaml.dump({"/robot/ins_node": {"ros__parameters": {**DEFAULTS, "use_sim_time": 1}}})

        assert self.read(tmp_path, dump) == DEFAULTS

    def test_what_ros2_param_load_sends(self) -> None:
        # It sends the texts of what it has read; 1e-08 stays a text there.
        sent = {name: str(value) for name, value in DEFAULTS.items()}

        assert parameters.check_change(DEFAULTS, sent) == DEFAULTS

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("[1, 2]", "not a parameter file"),
            ("other_node:\n  ros__parameters: {}\n", "no section for ins_node"),
            ("/**:\n  map_frame: map\n", "holds no 'ros__parameters:'"),
            ("/**:\n  ros__parameters:\n", "no 'ros__parameters:' with parameters below it"),
            ("/**:\n  ros__parameters:\n    1: 2\n", "a parameter's name must be a text"),
            ("/**: [", "no readable YAML: line 1"),
            ("a: 1\nb: *a\n", "no readable YAML"),
            ("[" * 5000, "no readable YAML: nested too deeply"),
            ("/**:\n  ros__parameters: {imu.position: [1e-08, 2, x]}\n", "mixes numbers and texts"),
            ("a: 1\n" * 40_000, "larger than a parameter file may be, 0.1 MB"),
            ("\ud800", "no readable YAML"),
        ],
    )
    def test_what_cannot_be_used_is_named(self, tmp_path: Path, text: str, said: str) -> None:
        path = tmp_path / "robot.yaml"
        path.write_text(text, encoding="utf-8", errors="surrogatepass")

        with pytest.raises(InputError, match=r"(?s)^[^\n]*$") as caught:
            parameter_file.load(path)
        assert said in str(caught.value)

    @pytest.mark.parametrize(
        ("lines", "said"),
        [
            (
                ["gnss: {patience: 1.0}", "gnss: {max_delay: 2.0}"],
                "gnss is given twice, line 4: keep one",
            ),
            (
                ["gnss.patience: 1.0", "gnss: {patience: 2.0}"],
                "gnss.patience is given twice, line 4: keep one",
            ),
            (
                ["gnss:", "  patience: 2.0", "gnss.patience: 1.0"],
                "gnss.patience is given twice, line 5: keep one",
            ),
            (
                ['gnss: {antenna_position: [0, 0, "1"]}'],
                "gnss.antenna_position: [0, 0, '1'] mixes numbers and texts, which ROS refuses: "
                "write numbers only, without quotes",
            ),
            (
                ["imu.position: [0, 0, true]"],
                "imu.position: [0, 0, True] mixes numbers and true or false",
            ),
        ],
    )
    def test_what_would_be_lost_or_is_refused_by_ros_is_named(
        self, tmp_path: Path, lines: list[str], said: str
    ) -> None:
        path = tmp_path / "robot.yaml"
        path.write_text("\n    ".join(["/**:\n  ros__parameters:", *lines]))
        for read in (parameter_file.load, read_by_node):
            with pytest.raises(InputError) as caught:
                read(path)
            assert str(caught.value).startswith(f"{path}: {said}")

    def test_a_section_of_the_node_adds_to_that_of_all(self, tmp_path: Path) -> None:
        path = tmp_path / "robot.yaml"
        path.write_text(
            "/**:\n  ros__parameters: {gnss: {patience: 1.0, max_delay: 1.0}}\n"
            "ins_node:\n  ros__parameters: {gnss: {max_delay: 2.0}}\n"
        )
        values = parameter_file.load(path)
        assert (values["gnss.patience"], values["gnss.max_delay"]) == (1.0, 2.0)

    def test_an_empty_section_is_the_defaults(self, tmp_path: Path) -> None:
        assert self.read(tmp_path, "/**:\n  ros__parameters: {}\n") == DEFAULTS

    @pytest.mark.parametrize(
        "text", ["-.4", "+.25", ".5e1", "1e-8", "1e-08", "1E+3", "-2.e-3", "1.5e3"]
    )
    def test_numbers_with_exponents(self, text: str) -> None:
        assert yaml_reader.parse(text) == float(text)


class TestRegularFiles:
    @pytest.mark.timeout(20)
    def test_pipes_and_devices_are_refused_unread(self, tmp_path: Path) -> None:
        pipe = tmp_path / "pipe.yaml"
        os.mkfifo(pipe)

        for path in (pipe, Path("/dev/zero"), tmp_path):
            with pytest.raises(InputError, match="not a regular file: give a model"):
                read_regular_file(path, 100, "a model")

    @pytest.mark.parametrize("name", ["none.yaml", "x" * 300, "a\0b", "none/" * 3000])
    def test_names_of_no_file(self, name: str) -> None:
        with pytest.raises(InputError, match=r"give a model") as caught:
            read_regular_file(Path(name), 100, "a model")
        assert len(str(caught.value)) < 300

    def test_the_limit_holds(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.write_bytes(b"x" * 101)

        assert read_regular_file(path, 101, "a model") == b"x" * 101
        with pytest.raises(InputError, match="larger than a model may be"):
            read_regular_file(path, 100, "a model")
