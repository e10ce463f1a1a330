"""How the sensitivities of a state turn with a corrected attitude."""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.inertial.state import DP, DV, EPS
from hybrid_ins.core.update.measurements import turned


@register_jitable
def turn_sensitivities(s, before, after):  # type: ignore[no-untyped-def]
    """
    Turn the sensitivities of position, velocity and attitude with a corrected attitude.

    What a lever arm does to the state turns with the vehicle, not with what is known of its
    attitude: otherwise the correction of a heading would be taken for a turn.
    """
    change = np.empty(9)  # C_after C_before'
    for i in range(3):
        change[i::3] = turned(after, before[3 * i : 3 * i + 3])
    for j in range(3):
        for part in (DP, DV, EPS):
            s[part, j] = turned(change, s[part, j])
