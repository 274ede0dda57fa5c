"""Priors: what is known of a window beside its picture, drawn for the network and for its training."""

import cv2
import msgspec
import numpy as np
import pytest
import torch

from penumbra.services.replay.chain import Replay
from penumbra.services.segmentation import inference, model, prednet, priors
from penumbra.services.segmentation.prednet import PredNet, Settings
from penumbra.services.segmentation.training import evaluate
from penumbra.services.segmentation.training import priors as drawn
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.contract.messages import Frame, Joints, Mask
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.lookout import Window
from penumbra.shared.perception.prediction import extrapolate
from penumbra.sim.sets import sequences, shots
from penumbra.tests.support import nodes

ROBOT, TARGET = (model.PRIORS.index(name) for name in ("robot", "target"))
SURE = 1e-10 * np.eye(6)


@pytest.fixture(scope="module")
def shot() -> shots.Shot:
    """The arm cell, with its robot and target in the picture."""
    found = (shots.shot(36, index, 320, 240, images=False) for index in range(1, 40, 2))
    return next(shot for shot in found if shot.joints and (shot.labels == Label.ROBOT).sum() > 500)


def of(shot: shots.Shot) -> priors.Priors:
    return priors.Priors(shot.cell, next(iter(shot.cell.cameras)), shot.cell.targets)


@pytest.mark.parametrize("window", [Window(0, 0, 320, 240), Window(0, 0, 160, 120, 2), Window(64, 40, 96, 128)])
def test_robot_and_target_are_where_the_picture_shows_them(shot, window):
    known = of(shot)(window, dict.fromkeys(shot.cell.targets, (shot.T_world_target, SURE)), shot.joints)
    assert known.shape == (window.height, window.width, 2) and known.dtype == np.float32
    middle = window.scale // 2
    labels = shot.labels[window.y0 + middle : window.bottom : window.scale, window.x0 + middle : window.right : window.scale]
    inner = lambda mask: cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # noqa: E731
    for channel, shown in ((ROBOT, labels == Label.ROBOT), (TARGET, np.isin(labels, TARGET_LABELS))):
        if inner(shown).any():  # pads stand out of the robot's hull, and are a part of it in the picture
            assert (known[..., channel][inner(shown)] == 1.0).mean() > 0.85
    free = inner(labels == Label.BACKGROUND)
    assert (known[free] == -1.0).mean() > 0.95


def test_what_is_not_known_is_zero(shot):
    window, pose = Window(0, 0, 320, 240), (shot.T_world_target, SURE)
    nothing = of(shot)(window, {}, {})
    assert not nothing.any()
    half = of(shot)(window, {}, shot.joints)
    assert not half[..., TARGET].any() and set(np.unique(half[..., ROBOT])) == {-1.0, 1.0}
    two = shot.cell.model_copy(update={"targets": {name: next(iter(shot.cell.targets.values())) for name in "ab"}})
    one_lost = priors.Priors(two, next(iter(two.cameras)), "ab")(window, {"a": pose}, shot.joints)
    assert set(np.unique(one_lost[..., TARGET])) == {0.0, 1.0}, "the other one may be anywhere"
    behind = rigid.perturb(shot.camera.T_world_camera, np.zeros(6)), SURE
    assert not of(shot)(window, dict.fromkeys(shot.cell.targets, behind), {})[..., TARGET].any()


def test_a_silhouette_is_as_soft_as_its_pose_is_uncertain():
    """The mean of the silhouettes of drawn poses, and what the blur makes of the middle one."""
    cell = cells.load("table")
    mesh = anatomy.target_mesh(next(iter(cell.targets.values())), cell)
    rng, k, shape = np.random.default_rng(0), Intrinsics(400.0, 400.0, 96.0, 80.0), (160, 192)
    T = rigid.from_rpy((0.0, 0.0, 1.2), (0.3, 0.4, 0.5))
    for metres, turn in ((0.004, 0.02), (0.015, 0.1), (0.04, 0.2)):
        stated = np.repeat([metres, turn], 3)
        mean = np.zeros(shape)
        for error in stated * rng.normal(size=(300, 6)):
            points = rigid.apply(rigid.perturb(T, error), mesh.vertices)
            mean += raster.silhouette(points, mesh.faces, (k.fx, k.fy, k.cx, k.cy), (0, 0, 192, 160)) / 300.0
        found = priors.silhouette(mesh, T, np.diag(stated**2), k, shape)
        assert found is not None and found.min() >= 0.0 and found.max() <= 1.0 + 1e-6
        assert np.abs(found - mean)[(mean > 0.01) | (found > 0.01)].mean() < 0.06
        assert np.abs(found - mean).max() < 0.5  # one blur for all of the limb, whose ends are less sure than its middle


