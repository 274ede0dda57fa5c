"""First poses from landmarks: of arms with straight and bent wrists, with and without an elbow."""

import numpy as np
import pytest

from penumbra.services.search import starter
from penumbra.shared.cell.description import Body, Camera, Placement, Size, Target
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.limbs import KNUCKLES, Limb

CAMERA = Camera(
    width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0, rate_hz=20, position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)
)
BODY = Body()


def seen(T: np.ndarray, rng: np.random.Generator, bent: tuple[float, float] = (0.0, 0.0), has_elbow: bool = True) -> Limb:
    """Landmarks of an arm at T_camera_target, off by a tenth of the hand, its elbow by three."""
    half = BODY.forearm_length / 2.0
    across = np.array(starter.ACROSS) * BODY.hand_breadth
    hand = np.column_stack([np.full(4, starter.TO_KNUCKLES * BODY.hand_length), across, np.zeros(4)])
    hand = hand @ rigid.rotation((0.0, bent[0], 0.0)).T @ rigid.rotation((0.0, 0.0, bent[1])).T + (half, 0.0, 0.0)
    points = rigid.apply(T, np.vstack([(half, 0.0, 0.0), hand, (-half, 0.0, 0.0)]))
    pixels = points[:, :2] / points[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
    size = np.linalg.norm(pixels[1:5].mean(0) - pixels[0])
    pixels = pixels + rng.normal(size=pixels.shape) * size * np.array([0.1] * 5 + [0.3])[:, None]
    marks = np.zeros((21, 2))
    marks[0], marks[list(KNUCKLES)] = pixels[0], pixels[1:5]
    return Limb(marks, pixels[5] if has_elbow else None)


def drawn(rng: np.random.Generator) -> np.ndarray:
    """An arm before the camera that points less than 50 degrees to it or away."""
    while True:
        q = rng.normal(size=4)
        T = rigid.transform((rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.7, 1.6)), q / np.linalg.norm(q))
        if abs(T[2, 0]) < 0.77:
            return T


def errors(T: np.ndarray, found: list[starter.Start]) -> tuple[float, float]:
    """Of the best of the first four: the angle [rad] between the axes, and the error of the depth as a share of it."""
    each = [(rigid.axis_angle_error(T, one.T), abs(one.T[2, 3] / T[2, 3] - 1.0)) for one in found[:4]]
    return min(each, key=lambda one: one[0] + one[1])


@pytest.mark.parametrize("bent", [(0.0, 0.0), (0.6, 0.2), (-0.4, 0.0)])
def test_one_of_a_few_starts_is_near_the_arm(bent):
    rng = np.random.default_rng(5)
    found = [errors(T, starter.starts(seen(T, rng, bent), CAMERA, BODY)) for T in (drawn(rng) for _ in range(12))]
    angles, depths = np.array(found).T
    assert np.median(angles) < np.radians(15.0) and np.median(depths) < 0.12, (np.degrees(angles), depths)


def test_without_an_elbow_the_hand_says_where_it_is():
    rng = np.random.default_rng(6)
    found = []
    for T in (drawn(rng) for _ in range(12)):
        found.append(errors(T, starter.starts(seen(T, rng, has_elbow=False), CAMERA, BODY)))
    angles, depths = np.array(found).T
    assert np.median(angles) < np.radians(30.0) and np.median(depths) < 0.25, (np.degrees(angles), depths)


def test_the_derivatives_are_those_of_the_offsets():
    rng = np.random.default_rng(7)
    T, angles, step = drawn(rng), np.array([0.3, -0.2]), 1e-6
    problem = starter._Problem.of(seen(T, rng), CAMERA, BODY)
    assert problem is not None
    T = rigid.perturb(T, [0.02, -0.01, 0.05, 0.1, -0.2, 0.1])
    r, J = problem._residuals(T, angles)
    for k, e in enumerate(step * np.eye(8)):
        ahead, _ = problem._residuals(rigid.perturb(T, e[:6]), angles + e[6:])
        np.testing.assert_allclose((ahead - r) / step, J[:, k], atol=1e-3 * max(1.0, np.abs(J[:, k]).max()))


def test_landmarks_in_one_point_are_no_hand():
    assert starter.starts(Limb(np.full((21, 2), 100.0)), CAMERA, BODY) == []


def test_the_limb_has_the_target_s_size_and_a_user_s_own_mesh_has_no_known_wrist():
    forearm = Target(
        mesh="body:forearm", labels=("forearm", "hand"), home=Placement(position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0))
    )
    assert starter.body_of(forearm, BODY) == BODY
    longer = starter.body_of(forearm.model_copy(update={"size": Size(length=1.1, girth=0.9)}), BODY)
    assert longer is not None
    assert longer.forearm_length == pytest.approx(1.1 * BODY.forearm_length)
    assert longer.hand_breadth == pytest.approx(0.9 * BODY.hand_breadth)
    assert starter.body_of(forearm.model_copy(update={"mesh": "arm.stl"}), BODY) is None
