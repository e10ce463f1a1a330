"""The state of the last run: what of it the next start uses, and when not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.state import HEADING_DOUBT, N_ERROR, NavState
from hybrid_ins.core.navigator.phases import Running
from hybrid_ins.errors import InputError
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import set_stamp
from hybrid_ins.ros.start.saved_state import SavedState
from hybrid_ins.ros.start.warm_start import WarmStart

EPOCH_NS = 1_700_000_000_000_000_000
PLACE = (32.1, 34.8, 50.0)
METRE = 1.0 / 111_000.0  # deg of latitude


class Parked:
    """A vehicle that stands, level and with a heading of 60°, and its node's estimator."""

    def __init__(self, file: Path, start: float = 0.0, **values: Any) -> None:
        given = {**parameters.defaults(), "state_file": str(file), **values}
        self.log: list[str] = []
        self.warned: list[str] = []
        self.estimator = Estimator(given, self._note)
        self.warm_start = WarmStart(self.estimator, given)
        self.warm_start.load_at_start()
        self.t = start
        self.rng = np.random.default_rng(1)

    def _note(self, level: str, text: str) -> None:
        self.log.append(text)
        if level == "warn":
            self.warned.append(text)

    def wait(self, seconds: float, place: tuple[float, ...] = PLACE, tilt: float = 0.0) -> None:
        for k in range(round(100 * seconds)):
            self.t += 0.01
            t_ns = EPOCH_NS + round(self.t * 1e9)
            noise = self.rng.normal(0.0, 1.0, 6) * np.repeat([0.02, 0.001], 3)
            force = noise[:3] + 9.795 * np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
            self.estimator.handle_imu(ImuFields(t_ns, tuple(force), tuple(noise[3:])))
            self.estimator.run_periodic()
            if k % 20 == 10:
                fix = new_message("sensor_msgs/msg/NavSatFix")
                fix.header.frame_id = "gnss_link"
                set_stamp(fix.header.stamp, t_ns)
                fix.latitude, fix.longitude, fix.altitude = place
                fix.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
                fix.position_covariance_type = 2
                self.estimator.handle_fix(fix)
                self.warm_start.on_fix(fix)

    def heading(self) -> tuple[float, float]:
        """Heading from north and its standard deviation [deg]; it must be aligned."""
        running = self.estimator.navigator.filter
        assert running is not None, self.log
        saved = SavedState.of(running.flat_state(), 1, True, np.zeros(6), 0.0)
        return saved.heading, saved.heading_std


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return what a run has left that knew the heading."""
    path = tmp_path_factory.mktemp("run") / "state.yaml"
    known = {"alignment.heading_source": "parameter", "alignment.yaw": math.radians(30.0)}
    run = Parked(path, **known, **{"alignment.yaw_std": 0.01})
    run.wait(8.0)
    assert run.warm_start.save() == f"saved to {path}"
    return path.read_bytes()


@pytest.fixture
def file(left: bytes, tmp_path: Path) -> Path:
    """A file of that run, of the test's own."""
    path = tmp_path / "state.yaml"
    path.write_bytes(left)
    return path


def test_the_heading_is_used_where_the_vehicle_has_not_moved(file: Path) -> None:
    """GIVEN a parked vehicle WHEN started a minute later THEN it is aligned without motion."""
    cold = Parked(file.with_name("none.yaml"), 70.0)
    cold.wait(4.0)
    assert cold.estimator.navigator.filter is None

    warm = Parked(file, 70.0)
    warm.wait(4.0)

    heading, std = warm.heading()
    assert heading == pytest.approx(60.0, abs=1.0)
    assert 1.9 < std < 2.2
    assert any("the vehicle has not moved" in line for line in warm.log)


def test_an_antenna_that_tf_static_places_is_not_taken_for_a_way(file: Path) -> None:
    """GIVEN an antenna 2 m from the IMU, by /tf_static WHEN parked THEN nothing has moved."""
    run = Parked(file, 70.0)
    message = new_message("tf2_msgs/msg/TFMessage")
    message.transforms = [new_message("geometry_msgs/msg/TransformStamped")]
    message.transforms[0].header.frame_id = "base_link"
    message.transforms[0].child_frame_id = "gnss_link"
    message.transforms[0].transform.translation.x = 2.0
    message.transforms[0].transform.rotation.w = 1.0
    run.estimator.handle_static_transforms(message)
    run.wait(4.0, place=(PLACE[0] + 2.0 * METRE, *PLACE[1:]))

    assert any("the vehicle has not moved" in line for line in run.log), run.log


@pytest.mark.parametrize(
    ("moved", "words"),
    [
        ({"place": (PLACE[0] + 20.0 * METRE, *PLACE[1:])}, "20.0 m from where it was"),
        ({"tilt": math.radians(6.0)}, "tilted by 6.0°"),
    ],
    ids=["elsewhere", "tilted"],
)
def test_the_heading_of_a_vehicle_that_was_moved_is_not_used(
    file: Path, moved: dict[str, Any], words: str
) -> None:
    run = Parked(file, 70.0)
    run.wait(4.0, **moved)

    assert run.estimator.navigator.filter is None  # it waits for motion
    assert any(words in line for line in run.log), run.log
    assert sum("the heading is not used" in line for line in run.log) == 1


def test_biases_are_used_wherever_the_vehicle_is(file: Path) -> None:
    saved = replace(SavedState.read(file), accelerometer_bias=[0.2, -0.1, 0.05], standing=False)
    saved = replace(saved, accelerometer_bias_std=[0.01] * 3)
    saved.write(file)

    run = Parked(file, 70.0)
    run.wait(4.0)

    best = run.estimator.navigator.phase.best
    assert best is not None
    assert best.state.bias_a[0] == pytest.approx(0.2, abs=0.15)
    assert any("was moving when it was saved" in line for line in run.log)


