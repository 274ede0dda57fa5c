"""The paper's observer: its equations, and what was chosen where it leaves something open."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, expm, solve_continuous_are

from penumbra.services.fusion import paper
from penumbra.services.fusion.paper import SENSES, C, PaperObserver, PaperSettings
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import perturb
from penumbra.tests.support.fusion_data import HOME, SKIN, SPREAD, VISION, ns, without_roll


def test_the_papers_noise_of_vision_grows_with_what_is_hidden_and_has_a_floor() -> None:
    observer = PaperObserver(HOME, SPREAD)
    np.testing.assert_allclose(np.diag(observer.R_v(0.5)), 0.5 * np.array([8, 8, 8, 16 * np.pi, 16 * np.pi, 16 * np.pi]))
    sigma = np.sqrt(np.diag(observer.R_v(0.0)))
    np.testing.assert_allclose(sigma[0], 0.01)
    np.testing.assert_allclose(np.degrees(sigma[3]), 1.44, atol=0.01)


def test_the_papers_observer_converges_on_both_senses_weighted_by_the_inverse_of_their_noise() -> None:
    observer = PaperObserver(HOME, SPREAD)
    a, b = perturb(HOME, [0.03, 0, 0, 0, 0.1, 0]), perturb(HOME, [0.05, 0, 0, 0, 0.1, 0])
    for k in range(100):
        if k % 5 == 0:
            observer.measure("vision", ns(0.01 * k), a, VISION, hidden=0.0)
        observer.measure("haptic", ns(0.01 * k), b, 0.25 * VISION)  # (2 cm)^2, against the floor's (1 cm)^2
    estimate = observer.estimate(ns(0.995))
    assert estimate.T[0, 3] == pytest.approx(0.8 * 0.03 + 0.2 * 0.05, abs=1e-3)
    assert rigid.axis_angle_error(a, estimate.T) < 1e-3
    assert estimate.state == "tracking"
    assert estimate.sources["vision"].weight + estimate.sources["haptic"].weight == pytest.approx(1.0)
    for k in range(100, 120):
        observer.measure("vision", ns(0.01 * k), a, VISION, hidden=0.9)
        observer.measure("haptic", ns(0.01 * k), b, 0.25 * VISION)
    hidden = observer.estimate(ns(1.195))
    assert hidden.T[0, 3] == pytest.approx(0.05, abs=1e-3)
    assert hidden.sources["haptic"].weight > 0.99


def test_the_papers_gain_settles_at_that_of_the_algebraic_riccati_equation_of_both_senses() -> None:
    observer = PaperObserver(HOME, SPREAD)
    Q = observer.settings.rate**2 * np.diag(observer.settings.W_v)
    root = np.random.default_rng(0).normal(size=(6, 6))
    R = block_diag(observer.R_v(0.7), root @ root.T + np.eye(6))  # of the skin: any, with correlations
    expected = solve_continuous_are(np.zeros((6, 6)), C.T, Q, R)
    P = np.diag(observer.settings.W_v)
    for _ in range(4_000):
        P = observer._riccati(P, 2e-4, np.linalg.inv(R))
    np.testing.assert_allclose(P, expected, rtol=0.01, atol=0.002 * np.abs(expected).max())


def test_in_short_steps_the_papers_observer_is_the_printed_differential_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "STEP_S", 2e-4)
    settings = dataclasses.replace(PaperSettings(), velocity_time=1e9)  # u is not in the equations: it stays zero
    observer = PaperObserver(HOME, SPREAD, settings)
    seen = perturb(HOME, [0.03, -0.02, 0.01, 0.0, 0.0, 0.2])
    felt = perturb(HOME, [0.05, 0.01, -0.02, 0.0, 0.0, -0.1])
    observer.measure("vision", ns(0.0), seen, VISION, hidden=0.5)
    observer.measure("haptic", ns(0.0), felt, 4.0 * np.diag([1, 2, 3, 4, 5, 6]))
    (begin,) = observer._ahead
    y = np.concatenate([held.y for held in observer._held.values()])
    R_inverse = block_diag(*(held.R_inverse for held in observer._held.values()))
    Q = settings.rate**2 * np.diag(settings.W_v)

    def printed(_: float, state: np.ndarray) -> np.ndarray:
        x, P = state[:6], state[6:].reshape(6, 6)
        K = P @ C.T @ R_inverse
        return np.concatenate([K @ (y - C @ x), (Q - P @ C.T @ R_inverse @ C @ P).ravel()])

    solved = solve_ivp(printed, (0.0, 0.03), np.concatenate([begin.x, begin.P.ravel()]), rtol=1e-8, method="LSODA")
    found = observer._advanced(ns(0.03)).x
    way = np.abs(solved.y[:6, -1] - begin.x).max()
    assert way > 0.01
    np.testing.assert_allclose(found, solved.y[:6, -1], atol=0.02 * way)


def test_a_sense_that_has_nothing_to_say_leaves_its_rows_without_weight() -> None:
    observer = PaperObserver(HOME, SPREAD)
    observer.measure("haptic", ns(0.0), HOME, without_roll(HOME, SKIN))
    (state,) = observer._ahead
    y, R_inverse = observer._measured(state, ns(0.01))
    assert y.shape == (12,) and R_inverse.shape == (12, 12)
    assert not R_inverse[SENSES["vision"]].any()
    np.testing.assert_allclose(R_inverse[SENSES["haptic"], SENSES["haptic"]], without_roll(HOME, SKIN), rtol=1e-9)
    assert not observer._measured(state, ns(0.06))[1].any()  # held for 50 ms


def test_the_papers_low_pass_is_the_canonical_second_order_one() -> None:
    settings = PaperSettings()
    observer = PaperObserver(HOME, SPREAD, settings)
    observer.measure("vision", ns(0), HOME, VISION)
    (state,) = observer._ahead
    rng = np.random.default_rng(0)
    state = dataclasses.replace(state, smooth=rng.normal(size=6), rate=rng.normal(size=6))
    x, h = rng.normal(size=6), 0.007
    w, z = settings.omega_n, settings.zeta
    A = np.array([[0, 1, 0], [-w * w, -2 * z * w, w * w], [0, 0, 0]])  # s, its rate, and the input
    expected = expm(A * h) @ np.stack([state.smooth, state.rate, x])
    np.testing.assert_allclose(observer._low_pass(state, x, h), expected[:2], rtol=1e-9, atol=1e-9)
