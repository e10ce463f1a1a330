"""
The frame_id of one topic's messages: what is stray, such as a second publisher's, is no change.
"""

from __future__ import annotations

CONFIRMED = 5  # messages in a row that have another frame_id, and
LASTING_NS = 1_000_000_000  # for so long: then it is a change


class FrameId:
    """
    A frame_id that changes once enough messages in a row have another one.

    Attributes
    ----------
    in_force : str or None
        None before the first message.
    """

    def __init__(self) -> None:
        self.in_force: str | None = None
        self._other = ""
        self._count = 0  # of messages in a row that have the other one
        self._first_ns = 0  # stamp of the first of these

    def set(self, name: str) -> None:
        """Use a frame_id from now on."""
        self.in_force, self._count = name, 0

    def is_settled(self, name: str) -> bool:
        """Return whether a message's frame_id is the one in force, and so was the last one's."""
        return name == self.in_force and not self._count

    def is_confirmed(self, name: str, t_ns: int) -> bool:
        """Note a message's frame_id and stamp [ns]; return whether it is no stray one."""
        if name == self.in_force:
            self._count = 0
            return True
        if not self._count or name != self._other or t_ns < self._first_ns:
            self._other, self._count, self._first_ns = name, 0, t_ns
        self._count += 1
        return self._count >= CONFIRMED and t_ns - self._first_ns >= LASTING_NS