def test_a_heading_given_otherwise_is_not_replaced(file: Path) -> None:
    run = Parked(
        file, 70.0, **{"alignment.heading_source": "parameter", "alignment.yaw": math.pi / 2}
    )
    run.wait(4.0)

    assert run.heading()[0] == pytest.approx(0.0, abs=3.0) or run.heading()[0] > 357.0


def test_the_clock_offset_is_where_the_search_begins(file: Path) -> None:
    replace(SavedState.read(file), clock_offset=0.123).write(file)

    given = Parked(file, **{"gnss.time_offset.estimate": False})
    assert given.estimator.clock.offset == 0.0
    assert Parked(file).estimator.clock.offset == 0.123


def test_a_leap_of_the_receiver_s_clock_is_not_saved(file: Path) -> None:
    run = Parked(file)
    run.wait(8.0)
    run.estimator.clock.leap(-3.0)
    assert run.estimator.clock.offset == -3.0

    run.warm_start.save()

    assert Parked(file).estimator.clock.offset == 0.0


BROKEN = {
    "cut short": lambda text: text[: len(text) // 2],
    "no YAML": lambda text: "a: [1, 2",
    "another version": lambda text: text.replace("version: 1", "version: 99"),
    "NaN": lambda text: text.replace("height: ", "height: .nan #"),
    "a text": lambda text: text.replace("heading: ", "heading: north #"),
    "empty": lambda text: "",
    "a negative std": lambda text: text.replace("position_std: ", "position_std: -"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_corrupt_file_is_named_and_ignored(file: Path, how: str) -> None:
    file.write_text(BROKEN[how](file.read_text()))

    run = Parked(file, 70.0)
    run.wait(3.0)

    (line,) = [text for text in run.log if "it is ignored" in text]
    assert str(file) in line
    assert "\n" not in line
    assert run.estimator.navigator.phase.best is not None


def test_a_file_reads_back_and_says_what_it_is(file: Path) -> None:
    saved = SavedState.read(file)
    saved.write(file)

    assert SavedState.read(file) == saved
    assert file.read_text().startswith("# What ins_node has found")
    assert [path.name for path in file.parent.iterdir()] == ["state.yaml"]


def test_a_heading_that_motion_leaves_in_doubt_is_saved_as_one() -> None:
    known = np.eye(N_ERROR) * math.radians(1.0) ** 2
    at_rest = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3)
    nav = NavState(np.array([0.5, 0.1, 0.0]), *at_rest, known).to_flat()
    nav[HEADING_DOUBT] = math.radians(20.0) ** 2

    saved = SavedState.of(nav, 1, True, np.zeros(6), 0.0)

    assert saved.heading_std == pytest.approx(math.hypot(1.0, 20.0))


def test_it_is_saved_where_the_vehicle_moves_off_and_every_half_minute(file: Path) -> None:
    run = Parked(file, 70.0, **{"alignment.heading_source": "parameter", "alignment.yaw_std": 0.01})
    run.wait(6.0)
    run.warm_start.save_where_due()
    first = SavedState.read(file)
    assert first.standing

    run.wait(1.0)
    run.warm_start.save_where_due()
    assert SavedState.read(file) == first  # nothing is due
    run.estimator.navigator.monitor.standing = False
    run.warm_start.save_where_due()
    assert not SavedState.read(file).standing


def test_nothing_can_be_saved_without_a_file_or_a_filter(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not run yet"):
        Parked(tmp_path / "state.yaml").warm_start.save()
    no_file = Parked(tmp_path / "state.yaml")
    no_file.warm_start.path = None
    with pytest.raises(InputError, match="state_file is empty"):
        no_file.warm_start.load()
    nowhere = Parked(tmp_path / "none" / "state.yaml", **{"alignment.heading_source": "parameter"})
    nowhere.wait(3.0)
    with pytest.raises(InputError, match=r"cannot be written .No such file or directory."):
        nowhere.warm_start.save()


@pytest.mark.parametrize("name", ["none/state.yaml", "a_file/state.yaml", "a_folder", "n" * 300])
def test_a_file_that_cannot_be_written_is_named_at_the_start_and_when_saving_fails(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "a_file").write_text("")
    (tmp_path / "a_folder").mkdir()
    kept = tmp_path / "a_folder" / "kept"
    kept.write_text("")

    run = Parked(tmp_path / name, **{"alignment.heading_source": "parameter"})
    assert run.warned[0].startswith("state_file: ") and "nothing will be saved" in run.warned[0]
    assert str((tmp_path / name).parent) in run.warned[0]
    run.wait(3.0)
    run.warned.clear()
    for _ in range(9):
        run.warm_start.save_where_due()

    assert len(run.warned) == 1 and "cannot be written" in run.warned[0]
    assert kept.exists()


def test_a_file_that_can_be_written_leaves_the_log_alone(tmp_path: Path) -> None:
    assert not Parked(tmp_path / "state.yaml").warned
    assert not list(tmp_path.iterdir())


def test_nothing_is_saved_while_the_clock_offset_is_searched_for(file: Path) -> None:
    """GIVEN a filter whose offset may be another WHEN it is saved THEN the file stays as it was."""
    run = Parked(file, 70.0)
    run.wait(4.0)
    phases = run.estimator.navigator.phases
    assert isinstance(phases.phase, Running)
    phases.phase = replace(phases.phase, is_provisional=True)
    before = file.read_bytes()

    run.warm_start.save_where_due()
    run.warm_start.save_at_end()

    assert file.read_bytes() == before
    assert not any("not known yet" in line for line in run.log)
    with pytest.raises(InputError, match="clock offset of the fixes is not known yet"):
        run.warm_start.save()