def test_a_wide_blur_on_a_coarse_grid_is_that_of_the_fine_one():
    rng = np.random.default_rng(0)
    shares = (cv2.GaussianBlur(rng.normal(size=(128, 160)), (0, 0), 6.0) > 0.0).astype(np.float32)
    for sigma in (0.3, 2.0, 5.0, 11.0, 17.0):
        wanted = cv2.GaussianBlur(shares, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE) if sigma > 0.4 else shares
        inner = np.s_[32:-32, 32:-32]  # beyond the border pixels go on as they are there, and the coarse grid's are larger
        np.testing.assert_allclose(priors.blurred(shares, (sigma, sigma))[inner], wanted[inner], atol=0.03)


@pytest.fixture(scope="module")
def simulated() -> list[sequences.Sequence]:
    return [sequences.render(77, index, sequences.Variety(frames=5, size=96)) for index in range(24)]


def test_a_training_draws_right_wrong_and_missing_priors_and_bytes_keep_them(simulated):
    rng = np.random.default_rng(0)
    films = [drawn.of_sequence(sequence, rng) for sequence in simulated for _ in range(6)]
    for channel in (ROBOT, TARGET):
        missing = [not film[..., channel].any() for film in films]
        frames = [film[..., channel].reshape(len(film), -1).any(1) for film in films]
        assert 0.2 < np.mean(missing) < 0.5
        assert 0.05 < np.mean([there.any() and not there.all() for there in frames]) < 0.4, "lost or found in between"
    kept = drawn.unpacked(drawn.packed(films[0]))
    np.testing.assert_allclose(kept, films[0], atol=0.005)
    assert not drawn.unpacked(drawn.packed(np.zeros((2, 2), np.float32))).any(), "nothing is nothing"


def test_right_priors_lie_on_the_target_and_wrong_ones_do_not(simulated):
    on: dict[drawn.Kind, list[float]] = {"right": [], "wrong": []}
    for index, sequence in enumerate(simulated):
        shown = np.isin(sequence.labels, TARGET_LABELS)
        if shown.sum() < 500 or sequence.hidden.max() > 0.5:
            continue
        for kind in on:
            known = drawn.of_sequence(sequence, np.random.default_rng(index), kind)[..., TARGET]
            on[kind].append(float(known[shown].mean() - known[~shown].mean()))
    assert len(on["right"]) > 5 and np.mean(on["right"]) > 0.5 > 0.3 > np.mean(on["wrong"])


def test_robots_are_known_where_something_covers_them(simulated):
    covered = 0
    for sequence in simulated:
        assert sequence.robots is not None
        assert sequence.robots[sequence.labels == Label.ROBOT].mean() > 0.999 if (sequence.labels == Label.ROBOT).any() else True
        covered += (sequence.robots & (sequence.labels != Label.ROBOT)).sum()
    assert covered > 1000


def test_of_labels_alone_a_prior_shows_both_arms_or_one():
    labels = np.full((5, 96, 96), Label.BACKGROUND, np.uint8)
    labels[:, 20:80, 10:25], labels[:, 20:80, 70:85], labels[:, :5] = Label.FOREARM, Label.HAND, UNLABELLED
    shown = set()
    for seed in range(60):
        known = drawn.of_labels(labels, np.random.default_rng(seed), "right")
        assert known.shape == (5, 96, 96, 2) and not known[..., ROBOT].any()
        if known.max() > 0.8:  # a sharp one
            shown.add((known[..., 10:25, TARGET].max() > 0.5, known[..., 70:85, TARGET].max() > 0.5))
    assert {(True, True), (True, False), (False, True)} <= shown
    assert not drawn.of_labels(np.zeros_like(labels), np.random.default_rng(0), "right").any()


