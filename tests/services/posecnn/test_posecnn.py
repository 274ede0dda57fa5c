"""PoseCNN: votes, losses, patches, training, weights, and the service on a recording."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from penumbra.services import flags
from penumbra.services.command import cli
from penumbra.services.launcher import launch, up
from penumbra.services.posecnn import estimator, network, patch, voting
from penumbra.services.posecnn.estimator import PoseCNN
from penumbra.services.posecnn.training import evaluate, loss, patches, pictures, train
from penumbra.services.posecnn.training.schedule import Schedule
from penumbra.services.posecnn.uncertainty import KINDS, Signs, Uncertainty, errors, fitted
from penumbra.services.replay.chain import Replay
from penumbra.shared import training
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.labels import TARGET_LABELS, Label
from penumbra.shared.contract.messages import Frame
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.perception.lookout import Window, whole_frame
from penumbra.sim.sets import sequences, shots
from penumbra.sim.world.world import record

CPU = torch.device("cpu")
TABLE = cells.load("table")
SMALL = network.PoseCnnSettings(channels=(8, 8, 16, 16), pooled=4, hidden=16)


@pytest.fixture(autouse=True)
def one_thread():
    torch.manual_seed(0)
    torch.set_num_threads(1)


def rays(centre, noise_rad, count=400, seed=0):
    """Pixels on a slanted limb, and directions to a centre with normal errors of angle."""
    rng = np.random.default_rng(seed)
    along, across = rng.uniform(4, 60, count), rng.normal(0, 4, count)
    pixels = np.column_stack([along + 0.5 * across, 0.6 * along - across + 10.0])
    angle = np.arctan2(*(centre - pixels).T[::-1]) + rng.normal(0, noise_rad, count)
    return pixels, np.column_stack([np.cos(angle), np.sin(angle)]), rng


@pytest.mark.parametrize("centre", [(31.3, 28.8), (-20.4, 11.2), (60.0, 95.5)])
def test_exact_directions_meet_in_the_centre_also_outside_of_the_picture(centre):
    pixels, directions, _ = rays(np.array(centre), 0.0)
    vote = voting.vote(pixels, directions, 64)
    assert vote.centre == pytest.approx(centre, abs=0.02)
    assert vote.share == 1.0


def test_the_vote_finds_the_centre_among_noise_and_outliers_and_distinguishes_them():
    centre = np.array([30.0, 27.0])
    pixels, directions, rng = rays(centre, 0.05)
    wrong = rng.random(len(pixels)) < 0.35
    turn = rng.uniform(0, 2 * np.pi, wrong.sum())
    directions[wrong] = np.column_stack([np.cos(turn), np.sin(turn)])
    vote = voting.vote(pixels, directions, 64)
    assert np.linalg.norm(vote.centre - centre) < 0.5
    assert np.mean(vote.agrees[~wrong]) > 0.95
    assert np.mean(vote.agrees[wrong]) < 0.2
    assert 0.03 < vote.spread < 0.1


def test_votes_for_two_centres_disagree():
    left, right = np.array([12.0, 20.0]), np.array([50.0, 40.0])
    pixels, directions, _ = rays(left, 0.0)
    half = len(pixels) // 2
    directions[:half] = (right - pixels[:half]) / np.linalg.norm(right - pixels[:half], axis=1, keepdims=True)
    assert voting.vote(pixels, directions, 64).share < 0.7


def test_no_pixel_cannot_vote():
    with pytest.raises(ValueError, match="expected at least one pixel"):
        voting.vote(np.zeros((0, 2)), np.zeros((0, 2)), 64)


def tube(segments=12):
    """Points of a tapering tube along x, and others that no roll maps to each other."""
    angle = np.arange(segments) * 2 * np.pi / segments
    rings = [np.column_stack([np.full(segments, x), r * np.cos(angle), r * np.sin(angle)]) for x, r in ((-0.3, 0.1), (0.3, 0.06))]
    return torch.tensor(np.concatenate(rings))[None], torch.tensor([[[0.5, 0.1, 0.0], [0.6, 0.2, -0.05]]], dtype=torch.float64)


def turned(*rotation_vector):
    return torch.tensor(Rotation.from_rotvec(rotation_vector).as_matrix())[None]


def test_a_symmetric_turn_costs_the_symmetric_points_nothing_and_the_others_their_way():
    symmetric, other = tube()
    none = torch.zeros(1, 0, 3, dtype=torch.float64)
    still, step = turned(0, 0, 0), turned(2 * np.pi / 12, 0, 0)
    assert loss.rotation(step, still, symmetric, none) == pytest.approx(0.0, abs=1e-9)
    on_axis = torch.zeros(1, 1, 3, dtype=torch.float64)
    assert loss.rotation(step, still, on_axis, symmetric) > 0.03
    way = float((other @ step.mT - other).norm(dim=-1).mean())
    assert loss.rotation(step, still, symmetric, other) == pytest.approx(way * 2 / 26)


@pytest.mark.parametrize("turn", [(np.pi / 12, 0, 0), (0, 0, 0.1), (0, 0, np.pi)])
def test_a_turn_that_does_not_map_the_points_to_themselves_costs(turn):
    symmetric, other = tube()
    assert loss.rotation(turned(*turn), turned(0, 0, 0), symmetric, other[:, :0]) > 1e-3
    assert loss.rotation(turned(0, 0, 0), turned(0, 0, 0), symmetric, other) == pytest.approx(0.0, abs=1e-5)


def test_quaternions_give_scipy_s_matrices():
    quaternions = Rotation.random(5, random_state=1).as_quat()
    assert np.allclose(loss.matrices(torch.tensor(quaternions)), Rotation.from_quat(quaternions).as_matrix())


def test_a_patch_has_the_intrinsics_that_it_says():
    k = np.array([500.0, 400.0, 310.0, 250.0])
    angle, point = 0.3, np.array([0.1, -0.05, 1.4])
    M, focal, centre = patch.square(k, np.array([350.0, 230.0]), 180.0, angle)
    pixel = k[:2] * point[:2] / point[2] + k[2:]
    x, y, z = rigid.from_rpy((0, 0, 0), (0, 0, angle))[:3, :3] @ point
    assert M[:, :2] @ pixel + M[:, 2] == pytest.approx(focal * np.array([x, y]) / z + centre)
    assert M[:, :2] @ [350.0, 230.0] + M[:, 2] == pytest.approx([(patch.SIDE - 1) / 2.0] * 2)


def test_patches_and_rays_of_many_are_those_of_each():
    k, middle, side = np.array([[500.0, 400.0, 310.0, 250.0], [90.0, 90.0, 5.0, 6.0]]), np.eye(2) * 100.0, np.array([180.0, 40.0])
    angle = np.array([0.3, -1.0])
    together, each = patch.square(k, middle, side, angle), [patch.square(k[i], middle[i], side[i], angle[i]) for i in range(2)]
    for found, expected in zip(together, zip(*each, strict=True), strict=True):
        assert np.allclose(found, expected)
    points = np.array([[0.5, -0.3, 1.2], [-0.1, 0.2, 3.0]])
    assert np.allclose(patch.facing(points), [patch.facing(point) for point in points])


@pytest.mark.parametrize("side", [60.0, 128.0, 500.0])
def test_what_a_patch_shows_lies_where_its_map_says(side):
    image = np.zeros((480, 640, 3), np.uint8)
    middle = np.array([360.0, 200.0])
    corner = np.array([360.0 + side / 5, 200.0 - side / 4])
    cv2.circle(image, (round(corner[0]), round(corner[1])), max(round(side / 16), 2), (255, 255, 255), -1)
    square = patch.cut(image, np.array([550.0, 550.0, 319.5, 239.5]), middle, side)
    rows, columns = np.nonzero(square.pixels[..., 0] > 127)
    expected = square.centre + (np.round(corner) - [319.5, 239.5]) / 550.0 * square.focal
    assert [columns.mean(), rows.mean()] == pytest.approx(expected, abs=0.3)


def test_facing_turns_straight_ahead_to_the_point_without_roll():
    point = np.array([0.5, -0.3, 1.2])
    R = patch.facing(point)
    assert R[:, 2] == pytest.approx(point / np.linalg.norm(point))
    axis = Rotation.from_matrix(R).as_rotvec()
    assert axis[2] == pytest.approx(0.0, abs=1e-12)


def test_errors_of_a_length_that_cancel_cost_its_pixels_but_not_the_distance():
    labels = torch.full((1, 4, 4), int(Label.BACKGROUND))
    labels[0, 1, :2] = int(Label.FOREARM)
    length = torch.zeros(1, 4, 4)
    length[0, 1, 0], length[0, 1, 1] = 0.3, -0.1
    out = network.Dense(torch.zeros(1, len(Label), 4, 4), torch.zeros(1, 2, 4, 4), length, torch.zeros(1, 4, 4), torch.zeros(1))
    costs = {true: loss.dense(out, labels, torch.zeros(1, 2), torch.tensor([true])) for true in (0.1, -0.1)}
    assert costs[0.1]["distance"] == pytest.approx(0.0, abs=1e-6)
    assert costs[-0.1]["distance"] == pytest.approx(0.2, abs=0.01)
    assert costs[0.1]["length"] == pytest.approx(0.2, abs=0.02)


def test_lengths_count_by_their_weights_where_they_count_at_all():
    length, weight = torch.tensor([[[1.0, 3.0, 9.0]], [[1.0, 3.0, 9.0]]]), torch.log(torch.tensor([[[3.0, 1.0, 7.0]]] * 2))
    counts = torch.tensor([[[True, True, False]], [[False, False, False]]])
    assert network.mean_length(length, weight, counts).tolist() == pytest.approx([1.5, 0.0])


class Said(network.Network):
    """A network that sees the target everywhere, its centre in the middle and the same length in every patch."""

    def forward(self, images, shapes):
        n, side = len(images), patch.SIDE // network.STRIDE
        logits = torch.zeros(n, len(Label), side, side)
        logits[:, Label.FOREARM] = 1.0
        steps = torch.arange(side, dtype=torch.float32) - (side - 1) / 2.0
        direction = -torch.stack(torch.meshgrid(steps, steps, indexing="xy")).expand(n, -1, -1, -1)
        said = torch.full((n, side, side), 0.2)
        return network.Dense(logits, direction, said, torch.zeros_like(said), torch.zeros(n, 1, side // 4, side // 4))

    def rotations(self, features, centre, length):
        return torch.tensor([[0.0, 0.0, 0.0, 1.0]])


def test_the_depth_is_the_mean_of_what_both_patches_say():
    posecnn = PoseCNN(TABLE, net=Said(SMALL), uncertainty=evaluate.UNCALIBRATED)
    image = np.zeros((480, 640, 3), np.uint8)
    squares = posecnn._squares(image, np.array([320.0, 240.0]), 200.0)
    assert [square.focal for square in squares] == pytest.approx(
        [patch.SIDE / (width * 200.0) * TABLE.cameras["front"].fx for width in estimator.WIDTHS]
    )

    def depth(squares):
        _, found = posecnn._look(squares)
        assert found is not None
        return found.T[2, 3]

    depths = [depth([square]) for square in squares]
    assert depths[0] / depths[1] == pytest.approx(estimator.WIDTHS[1] / estimator.WIDTHS[0])
    assert depth(squares) == pytest.approx(np.sqrt(depths[0] * depths[1]))


def test_a_camera_further_away_shows_the_target_as_large():
    (near, things), (far, _) = (
        sequences.scene(np.random.default_rng(6), sequences.Variety(frames=1, away=away)) for away in ((1.0, 1.0), (5.0, 5.0))
    )
    target = things[0].T[0, :3, 3]
    nearer, further = (np.asarray(camera.position) - target for camera in (near, far))
    assert further == pytest.approx(5.0 * nearer)
    assert [far.fx, far.fy] == pytest.approx([5.0 * near.fx, 5.0 * near.fy])
    assert (far.width, far.height) == (near.width, near.height)


def test_a_finer_picture_shows_the_target_larger():
    (plain, _), (fine, _) = (
        sequences.scene(np.random.default_rng(6), sequences.Variety(frames=1, finer=finer)) for finer in (1.0, 1.5)
    )
    assert fine.fx == pytest.approx(1.5 * plain.fx)
    assert fine.position == pytest.approx(plain.position)


def test_sequences_say_where_their_target_is():
    faces = anatomy.forearm_mesh(cells.Body()).faces
    overlaps = []
    for index in range(12):
        sequence = sequences.render(5, index, sequences.Variety(frames=2))
        for t in range(2):
            if sequence.hidden[t] > 0.02:
                continue
            assert sequence.poses is not None
            vertices = rigid.apply(sequence.poses.T_camera_target[t], sequence.poses.vertices)
            expected = raster.silhouette(vertices, faces, tuple(sequence.poses.intrinsics), (0, 0, 192, 192))
            shown = np.isin(sequence.labels[t], TARGET_LABELS)
            overlaps.append((expected & shown).sum() / (expected | shown).sum())
    assert len(overlaps) > 3
    assert min(overlaps) > 0.9


FEW = Schedule(batch=4, peak_rate=4e-3, reuse=2, kept=16, first=12)


class Still(pictures.RenderedPictures):
    """Pictures to which no step adds any."""

    def ensure(self, step):
        return super().ensure(0)


@pytest.fixture(scope="module")
def data():
    data = Still(1, each=1, kept=32, first=32, device=CPU)
    data.ensure(0)
    return data


def test_the_last_pictures_are_kept_and_every_step_brings_new_ones():
    data = pictures.RenderedPictures(1, each=2, kept=6, first=2, device=CPU)
    assert data.ensure(0) == 4
    assert data.ensure(5) == 6
    pixels, _ = pictures.Rendered(1)[range(8, 14)]
    assert torch.equal(data.pixels, pixels[[4, 5, 0, 1, 2, 3]])  # 12 and 13 took the place of 6 and 7
    again = pictures.RenderedPictures(1, each=2, kept=6, first=2, device=CPU)
    assert again.ensure(5) == 6
    assert torch.equal(again.pixels, data.pixels)
    assert np.array_equal(again.truth(np.arange(6)).length, data.truth(np.arange(6)).length)


def trained(steps, checkpoint, resume_at=None, workers=0):
    trainer = train.Trainer(SMALL, FEW, seed=1)
    if resume_at is not None:
        first = FEW.pictures(1, CPU, 0)
        while trainer.step < resume_at:
            trainer.train_step(first, trainer.step / steps)
        trainer.save(checkpoint)
        trainer = train.Trainer.restore(checkpoint, FEW)
    data = FEW.pictures(1, CPU, workers)
    training.run(trainer, data, steps, 0.0, checkpoint)
    data.close()
    return trainer


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_training_that_was_interrupted_ends_with_the_same_weights_whoever_draws(tmp_path, workers):
    straight = trained(4, tmp_path / "a")
    resumed = trained(4, tmp_path / "b", 2, workers)
    for a, b in zip(straight.average.parameters(), resumed.average.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_training_lowers_the_loss(data):
    weights = {**dict(Schedule.weights), "distance": 10.0}  # with so small a network it is mostly chance
    trainer = train.Trainer(SMALL, Schedule(batch=16, peak_rate=4e-3, weights=tuple(weights.items())), seed=1)
    parts = [trainer.train_step(data, 0.1) for _ in range(100)]
    before, after = ({name: np.mean([part[name] for part in some]) for name in parts[0]} for some in (parts[:6], parts[-12:]))
    assert after["total"] < 0.72 * before["total"]
    for name in ("labels", "length", "rotation"):
        assert after[name] < 0.75 * before[name], name


def test_a_batch_contains_the_target_s_place_in_every_patch(data):
    rng = np.random.default_rng(3)
    chosen = np.flatnonzero(data.truth(np.arange(32)).hidden < 0.3)
    batch = patches.draw_batch(data.pixels, chosen, data.truth(chosen), Schedule(), rng)
    assert batch.images.shape == (len(chosen), 3, patch.SIDE, patch.SIDE)
    for labels, centre, length in zip(batch.labels, batch.centre, batch.length, strict=True):
        rows, columns = np.nonzero(np.isin(labels, TARGET_LABELS))
        if len(rows) > 50:
            away = np.hypot(columns * network.STRIDE - float(centre[0]), rows * network.STRIDE - float(centre[1]))
            assert away.min() < 0.5 * float(length)
            assert away.max() < network.REACH * float(length) + 4.0


@pytest.mark.parametrize("spoilt", [{}, {"cropped": 1.0}, {"coarse": 1.0}, {"soft": 1.0}])
def test_a_spoilt_picture_shows_the_target_where_its_batch_says(spoilt):
    plain: dict[str, float] = {"cropped": 0.0, "coarse": 0.0, "soft": 0.0, "noise": 0.0, "jitter": 0.0}
    schedule = Schedule(**{**plain, **spoilt, "off": 0.0, "wide": 0.0})
    vertices = anatomy.forearm_mesh(cells.Body()).vertices
    T, intrinsics = rigid.from_rpy((0.02, -0.03, 1.5), (0.0, 0.0, 0.6)), np.array([750.0, 750.0, 195.0, 180.0])
    pixels = np.zeros((1, 384, 384, 4), np.uint8)
    x, y = intrinsics[:2] * T[:2, 3] / T[2, 3] + intrinsics[2:]
    rows, columns = np.indices((384, 384))
    blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * 7.0**2))
    pixels[..., :3] = np.round(255.0 * blob)[..., None]
    truth = pictures.Truth.of(np.repeat(pictures.row(T, intrinsics, 0.0, vertices)[None], 8, 0))
    batch = patches.draw_batch(torch.from_numpy(pixels), np.zeros(8, np.int64), truth, schedule, np.random.default_rng(5))
    bright = batch.images.mean(1)
    places = torch.from_numpy(np.indices((patch.SIDE, patch.SIDE), np.float32))
    for picture, centre in zip(bright, batch.centre, strict=True):
        found = [float((picture * place).sum() / picture.sum()) for place in reversed(places)]
        assert found == pytest.approx(centre.tolist(), abs=0.4)


def test_a_training_starts_from_weights_and_its_checkpoint_names_them(tmp_path):
    first = network.Network(SMALL)
    network.save(tmp_path / "w.npz", first, {"seed": 3, "date": "2026-01-02"})
    trainer = train.Trainer.begin(tmp_path / "w.npz", Schedule(), seed=1)
    for net in (trainer.net, trainer.average):
        for ours, theirs in zip(net.parameters(), first.parameters(), strict=True):
            assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4)
    trainer.save(tmp_path / "checkpoint")
    assert train.Trainer.restore(tmp_path / "checkpoint", Schedule()).started_from == {"seed": 3, "date": "2026-01-02"}


def test_the_calibration_finds_the_deviations_that_errors_were_drawn_with():
    rng = np.random.default_rng(0)
    truth = Uncertainty({kind: (np.log(0.1), 1.0, 0.0, 0.0, 0.0, 0.0) for kind in KINDS})
    signs = [Signs(rng.uniform(0, 0.9), 100.0, 0.1, 1.0) for _ in range(800)]
    missed = [{kind: rng.normal(0, truth.deviations(one)[kind], 1 + (kind == "lateral")) for kind in KINDS} for one in signs]
    found = fitted(signs, missed)
    for hidden in (0.1, 0.8):
        one = Signs(hidden, 100.0, 0.1, 1.0)
        for kind in KINDS:
            assert found.deviations(one)[kind] == pytest.approx(truth.deviations(one)[kind], rel=0.2)


def test_the_covariance_lies_along_the_ray_and_the_limb():
    uncertainty = Uncertainty(
        {kind: (np.log(value), *[0.0] * 5) for kind, value in zip(KINDS, (0.1, 0.02, 0.05, 0.2, 0.4), strict=True)}
    )
    T = rigid.from_rpy((0.3, -0.2, 1.5), (0.4, 0.2, 1.0))
    covariance = uncertainty.covariance(T, 0.5, Signs(0.0, 100.0, 0.1, 1.0))
    ray, axis = T[:3, 3] / np.linalg.norm(T[:3, 3]), T[:3, 0]
    assert np.sqrt(ray @ covariance[:3, :3] @ ray) == pytest.approx(0.1 * np.linalg.norm(T[:3, 3]))
    tilt = np.cross(axis, ray) / np.linalg.norm(np.cross(axis, ray))
    turn = np.cross(tilt, axis)
    assert np.sqrt(axis @ covariance[3:, 3:] @ axis) == pytest.approx(0.4)
    assert np.sqrt(tilt @ covariance[3:, 3:] @ tilt) == pytest.approx(0.2)
    assert np.sqrt(turn @ covariance[3:, 3:] @ turn) == pytest.approx(0.05)
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    found = [errors(rigid.perturb(T, error), T, 0.5) for error in drawn[:1000]]
    assert np.std([one["depth"] for one in found]) == pytest.approx(0.1, rel=0.1)
    assert np.std([one["roll"] for one in found]) == pytest.approx(0.4, rel=0.1)
    assert np.std([one["turn"] for one in found]) == pytest.approx(0.05, rel=0.1)
    assert np.std([one["lateral"] for one in found]) == pytest.approx(0.02, rel=0.1)


def test_the_committed_weights_fit_their_card():
    net, card = network.load(estimator.WEIGHTS)
    assert card["parameters"] == sum(p.numel() for p in net.parameters()) <= 4_200_000
    assert set(card["calibration"]["coefficients"]) == set(KINDS)
    assert card["calibration"]["seed"] != card["held_out"]["seed"]
    schedule = Schedule(peak_rate=1.5e-3).times(32)
    assert card["settings"]["schedule"] == json.loads(json.dumps(dataclasses.asdict(schedule)))
    assert card["differs"] == list(train.DIFFERS)
    assert [row["hidden"] for row in card["held_out"]["bands"]] == [list(band) for band in evaluate.BANDS]


def test_weights_of_another_network_are_refused(tmp_path):
    net = network.Network(SMALL)
    network.save(tmp_path / "w.npz", net, {})
    path = tmp_path / "w.json"
    path.write_text(path.read_text().replace('"hidden": 16', '"hidden": 32'))
    with pytest.raises(ValueError, match=r"expected weights of .*'hidden': 32\}, as its card says"):
        network.load(tmp_path / "w.npz")


def test_missing_weights_are_an_error_that_says_how_to_make_them(tmp_path, capsys):
    with pytest.raises(FileNotFoundError, match="make them with `penumbra posecnn train --out"):
        estimator.load(tmp_path / "none.npz")


def test_held_out_arms_are_found_and_the_covariance_shows_how_far_off_they_are():
    net, uncertainty = estimator.load()
    shown = [shots.shot(4_200_000, index, distance_m=1.5, hidden=hidden) for index in range(12) for hidden in (0.0, 0.4)]
    found = evaluate.results(net, uncertainty, shown, 1)
    tracked = [one for one in found if one.estimate.state == "tracking"]
    assert len(tracked) > 0.7 * len(found)
    assert np.median([np.linalg.norm(one.error[:3]) for one in tracked]) < 0.15
    assert np.median([one.nees for one in tracked]) < 12.6  # 95 % of six degrees of freedom


def test_a_window_of_the_whole_frame_is_looked_at_again_from_nearer():
    found = 0
    for index in range(8):
        shot = shots.shot(4_200_000, index, distance_m=2.0)
        assert shot.image is not None
        estimate = PoseCNN(shot.cell).update(shot.image, whole_frame(shot.camera))
        off = np.linalg.norm(estimate.T[:3, 3] - shot.T_world_target[:3, 3])
        found += int(estimate.state == "tracking" and off < 0.3)
    assert found >= 4


def test_an_empty_picture_is_lost_and_a_covered_one_occluded(monkeypatch):
    posecnn = PoseCNN(TABLE)
    image = np.full((480, 640, 3), 200, np.uint8)
    T = TABLE.targets["forearm"].home.transform
    window = Window(200, 100, 224, 224)
    assert posecnn.update(image, window).state == "lost"
    for label, state in ((Label.BACKGROUND, "lost"), (Label.OCCLUDER, "occluded")):
        covered = np.full((64, 64), int(label))
        monkeypatch.setattr(posecnn, "_look", lambda _, covered=covered: (covered, None))
        estimate = posecnn.update(image, window, T)
        assert estimate.state == state
        assert np.linalg.eigvalsh(estimate.covariance).min() >= 1.0


def test_a_frame_of_another_size_is_refused_with_the_reason():
    with pytest.raises(ValueError, match=r"image: expected 640 x 480 \(the cell file\), got 320 x 240"):
        PoseCNN(TABLE).update(np.zeros((240, 320, 3), np.uint8), Window(0, 0, 320, 240))


@pytest.fixture(scope="module")
def heard():
    replay = Replay(TABLE, ("posecnn", "fusion"))
    return replay.run(record(TABLE, 5, 3.0))


def test_the_service_publishes_a_pose_of_every_frame_and_fusion_uses_it(heard):
    poses = [one.message for one in heard if one.topic is topics.VISION]
    frames = [one.message for one in heard if one.topic is topics.FRAME]
    assert {pose.stamp_ns for pose in poses} >= {frame.stamp_ns for frame in frames[:-1]}
    assert np.mean([pose.state == "tracking" for pose in poses]) > 0.5
    truth = {one.message.stamp_ns: one.message for one in heard if one.topic is topics.TRUTH}
    off = [
        np.linalg.norm(pose.position - truth[pose.stamp_ns].position)
        for pose in poses
        if pose.state == "tracking" and pose.stamp_ns in truth
    ]
    assert np.median(off) < 0.15
    fused = [one.message for one in heard if one.topic is topics.FUSED][-1]
    assert fused.state != "lost"
    assert fused.sources["vision"].age_s < 0.2


def test_the_service_refuses_a_frame_of_another_size():
    replay = Replay(TABLE, ("posecnn",))
    frame = Frame(stamp_ns=10**18, image=np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(ValueError, match="expected a picture of 640 x 480, got 320 x 240"):
        replay.run([(topics.FRAME, {"camera": "front"}, frame)])


@pytest.mark.parametrize(("vision", "there"), [("procnet", {"segmentation", "search"}), ("posecnn", {"posecnn"})])
def test_up_starts_one_way_to_see(vision, there):
    options = flags.parse(up.PARAMS, ["--vision", vision, "--port", "1"])
    started = {process.service for process in launch.fleet(TABLE, options).processes}
    assert started == there | {"router", "emulator", "haptics", "fusion", "dashboard"}


@pytest.mark.slow
def test_the_command_s_train_writes_weights_that_the_service_reads(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "Schedule", lambda: FEW)
    monkeypatch.setattr(train, "PoseCnnSettings", lambda: SMALL)
    out = tmp_path / "weights" / "mine.npz"
    places = ["--checkpoint", str(tmp_path / "checkpoint"), "--out", str(out)]
    assert cli.main(["posecnn", "train", "--steps", "2", "--held-out", "2", *places]) == 0
    net, _ = estimator.load(out)
    assert net.settings == SMALL
