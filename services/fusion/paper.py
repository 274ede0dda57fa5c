"""The paper's observer (section "Modified Luenberger-type Observer" and the two after it), kept as `--observer paper`.

Equations are named by their label in the paper, or by their section where they have none: x (6,) position and roll, pitch, yaw;
y, g, z (12,) and C (12, 6) of both senses, vision first; R (12, 12) = diag(R_v, R_c); G = K (6, 12); P, Q (6, 6).

Points that the paper leaves open or that cannot be done as printed, and what is done here:
- equ:luenberger_pose, y^ = g(x^) + n: the noise n(t) is unknown and left out.
- equ:luenberger_pose, "z in R^6": y has 12 entries, and so has z.
- equ:luenberger_pose, x has angles that wrap: z is taken modulo 2 pi. They are singular at a pitch of 90 degrees.
- equ:luenberger_pose has a gain G and equ:luenberger_estim a gain K, and the paper does not say that they are the same: G = K.
- f, g and u are "nonlinear" and not given: both senses report poses, g(x) = [x; x] and C = [I; I]; f(x, u) = u, a constant
  velocity, and so A = 0. Nothing measures u: it is the rate of x^, smoothed.
- Q is not given: Q = lambda^2 W_v, so that a fully hidden arm seen by the camera alone is followed with a rate of lambda. The
  table of results requires a fast one: out of the skin's range the fused error there equals the camera's.
- f_v sums m^ - m over all pixels, so that a mask too large elsewhere compensates for hidden parts, and divides by zero if the
  rendered mask is empty: here it is the share of m^ that is hidden, in [0, 1], as the search publishes it with every pose.
- R_v = f_v W_v is zero if nothing is hidden, which trusts the camera entirely: it has a floor of 1 cm and 1.4 degrees, the
  resolution of a camera at 1.5 m. R_v then grows by W_v = 8 m^2 and 16 pi rad^2, so that a hundredth of the arm hidden gives the
  camera a standard deviation of 28 cm: whenever the skin is in range it decides nearly alone. That is the paper's weighting, and
  is kept.
- R_c = f_c(x^, theta) by Gaussian-process regression: its inverse is the information of the haptic pose, with `penumbra haptics
  --method paper` that of the regression (`Regression` of services/haptics/paper_network.py). Along directions that the skin does
  not observe it is zero, and R_c infinite; so only R^-1 is used, never R, and a sense without information has a block of zeros.
- Continuous time, with measurements that arrive one by one: between two of them y moves on with u, and an old one is dropped.
  The Riccati equation is integrated by backward Euler in information form, stable for any step and gain; the low-pass exactly.
- Late measurements: a sense's older pose after a newer one is refused; y is not taken back to its stamp.
- P_0 is not given: W_v. P has no scale of its own, since that of Q and W_v is arbitrary. The published covariance follows from
  the senses' own covariances by the stationary weights of the two, and grows with their age.
- The paper has no gate: every measurement is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from penumbra.services.fusion.estimate import Array, Estimate, Limits, Log
from penumbra.shared.contract.messages import FusedPose, Source
from penumbra.shared.geometry import rigid

STEP_S = 0.01
"""Maximum step [s] of the integration. Chosen: the backward Euler step is stable for any."""
SENSES = {"vision": slice(0, 6), "haptic": slice(6, 12)}
"""Rows of y, g, z and C, and blocks of R: the paper's two senses. This observer uses no others, whatever the table contains."""
C = np.vstack([np.eye(6), np.eye(6)])
"""C = dg/dx (section "Modified Luenberger-type Observer"), (12, 6)."""


def f(x: Array, u: Array) -> Array:
    """f(x, u) (6,) of equ:luenberger_pose: a constant velocity u (6,)."""
    return u


def g(x: Array) -> Array:
    """g(x) (12,): the pose that vision and the skin would each measure."""
    return C @ x


