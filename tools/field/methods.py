"""The methods of the field experiment: parameters of the node, by the name in the tables."""

from __future__ import annotations

from typing import Any

from tools.paper.navigation import PAPER_TABLE as PAPER_FIGURES

OURS, TUNED, BEST = "HB-AEKF, ours", "tuned on the other session", "best constant in hindsight"
NO_BACKGROUND = {
    f"noise.background_{sensor}": [0.0, 0.0, 0.0] for sensor in ("accelerometer", "gyroscope")
}
OTHERS: dict[str, dict[str, Any]] = {
    "HB-AEKF, ours, without innovation scale": {"noise.innovation_scale": False},
    "HB-AEKF, ours, without background": NO_BACKGROUND,
    "HB-AEKF, paper's network": {
        "noise.model": "paper",
        "noise.innovation_scale": False,
        **NO_BACKGROUND,
    },
    "MB-EKF-AQ1 (ξ = 1)": {"noise.mode": "innovation", "noise.innovation_window": 1},
    "MB-EKF-AQ2 (ξ = 3)": {"noise.mode": "innovation", "noise.innovation_window": 3},
    "MB-EKF-AQ3 (ξ = 5)": {"noise.mode": "innovation", "noise.innovation_window": 5},
    "MB-EKF-CQ1": {"noise.mode": "cq1"},
    "MB-EKF-CQ2": {"noise.mode": "cq2"},
    "MB-EKF-CQ3": {"noise.mode": "cq3"},
    "MB-EKF-CQ3, Qc = q as printed": {"noise.mode": "cq3", "noise.units": "paper"},
}
NO_SCALE, PLAIN, PAPER, *_ = OTHERS
ORACLE = "HB-AEKF, told the injected levels"
ONLINE: dict[str, tuple[float, bool, float | None]] = {
    # Rate of the fixes [Hz], whether the rest is calibrated, error of the heading given [rad].
    "online 5 Hz": (5.0, False, 0.0),
    "online 5 Hz, the rest calibrated": (5.0, True, 0.0),
    "online 5 Hz, nor the heading known": (5.0, False, None),
    "online 1 Hz": (1.0, False, 0.0),
    "online 1 Hz, the rest calibrated": (1.0, True, 0.0),
}
HARDER = ("heading 30°", "heading unknown", "published 5 Hz", "published 1 Hz", *ONLINE)
PAPER_TABLE = {  # PMAE and PRMSE [m] of the paper's flight
    PAPER: PAPER_FIGURES["paper's network"],
    "MB-EKF-AQ1 (ξ = 1)": PAPER_FIGURES["AQ1"],
    "MB-EKF-AQ2 (ξ = 3)": PAPER_FIGURES["AQ2"],
    "MB-EKF-AQ3 (ξ = 5)": PAPER_FIGURES["AQ3"],
    **{f"MB-EKF-{name}": PAPER_FIGURES[name] for name in ("CQ1", "CQ2", "CQ3")},
}


def constant(accelerometer: float, gyroscope: float) -> tuple[str, dict[str, Any]]:
    """Return a constant's name and parameters."""
    return f"q {accelerometer:g}, {gyroscope:g}", {
        "noise.mode": "constant",
        "noise.q_accelerometer": accelerometer,
        "noise.q_gyroscope": gyroscope,
    }


GRID = dict(constant(a, g) for g in (1e-6, 1e-5, 1e-4) for a in (0.01, 0.03, 0.1, 0.3, 1.0))
NOISY_GRID = dict(constant(a, g) for g in (1e-4, 1e-3, 1e-2) for a in (0.3, 1.0, 3.0, 10.0))
