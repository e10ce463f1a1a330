"""What the programs answer to wrong arguments: status 2 and one line that says what is wrong."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from support.paths import ROOT

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from tools.processes import program

MODULES = {
    "ins_calibrate": "hybrid_ins.cli.calibrate",
    "ins_convert": "hybrid_ins.cli.convert",
    "ins_evaluate": "hybrid_ins.cli.evaluate",
    "ins_play": "hybrid_ins.cli.play",
    "ins_replay": "hybrid_ins.cli.replay",
    "ins_simulate": "hybrid_ins.cli.simulate",
    "ins_status": "hybrid_ins.cli.status",
}
ENVIRONMENT = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
IGNORED = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # as a shell may have left it
Main = Callable[[list[str]], int]


def load(name: str) -> Main:
    main: Main = EntryPoint(name, f"{MODULES[name]}:main", "console_scripts").load()
    return main


def status_of(name: str, arguments: list[str]) -> int:
    """Run a program in this process; argparse leaves by SystemExit, as in a shell."""
    try:
        return load(name)(arguments)
    except SystemExit as leave:
        return int(leave.code or 0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of inputs: ``bag`` and ``estimate`` are sound, the others are not."""
    folder = tmp_path_factory.mktemp("files")
    quick = ["--duration", "3", "--imu-rate", "100", "--trajectory", "static"]
    assert status_of("ins_simulate", [str(folder / "bag"), *quick]) == 0
    with BagWriter(folder / "estimate") as estimate:
        for second in range(1, 10):
            message = new_message("nav_msgs/msg/Odometry")
            message.header.stamp.sec = second
            message.pose.pose.orientation.w = 1.0
            estimate.write("/odometry", message, second * 10**9)
    (folder / "empty").mkdir()
    (folder / "text.mcap").write_text("this is no bag\n" * 100)
    (folder / "nothing.mcap").touch()
    (folder / "unknown.yaml").write_text("/**:\n  ros__parameters:\n    gnss.max_dealy: 1.0\n")
    (folder / "range.yaml").write_text("/**:\n  ros__parameters:\n    gnss.max_delay: -1.0\n")
    (folder / "type.yaml").write_text("/**:\n  ros__parameters:\n    gnss.max_delay: soon\n")
    (folder / "broken.yaml").write_text("/**: [ros__parameters: {\n")
    return folder


WRONG = [
    ("ins_simulate", "OUT --duration -1", "--duration"),
    ("ins_simulate", "OUT --imu-rate many", "--imu-rate"),
    ("ins_simulate", "OUT --trajectory train", "--trajectory"),
    ("ins_simulate", "OUT --outage 10", "--outage"),
    ("ins_simulate", "OUT --time-offset 1e12", "1e12 is too large"),
    ("ins_simulate", "OUT --time-offset -1.7e9", "stamps begin in 1970 and end in 2038"),
    ("ins_simulate", "OUT --time-offset 1.7e9", "stamps begin in 1970 and end in 2038"),
    ("ins_simulate", "OUT --gyroscope-bias -1e-3 -.2E+1 -5. --imu-rate 1e6", "6e+07 samples"),
    ("ins_simulate", "/ --overwrite", "/: holds other files"),
    ("ins_simulate", "bag", "bag"),
    ("ins_simulate", "text.mcap/OUT", "text.mcap"),
    ("ins_convert", "missing OUT", "missing"),
    ("ins_convert", "empty OUT", "empty"),
    ("ins_convert", "text.mcap OUT", "text.mcap"),
    ("ins_convert", "empty OUT --gnss-rate 0", "--gnss-rate"),
    ("ins_convert", "empty OUT --imu one", "--imu"),
    ("ins_replay", "missing OUT", "missing"),
    ("ins_replay", "empty OUT", "empty"),
    ("ins_replay", "text.mcap OUT", "text.mcap"),
    ("ins_replay", "nothing.mcap OUT", "nothing.mcap"),
    ("ins_replay", "bag OUT --imu-topic /some/imu", "/some/imu"),
    ("ins_replay", "bag OUT --fix-topic /imu/data", "/imu/data"),
    ("ins_replay", "bag OUT --params-file missing.yaml", "missing.yaml"),
    ("ins_replay", "bag OUT --params-file broken.yaml", "broken.yaml"),
    ("ins_replay", "bag OUT --params-file unknown.yaml", "did you mean gnss.max_delay"),
    ("ins_replay", "bag OUT --params-file range.yaml", "gnss.max_delay"),
    ("ins_replay", "bag OUT --params-file type.yaml", "gnss.max_delay"),
    ("ins_replay", "bag bag", "bag"),
    ("ins_play", "missing", "missing"),
    ("ins_play", "text.mcap", "text.mcap"),
    ("ins_play", "bag --rate 0", "--rate"),
    ("ins_play", "bag --topics /some/topic", "/some/topic"),
    ("ins_play", "bag --start 1000", "--start"),
    ("ins_evaluate", "missing", "missing"),
    ("ins_evaluate", "text.mcap", "text.mcap"),
    ("ins_evaluate", "bag", "odometry"),
    ("ins_evaluate", "estimate --truth missing", "missing"),
    ("ins_evaluate", "bag --skip -1", "--skip"),
    ("ins_evaluate", "estimate --no-truth --end 1e300", "1e300 is too large"),
    ("ins_evaluate", "estimate --no-truth --time-offset 1e10", "1e10 is too large"),
    ("ins_evaluate", "estimate --no-truth --start 5 --end 3", "it lasts 8.0 s"),
    ("ins_evaluate", "estimate --no-truth --results OUT", "--results is for several bags"),
    ("ins_evaluate", "estimate --no-truth --skip 20", "it lasts 8.0 s"),
    ("ins_evaluate", "bag --plot picture.doc", "picture.doc"),
    ("ins_calibrate", "missing --out OUT", "missing"),
    ("ins_calibrate", "bag ./bag --out OUT", "bag: is given twice: give each recording once"),
    ("ins_calibrate", "bag EMPTY --out OUT", "'' is no name of a file or folder"),
    ("ins_replay", "EMPTY OUT", "'' is no name of a file or folder"),
    ("ins_evaluate", "EMPTY", "'' is no name of a file or folder"),
    ("ins_calibrate", "text.mcap --out OUT", "text.mcap"),
]


