"""The paper's observer: its equations, and what was chosen where it leaves something open."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from services.fusion.paper import PaperObserver, PaperSettings
from shared import geometry
from shared.geometry import perturb
from tests.fusion_data import HOME, SPREAD, VISION, ns


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
    assert geometry.axis_angle_error(a, estimate.T) < 1e-3
    assert estimate.state == "tracking"
    assert estimate.sources["vision"].weight + estimate.sources["haptic"].weight == pytest.approx(1.0)
    for k in range(100, 120):
        observer.measure("vision", ns(0.01 * k), a, VISION, hidden=0.9)
        observer.measure("haptic", ns(0.01 * k), b, 0.25 * VISION)
    hidden = observer.estimate(ns(1.195))
    assert hidden.T[0, 3] == pytest.approx(0.05, abs=1e-3)
    assert hidden.sources["haptic"].weight > 0.99


def test_the_papers_riccati_equation_settles_where_its_derivative_is_zero() -> None:
    settings = PaperSettings()
    observer = PaperObserver(HOME, SPREAD, settings)
    Q = settings.rate**2 * np.diag(settings.W_v)
    R = observer.R_v(0.7)
    P = np.diag(settings.W_v)
    for _ in range(2_000):
        P = observer._riccati(P, 2e-4, np.linalg.inv(R))
    np.testing.assert_allclose(Q, P @ np.linalg.inv(R) @ P, rtol=0.01, atol=1e-6)


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
