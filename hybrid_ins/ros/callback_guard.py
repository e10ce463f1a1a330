"""
Callbacks that cannot end the node: what they raise is counted and logged.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog


class CallbackGuard:
    """
    Wraps callbacks.

    Parameters
    ----------
    inputs : InputLog
        Counts what is not decodable, and internal errors.
    """

    def __init__(self, inputs: InputLog) -> None:
        self._inputs = inputs

    def decoding(
        self, topic: str, decode: Callable[[bytes], Any], callback: Callable[[Any], None]
    ) -> Callable[[bytes], None]:
        """Return a callback for serialised messages on a topic; bad ones are counted."""

        def on_bytes(data: bytes) -> None:
            try:
                message = decode(data)
            except Exception:  # rclpy's errors share no public base
                self._inputs.count_and_warn(
                    topic,
                    Refused(
                        f"{topic.strip('/')}: not decodable",
                        f"a message of {len(data)} bytes is not of the topic's type: stop its "
                        "publisher",
                    ),
                )
                return
            try:
                callback(message)
            except Exception as error:  # nothing on the network may end the navigation
                self.on_error(error)

        return on_bytes

    def wrap(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that does not raise."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.on_error(error)

        return guarded

    def on_error(self, error: Exception) -> None:
        """Count and log an error that no callback should raise."""
        frames = traceback.extract_tb(error.__traceback__)
        place = f" in {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
        text = shortened(" ".join(str(error).split()), 200)
        self._inputs.count_and_warn(
            "internal error",
            Refused("internal error", f"{type(error).__name__}{place}: {text}: please report it"),
        )
