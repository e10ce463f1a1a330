"""``ins_calibrate``: what it finds is not lost, and no input is lost either."""

from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.streams import closed_pipe, latin_1

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.calibrate import Calibration
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Finding
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.trial import Trial
from hybrid_ins.cli import calibrate as program
from hybrid_ins.cli import simulate
from hybrid_ins.core.imu_axes.faults import AxesFault
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import defaults
from hybrid_ins.parameters.parameter_file import load


def found(*misfits: str) -> Calibration:
    """Return a calibration without the work."""
    read = Recording(
        "bag", np.zeros(2), np.zeros((2, 6)), np.zeros(5), np.zeros(5, int), np.zeros((5, 3)),
        np.zeros((5, 3, 3)),
    )  # fmt: skip
    one = FilterPass(np.ones((5, 3)), np.tile(np.eye(3), (5, 1, 1)), np.ones(5), np.empty((0, 1)))
    fitted = Fit(
        ("offset",), np.array([0.1]), np.array([0.01]), (), frozenset(), (), (read,), np.zeros(1),
        np.zeros((1, 1)), np.array([0.0]), True, np.zeros((0, 1)),
    )  # fmt: skip
    values = {**defaults(), "gnss.time_offset.value": 0.1}
    notes = {"gnss.time_offset.value": "identified: clock offset ± 0.01 s"}
    findings = [Finding("clock offset", "+0.1 s", "0.01 s", "identified", "σ")]
    return Calibration(fitted, [one], [one], findings, values, notes, list(misfits))


def trial(error: float) -> Trial:
    return Trial(np.full(8, error), np.ones(8), 1.0)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    """Run the program in a folder with a bag, reading and fitting left out."""
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag_0.mcap").write_bytes(b"recording")
    monkeypatch.chdir(tmp_path)
    short = SimpleNamespace(t=np.zeros(2), begin=0.0, rows=np.arange(2))
    monkeypatch.setattr(program, "read_recording", lambda *args, **options: short)
    monkeypatch.setattr(program, "with_placement", lambda bags, values, *topics: values)
    monkeypatch.setattr(program, "axes_fault", lambda *args: None)
    monkeypatch.setattr(program, "antenna_is_base", lambda *args: False)
    monkeypatch.setattr(program, "calibrate", lambda *args, **options: found())
    monkeypatch.setattr(program, "run_trial", lambda *args, **options: trial(0.5))
    monkeypatch.setattr(program.kernels, "prepare", lambda *args, **options: None)
    return lambda *arguments: program.main(list(arguments))


