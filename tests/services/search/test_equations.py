"""The normal equations of a contour beside the same worked out in full: errors that all of it shares, and the limb's roll."""

import numpy as np
import pytest

from penumbra.services.search import contour, evidence
from penumbra.services.search.contour import MEASURED, SECTION, SHAPE, normal_equations, slow_waves, turned
from penumbra.services.search.mask_fit import KEPT, Limits, marginal
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.intrinsics import Intrinsics

CELL = description.load("table")
MODEL = contour.Model(anatomy.target_mesh(CELL.targets["forearm"], CELL))
K = Intrinsics(600.0, 600.0, 320.0, 240.0)
T = rigid.from_rpy([0.05, -0.02, 1.2], [0.4, 0.5, 0.3])
AXIS = T[:3, 0]


@pytest.fixture(scope="module")
def points():
    labels = MODEL.silhouette(T, K, (0, 0, 640, 480)) * np.uint8(Label.FOREARM)
    seen = evidence.gather(evidence.classify(labels, [Label.FOREARM]), labels, K)
    return MODEL.matched(T, seen, 3.0, 8.0).points


def derivatives(points, solving):
    """Of each offset by pose error and dilation (n, 7): the right side of a point alone."""

    def row(i):
        one = points[i : i + 1]
        kind = np.full(1, MEASURED, np.uint8)
        return normal_equations(one, np.ones(1), kind, np.ones(1), T[:3, 3], AXIS, K.fx, K.fy, np.inf, solving).g

    return np.array([row(i) for i in range(len(points))])


def test_errors_that_the_offsets_share_are_weighed_as_the_noise_that_they_are(points):
    rng = np.random.default_rng(1)
    n, limits = len(points), Limits()
    weights, r = rng.uniform(0.5, 4.0, n), rng.normal(0.0, 0.3, n)
    shared = [0.4 * wave for wave in slow_waves(points, T)]
    regular, moved = np.diag([1e3, 2e3, 500.0, 40.0, 30.0, 20.0, 9.0]), 0.01 * rng.standard_normal(7)
    found = normal_equations(
        points, r, np.full(n, MEASURED, np.uint8), weights, T[:3, 3], AXIS, K.fx, K.fy, np.inf, False, shared
    )
    T_found, covariance = marginal(T, moved, found.H, found.g, regular, limits)

    J = derivatives(points, solving=False)
    noise = np.diag(1.0 / weights) + sum(np.outer(error, error) for error in shared)
    dilation = np.outer(J[:, 6], J[:, 6]) / regular[6, 6]  # of which -moved is expected
    weak = (1.0 - KEPT) * limits.information + KEPT * regular[:6, :6]
    W = np.linalg.inv(noise + dilation)
    expected = np.linalg.inv(J[:, :6].T @ W @ J[:, :6] + weak)
    offset = expected @ (J[:, :6].T @ W @ (r + moved[6] * J[:, 6]) - weak @ moved[:6])
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(T_found, rigid.perturb(T, offset), atol=1e-9)


def test_a_lever_that_is_shorter_than_the_mesh_is_right_says_nothing_of_the_roll(points):
    every, long = (derivatives(points, solving)[:, 3:6] @ AXIS for solving in (True, False))
    shortest = SHAPE * K.fx / points["position"][:, 2]
    np.testing.assert_allclose(long, np.sign(every) * np.maximum(np.abs(every) - shortest, 0.0), atol=1e-9)
    assert (np.abs(long) < 1e-9).any() and (np.abs(long) > 1.0).any()
    sure, unsure = (turned(points, T, K, np.eye(6) / sd**2) for sd in (0.1 * SECTION, 3.0 * SECTION))
    np.testing.assert_allclose(sure, SECTION * (every - long), atol=1e-9)
    np.testing.assert_allclose(unsure, 3.0 * SECTION * (every - long), atol=1e-9)


def test_the_other_directions_are_measured_by_every_lever(points):
    across = np.eye(7)[:, [0, 1, 2, 6]]
    np.testing.assert_array_equal(derivatives(points, True) @ across, derivatives(points, False) @ across)