@dataclass(frozen=True)
class PaperSettings:
    """Numbers of the paper's observer.

    W_v : noise of a fully hidden arm, position [m^2] and rotation [rad^2] (section "Numerical Simulation").
    omega_n, zeta : low-pass on the pose [rad/s] and its damping (the same section).
    floor : minimum hidden share: 1.25e-5 of W_v is (1 cm)^2 and (1.4 degrees)^2.
    rate : lambda [1/s] in Q = lambda^2 W_v: one camera period.
    velocity_time : time constant of the smoothing of u [s]. Chosen, not measured.
    hold : maximum age [s] at which a measurement is used, by sense: its delay and two of its periods.
    acceleration : density [m^2/s^3] and [rad^2/s^3] with which the published covariance grows with age. Chosen, not measured.
    """

    W_v: tuple[float, ...] = (8.0, 8.0, 8.0, 16 * np.pi, 16 * np.pi, 16 * np.pi)
    omega_n: float = 120 * np.pi
    zeta: float = float(np.sqrt(0.5))
    floor: float = 1.25e-5
    rate: float = 20.0
    velocity_time: float = 0.2
    hold: tuple[tuple[str, float], ...] = (("vision", 0.2), ("haptic", 0.05))
    acceleration: tuple[float, float] = (0.3, 2.0)
    limits: Limits = Limits()


@dataclass(frozen=True)
class _Held:
    """The newest measurement of one sense: y (6,), R^-1 (6, 6) and its covariance (6, 6), zero where it observes nothing."""

    stamp_ns: int
    y: Array
    R_inverse: Array
    covariance: Array


@dataclass(frozen=True)
class _State:
    """x^ (6,), P (6, 6), u (6,), and the low-pass: its output (6,) and the output's rate (6,)."""

    stamp_ns: int
    x: Array
    P: Array
    u: Array
    smooth: Array
    rate: Array