@pytest.fixture
def weights(tmp_path):
    """A network whose masks priors change."""
    torch.manual_seed(0)
    net = PredNet(Settings((4, 4, 8), (3, 3, 3), 4, priors=2))
    for value in (net.prior_input, net.prior_drive):
        assert value is not None
        value.weight.data *= 10.0
    card = {"seed": 0, "date": "2026-01-01", "calibration": {"target_logit_offset": 0.0}}
    prednet.save(tmp_path / "net.npz", net, card)
    return tmp_path / "net.npz"


def test_the_service_gives_a_network_what_is_known_at_the_frame_and_waits_for_nothing(weights):
    cell, image = cells.load("arm"), np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    period_ns, start_ns = 50_000_000, 10**18
    turning = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.0])
    angles = lambda t: turning + 0.1 * t  # noqa: E731
    home = next(iter(cell.targets.values())).home.transform

    def masks(has_joints: bool, has_pose: bool) -> list[Mask]:
        recording: list = []
        for t in range(5):  # of which the last one's mask is still on its way at the end
            stamp_ns = start_ns + t * period_ns
            pose = msgspec.structs.replace(nodes.pose(stamp_ns), position=home[:3, 3], covariance=1e-4 * np.eye(6))
            recording += [(topics.FUSED, {"target": "forearm"}, pose)] * has_pose
            recording += [(topics.JOINTS, {"robot": "panda"}, Joints(stamp_ns=stamp_ns, position=angles(t)))] * has_joints
            recording.append((topics.FRAME, {"camera": "side"}, Frame(stamp_ns=stamp_ns + 20_000_000, image=image)))
        replay = Replay(cell, ("segmentation",), {"segmentation": ["--weights", str(weights)]})
        return [heard.message for heard in replay.run(recording) if heard.topic is topics.MASK]

    prior = priors.Priors(cell, "side", ["forearm"])
    for has_joints, has_pose in ((True, True), (True, False), (False, True), (False, False)):
        found = masks(has_joints, has_pose)
        ours, ignorant = inference.load_segmenter(weights), inference.load_segmenter(weights)
        assert len(found) == 4, "a mask of every frame"
        for t, mask in enumerate(found):
            window = Window(mask.x0, mask.y0, mask.labels.shape[1], mask.labels.shape[0], mask.scale)
            T = rigid.transform(home[:3, 3], (0.0, 0.0, 0.0, 1.0))
            poses = {"forearm": extrapolate(T, np.zeros(6), 1e-4 * np.eye(6), 0.02)} if has_pose else {}
            # carried on with the last velocity: the joints of the frame's stamp come later
            joints = {"panda": angles(t + 0.4 if t else 0.0)} if has_joints else {}
            wanted = ours(image, window, mask.stamp_ns, prior(window, poses, joints))
            assert (mask.labels != wanted).mean() < 1e-3, (has_joints, has_pose, t)
            without = ignorant(image, window, mask.stamp_ns)
            assert ((mask.labels != without).mean() > 0.01) == (has_joints or has_pose)


def test_a_network_without_priors_needs_no_joints(tmp_path):
    card = {"seed": 0, "date": "2026-01-01", "calibration": {"target_logit_offset": 0.0}}
    prednet.save(tmp_path / "plain.npz", PredNet(Settings((4, 4, 8), (3, 3, 3), 4)), card)
    replay = Replay(cells.load("arm"), ("segmentation",), {"segmentation": ["--weights", str(tmp_path / "plain.npz")]})
    assert {topic for topic, _, _ in replay._listeners} == {topics.FRAME, topics.FUSED}


def test_the_card_says_what_priors_give_and_what_wrong_ones_cost(weights, simulated):
    net, _ = prednet.load(weights)
    score = evaluate.held_out(net, 0.0, simulated[:6])
    assert score["with_priors"]["iou_by_class"] != score["iou_by_class"] != score["with_wrong_priors"]["iou_by_class"]
    plain = PredNet(Settings((4, 4, 8), (3, 3, 3), 4))
    assert not {"with_priors", "with_wrong_priors"} & evaluate.held_out(plain, 0.0, simulated[:6]).keys()
