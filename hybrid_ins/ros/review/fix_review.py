"""What warns of the last fixes of a receiver, and not again for many more."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

FIXES_KEPT = 40  # fixes
NEXT_WARNING = 200  # fixes

Seen = TypeVar("Seen")


class FixReview(Generic[Seen]):
    """
    Keeps what was seen of the last fixes.

    Parameters
    ----------
    inputs : InputLog
        Warns.
    """

    def __init__(self, inputs: InputLog) -> None:
        self._inputs = inputs
        self._fixes: deque[Seen] = deque(maxlen=FIXES_KEPT)
        self._quiet = 0  # fixes until the next warning

    def _warn(self, name: str, text: str) -> None:
        """Count a fault under its name, and warn with ``text``."""
        self._quiet = NEXT_WARNING
        self._inputs.count_and_warn("gnss/fix", Refused(name, text))