@pytest.mark.parametrize(
    ("name", "arguments", "words"), WRONG, ids=[f"{name} {line}" for name, line, _ in WRONG]
)
def test_wrong_arguments_get_one_clear_line(
    name: str,
    arguments: str,
    words: str,
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(files)
    out = tmp_path / "out"

    words_given = arguments.replace("OUT", str(out)).split()
    status = status_of(name, ["" if word == "EMPTY" else word for word in words_given])

    printed = capsys.readouterr()
    [last] = printed.err.strip().splitlines()
    assert status == 2
    assert last.startswith(f"{name}: error: ")
    assert words in last
    assert not out.exists(), "left something behind"


@pytest.mark.parametrize("name", sorted(MODULES))
def test_no_or_unknown_options_are_one_line_with_a_hint_at_the_help(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = [] if name == "ins_status" else [[]]
    for arguments in (*needed, ["--no-such-option"]):
        assert status_of(name, arguments) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith(f"{name}: error: ")
        assert line.endswith(f": see {name} --help")


@pytest.mark.parametrize("name", sorted(MODULES))
def test_help_teaches_by_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(name, ["--help"]) == 0

    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: {name}")
    assert f"example:\n  {name} " in printed


FLIGHT = ["--duration", "8", "--imu-rate", "100", "--seed", "1"]
HEADING = ["-p", "alignment.heading_source:=parameter"]


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    assert status_of("ins_simulate", [str(tmp_path / "flight"), *FLIGHT]) == 0
    return tmp_path / "flight"


@pytest.mark.parametrize("out", ["flight", "flight/flight_0.mcap", "link", "sub/../flight/", "."])
@pytest.mark.parametrize("program_name", ["ins_replay", "ins_play"])
def test_no_program_writes_where_it_reads(
    program_name: str,
    out: str,
    flight: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if program_name == "ins_play":
        pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")
    (flight.parent / "link").symlink_to(flight)
    (flight.parent / "sub").mkdir()
    monkeypatch.chdir(flight.parent)
    before = {p: p.read_bytes() for p in flight.iterdir()}
    option = ["--record"] if program_name == "ins_play" else []

    assert status_of(program_name, ["flight", *option, out, "--overwrite"]) == 2

    assert "the input" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in flight.iterdir()} == before


def test_a_folder_of_bags_is_not_replayed_into_itself(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = flight.parent / "flights"
    folder.mkdir()
    assert status_of("ins_simulate", [str(folder / "one.mcap"), *FLIGHT]) == 0
    before = (folder / "one.mcap").read_bytes()

    assert status_of("ins_replay", [str(folder), str(folder), "--overwrite", *HEADING]) == 2

    assert "the input" in capsys.readouterr().out
    assert (folder / "one.mcap").read_bytes() == before


@pytest.mark.parametrize("name", ["GT.csv", "map.yaml"])
def test_a_conversion_or_simulation_replaces_bags_only(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("a,b\n1,2\n")

    assert status_of("ins_simulate", [str(tmp_path / name), *FLIGHT, "--overwrite"]) == 2
    assert f"{name}: is not a bag: not overwritten" in capsys.readouterr().err
    assert status_of("ins_simulate", [str(tmp_path), *FLIGHT, "--overwrite"]) == 2
    assert "holds other files than those of one bag" in capsys.readouterr().err

    assert (tmp_path / name).read_text() == "a,b\n1,2\n"


def test_a_replay_of_a_vehicle_that_stands_has_its_position(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = str(tmp_path / "bag"), str(tmp_path / "out")
    motion = ["--trajectory", "static", "--duration", "8", "--imu-rate", "100"]
    assert status_of("ins_simulate", [bag, *motion]) == 0

    assert status_of("ins_replay", [bag, out]) == 0

    assert "the heading was never known: it needs motion that shows" in capsys.readouterr().err
    with BagReader(Path(out)) as reader:
        assert reader.count("/odometry") > 60
        assert reader.count("/odometry/local") == 0
    assert status_of("ins_replay", [bag, f"{out}2", "--smooth"]) == 2
    assert "never started" in capsys.readouterr().err


@pytest.mark.slow
def test_a_replay_that_never_starts_leaves_nothing_in_the_way(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(flight.with_name("out"))

    no_fix = ["-p", "gnss.position_std_max:=0.02", "-p", "gnss.position_std_min:=0.01"]
    assert status_of("ins_replay", [str(flight), out, *no_fix]) == 2
    assert "never started: it waited for a GNSS fix" in capsys.readouterr().err
    assert not list(flight.parent.glob("out*"))

    assert status_of("ins_replay", [str(flight), out, *HEADING]) == 0


BODY = """
import sys
from pathlib import Path
from hybrid_ins.cli import program

def body(args):
    for k in range(10_000):
        print("σ", k)
        print("σ", k, file=sys.stderr)
    Path(sys.argv[1]).write_text("result")

sys.exit(program.run(body, program.parser("ins_test", "").parse_args([])))
"""


NESTED = """
import logging, sys
from hybrid_ins.cli import program

def said(text):
    logging.getLogger("hybrid_ins").info(text)

def inner(args):
    said("inside")

def outer(args):
    said("before")
    program.run(inner, program.parser("inner", "").parse_args([]))
    said("after")

sys.exit(program.run(outer, program.parser("outer", "").parse_args([])))
"""


def test_a_program_within_a_program_speaks_in_its_own_name_alone() -> None:
    done = subprocess.run([sys.executable, "-c", NESTED], capture_output=True, text=True)

    expected = ["outer: info: before", "inner: info: inside", "outer: info: after"]
    assert done.stderr.splitlines() == expected


INTERRUPTED = """
import os, signal, sys, time
from hybrid_ins.cli import program

CALLED = '''
def called():
    try:
        os.kill(os.getpid(), number)
    except BaseException:
        raise SystemError("returned a result with an exception set")
'''

def body(args):
    number = signal.Signals[sys.argv[1]]
    inside = {"__name__": "numba.core.serialize", "os": os, "number": number}
    exec(CALLED, inside)
    inside["called"]()
    time.sleep(30.0)

sys.exit(program.run(body, program.parser("ins_test", "").parse_args([])))
"""


ENDING = """
import os, signal, sys, time, weakref
from hybrid_ins.cli import program

class Thing:
    pass

def body(args):
    thing = Thing()
    number = signal.Signals[sys.argv[1]]
    last = weakref.ref(thing, lambda reference: os.kill(os.getpid(), number))
    del thing
    time.sleep(30.0)

sys.exit(program.run(body, program.parser("ins_test", "").parse_args([])))
"""


@pytest.mark.parametrize("script", [INTERRUPTED, ENDING], ids=["compiled code", "end of an object"])
@pytest.mark.parametrize(
    ("name", "status", "said"),
    [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated"), ("SIGHUP", 129, "terminated")],
)
def test_a_signal_that_would_be_lost_comes_again(
    name: str, status: int, said: str, script: str
) -> None:
    """GIVEN a signal where nothing can be raised THEN it ends the program right after that."""
    done = subprocess.run(
        [sys.executable, "-c", script, name],
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=partial(signal.signal, signal.SIGHUP, signal.SIG_DFL),  # not as behind nohup
        check=False,
    )

    assert done.stderr == f"ins_test: {said}\n"
    assert done.returncode == status


HUNG_UP = """
import os, signal, sys
from hybrid_ins.cli import program

def body(args):
    sys.stdin.read()  # until the terminal is closed
    os.kill(os.getpid(), signal.SIGHUP)
    print("the rest", file=sys.stderr)
    print("the rest")

sys.exit(program.run(body, program.parser("ins_test", "").parse_args([])))
"""


@pytest.mark.parametrize(("handler", "status"), [("SIG_IGN", 0), ("SIG_DFL", 129)])
def test_a_terminal_that_closes_ends_a_program_unless_nohup_keeps_it(
    handler: str, status: int
) -> None:
    keyboard, screen = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", HUNG_UP],
        env=os.environ | ENVIRONMENT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=screen,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGHUP, getattr(signal, handler)),
    )
    os.close(screen)
    os.close(keyboard)

    printed, _ = process.communicate(timeout=60)

    assert process.returncode == status
    assert printed == ("the rest\n" if status == 0 else "")


@pytest.mark.parametrize("closed", ["stdout", "stderr", "both", "none"])
@pytest.mark.parametrize("encoding", ["latin-1", "ascii", "utf-8"])
def test_neither_a_closed_pipe_nor_an_encoding_loses_a_result(
    closed: str, encoding: str, tmp_path: Path
) -> None:
    """GIVEN `| head`, or a terminal without σ WHEN a program prints THEN it writes all the same."""
    reading, writing = os.pipe()
    os.close(reading)
    streams = {
        name: writing if closed in (name, "both") else subprocess.DEVNULL
        for name in ("stdout", "stderr")
    }

    done = subprocess.run(
        [sys.executable, "-c", BODY, str(tmp_path / "result")],
        env=os.environ | ENVIRONMENT | {"PYTHONIOENCODING": encoding},
        timeout=60,
        **streams,  # type: ignore[call-overload]
    )

    os.close(writing)
    assert done.returncode == 0
    assert (tmp_path / "result").read_text() == "result"


@pytest.mark.parametrize("closed", [(1,), (2,), (1, 2)])
def test_a_program_needs_no_standard_streams(closed: tuple[int, ...], tmp_path: Path) -> None:
    """GIVEN `>&-`, as a service may be started, THEN a program writes its result."""

    def close() -> None:
        for stream in closed:
            os.close(stream)

    done = subprocess.run(
        [sys.executable, "-c", BODY, str(tmp_path / "result")],
        env=os.environ | ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=close,
        timeout=60,
    )

    assert done.returncode == 0
    assert (tmp_path / "result").read_text() == "result"


def interrupted(code: str) -> subprocess.CompletedProcess[str]:
    """Run Python code, whose loading a signal interrupts, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", f"import signal\n{IGNORED}\n{code}"],
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_ctrl_c_while_a_program_is_loaded_is_one_line() -> None:
    done = interrupted("import hybrid_ins.cli, signal; signal.raise_signal(signal.SIGINT)")

    assert done.returncode == -signal.SIGINT
    assert done.stderr == "-c: interrupted\n"


def test_ctrl_c_while_the_node_is_loaded_is_one_line() -> None:
    """GIVEN Ctrl-C when the first module of rclpy is asked for THEN there is no traceback."""
    done = interrupted(
        "import sys; from importlib.abc import MetaPathFinder\n"
        "class Finder(MetaPathFinder):\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'rclpy': signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "import hybrid_ins.cli.node"
    )

    assert done.returncode == -signal.SIGINT
    assert done.stderr == "-c: interrupted\n"


class TestNode:
    """The node is a process of its own: rclpy's context and signals are per process."""

    @pytest.mark.parametrize(
        ("option", "words"),
        [
            (["-p", "gnss.max_delay:=-1.0"], "gnss.max_delay"),
            (["-p", "gnss.max_delay:=soon"], "gnss.max_delay"),
            (["-p", "noise.mode:=magic"], "noise.mode"),
            (["--params-file", "missing.yaml"], "missing.yaml"),
            (["--params-file", "broken.yaml"], "broken.yaml"),
        ],
    )
    def test_wrong_parameters_get_one_clear_line(
        self, option: list[str], words: str, files: Path
    ) -> None:
        pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")

        result = subprocess.run(
            [program("ins_node"), "--ros-args", *option],
            cwd=files,
            capture_output=True,
            text=True,
            timeout=60,
        )

        assert result.returncode == 2, result.stderr
        assert "Traceback" not in result.stderr
        last = result.stderr.strip().splitlines()[-1]
        assert last.startswith("ins_node: error: ")
        assert words in last