def test_a_closed_pipe_does_not_lose_the_file(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with closed_pipe(monkeypatch):
        assert run("bag", "--out", "robot.yaml") == 0

    assert load("robot.yaml")["gnss.time_offset.value"] == 0.1


def test_any_terminal_shows_the_table(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with latin_1(monkeypatch) as shown:
        assert run("bag", "--out", "robot.yaml") == 0
        text = shown.getvalue().decode("latin-1")

    assert "identified: ?" in text  # for the σ
    assert "robot.yaml: for ins_node" in text
    assert "± 0.01 s" in Path("robot.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize("out", ["bag", "bag/bag_0.mcap", "other/../bag", "link", "given.yaml"])
@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_no_input_is_replaced(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str], option: str, out: str
) -> None:
    Path("other").mkdir()
    Path("link").symlink_to("bag")
    Path("given.yaml").write_text("/**:\n  ros__parameters:\n    gnss.max_delay: 1.0\n")

    assert run("bag", "--params-file", "given.yaml", option, out, "--overwrite") == 2

    error = capsys.readouterr().err
    assert ("the input" if option == "--out" else ".png") in error
    assert Path("bag/bag_0.mcap").read_bytes() == b"recording"
    assert "max_delay" in Path("given.yaml").read_text()


def test_a_failed_run_leaves_nothing_that_blocks_the_next(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **options: object) -> Calibration:
        raise InputError("not today")

    with monkeypatch.context() as m:
        m.setattr(program, "calibrate", fail)
        assert run("bag", "--out", "robot.yaml") == 2
    assert sorted(p.name for p in Path.cwd().iterdir()) == ["bag"]
    assert run("bag", "--out", "robot.yaml") == 0


def test_a_first_compilation_is_announced_before_the_work(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    order: list[str] = []

    def prepare(announce: Callable[[str], None], parts: Sequence[str]) -> None:
        assert "calibration" in parts
        announce("compiling")
        order.append("compiled")

    def calibrate(*args: object, **options: object) -> Calibration:
        order.append("calibrated")
        return found()

    monkeypatch.setattr(program.kernels, "prepare", prepare)
    monkeypatch.setattr(program, "calibrate", calibrate)

    assert run("bag") == 0
    assert order == ["compiled", "calibrated"]
    assert "ins_calibrate: info: compiling" in capsys.readouterr().err


def test_what_does_not_fit_is_written_only_by_force(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = "the innovations are too large"
    monkeypatch.setattr(program, "calibrate", lambda *args, **options: found(reason))

    assert run("bag", "--out", "robot.yaml") == 2
    error = capsys.readouterr().err
    assert f"does not fit: check units, axes and mount: {reason}" in error
    assert "robot.yaml is not written" in error
    assert not Path("robot.yaml").exists()

    assert run("bag", "--out", "robot.yaml", "--force") == 0
    assert reason in capsys.readouterr().err
    assert load("robot.yaml")["gnss.time_offset.value"] == 0.1


def test_what_makes_withheld_fixes_worse_is_written_only_by_force(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # GIVEN withheld fixes that are 0.5 m off with the given parameters, 0.8 m with those found
    offsets = {0.0: 0.5, 0.1: 0.8}
    monkeypatch.setattr(
        program,
        "run_trial",
        lambda path, values, *_, **__: trial(offsets[values["gnss.time_offset.value"]]),
    )

    assert run("bag", "--out", "robot.yaml") == 2
    shown = capsys.readouterr()
    assert "0.500 -> 0.800 m off" in shown.out
    assert "withheld fixes are 0.800 m off, with the given parameters 0.500 m" in shown.err
    assert not Path("robot.yaml").exists()
    assert run("bag", "--out", "robot.yaml", "--force") == 0
    assert Path("robot.yaml").exists()


def test_what_is_found_is_shown_where_the_comparison_is_killed(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a replay that the system kills THEN its table is there, and a line says why."""

    def killed(*_: object) -> None:
        raise BrokenProcessPool

    monkeypatch.setattr(program, "_compare", killed)

    assert run("bag", "--out", "robot.yaml") == 2

    said = capsys.readouterr()
    assert "clock offset" in said.out
    assert "a process that replayed a recording was killed" in said.err
    assert not Path("robot.yaml").exists()
    assert run("bag", "--out", "robot.yaml", "--force") == 0


def with_wheels(plain: Path, out: Path, *, reading: float) -> None:
    """Add speeds of wheels at 10 Hz to a simulated drive; they read a share of the truth."""
    rng = np.random.default_rng(2)
    covariance = np.diag([0.05**2, 1e9, 1e9, 1e9, 1e9, 1e9]).ravel()
    with BagReader(plain) as bag, BagWriter(out) as copy:
        for source in ("/imu/data", "/gnss/fix"):
            for _, log_ns, message in bag.messages(source):
                copy.write(source, message, log_ns)
        for _, log_ns, truth in bag.messages("/truth/odometry"):
            wheels = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
            wheels.header.stamp, wheels.header.frame_id = truth.header.stamp, "base_link"
            speed = reading * truth.twist.twist.linear.x + 0.05 * rng.standard_normal()
            wheels.twist.twist.linear.x = speed
            wheels.twist.covariance = covariance
            copy.write("/aiding/velocity", wheels, log_ns)


@pytest.mark.slow
def test_a_car_with_wheels_is_calibrated_from_its_bag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """
    GIVEN two minutes of a car whose IMU is turned by 5 degrees and whose wheels read 1 % too little
    WHEN the program reads the bag, told that the car moves along its nose
    THEN mount, kind, nose, axle, slip and scale are found, printed and written.
    """
    plain, bag, out = tmp_path / "plain.mcap", tmp_path / "car.mcap", tmp_path / "car.yaml"
    car = ["--trajectory", "car", "--duration", "120", "--imu-rate", "50", "--gnss-rate", "2"]
    assert (
        simulate.main([str(plain), *car, "--truth-rate", "10", "--mount-rpy", "0", "0", "5"]) == 0
    )
    with_wheels(plain, bag, reading=1.0 / 1.01)

    status = program.main([str(bag), "--nose-first", "--search", "0.2", "--out", str(out)])

    assert status == 0
    printed = capsys.readouterr().out
    rows = {line[:28].split("  ")[0]: line for line in printed.splitlines()}
    for label in ("IMU mount", "nose", "axle forward", "slip left, up", "wheel scale"):
        assert "identified" in rows[label], rows[label]
    values = load(out)
    assert values["vehicle.kind"] == "ground"
    assert values["imu.mount_rpy"][2] == pytest.approx(np.radians(5.0), abs=0.006)
    np.testing.assert_allclose(values["vehicle.nose"], 0.0, atol=0.009)
    assert values["aiding.velocity_scale"] == pytest.approx(1.01, abs=0.004)


def test_a_wrong_unit_that_the_motion_shows_ends_it_before_the_work(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fault = AxesFault(((np.eye(3), np.eye(3) * np.pi / 180.0),), np.eye(3))
    monkeypatch.setattr(program, "axes_fault", lambda *args: fault)
    monkeypatch.setattr(
        program,
        "read_recording",
        lambda *args, **options: SimpleNamespace(name="bag", t=np.zeros(2), begin=0.0),
    )

    assert run("bag", "--out", "robot.yaml") == 2
    shown = capsys.readouterr()
    assert "bag: /imu/data: angular_velocity fits the motion only if it is divided" in shown.err
    assert not shown.out


@pytest.mark.parametrize(
    ("content", "may"),
    [
        ("#!/bin/sh\necho important\n", False),
        ("key: value\n", False),
        ("- 1\n", False),
        ("", True),
        ("/**:\n  ros__parameters:\n    gnss.max_delay: 1.0\n", True),
        ("other_node:\n  ros__parameters:\n    rate: 1\n", True),
    ],
)
def test_only_a_parameter_file_is_replaced(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str], content: str, may: bool
) -> None:
    out = Path("t.sh")
    out.write_text(content)

    assert run("bag", "--out", "t.sh") == 2  # it exists
    capsys.readouterr()
    assert run("bag", "--out", "t.sh", "--overwrite") == (0 if may else 2)

    error = capsys.readouterr().err
    assert ("t.sh: is not a parameter file" in error) is not may
    assert (out.read_text() == content) is not may


@pytest.mark.slow
def test_the_truth_shows_the_imu_s_place_and_leaves_the_antenna_s(tmp_path: Path) -> None:
    """GIVEN a flight with an antenna that is placed rightly WHEN calibrated on its truth."""
    bag, given, out = (tmp_path / name for name in ("flight.mcap", "given.yaml", "out.yaml"))
    flight = [str(bag), "--duration", "60", "--imu-rate", "50", "--lever-arm", "0.5", "0", "0.3"]
    assert simulate.main(flight) == 0
    given.write_text("ins_node:\n  ros__parameters:\n    gnss.antenna_position: [0.5, 0.0, 0.3]\n")

    words = ["--use-truth", "--params-file", str(given), "--search", "0.2", "--out", str(out)]
    assert program.main([str(bag), *words]) == 0

    values = load(out)
    assert values["gnss.antenna_position"] == [0.5, 0.0, 0.3]
    np.testing.assert_allclose(values["imu.position"], 0.0, atol=0.1)
