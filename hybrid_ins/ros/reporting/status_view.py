"""
The node's diagnostics and verdicts as one screen of text, or as plain values for JSON.
"""

from __future__ import annotations

import math
import textwrap
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hybrid_ins.ros.reporting.reports import Status

LEVELS = ("OK", "WARN", "ERROR", "STALE")
SHOWN = {
    "filter": (
        ("sigma_position_horizontal", "σ horizontal", "m"),
        ("sigma_position_vertical", "σ vertical", "m"),
        ("sigma_heading_deg", "σ heading", "°"),
        ("fixes_fused", "fixes fused", ""),
        ("standing", "standing", ""),
    ),
}
"""Values of a status that are worth a line, with names and units; of others all are in JSON."""
NAME_WIDTH, VERDICTS_KEPT = 16, 40


@dataclass
class NodeStatus:
    """What a node has said last."""

    statuses: dict[str, Status] = field(default_factory=dict)  # by name, without the node's
    verdicts: deque[Status] = field(default_factory=lambda: deque(maxlen=VERDICTS_KEPT))
    elsewhere: set[str] = field(default_factory=set)  # other namespaces that have such a node

    @property
    def level(self) -> int:
        """The worst level of all statuses."""
        return max((status.level for status in self.statuses.values()), default=3)

    def as_dict(self) -> dict[str, Any]:
        """Return everything, numbers as numbers, for JSON."""
        return {
            "level": LEVELS[self.level],
            "statuses": {
                name: {
                    "level": LEVELS[status.level],
                    "message": status.text,
                    "values": plain_values(dict(status.values)),
                }
                for name, status in self.statuses.items()
            },
            "verdict": plain_values(dict(self.verdicts[-1].values)) if self.verdicts else None,
            "fixes": self._fixes(),
        }

    def _fixes(self) -> dict[str, Any]:
        """Count the latest verdicts."""
        values = [dict(status.values) for status in self.verdicts]
        fused = [v for v in values if v.get("accepted") == "true"]
        ratios = [
            float(v["nis"]) / float(v["dof"]) for v in fused if float(v.get("nis", "nan")) > 0
        ]
        return {
            "judged": len(values),
            "fused": len(fused),
            "mean_nis_per_dof": sum(ratios) / len(ratios) if ratios else None,
        }

    def as_text(self, age: float, width: int = 100) -> str:
        """Return one screen; ``age`` is the time since the last diagnostics [s]."""
        if not self.statuses and self.elsewhere:
            names = ", ".join(sorted(self.elsewhere))
            return f"no diagnostics of hybrid_ins here, but in {names}: choose by --namespace"
        if not self.statuses:
            return "no diagnostics of hybrid_ins: is ins_node active, in this ROS domain?"
        head = f"hybrid_ins: {LEVELS[self.level]}, {age:.0f} s ago"
        return "\n".join([head, *self._status_lines(width), *self._verdict_lines(width)])

    def _status_lines(self, width: int) -> list[str]:
        lines = []
        indent = " " * (NAME_WIDTH + 7)
        for name, status in self.statuses.items():
            start = f"{name:<{NAME_WIDTH}} {LEVELS[status.level]:<5} "
            lines += textwrap.wrap(
                status.text, width, initial_indent=start, subsequent_indent=indent
            )
            values = dict(status.values)
            shown = [
                f"{title} {_short(values[key])}{' ' if unit == 'm' else ''}{unit}"
                for key, title, unit in SHOWN.get(name, ())
                if key in values
            ]
            if name == "input":
                shown = [f"{key}: {count}" for key, count in status.values]
            if shown:
                lines += textwrap.wrap(
                    "; ".join(shown), width, initial_indent=indent, subsequent_indent=indent
                )
        return lines

    def _verdict_lines(self, width: int) -> list[str]:
        if not self.verdicts:
            return ["no verdict on a fix has come since this program started"]
        fixes = self._fixes()
        ratio = fixes["mean_nis_per_dof"]
        nis = "" if ratio is None else f"; NIS per dimension {ratio:.2f} (1 on average when right)"
        refused = [status for status in self.verdicts if status.level]
        lines = [
            f"last {fixes['judged']} fixes: {fixes['fused']} fused{nis}",
            f"last fix: {self.verdicts[-1].text}",
        ]
        if refused and refused[-1] is not self.verdicts[-1]:
            lines.append(f"last one that was not simply fused: {refused[-1].text}")
        return [part for line in lines for part in textwrap.wrap(line, width)]


def _short(value: str) -> str:
    """Return a value for people: three digits of a fraction, yes or no."""
    plain = _plain(value)
    if isinstance(plain, bool):
        return "yes" if plain else "no"
    if not isinstance(plain, float):
        return value
    return f"{plain:.3g}" if abs(plain) < 1000.0 else f"{plain:.0f}"


def plain_values(values: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of a status with numbers and truths for what reads as such."""
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: str) -> Any:
    if value in ("true", "false"):
        return value == "true"
    for kind in (int, float):
        try:
            number = kind(value)
        except ValueError:
            continue
        return number if math.isfinite(number) else None
    return value
