"""What ins_status shows of the node's statuses and verdicts."""

import json

from hybrid_ins.ros.reporting.reports import Status
from hybrid_ins.ros.reporting.status_view import VERDICTS_KEPT, NodeStatus


def verdict(accepted: bool, nis: float = 3.0) -> Status:
    values = [("accepted", str(accepted).lower()), ("nis", str(nis)), ("dof", "3")]
    return Status(
        int(not accepted), "hybrid_ins: gnss", "fused" if accepted else "refused: x", values
    )


def status() -> NodeStatus:
    return NodeStatus(
        {
            "filter": Status(
                0,
                "hybrid_ins: filter",
                "aligned, GNSS fused",
                [("sigma_heading_deg", "0.4"), ("standing", "false"), ("fixes_fused", "nan")],
            ),
            "input": Status(1, "hybrid_ins: input", "3 messages", [("imu: gaps bridged", "3")]),
        }
    )


def test_text_has_levels_values_and_counts() -> None:
    shown = status()
    shown.verdicts.extend([verdict(True), verdict(False, 90.0), verdict(True, 6.0)])

    text = shown.as_text(0.4, 80)

    assert text.startswith("hybrid_ins: WARN")
    assert "σ heading 0.4°" in text
    assert "imu: gaps bridged: 3" in text
    assert "last 3 fixes: 2 fused; NIS per dimension 1.50" in text
    assert "last one that was not simply fused: refused: x" in text
    assert max(map(len, text.splitlines())) <= 80


def test_nodes_of_other_namespaces_are_named() -> None:
    text = NodeStatus(elsewhere={"/rover2", "/rover1"}).as_text(0.0)

    assert text.endswith("but in /rover1, /rover2: choose by --namespace")
    assert "is ins_node active" in NodeStatus().as_text(0.0)


def test_values_are_short_enough_to_read() -> None:
    shown = status()
    shown.statuses["filter"].values[:] = [
        ("sigma_position_horizontal", "0.0738773"),
        ("sigma_position_vertical", "1234.56"),
        ("fixes_fused", "12345"),
        ("standing", "true"),
    ]

    text = " ".join(shown.as_text(0.0).split())

    assert "σ horizontal 0.0739 m; σ vertical 1235 m; fixes fused 12345; standing yes" in text


def test_json_has_numbers_and_truths() -> None:
    shown = status()
    shown.verdicts.append(verdict(True))

    read = json.loads(json.dumps(shown.as_dict(), allow_nan=False))

    assert read["level"] == "WARN"
    values = read["statuses"]["filter"]["values"]
    assert values == {"sigma_heading_deg": 0.4, "standing": False, "fixes_fused": None}
    assert read["verdict"]["accepted"] is True
    assert read["fixes"] == {"judged": 1, "fused": 1, "mean_nis_per_dof": 1.0}


def test_nothing_heard() -> None:
    assert "is ins_node active" in NodeStatus().as_text(float("inf"))
    assert NodeStatus().as_dict()["level"] == "STALE"


def test_old_verdicts_are_forgotten() -> None:
    shown = status()
    shown.verdicts.extend([verdict(False)] * 5 + [verdict(True)] * VERDICTS_KEPT)

    assert shown.as_dict()["fixes"]["fused"] == VERDICTS_KEPT


def test_without_a_verdict_the_text_says_since_when() -> None:
    assert "no verdict on a fix has come since this program started" in status().as_text(0.0)