class PaperObserver:
    """The paper's equations with the interface of `observer.ErrorStateObserver`."""

    def __init__(self, home: rigid.Array, spread: tuple[float, float], settings: PaperSettings | None = None):
        self.settings = settings or PaperSettings()
        self.log = Log(SENSES)
        self._home = home
        self._home_covariance = np.diag(np.repeat(np.square(spread), 3))
        self._W_v = np.diag(self.settings.W_v)
        self._Q = self.settings.rate**2 * self._W_v
        self._nobody = np.linalg.inv(1e3 * self._W_v)  # R^-1 of a sense with almost no information
        self._hold_ns = {source: int(1e9 * seconds) for source, seconds in self.settings.hold}
        self.forget()

    def forget(self) -> None:
        """Starts over; the counts continue."""
        self._held: dict[str, _Held] = {}
        self._ahead: list[_State] = []  # the state at the newest measurement, and those ahead of it, as far as requested
        self._covariance = self._home_covariance
        self._weights: dict[str, float] = {}
        self.log.first_ns.clear()

    def measure(
        self,
        source: str,
        stamp_ns: int,
        T: Array,
        information: Array,
        hidden: float | None = None,
        now_ns: int | None = None,
        step: Array | None = None,
    ) -> bool:
        """Takes a pose T (4, 4) with its information (6, 6). True if it is newer than the one before of this source.

        source : `vision` (R_v from the share `hidden`) or `haptic` (R_c from the information). `step` is not used. Raises
        RefusedMeasurement, which is counted, for a pose that is no rigid transform, an information that is not symmetric and
        positive semi-definite, and a stamp ahead of the reader's clock `now_ns` (if given); ValueError for an unknown source.
        """
        T, information = self.log.admitted(source, stamp_ns, T, information, now_ns)
        before = self._held.get(source)
        if before is not None and stamp_ns <= before.stamp_ns:
            self.log.counts[source].late += 1
            return False
        y = _pose(T)
        B = _rates(y)
        R_c_inverse = B.T @ information @ B
        R_inverse = np.linalg.inv(self.R_v(hidden or 0.0)) if source == "vision" else R_c_inverse
        held = _Held(stamp_ns, y, R_inverse, np.linalg.pinv(R_c_inverse, rcond=1e-9, hermitian=True))
        if not self._ahead or stamp_ns - self._newest_ns() > self.settings.limits.lost_age * 1e9:
            # P(t_0) = P_0: only home is known; the first step moves x^ to the measurement
            x = _pose(self._home)
            self._held = {source: held}
            self._ahead = [_State(stamp_ns - int(STEP_S * 1e9), x, self._W_v, np.zeros(6), x, np.zeros(6))]
            state = self._advanced(stamp_ns)
            state = replace(state, u=np.zeros(6), smooth=state.x, rate=np.zeros(6))
        else:
            state = self._advanced(stamp_ns)
            self._held[source] = held
        self._ahead = [state]
        self._weigh()
        self.log.counts[source].accepted += 1
        return True

    def deny(self, source: str, stamp_ns: int, now_ns: int | None = None) -> None:
        """Notes that the sense runs: to the paper's observer, a sense that does not see the target says nothing."""
        self.log.received(source, stamp_ns)

    def adopt(self, message: FusedPose) -> None:
        """Does nothing: the paper's state is bound to the measurements in use, so that it waits for its own."""

    def estimate(self, stamp_ns: int) -> Estimate:
        """The pose at a stamp, not before the newest measurement. Does not change later estimates."""
        sources = {}
        for name, since_ns in self.log.first_ns.items():
            newest_ns = self._held[name].stamp_ns if name in self._held else since_ns
            in_use = name in self._held and stamp_ns - newest_ns <= self._hold_ns[name]
            sources[name] = Source(max(0.0, (stamp_ns - newest_ns) * 1e-9), self._weights.get(name, 0.0) if in_use else 0.0)
        if not self._ahead:
            return Estimate(self._home, np.zeros(6), self._home_covariance, "lost", sources)
        state = self._advanced(stamp_ns)
        B = _rates(state.smooth)
        age_s = (stamp_ns - self._newest_ns()) * 1e-9
        growth = np.repeat(self.settings.acceleration, 3) * max(0.0, age_s) ** 3 / 3.0
        covariance = B @ self._covariance @ B.T + np.diag(growth)
        velocity = np.concatenate([state.u[:3], B[3:, 3:] @ state.u[3:]])
        return Estimate(_transform(state.smooth), velocity, covariance, self.settings.limits.state(age_s, covariance), sources)

    @property
    def earliest_ns(self) -> int:
        """The first stamp for which the pose is known: that of the newest measurement."""
        return self._newest_ns() if self._held else 0

    def R_v(self, hidden: float) -> Array:
        """R_v (6, 6) = f_v W_v for the hidden share f_v in [0, 1] of the arm, with a floor (section "Integration of Perception
        Methods")."""
        return max(hidden, self.settings.floor) * self._W_v

    def _newest_ns(self) -> int:
        return max(held.stamp_ns for held in self._held.values())

    def _in_use(self, stamp_ns: int) -> dict[str, _Held]:
        return {name: held for name, held in self._held.items() if stamp_ns - held.stamp_ns <= self._hold_ns[name]}

    def _advanced(self, stamp_ns: int) -> _State:
        """The state at a stamp, in steps of STEP_S while a measurement is in use; not before the newest measurement."""
        begin_ns, step_ns = self._ahead[0].stamp_ns, int(STEP_S * 1e9)
        end_ns = min(stamp_ns, max(held.stamp_ns + self._hold_ns[name] for name, held in self._held.items()))
        while self._ahead[-1].stamp_ns + step_ns <= end_ns:
            self._ahead.append(self._step(self._ahead[-1], self._ahead[-1].stamp_ns + step_ns))
        state = self._ahead[max(0, end_ns - begin_ns) // step_ns]
        if end_ns > state.stamp_ns:
            state = self._step(state, end_ns)
        if stamp_ns <= state.stamp_ns:
            return state
        h = (stamp_ns - state.stamp_ns) * 1e-9  # no measurement in use: x^ moves on with u, which decays
        decay = float(np.exp(-h / self.settings.velocity_time))
        x = state.x + self.settings.velocity_time * (1.0 - decay) * state.u
        smooth, rate = self._low_pass(state, x, h)
        return _State(stamp_ns, x, self._riccati(state.P, h, np.zeros((12, 12))), decay * state.u, smooth, rate)

    def _measured(self, state: _State, stamp_ns: int) -> tuple[Array, Array]:
        """y (12,) and R^-1 (12, 12) at a stamp; zeros for a sense that is not in use."""
        y, R_inverse = np.zeros(12), np.zeros((12, 12))
        for name, held in self._in_use(stamp_ns).items():
            rows = SENSES[name]
            y[rows] = held.y + (stamp_ns - held.stamp_ns) * 1e-9 * state.u
            R_inverse[rows, rows] = held.R_inverse  # R = diag(R_v, R_c), equ:luenberger_estim
        return y, R_inverse

    def _riccati(self, P: Array, h: float, R_inverse: Array) -> Array:
        """P (6, 6) after a step h [s] of equ:luenberger_estim, dP/dt = A P + P A' + Q - P C' R^-1 C P with A = df/dx = 0.

        A sense with almost no information keeps P bounded if no other does.
        """
        P = np.linalg.inv(P + h * self._Q)
        P = np.linalg.inv(P + h * (C.T @ R_inverse @ C) + h * self._nobody)
        return 0.5 * (P + P.T)

    def _step(self, state: _State, stamp_ns: int) -> _State:
        settings = self.settings
        h = (stamp_ns - state.stamp_ns) * 1e-9
        y, R_inverse = self._measured(state, stamp_ns)
        P = self._riccati(state.P, h, R_inverse)
        G = P @ C.T @ R_inverse  # K = P C' R^-1, equ:luenberger_estim
        x = state.x + h * f(state.x, state.u)
        z = _wrapped(y - g(x))  # z = y - y^, equ:luenberger_pose
        x = x + h * (G @ z)  # dx^/dt = f(x^, u) + G z, equ:luenberger_pose
        share = 1.0 - np.exp(-h / settings.velocity_time)
        u = state.u + share * ((x - state.x) / h - state.u)
        smooth, rate = self._low_pass(state, x, h)
        turns = x - _wrapped(x)  # whole turns, subtracted from the pose and from its low-pass
        return _State(stamp_ns, x - turns, P, u, smooth - turns, rate)

    def _low_pass(self, state: _State, x: Array, h: float) -> tuple[Array, Array]:
        """The canonical second-order low-pass (section "Modified Luenberger-type Observer") over a step h with x held: output
        (6,) and its rate (6,) of s'' + 2 zeta omega_n s' + omega_n^2 s = omega_n^2 x."""
        damping = self.settings.zeta * self.settings.omega_n
        omega = self.settings.omega_n * np.sqrt(1.0 - self.settings.zeta**2)
        a = state.smooth - x
        b = (state.rate + damping * a) / omega
        c, s = np.exp(-damping * h) * np.array([np.cos(omega * h), np.sin(omega * h)])
        return x + a * c + b * s, (omega * b - damping * a) * c - (omega * a + damping * b) * s

    def _weigh(self) -> None:
        """Computes covariance and weights of the senses in use, from the shares of their R^-1 in the stationary solution."""
        in_use = self._in_use(self._newest_ns())
        gather = np.linalg.inv(sum((held.R_inverse for held in in_use.values()), start=self._nobody))
        shares = {name: gather @ held.R_inverse for name, held in in_use.items()}
        rest = gather @ self._nobody
        covariance = rest @ self._home_covariance @ rest.T
        for name, held in in_use.items():
            covariance = covariance + shares[name] @ held.covariance @ shares[name].T
        self._covariance = covariance
        traces = {name: float(np.trace(share)) for name, share in shares.items()}
        self._weights = {name: trace / sum(traces.values()) for name, trace in traces.items()}


def _pose(T: Array) -> Array:
    """x (6,) of a transform: position and roll, pitch, yaw about the fixed axes."""
    R = T[:3, :3]
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return np.array([*T[:3, 3], np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def _transform(x: Array) -> rigid.Array:
    return rigid.from_rpy(x[:3], x[3:])


def _wrapped(x: Array) -> Array:
    """x (6,), or z (12,), with its angles within (-pi, pi]."""
    x = x.reshape(-1, 6).copy()
    x[:, 3:] = np.pi - np.mod(np.pi - x[:, 3:], 2.0 * np.pi)
    return x.ravel()


def _rates(x: Array) -> Array:
    """B (6, 6): maps a small change of x to a pose error (translation, rotation vector about fixed axes)."""
    about_y, about_z = rigid.rotation((0.0, x[4], 0.0)), rigid.rotation((0.0, 0.0, x[5]))
    B = np.eye(6)
    B[3:, 3] = about_z @ about_y[:, 0]
    B[3:, 4] = about_z[:, 1]
    return B
