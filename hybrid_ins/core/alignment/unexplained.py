"""
Jumps of the measurements that no hypothesis explains.
"""

from __future__ import annotations

from collections.abc import Sequence

from hybrid_ins.core.update.gate import Verdict

RETURN_NS = 5_000_000_000  # by then hypotheses that are not wrong agree with the fixes again


class Unexplained:
    """
    Knows since when measurements are no evidence on the hypotheses of a bank.

    After a jump that none of them explains they return to the measurements one after the other, by
    when each has first rejected one. Until all agree that says nothing of which is right.
    """

    def __init__(self) -> None:
        self._jump: tuple[str, int] | None = None  # the last one's kind and stamp [ns]

    def observe(self, verdicts: Sequence[Verdict]) -> bool:
        """Use the verdicts on one measurement; return whether it is no evidence."""
        agree = [v.nis <= v.threshold for v in verdicts]
        kind, t_ns = verdicts[0].measurement.kind, verdicts[0].measurement.t_ns
        if not any(agree) and any(v.jump for v in verdicts):
            self._jump = kind, t_ns
        elif self._jump is not None:
            returned = kind == self._jump[0] and all(agree)
            if returned or t_ns - self._jump[1] > RETURN_NS:
                self._jump = None
        return self._jump is not None
