"""The arithmetic of the default observer: an error-state Kalman filter that knows that the errors of a sense last.

State: position p, rotation R, linear and angular velocity, and a bias of every sense. Errors are along fixed axes, the rotation's
applied from the left (`shared.geometry.perturb`). Velocities are constant but for white acceleration, and slowly forgotten.

A sense is wrong by nearly the same amount from one measurement to the next: a mask a pixel too large is a forearm 2 cm too near
for as long as nobody moves. A filter that takes 100 such measurements a second for independent believes in a tenth of the error
that they have, and then no longer listens to the other sense. So the error of every measurement is split: a share `lasting` of
its variance belongs to the sense's bias, a first-order Gauss-Markov process that the filter estimates, the rest is white. The
bias is kept in units of the measurement's own standard deviation, which changes with distance and occlusion: a measurement of
covariance L L' reads pose + sqrt(lasting) L bias + white noise.

Two numbers are learned from the innovations on the way, both from whether each resembles the one before of the same sense.
Innovations that resemble each other mean that the filter lags behind the limb: more process noise. Innovations that are too large
and do not resemble each other mean that the sense is noisier than it says: less belief in it, never more than it asks for.

Sources: error-state filter on SO(3): Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), arXiv:1711.02508;
coloured measurement noise by state augmentation: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation" (2001), sections 8.2 and 8.3, DOI 10.1002/0471221279; correlation of innovations as the sign of a wrong process
noise: Mehra, "On the identification of variances and adaptive Kalman filtering" (1970), DOI 10.1109/TAC.1970.1099422.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import gammaincinv

from services.fusion import so3
from services.fusion.estimate import SOURCES, Array, Limits

POSE, MOTION = 6, 12  # sizes of the pose, and of the pose with its velocities, within the state
UNITS = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
"""Units [m, rad] in which translations and rotations compare: a turn by 1 rad moves the ends of a forearm by about 10 cm."""


@dataclass(frozen=True)
class Sense:
    """What is known of the errors of one sense.

    lasting : share of the variance that is the same from one measurement to the next.
    time_constant : after which such an error is forgotten [s].
    floor : standard deviation that no measurement is better than, in UNITS: 0.01 is 1 mm and 0.6 degrees.
    """

    lasting: float = 0.8
    time_constant: float = 1.0
    floor: float = 0.01


@dataclass(frozen=True)
class Settings:
    """Numbers of the filter, with the reasons for their defaults.

    senses : see Sense. A mask's bias lasts for as long as the limb rests. The skin's windows share no samples and its voltages'
        noise is white: measured on the emulator, a fifth of the variance is the response model's and lasts.
    acceleration : density of the white acceleration, linear [m^2/s^3] and angular [rad^2/s^3]: an arm that reaches 0.25 m/s.
    velocity_time : after which a velocity is forgotten [s]: limbs reach to places and stop there.
    velocity_spread : standard deviation of an unknown velocity, linear [m/s] and angular [rad/s].
    agility : bounds of the factor on `acceleration` that is learned: from a resting arm to a hand at 2 m/s.
    doubt : largest factor on the covariance of a sense that is learned.
    learning : step of both per measurement, at most, and per second.
    gate : probability with which a good measurement passes the gate.
    patience : after refusing everything of all senses for so long [s], start again from the newest measurement.
    source_patience : after refusing one sense for so long [s] while another is believed, doubt the state.
    refusals : and at least so many measurements refused, so that two outliers after a pause do not count as persistence.
    unobserved : a direction with a standard deviation beyond this, in UNITS, is taken as not observed.
    horizon : length of the history [s]: vision is 30 to 100 ms late, more when the machine is busy.
    weight_time : over which a source's weight remembers [s].
    """

    senses: dict[str, Sense] = field(default_factory=lambda: {"vision": Sense(), "haptic": Sense(lasting=0.2, time_constant=0.3)})
    acceleration: tuple[float, float] = (0.15, 1.0)
    velocity_time: float = 1.0
    velocity_spread: tuple[float, float] = (0.4, 1.0)
    agility: tuple[float, float] = (0.2, 30.0)
    doubt: float = 100.0
    learning: tuple[float, float] = (0.1, 5.0)
    gate: float = 0.999
    patience: float = 0.5
    source_patience: float = 1.0
    refusals: int = 5
    unobserved: float = 2.0
    horizon: float = 1.0
    weight_time: float = 0.5
    limits: Limits = Limits()


@dataclass(frozen=True)
class Measurement:
    """One pose of one sense, reduced to the k directions that it observes.

    key : stamp [ns] and source.
    T : the pose (4, 4).
    directions : their unit vectors (6, k), in UNITS.
    basis : (k, 6); `basis @ error` has independent entries with standard deviations `sigma` (k,).
    axis : the axis (3,) about which a rotation is not observed (the limb's, where the sense does not see its roll), or None.
    slides : whether a translation is not observed (along the limb, where the sense sees neither of its ends).
    """

    key: tuple[int, str]
    T: Array
    directions: Array
    basis: Array
    sigma: Array
    axis: Array | None
    slides: bool

    @property
    def rank(self) -> int:
        return len(self.sigma)


@dataclass(frozen=True)
class Record:
    """One sense as the filter knows it.

    heard_ns, accepted_ns : stamps of its last measurement and of the last accepted one.
    refused, refused_ns : how many were refused since, and the stamp of the first of them.
    gain : the information that it brought [nats], fading: by how much it made the logarithm of the volume of the pose's
        uncertainty smaller. It counts what was new: the hundredth measurement with the same error brings next to nothing.
    doubt : learned factor on its covariance.
    innovation : its last one (6,), in units of its standard deviation.
    """

    heard_ns: int
    accepted_ns: int | None = None
    refused: int = 0
    refused_ns: int | None = None
    gain: float = 0.0
    doubt: float = 1.0
    innovation: Array | None = None


@dataclass(frozen=True)
class State:
    """The filter after one measurement.

    P : covariance (n, n) of the errors of position, rotation, linear velocity, angular velocity, and the bias of each sense.
    accepted_ns : stamp of the last accepted measurement of any sense.
    agility : learned factor on the process noise.
    passed : whether the last measurement was accepted.
    """

    stamp_ns: int
    p: Array
    R: Array
    velocity: Array
    bias: Array
    P: Array
    senses: dict[str, Record]
    accepted_ns: int
    agility: float = 1.0
    passed: bool = True


class Filter:
    """From one state to the next, with nothing remembered in between."""

    def __init__(self, settings: Settings, home: Array, home_covariance: Array):
        self.settings = settings
        self.home, self.home_covariance = home, home_covariance
        self.bias_of = {name: slice(MOTION + POSE * i, MOTION + POSE * (i + 1)) for i, name in enumerate(SOURCES)}
        self.size = MOTION + POSE * len(SOURCES)
        self.forget = np.repeat([1.0 / settings.senses[name].time_constant for name in SOURCES], POSE)
        self.density = np.repeat(settings.acceleration, 3)
        self.threshold = [2.0 * gammaincinv(0.5 * max(k, 1), settings.gate) for k in range(POSE + 1)]  # chi-square quantiles

    def measurement(self, source: str, stamp_ns: int, T: Array, information: Array) -> Measurement:
        """A pose with its information (6, 6), made ready for `step`."""
        eigenvalues, vectors = np.linalg.eigh(information * np.outer(UNITS, UNITS))
        observed = eigenvalues > max(self.settings.unobserved**-2, 1e-9 * eigenvalues[-1])
        directions = vectors[:, observed]
        sigma = np.sqrt(1.0 / eigenvalues[observed] + self.settings.senses[source].floor ** 2)
        weakest, axes = np.linalg.eigh(directions[3:] @ directions[3:].T)
        axis = axes[:, 0] if weakest[0] < 1e-3 else None
        slides = bool(np.linalg.eigvalsh(directions[:3] @ directions[:3].T)[0] < 1e-3)
        return Measurement((stamp_ns, source), T, directions, directions.T / UNITS, sigma, axis, slides)

    def step(self, state: State | None, m: Measurement) -> State:
        """The state after a measurement: predicted to its stamp, and updated unless the gate refuses it."""
        stamp_ns, source = m.key
        settings = self.settings
        if state is None or stamp_ns - state.accepted_ns > settings.limits.lost_age * 1e9:
            return self.start(m, self.home, self.home_covariance)
        state = self.predicted(state, stamp_ns)
        z, H = self.linearised(state, m)
        PHt, S_inverse, innovation = self.innovation(state, z, H, m)
        distance = float(innovation @ innovation)
        state = self.learnt(state, m, innovation)
        if distance > self.threshold[m.rank]:
            before = state.senses[source]
            record = replace(before, refused=before.refused + 1, refused_ns=before.refused_ns or stamp_ns)
            state = replace(state, senses=state.senses | {source: record}, passed=False)
            if self._is_blind(state):
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = state.R, state.p
                return self.start(m, T, state.P[:POSE, :POSE] + self.home_covariance)
            if record.refused < settings.refusals or stamp_ns - (record.refused_ns or 0) < settings.source_patience * 1e9:
                return state
            # So long a disagreement is no outlier: one of the senses is biased beyond its covariance, nobody knows which.
            state = replace(state, P=state.P * (distance / m.rank))
            PHt, S_inverse, _ = self.innovation(state, z, H, m)
        return self.updated(state, m, z, PHt, S_inverse)

    def _is_blind(self, state: State) -> bool:
        """Whether everything of all senses has been refused for so long that the state must be wrong."""
        refused = [record for record in state.senses.values() if record.refused_ns is not None]
        first_ns = min(record.refused_ns or 0 for record in refused)
        blind_ns = state.stamp_ns - max(state.accepted_ns, first_ns)
        return blind_ns >= self.settings.patience * 1e9 and sum(r.refused for r in refused) >= self.settings.refusals

    def start(self, m: Measurement, T: Array, covariance: Array) -> State:
        """A new state from one measurement; along what it does not observe, from the pose T (4, 4) with its covariance (6, 6)."""
        p, R = T[:3, 3].copy(), T[:3, :3].copy()
        for _ in range(5):  # Gauss-Newton on the observed directions; one step does where all are observed
            value, _ = self.error(p, R, m)
            correction = UNITS * (m.directions @ value)
            p, R = p - correction[:3], so3.exp(-correction[3:]) @ R
        wide = np.eye(POSE) + 9.0 * (UNITS[:, None] * m.directions) @ m.basis  # where it observes, the measurement decides
        P = np.eye(self.size)
        P[:POSE, :POSE] = wide @ covariance @ wide.T
        P[POSE:MOTION, POSE:MOTION] = np.diag(np.repeat(np.square(self.settings.velocity_spread), 3))
        stamp_ns, source = m.key
        zero = np.zeros(self.size - POSE)
        state = State(stamp_ns, p, R, zero[:POSE], zero[POSE:], P, {source: Record(stamp_ns)}, stamp_ns)
        z, H = self.linearised(state, m)
        PHt, S_inverse, _ = self.innovation(state, z, H, m)
        return self.updated(state, m, z, PHt, S_inverse)

    def moved(self, state: State, dt: float) -> tuple[Array, Array, Array]:
        """Position (3,), rotation (3, 3) and velocity (6,) after dt [s]."""
        tau = self.settings.velocity_time
        reach = -tau * np.expm1(-dt / tau)
        return (
            state.p + reach * state.velocity[:3],
            so3.exp(reach * state.velocity[3:]) @ state.R,
            np.exp(-dt / tau) * state.velocity,
        )

    def transition(self, state: State, dt: float) -> tuple[Array, Array]:
        """Transition F and process noise Q (12, 12) of the motion over dt [s]: an integrated Ornstein-Uhlenbeck velocity."""
        tau = self.settings.velocity_time
        decay, reach, twice = np.exp(-dt / tau), -tau * np.expm1(-dt / tau), -0.5 * tau * np.expm1(-2.0 * dt / tau)
        turn = reach * state.velocity[3:]
        i = np.arange(POSE)
        F = np.eye(MOTION)
        F[3:6, 3:6] = so3.exp(turn)
        F[i, i + 6] = reach
        F[3:6, 9:12] += 0.5 * reach * so3.hat(turn)  # left Jacobian to first order
        F[i + 6, i + 6] = decay
        density = state.agility * self.density
        Q = np.zeros((MOTION, MOTION))
        Q[i, i] = density * max(0.0, tau**2 * (dt - 2.0 * reach + twice))
        Q[i, i + 6] = Q[i + 6, i] = density * 0.5 * reach**2
        Q[i + 6, i + 6] = density * twice
        return F, Q

    def predicted(self, state: State, stamp_ns: int) -> State:
        """The state at a later stamp."""
        dt = (stamp_ns - state.stamp_ns) * 1e-9
        p, R, velocity = self.moved(state, dt)
        F, Q = self.transition(state, dt)
        keep = np.exp(-self.forget * dt)
        P = np.empty_like(state.P)
        P[:MOTION, :MOTION] = F @ state.P[:MOTION, :MOTION] @ F.T + Q
        P[:MOTION, MOTION:] = F @ state.P[:MOTION, MOTION:] * keep
        P[MOTION:, :MOTION] = P[:MOTION, MOTION:].T
        P[MOTION:, MOTION:] = state.P[MOTION:, MOTION:] * np.outer(keep, keep) + np.diag(1.0 - keep**2)
        fade = float(np.exp(-dt / self.settings.weight_time))
        senses = {name: replace(record, gain=fade * record.gain) for name, record in state.senses.items()}
        return replace(state, stamp_ns=stamp_ns, p=p, R=R, velocity=velocity, bias=keep * state.bias, P=P, senses=senses)

    def error(self, p: Array, R: Array, m: Measurement) -> tuple[Array, Array]:
        """The error of a pose p (3,), R (3, 3) along the directions of a measurement (k,), and its derivative (k, 6) by the pose.

        What is not observed belongs to the limb and turns with it: the roll about its axis, the way along it. Were the directions
        those at the measured pose, their noise would let information leak into what nobody observes; so they are turned to the
        pose in question. A roll that is made up, however large, says nothing (swing-twist decomposition).
        """
        turn = R @ m.T[:3, :3].T
        if m.axis is None:
            rotation = so3.log(turn)
            jacobian = so3.left_jacobian_inverse(rotation)
        else:
            rotation = so3.swing(m.axis, turn @ m.axis)
            jacobian = so3.exp(-rotation)
        derivative = m.basis.copy()
        derivative[:, 3:] = m.basis[:, 3:] @ jacobian
        if m.slides:
            derivative[:, :3] = m.basis[:, :3] @ so3.exp(-rotation)
        return derivative[:, :3] @ (p - m.T[:3, 3]) + m.basis[:, 3:] @ rotation, derivative

    def linearised(self, state: State, m: Measurement) -> tuple[Array, Array]:
        """Innovation z (k,) and its derivative H (k, n) by the state, the white noise left out.

        A measurement says: the error e with `perturb(T_measured, e) == T_true` is noise along its directions.
        """
        source = m.key[1]
        lasting = self._doubt(state, source) * self.settings.senses[source].lasting
        bias = np.sqrt(lasting) * m.sigma[:, None] * m.directions.T
        H = np.zeros((m.rank, self.size))
        value, H[:, :POSE] = self.error(state.p, state.R, m)
        H[:, self.bias_of[source]] = bias
        offset = self.bias_of[source].start - MOTION
        return -value - bias @ state.bias[offset : offset + POSE], H

    def innovation(self, state: State, z: Array, H: Array, m: Measurement) -> tuple[Array, Array, Array]:
        """P H' (n, k), the inverse of the innovation's covariance (k, k), and the innovation (6,) in units of its standard
        deviation, zero where the measurement sees nothing; its square is the squared Mahalanobis distance."""
        source = m.key[1]
        PHt = state.P @ H.T
        white = self._doubt(state, source) * (1.0 - self.settings.senses[source].lasting) * m.sigma**2
        eigenvalues, vectors = np.linalg.eigh(H @ PHt + np.diag(white))
        root = vectors / np.sqrt(eigenvalues)  # S^-1/2 is symmetric, so that innovations of different directions compare
        return PHt, root @ root.T, m.directions @ (vectors @ (root.T @ z))

    def _doubt(self, state: State, source: str) -> float:
        return state.senses[source].doubt if source in state.senses else 1.0

    def learnt(self, state: State, m: Measurement, innovation: Array) -> State:
        """The state with agility and doubt adapted to an innovation (6,)."""
        stamp_ns, source = m.key
        settings = self.settings
        length = float(np.sqrt(innovation @ innovation / m.rank))
        innovation = innovation * min(1.0, 2.0 / max(length, 1e-9))  # an outlier teaches no more than two sigma do
        record = state.senses.get(source, Record(stamp_ns))
        agility, doubt = state.agility, record.doubt
        if record.innovation is not None:
            step = min(settings.learning[0], settings.learning[1] * (stamp_ns - record.heard_ns) * 1e-9)
            alike = float(innovation @ record.innovation) / m.rank  # 0 expected
            unlike = float(innovation @ innovation) / m.rank - alike  # 1 expected
            agility = float(np.clip(agility * np.exp(step * alike), *settings.agility))
            doubt = float(np.clip(doubt * np.exp(step * (unlike - 1.0)), 1.0, settings.doubt))
        record = replace(record, heard_ns=stamp_ns, doubt=doubt, innovation=innovation)
        return replace(state, senses=state.senses | {source: record}, agility=agility)

    def updated(self, state: State, m: Measurement, z: Array, PHt: Array, S_inverse: Array) -> State:
        """The state after an accepted measurement."""
        stamp_ns, source = m.key
        K = PHt @ S_inverse
        dx = K @ z
        P = state.P - K @ PHt.T
        turn = so3.exp(dx[3:6])
        if m.rank < POSE:  # what is not observed turns with the limb: see `error`
            for axes in (slice(3, 6), slice(9, 12)):
                P[axes] = turn @ P[axes]
                P[:, axes] = P[:, axes] @ turn.T
        P = 0.5 * (P + P.T)
        volume = np.linalg.slogdet(state.P[:POSE, :POSE])[1] - np.linalg.slogdet(P[:POSE, :POSE])[1]
        record = state.senses[source]
        record = replace(record, accepted_ns=stamp_ns, refused=0, refused_ns=None, gain=record.gain + 0.5 * float(volume))
        return replace(
            state,
            p=state.p + dx[:3],
            R=so3.orthonormal(turn @ state.R),
            velocity=state.velocity + dx[POSE:MOTION],
            bias=state.bias + dx[MOTION:],
            P=P,
            senses=state.senses | {source: record},
            accepted_ns=stamp_ns,
            passed=True,
        )
