"""
Input that does not come: for how long, and what the log says of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hybrid_ins.ros.reporting.input_log import Log

WARN_AFTER = 10.0  # s without a message, from which on the log says so


class Silence:
    """
    How long nothing new has come, by a clock of its owner: stamps may be of another epoch.

    Attributes
    ----------
    seconds : float
        Since something new was last seen, or since the start.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._newest = 0

    def update(self, newest: int, elapsed: float) -> float:
        """
        Return the silence after ``elapsed`` [s] more, in which ``newest`` was the last that came.

        ``newest`` is a number that changes with all that comes, 0 before the first.
        """
        is_new = newest not in (0, self._newest)
        self._newest = newest or self._newest
        self.seconds = 0.0 if is_new else self.seconds + elapsed
        return self.seconds


class OutageLog:
    """
    Logs, once for each outage, that nothing comes on a topic, and that messages came again.

    Parameters
    ----------
    log : callable
        Called with a level and a line for the user.
    topic : str
        The topic's full name.
    """

    def __init__(self, log: Log, topic: str) -> None:
        self._log = log
        self._topic = topic
        self._warned_of = 0.0  # s of the outage that was warned of

    def note(self, seconds: float, describe: Callable[[], str]) -> None:
        """Note that nothing has come for some seconds; ``describe`` says why, and the remedy."""
        if seconds >= WARN_AFTER:
            if not self._warned_of:
                text = f"no messages on {self._topic} for {seconds:.0f} s: {describe()}"
                self._log("warn", text)
            self._warned_of = seconds
        elif self._warned_of:
            self._log("info", f"{self._topic}: messages come, after {self._warned_of:.0f} s")
            self._warned_of = 0.0


def why_missing(name: str, kind: str, publishers: int, others: Sequence[str], option: str) -> str:
    """
    Return why nothing has come on a topic since the start, and the remedy.

    Parameters
    ----------
    name : str
        The topic as the node calls it, such as ``imu/data``.
    kind : str
        Its type.
    publishers : int
        How many it has.
    others : sequence of str
        Other topics of that type that are published.
    option : str
        The argument of the launch file that sets the topic.
    """
    if publishers:
        return f"it has a publisher ({publishers}): does it publish, are type and QoS right?"
    if not others:
        return f"nobody publishes it, nor another {kind}: start the driver"
    first = others[0]
    return (
        f"nobody publishes it: choose {' or '.join(others)} with -r {name}:={first} "
        f"(launch: {option}:={first})"
    )
