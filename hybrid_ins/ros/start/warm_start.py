"""
Start with what the last run has found, and save it for the next.

The heading is used only where the vehicle has not moved since: it stood when the file was written,
and stands where it stood, with gravity from the same side. A turn on the spot does not show in
these, which is why the heading is not assumed to be better than `HEADING_STD`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.core.alignment.alignment import Alignment
from hybrid_ins.core.imu.standstill import is_standing
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import check_output
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.conversions import STATUS_FIX, Message
from hybrid_ins.ros.start.saved_state import SavedState

HEADING_STD = math.radians(2.0)
SAME_DIRECTION = math.radians(2.0)  # of gravity: a parked vehicle settles, and biases drift
SAME_PLACE = 3.0  # standard deviations
LEAST_WINDOW_NS = 500_000_000  # of IMU samples that show standing and gravity
SAVED_EVERY_NS = 30_000_000_000


class WarmStart:
    """
    Saves and loads the state of an estimator.

    Parameters
    ----------
    estimator : Estimator
    values : mapping
        Checked parameters: ``state_file`` is the file, empty for none.

    Attributes
    ----------
    path : Path or None
    """

    def __init__(self, estimator: Estimator, values: Mapping[str, Any]) -> None:
        self._estimator = estimator
        self.path = Path(values["state_file"]) if values["state_file"] else None
        self._uses_heading = values["alignment.heading_source"] in ("auto", "motion")
        self._known: SavedState | None = None
        self._prepared: Alignment | None = None  # with the known biases
        self._heading_used = self._informed = False
        self._saved_ns, self._saved_standing = 0, False

    # Saving.

    def save(self) -> str:
        """
        Save, and return a line for the user.

        Raises
        ------
        InputError
            There is no file to write, or nothing to save yet.
        """
        path = self._given_path()
        navigator, clock = self._estimator.navigator, self._estimator.clock
        running = navigator.filter
        if running is None:
            raise InputError("nothing to save: the filter does not run yet")
        if navigator.phase.is_provisional:
            raise InputError("nothing to save: the clock offset of the fixes is not known yet")
        saved = SavedState.of(
            running.flat_state(),
            navigator.last_ns,
            navigator.monitor.standing,
            running.noise.levels(),
            clock.offset - clock.leapt,  # a leap is over when the receiver starts anew
        )
        saved.write(path)
        self._saved_ns, self._saved_standing = saved.stamp_ns, saved.standing
        return f"saved to {path}"

    def _given_path(self) -> Path:
        if self.path is None:
            raise InputError("the parameter state_file is empty: set it to a path, and restart")
        return self.path

    @property
    def _has_something(self) -> bool:
        """There is a file to write, and a filter with a clock offset that is known."""
        navigator = self._estimator.navigator
        running = navigator.filter is not None and not navigator.phase.is_provisional
        return self.path is not None and running

    def save_where_due(self) -> None:
        """Save every half a minute, and as soon as the vehicle stops or moves off."""
        navigator = self._estimator.navigator
        if not self._has_something:
            return
        aged = abs(navigator.last_ns - self._saved_ns) >= SAVED_EVERY_NS
        if aged or navigator.monitor.standing != self._saved_standing:
            self.save_at_end()

    def save_at_end(self) -> None:
        """Save where there is something to save; failures are logged."""
        if not self._has_something:
            return
        try:
            self.save()
        except InputError as error:
            self._estimator.inputs.inform("state_file", f"state_file: {error}", "warn")

    # Loading.

    def load(self) -> str:
        """
        Use the file from the next alignment on, and return a line for the user.

        Raises
        ------
        InputError
            There is no usable file.
        """
        self._known = SavedState.read(self._given_path())
        self._prepared, self._heading_used, self._informed = None, False, False
        offset = self._known.clock_offset
        if self._estimator.values["gnss.time_offset.estimate"]:
            self._estimator.change({"gnss.time_offset.value": offset})
        return f"loaded from {self.path}: biases, clock offset, pose"

    def load_at_start(self) -> None:
        """
        Load the file where there is one; one that cannot be used is named and ignored.

        So is a folder in which no file can be written.
        """
        if self.path is None:
            return
        try:
            check_output(self.path, overwrite=True)
        except InputError as error:
            text = f"state_file: nothing will be saved: {error}"
            self._estimator.inputs.log("warn", text)
        if not os.access(self.path, os.F_OK):  # nor where it cannot be looked for
            return
        try:
            self._estimator.inputs.log("info", f"state_file: {self.load()}")
        except InputError as error:
            self._estimator.inputs.log("warn", f"state_file: {error}; it is ignored")

    def on_fix(self, message: Message) -> None:
        """Compare a NavSatFix, while aligning, with the place in the file."""
        alignment = self._estimator.navigator.alignment
        known = self._known
        if known is None or alignment is None or message.status.status < STATUS_FIX:
            return
        if alignment is not self._prepared:
            self._prepared = alignment
            alignment.remember(known.biases)
            self._estimator.navigator.monitor.remember(known.biases)
        if self._heading_used or not self._uses_heading or self._informed:
            return
        samples = self._estimator.navigator.ring.after(
            self._estimator.navigator.last_ns - 2 * LEAST_WINDOW_NS
        )
        if len(samples) < 5 or samples["t_ns"][-1] - samples["t_ns"][0] < LEAST_WINDOW_NS:
            return
        reason = self._why_not(known, message, samples)
        log = self._estimator.inputs.log
        if reason:
            self._informed = True
            log("info", f"state_file: the heading is not used: {reason}")
            return
        self._heading_used = True
        std = max(math.radians(known.heading_std), HEADING_STD)
        alignment.set_yaw(int(samples["t_ns"][-1]), math.radians(known.heading), std)
        log("info", f"state_file: the vehicle has not moved: heading {known.heading:.1f}° from it")

    def _why_not(self, known: SavedState, message: Message, samples: Any) -> str:
        """Return why the heading is not to be used; empty where it is."""
        if not known.standing:
            return "the vehicle was moving when it was saved"
        if math.radians(known.heading_std) > HEADING_STD:
            return f"it was known to {known.heading_std:.1f}° only"
        if not is_standing(samples):
            return "the vehicle moves"
        lla = np.array([math.radians(message.latitude), math.radians(message.longitude), 0.0])
        away = displacement(known.lla, lla)[:2]
        fix_std = math.sqrt(max(message.position_covariance[0], message.position_covariance[4], 0))
        distance = float(np.linalg.norm(away))
        lever = float(np.linalg.norm(self._estimator.placement.lever_b))
        limit = SAME_PLACE * math.hypot(known.position_std, math.sqrt(2.0) * fix_std) + lever
        if not distance <= limit:
            return f"the vehicle is {distance:.1f} m from where it was"
        force = samples["f"].mean(axis=0) - known.accelerometer_bias
        cosine = -float(force @ known.down_b) / float(np.linalg.norm(force))
        tilt = math.acos(min(max(cosine, -1.0), 1.0))
        if tilt > SAME_DIRECTION:
            return f"the vehicle is tilted by {math.degrees(tilt):.1f}° since"
        return ""
