"""
A lift at constant speed, which reads like a stand: the pulse of acceleration at its start shows it.

From the last stand on, while the samples are not those of a stand, the specific force along the
stand's own vertical, less gravity as it read there, integrates to the vertical speed: to some
centimetres a second over the seconds of a pulse, whatever the biases. Until an opposite pulse
brings it back the vehicle moves. Where it has tilted meanwhile, or moved for longer, nothing is
known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_SPEED = 0.15  # m/s, of a lift
DRIFT = 0.02  # m/s², of the integral
LONGEST = 10.0  # s, of all pulses
LONGEST_RIDE = 180.0  # s
MOST_TILT = 0.05  # rad: 0.01 m/s² of gravity


class LiftWatch:
    """Integrates the vertical acceleration since the last stand."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stand: fixes show the motion."""
        self._mean: Array | None = None  # (6,) specific force, rate of the stand
        self._speed = self._pulses = self._ride = 0.0  # m/s upwards, s, s
        self._tilt = np.zeros(3)  # rad

    def note_stand(self, samples: NDArray[np.void]) -> None:
        """Begin with the ``samples`` (``SAMPLE_DTYPE``) of a stand."""
        self.reset()
        self._mean = np.concatenate((samples["f"].mean(axis=0), samples["w"].mean(axis=0)))

    def observe(self, samples: NDArray[np.void], seconds: float, is_calm: bool) -> None:
        """Use the samples of the last ``seconds``, which look like a stand or do not."""
        if self._mean is None or not len(samples):
            return
        self._ride += seconds
        if not is_calm:
            gravity, rate = self._mean[:3], self._mean[3:]
            size = float(np.linalg.norm(gravity))
            up = gravity / size
            self._pulses += seconds
            self._speed += seconds * (float(samples["f"].mean(axis=0) @ up) - size)
            turned = seconds * (samples["w"].mean(axis=0) - rate)
            self._tilt += turned - (turned @ up) * up
        tilted = float(np.linalg.norm(self._tilt)) > MOST_TILT
        if tilted or self._pulses > LONGEST or self._ride > LONGEST_RIDE:
            self.reset()

    @property
    def moves(self) -> bool:
        """The vehicle rises or sinks."""
        return abs(self._speed) > LEAST_SPEED + DRIFT * self._pulses
