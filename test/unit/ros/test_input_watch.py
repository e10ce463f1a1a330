"""What the node says of input that does not come; its clocks and its graph are stand-ins."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from support.drive import KNOWN, Drive

from hybrid_ins.ros import input_watch
from hybrid_ins.ros.input_watch import InputWatch
from hybrid_ins.ros.reporting.reports import Status

ANOTHER_EPOCH = 4e9  # s, of the node's clock


class Graph:
    """A node with an IMU on another topic than its own, and a clock that a test moves."""

    def __init__(self, is_simulated: bool) -> None:
        self.seconds = ANOTHER_EPOCH
        self.ros_time_is_active = is_simulated

    def get_clock(self) -> Graph:
        return self

    def now(self) -> SimpleNamespace:
        return SimpleNamespace(nanoseconds=round(self.seconds * 1e9))

    def resolve_topic_name(self, name: str) -> str:
        return name if name.startswith("/") else f"/{name}"

    def count_publishers(self, topic: str) -> int:
        return int(topic in ("/cam/imu", "/gnss/filtered", "/r1/gnss/filtered", "/r1/datum"))

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        imu, fix = ["sensor_msgs/msg/Imu"], ["sensor_msgs/msg/NavSatFix"]
        of_imu = [("/imu/data", imu), ("/unused", imu), ("/cam/imu", imu)]
        names = "/gnss/filtered", "/r1/gnss/filtered", "/r1/datum"  # two ins_nodes
        return [*of_imu, *((name, fix) for name in names)]


class Watched(Drive):
    """A flight, the watch on its input, and what that publishes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, is_simulated: bool = False) -> None:
        super().__init__(**KNOWN)
        self.graph, self.wall = Graph(is_simulated), 0.0
        self.said: list[Status] = []
        self.diagnostics: list[Status] = []
        monkeypatch.setattr(input_watch.time, "monotonic", lambda: self.wall)
        topics: Any = SimpleNamespace(
            publish_all=lambda reports: self.said.extend(r.content for r in reports),
            publish_diagnostics=lambda t_ns, statuses: self.diagnostics.extend(statuses),
        )
        self.watch = InputWatch(self.graph, self.estimator, topics)

    def fly(self, start: float, stop: float) -> None:
        self.play(start, stop)
        self.watch.imu_messages += 1
        self.watch.fixes += 1
        self.estimator.pop_reports()

    def wait(self, seconds: int, clock_runs: bool = True) -> None:
        for _ in range(seconds):
            self.wall += 1.0
            self.graph.seconds += clock_runs
            self.diagnostics.clear()
            self.watch.on_second()

    def hear_imu(self, seconds: int) -> None:
        """Let seconds pass in which messages of the IMU alone come."""
        for _ in range(seconds):
            self.watch.imu_messages += 1
            self.wait(1)

    def lines(self) -> list[str]:
        return [f"{level}: {text}" for level, text in self.log if "messages" in text]

    def last(self, name: str) -> Status:
        return next(s for s in self.diagnostics if s.name == f"hybrid_ins: {name}")


def test_without_samples_the_state_is_lost_until_they_return(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GIVEN a flight WHEN the IMU dies THEN all is lost, by the time since, at any epoch."""
    flown = Watched(monkeypatch)
    flown.fly(0.0, 5.0)
    flown.wait(1)
    assert not flown.said and not flown.diagnostics

    flown.wait(3)

    assert [said.text for said in flown.said] == ["position lost, velocity lost, heading lost"]
    assert flown.said[0].level == flown.last("validity").level == 2
    assert flown.last("validity").text == flown.said[0].text
    found = flown.last("filter")
    assert (found.level, dict(found.values)["state"]) == (2, "no IMU samples")
    assert "no IMU samples for 3 s" in found.text and "σ" not in found.text
    assert not any("sigma" in key for s in (found, flown.said[0]) for key, _ in s.values)
    assert "no messages on /imu/data for 3 s" in flown.last("imu").text
    flown.wait(12)
    flown.wait(20)
    assert len(flown.lines()) == 1 and "no messages on /imu/data for 10 s" in flown.lines()[0]

    flown.play(5.0, 6.0)
    told = [r.content for r in flown.estimator.pop_reports() if r.topic == "validity"]
    assert told and told[-1].text.startswith("position good, velocity good")
    flown.hear_imu(1)
    assert flown.lines()[-1] == "info: /imu/data: messages come, after 35 s"


def test_a_receiver_that_dies_is_logged_while_the_imu_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GIVEN a flight WHEN no fixes come any more THEN one line says so, not where both stop."""
    flown = Watched(monkeypatch)
    flown.fly(0.0, 2.0)
    flown.wait(1)
    flown.hear_imu(20)

    (line,) = flown.lines()
    assert line.startswith("warn: no messages on /gnss/fix for 10 s: while the IMU's come")
    flown.watch.fixes += 1
    flown.hear_imu(1)
    assert flown.lines()[1:] == ["info: /gnss/fix: messages come, after 20 s"]
    flown.wait(30)
    assert not any("/gnss/fix" in line for line in flown.lines()[2:])


def test_messages_of_no_use_are_told_from_none(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = Watched(monkeypatch)
    flown.fly(0.0, 2.0)
    flown.wait(1)
    flown.hear_imu(4)

    assert "no message on /imu/data was of use for 4 s" in flown.last("imu").text
    assert flown.last("validity").level == 2
    assert not flown.lines()


def test_a_bag_that_is_paused_keeps_its_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN simulated time WHEN its clock stops THEN the state is as it was; else it is lost."""
    flown = Watched(monkeypatch, is_simulated=True)
    flown.fly(0.0, 5.0)
    flown.wait(1)

    flown.wait(30, clock_runs=False)

    assert not flown.said and not flown.lines()
    assert flown.last("filter").text == "aligned, GNSS fused"
    assert "no messages on /imu/data for 30 s" in flown.last("imu").text
    flown.wait(2)
    assert flown.said[0].text.startswith("position lost")


def test_a_simulated_clock_that_never_came_is_named_and_hides_no_loss(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GIVEN use_sim_time without /clock WHEN the IMU dies THEN all is lost; /clock is missed."""
    flown = Watched(monkeypatch, is_simulated=True)
    flown.graph.seconds = 0.0
    flown.fly(0.0, 5.0)
    flown.wait(1, clock_runs=False)

    flown.wait(3, clock_runs=False)

    assert flown.said[0].text.startswith("position lost")
    flown.wait(10, clock_runs=False)
    (line,) = (line for line in flown.lines() if "/clock" in line)
    assert line.startswith("warn: no messages on /clock for 10 s: use_sim_time is true: start")
    flown.wait(1)
    assert flown.lines()[-1].startswith("info: /clock: messages come")


def test_what_never_came_is_logged_with_what_could_be_meant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    idle = Watched(monkeypatch)

    idle.wait(30)

    imu, fix = idle.lines()
    assert imu.startswith("warn: no messages on /imu/data for 10 s: ")
    assert "choose /cam/imu with -r imu/data:=/cam/imu" in imu
    assert fix.startswith("warn: no messages on /gnss/fix for 10 s: nobody publishes it, nor")
    assert "waiting" in idle.last("validity").text
    assert idle.last("filter").text.startswith("aligning, waiting for the IMU")
