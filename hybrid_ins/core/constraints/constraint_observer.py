"""
Whether a vehicle moves along its nose, and where the nose points: from the filter's own motion.

While fixes bound its errors, a filter knows the velocity in the vehicle without assuming anything
about it. The velocity across the nose is compared by two models, [1]_: that of a vehicle on wheels,
whose nose and point without slip are estimated along the way, and that of one which moves freely.
What is predicted before each observation counts, so that a nose fitted to one straight leg proves
nothing.

What of slip is proportional to the motion is no noise: tyres that slip out of turns move the point
without slip, and the body pitches with the acceleration. Both are estimated; what is left of slip
lasts for a fraction of a second.

What the IMU's scale errors have done to the attitude is part of the nose that is found: state and
nose err together, and the constraint does not see it. In an outage the attitude is corrected by
what is known of scale errors, so the derivative of the nose by them is kept.

The constraint is proven with the nominal slip, and disproven with that which the motion shows, to a
limit: a rough road is no ice, and a boat that hardly drifts is no car.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6 (multiple models).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose, point_velocity
from hybrid_ins.core.constraints.slip import SlipEstimator
from hybrid_ins.core.inertial.rotations import cross
from hybrid_ins.core.inertial.state import BIAS_G, covariance
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE

Array = NDArray[np.float64]

MIN_SPEED = 2.0  # m/s, from which the velocity across the nose can prove anything
FREE_ANGLE = 0.1  # rad: of the velocity against the nose, where a vehicle moves freely
SIDEWAYS = math.log(0.05)  # of a vehicle that moves freely: the probability of any direction
SLIP_TIME = 0.3  # s, correlation time of slip and bumps
SPRING_TIME = 3.0  # s, over which a body that pitches on its springs is averaged
SQUAT_STD = 0.005  # rad per m/s², of the body's pitch by acceleration: cars have some 0.003
STATE_TIME = 10.0  # s, of the errors of the filter's velocity and heading
NOSE_TIME = 1.0  # s: an error of the nose is constant, but the state made it, and both cancel
EVIDENCE_TIME = 2.0  # s for which motion shows the same
EVIDENCE_MEMORY, RECENT_MEMORY = 120.0, 8.0  # s over which evidence is remembered
MOST_EVIDENCE = 30.0  # nats
SHOWN = 10.0  # nats that prove the constraint
BROKEN = -4.0  # nats over ``RECENT_MEMORY`` that disprove it
TURNED = 2.0 * math.pi  # rad that the vehicle must have turned by: a straight leg fits any nose
KNOWN = math.radians(1.0)  # σ of the nose: a filter that knows little agrees with anything
REPEATED = 2.0  # factor on that angle each time that the constraint was disproven
MOST_TURNED = 8.0 * TURNED  # a day has many disproofs, each of some seconds
LARGEST_SLIP = 2.0  # of the nominal σ, with which a vehicle on wheels is not contradicted
OUTLIER = 16.0  # NIS of an observation that teaches nothing about the nose


@dataclass(frozen=True, slots=True)
class ConstraintSettings:
    """
    What is known of a vehicle before it moves.

    Attributes
    ----------
    nose : Nose
        Nominal.
    nose_std : float
        Of its yaw and pitch [rad].
    point_std : float
        Of the place along the nose that does not slip [m].
    std : ndarray, shape (2,)
        Velocity across the nose, to the right and down [m/s]: slip, bumps.
    assumed : bool
        The vehicle moves along its nose until its motion shows otherwise; then, and else, motion
        must show it.
    """

    nose: Nose
    nose_std: float
    point_std: float
    std: Array
    assumed: bool


class ConstraintObserver:
    """
    Compares both models, and estimates the nose.

    Parameters
    ----------
    settings : ConstraintSettings

    Attributes
    ----------
    nose : Nose
        As estimated.
    evidence : float
        Logarithm of the likelihood ratio over the last minutes [nats]; positive for the constraint.
    recent : float
        The same over the last seconds, with the slip that was shown.
    turned : float
        Angle turned by while it held [rad].
    slip : SlipEstimator
        The velocity across the nose that the motion shows; the constraint is not fused with that,
        since the road may change in an outage.
    ratio : SlipEstimator
        The same relative to what a model answers, which sees the road: no model knows every car.
    holds : bool
        The constraint is proven, or assumed, and not disproven.
    """

    def __init__(self, settings: ConstraintSettings) -> None:
        self._settings = settings
        self.nose = settings.nose
        self._P = (
            np.diag([settings.nose_std, settings.nose_std, settings.point_std, SQUAT_STD]) ** 2
        )
        self._by_scale = np.zeros((len(self._P), N_SCALE))
        self.evidence = self.recent = self.turned = 0.0
        self.slip, self.ratio = SlipEstimator(settings.std), SlipEstimator(np.ones(2))
        self.holds = settings.assumed
        self._to_turn = TURNED
        self._pitched: float | None = None  # rad, nose above the path, averaged

    @property
    def sigma(self) -> Array:
        """Standard deviations of the nose's yaw, pitch [rad], place [m] and squat, (4,)."""
        return np.asarray(np.sqrt(np.diag(self._P)))

    def observe(
        self,
        nav: Array,
        rate_b: Array,
        interval: float,
        *,
        fused: bool,
        answer: Array | None = None,
        by_scale: Array | None = None,
    ) -> None:
        """
        Use the motion at an instant.

        Parameters
        ----------
        nav : ndarray, shape (N_NAV,) or longer
            Flat state with nothing pending.
        rate_b : ndarray, shape (3,)
            The gyroscopes' reading [rad/s].
        interval : float
            Time since the last observation [s].
        fused : bool
            The filter fuses the constraint: agreement then proves nothing.
        answer : ndarray, shape (2, 2), optional
            A model's, on the covariance of the velocity across the nose [(m/s)²].
        by_scale : ndarray, shape (15, N_SCALE), optional
            Sensitivity of the state's error to the IMU's scale errors, see `ScaleErrorObserver`.
        """
        z, J, H, along = self._innovation(nav, rate_b)
        state = H @ covariance(nav) @ H.T
        self._pitched = self._averaged(-z[1] / along, interval) if abs(along) > MIN_SPEED else None
        speed = math.sqrt(along**2 + float(z @ z))
        S, slip = state + J @ self._P @ J.T, self._slip
        held, _ = _log_density(z, S + np.diag(self._settings.std**2))
        slipping, nis = _log_density(z, S + slip)
        sideways, _ = _log_density(z, S + slip + np.eye(2) * speed**2)
        free, is_fast = SIDEWAYS + sideways, abs(along) > MIN_SPEED
        if is_fast:
            nearly, _ = _log_density(z, S + np.eye(2) * (FREE_ANGLE * speed) ** 2)
            free = float(np.logaddexp(nearly, free))
        share = min(interval / EVIDENCE_TIME, 1.0)
        gains = share * (np.array([held, slipping]) - free)
        proves = is_fast and not fused
        if not proves:  # a vehicle that slews or crawls sideways still disproves the constraint
            gains = np.minimum(gains, 0.0)
        else:
            fading = math.exp(-interval / EVIDENCE_MEMORY)
            self.slip.observe(z, S, share, fading)
            if answer is not None:
                std = np.sqrt(np.diag(answer))
                self.ratio.observe(z / std, S / np.outer(std, std), share, fading)
        self.evidence = _faded(self.evidence, float(gains[0]), interval / EVIDENCE_MEMORY)
        self.recent = _faded(self.recent, float(gains[1]), interval / RECENT_MEMORY)
        if nis < OUTLIER and proves:
            self.turned += abs(float(rate_b[2] - nav[BIAS_G][2])) * interval
            R = inflated(state, STATE_TIME, interval)
            to_scale = np.zeros((2, N_SCALE)) if by_scale is None else H @ by_scale
            self._learn(z, J, R + inflated(slip, SLIP_TIME, interval), to_scale)
        self._decide()

    @property
    def _slip(self) -> Array:
        """Covariance of slip, (2, 2), that does not contradict wheels: the nominal one, or more."""
        nominal = np.diag(self._settings.std**2)
        return np.clip(self.slip.covariance, nominal, LARGEST_SLIP**2 * nominal)

    def measurement(
        self, t_ns: int, nav: Array, rate_b: Array, interval: float, slip: Array
    ) -> NonHolonomic:
        """
        Return the constraint at a stamp [ns], for one every ``interval`` [s].

        ``slip`` is the covariance (2, 2) of the velocity across the nose [(m/s)²]. Its errors and
        those of the nose last: they are made to count as white.
        """
        z, J, _, along = self._innovation(nav, rate_b)
        swing = 0.0 if self._pitched is None else -z[1] / along - self._pitched
        R = inflated(J @ self._P @ J.T, NOSE_TIME, interval)
        R = R + inflated(slip, SLIP_TIME, interval)
        return NonHolonomic(t_ns, rate_b, self.nose, R, swing, J @ self._by_scale)

    def _innovation(self, nav: Array, rate_b: Array) -> tuple[Array, Array, Array, float]:
        """Innovation (2,), its derivatives by the nose (2, 4) and the state (2, 15), the speed."""
        nose = self.nose.squatting(nav)
        velocity_b, by_error = point_velocity(nav, rate_b, nose.point_b)
        axes, forward = nose.axes, nose.forward
        speed = float(forward @ velocity_b)
        J = np.zeros((2, 4))
        J[0, 0], J[1, 1] = -speed, speed
        J[:, 2] = axes @ cross(rate_b - nav[BIAS_G], forward)
        J[1, 3] = -speed * self.nose.acceleration(nav)
        H = axes @ by_error
        return -axes @ velocity_b, J, H, speed

    def _averaged(self, pitched: float, interval: float) -> float:
        """Return the mean of an angle [rad] over the last seconds."""
        before = pitched if self._pitched is None else self._pitched
        return before + interval / SPRING_TIME * (pitched - before)

    def _learn(self, z: Array, J: Array, R: Array, by_scale: Array) -> None:
        """Correct the nose by an innovation, whose derivative by scale errors is ``by_scale``."""
        K = np.linalg.solve(J @ self._P @ J.T + R, J @ self._P).T
        A = np.eye(len(self._P)) - K @ J
        self._P = A @ self._P @ A.T + K @ R @ K.T
        self._by_scale = A @ self._by_scale - K @ by_scale
        yaw, pitch, along, squat = K @ z
        nose = self.nose
        self.nose = Nose(
            nose.yaw + yaw,
            nose.pitch + pitch,
            nose.point_b + along * nose.forward,
            nose.squat + squat,
        )

    def _decide(self) -> None:
        """Set ``holds``."""
        if self.recent < BROKEN:
            if self.holds:
                self._to_turn = min(REPEATED * self._to_turn, MOST_TURNED)
            self.holds, self.turned = False, 0.0
            self.evidence = min(self.evidence, 0.0)
        elif self.recent > 0.0:
            shown = self.evidence > SHOWN and self.turned > self._to_turn
            shown = shown and max(self.sigma[:2]) < KNOWN
            self.holds = self.holds or shown


def _log_density(z: Array, S: Array) -> tuple[float, float]:
    """Return the logarithm of a normal density of z (2,), but for a constant, and the NIS."""
    (x, y), ((a, b), (_, c)) = z.tolist(), S.tolist()
    determinant = a * c - b * b
    nis = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
    return -0.5 * (nis + math.log(determinant)), nis


def _faded(total: float, gain: float, share: float) -> float:
    """Return evidence with what is new; the old fades."""
    total = total * math.exp(-share) + gain
    return max(-MOST_EVIDENCE, min(MOST_EVIDENCE, total))


def inflated(R: Array, time: float, interval: float) -> Array:
    """
    Return the covariance under which errors of a correlation time [s] may count as white.

    The mean of many has the same variance then.
    """
    decay = math.exp(-interval / time)
    return R * (1.0 + decay) / (1.0 - decay)
