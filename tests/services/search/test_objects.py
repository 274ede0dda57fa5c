"""`search refine` and `search track`: household objects on masks as networks make them, and input that is wrong."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from penumbra.services.command import cli
from penumbra.services.search.contour import Model
from penumbra.services.search.objects import contest, meshes, region, tools
from penumbra.services.search.objects.creases import Creases
from penumbra.services.search.objects.pose import RigidObject, Tracker, _Colours, find_pose, started
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import raster
from penumbra.shared.geometry.lens import Lens
from penumbra.shared.geometry.rigid import apply, from_rpy, inverse, perturb, pose_error
from penumbra.sim.picture.distortion import Distortion
from penumbra.tests.bench import objects as bench
from penumbra.tests.bench.objects import CONVERGED, HEIGHT, WIDTH, K, Thing, errors, moved, scene, spoiled, thing

EXACT, NOISY = (1.0, 1.0), (0.85, 0.87)
CAMERA: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "fx": K.fx, "fy": K.fy, "cx": K.cx, "cy": K.cy}


def mesh_of(one: Thing) -> Mesh:
    faces = np.asarray(one.mesh.faces, np.int32)
    return Mesh(np.asarray(one.mesh.vertices, np.float64), faces, np.zeros(len(faces), np.uint8))


def drawn(one: Thing, T: np.ndarray) -> np.ndarray:
    mesh = mesh_of(one)
    return raster.silhouette(apply(T, mesh.vertices), mesh.faces, (K.fx, K.fy, K.cx, K.cy), (0, 0, WIDTH, HEIGHT))


def nees(found, T: np.ndarray) -> float:
    error = pose_error(T, found.T)
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.fixture(scope="module")
def drill() -> Thing:
    return thing("drill", 5)


@pytest.fixture(scope="module")
def rigid(drill: Thing) -> RigidObject:
    return RigidObject(mesh_of(drill))


# --- method -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degrees", "metres", "allowed"), [(20.0, 0.03, 1), (30.0, 0.05, 2)])
def test_a_bad_mask_of_a_drill_gives_its_pose_from_far_starts(drill, rigid, degrees, metres, allowed):
    missed = 0
    for seed in range(8):
        T, mask = scene(drill, (70, seed), NOISY)
        found = find_pose(rigid, mask, K, moved(T, degrees, metres, np.random.default_rng(seed)))
        missed += errors(drill, found.T, T).add > CONVERGED or found.state != "tracking"
    assert missed <= allowed


def test_an_exact_mask_gives_an_exact_pose(drill, rigid):
    T, mask = scene(drill, (71, 0), EXACT)
    found = find_pose(rigid, mask, K, moved(T, 20.0, 0.03, np.random.default_rng(0)))
    error = errors(drill, found.T, T)
    assert np.linalg.norm(error.position) < 0.005  # half a pixel in a silhouette 100 pixels wide
    assert error.rotation < np.radians(2.0)
    assert found.overlap > 0.97


def test_covariances_of_bad_masks_cover_their_errors(drill, rigid):
    values = []
    for seed in range(9):
        T, mask = scene(drill, (72, seed), NOISY)
        values.append(nees(find_pose(rigid, mask, K, moved(T, 15.0, 0.02, np.random.default_rng(seed))), T))
    assert np.median(values) < 12.6  # 95 % of chi^2 with six degrees of freedom
    assert np.median(values) > 0.5  # and not by claiming nothing


def test_what_hides_the_object_is_ignored_and_not_scored(drill, rigid):
    T, mask = scene(drill, (73, 1), EXACT)
    columns = np.flatnonzero(mask.any(axis=0))
    occluder = np.zeros_like(mask)
    occluder[:, : int(np.quantile(columns, 0.45))] = True
    start = moved(T, 10.0, 0.02, np.random.default_rng(1))
    told, untold = (find_pose(rigid, mask & ~occluder, K, start, given) for given in (occluder, None))
    assert errors(drill, told.T, T).add < CONVERGED
    assert errors(drill, told.T, T).add < 0.5 * errors(drill, untold.T, T).add


def test_an_object_wholly_behind_something_is_lost(rigid, drill):
    T, mask = scene(drill, (73, 1), EXACT)
    found = find_pose(rigid, mask, K, T, np.ones_like(mask))
    assert found.state == "lost"
    assert found.covariance[0, 0] >= 1.0


def test_the_border_of_the_picture_is_not_the_objects_contour(drill, rigid):
    T = from_rpy((0.0, 0.02, 0.8), (1.2, 0.3, 0.5))
    T[0, 3] = (15 - K.cx) / K.fx * T[2, 3]  # its middle at the left border
    mask = drawn(drill, T)
    assert mask[:, 0].any()
    found = find_pose(rigid, mask, K, moved(T, 10.0, 0.02, np.random.default_rng(3)))
    assert found.state == "lost" or errors(drill, found.T, T).add < CONVERGED


def test_a_ball_keeps_the_rotation_of_its_start_and_says_that_it_does_not_know_it():
    ball = trimesh.creation.icosphere(4, radius=0.06)
    rigid = RigidObject(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32), np.zeros(len(ball.faces), np.uint8)))
    T = from_rpy((0.05, 0.0, 0.9), (0.3, 0.2, 0.1))
    one = Thing("ball", ball, np.eye(3)[None])
    start = moved(T, 20.0, 0.03, np.random.default_rng(0))
    found = find_pose(rigid, drawn(one, T), K, start)
    assert np.linalg.norm(found.T[:3, 3] - T[:3, 3]) < 0.01
    assert np.sqrt(np.linalg.eigvalsh(found.covariance[3:, 3:])[0]) > np.radians(5.0)
    assert np.linalg.norm(pose_error(start, found.T)[3:]) < np.radians(15.0)


def test_two_blobs_of_one_object_are_lost_or_covered_by_the_covariance(drill, rigid):
    T, mask = scene(drill, (74, 2), EXACT)
    both = mask | np.roll(mask, 150 if np.flatnonzero(mask.any(axis=0)).mean() < WIDTH / 2 else -150, axis=1)
    found = find_pose(rigid, both, K, moved(T, 10.0, 0.02, np.random.default_rng(2)))
    assert found.state == "lost" or nees(found, T) < 22.5


def test_a_piece_of_the_mask_that_is_another_object_is_left_out(drill, rigid):
    T, mask = scene(drill, (74, 3), EXACT)
    columns = np.flatnonzero(mask.any(axis=0))
    aside = int(columns[0] - 60) if columns[0] > WIDTH - columns[-1] else int(columns[-1] + 60)
    rows = np.mgrid[:HEIGHT, :WIDTH][0]
    piece = np.hypot(np.arange(WIDTH) - aside, rows - HEIGHT / 2) < np.sqrt(0.3 * np.count_nonzero(mask) / np.pi)
    assert not (piece & mask).any()
    found = find_pose(rigid, mask | piece, K, moved(T, 20.0, 0.03, np.random.default_rng(4)))
    assert errors(drill, found.T, T).add < CONVERGED
    assert found.state == "tracking"


def test_another_shape_is_not_tracked(rigid):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[200:212, 100:420] = True  # a bar
    mask[100:380, 250:262] = True  # and another across
    found = find_pose(rigid, mask, K, from_rpy((-0.05, 0.0, 0.9), (1.5, 0.0, 0.0)))
    assert found.state == "lost"
    assert found.covariance[0, 0] >= 1.0


@pytest.mark.parametrize("kind", ["holes", "flipped", "soup"])
def test_a_damaged_mesh_gives_the_pose_of_the_whole_one(kind):
    T, mask = scene(
        Thing("drill", bench.worn(bench.drill(), 20_000, np.random.default_rng(0), "whole"), np.eye(3)[None]), (75, 1), EXACT
    )
    start = moved(T, 15.0, 0.02, np.random.default_rng(1))
    one = Thing("drill", bench.worn(bench.drill(), 20_000, np.random.default_rng(0), kind), np.eye(3)[None])
    assert errors(one, find_pose(RigidObject(mesh_of(one)), mask, K, start).T, T).add < 0.03


def test_a_repaired_mesh_has_the_silhouette_of_the_original():
    for name in ("mug", "scissors", "drill"):
        one = thing(name, 3)
        repaired = meshes.repaired(mesh_of(one), 4000)
        assert len(repaired.faces) < 6000
        T = bench.drawn_pose(np.random.default_rng(1))
        other = Thing(name, trimesh.Trimesh(repaired.vertices, repaired.faces, process=False), one.symmetries)
        assert bench.iou(drawn(one, T), drawn(other, T)) > 0.98


def photographed(one: Thing, T: np.ndarray, seed: int) -> np.ndarray:
    """A picture of an object in two colours before a background of patches in many."""
    rng = np.random.default_rng(seed)
    patches = cv2.resize(rng.uniform(40, 150, (12, 16, 3)).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    stripes = (np.arange(HEIGHT) // 30 % 2)[:, None, None]
    inside = np.where(stripes, (200.0, 60.0, 40.0), (220.0, 190.0, 60.0))
    picture = np.where(drawn(one, T)[..., None], inside, patches) + rng.normal(0.0, 6.0, (HEIGHT, WIDTH, 3))
    return cv2.GaussianBlur(picture, (0, 0), 0.6).clip(0, 255).astype(np.uint8)


def test_the_picture_is_sharper_than_the_mask(drill, rigid):
    better = []
    for seed in range(5):
        T, mask = scene(drill, (76, seed), (0.9, 0.92))
        picture = photographed(drill, T, seed)
        start = moved(T, 15.0, 0.02, np.random.default_rng(seed))
        by_mask, by_picture = (errors(drill, find_pose(rigid, mask, K, start, picture=p).T, T).add for p in (None, picture))
        better.append(by_picture / by_mask)
    assert np.median(better) < 0.6


def test_with_a_picture_a_mask_may_be_four_pixels_too_small_or_too_large(drill, rigid):
    T, mask = scene(drill, (78, 0), EXACT)
    picture, start = photographed(drill, T, 0), moved(T, 20.0, 0.03, np.random.default_rng(0))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    masks = [change(mask.astype(np.uint8), disc) > 0 for change in (cv2.erode, cv2.dilate)]
    found = [find_pose(rigid, one, K, start, picture=picture) for one in masks]
    assert all(errors(drill, one.T, T).add < 0.02 for one in found)
    assert np.linalg.norm(found[0].T[:3, 3] - found[1].T[:3, 3]) < 0.005
    alone = [find_pose(rigid, one, K, start) for one in masks]
    assert np.linalg.norm(alone[0].T[:3, 3] - alone[1].T[:3, 3]) > 0.02  # without the picture it matters


def test_a_picture_alone_gives_the_pose_from_far_starts(drill, rigid):
    for seed in range(3):
        T, _ = scene(drill, (79, seed), EXACT)
        picture = photographed(drill, T, seed)
        found = find_pose(rigid, None, K, moved(T, 20.0, 0.03, np.random.default_rng(seed)), picture=picture)
        assert errors(drill, found.T, T).add < CONVERGED / 2
        assert nees(found, T) < 22.5


def test_the_last_steps_of_a_search_bring_a_distance_nearer_to_the_true_one(drill, rigid):
    T, _ = scene(drill, (79, 0), EXACT)
    true = T @ rigid.T_object_middle
    far = true.copy()
    far[:3, 3] *= 1.02
    prior = started(rigid, far @ rigid.T_middle_object)
    window = region.Window(photographed(drill, T, 0), None, None, K, rigid.shape, far, 0.0)
    at = window.level(window.factors[-1], window.of_pose(rigid.shape.coarse, far, 0.015))
    begin = contest.scored(rigid.shape, rigid.shape.fine, at, far, prior, True)
    (found,) = contest.settled(rigid.shape, [begin], prior)
    assert abs(found.T[2, 3] - true[2, 3]) < 0.5 * abs(far[2, 3] - true[2, 3])
    assert found.score > begin.score


def test_a_contour_that_errs_in_waves_hardly_moves_the_pose_and_a_moved_one_does(drill, rigid):
    T, _ = scene(drill, (79, 0), EXACT)
    true = T @ rigid.T_object_middle
    window = region.Window(photographed(drill, T, 0), None, None, K, rigid.shape, true, 0.0)
    at = window.level(window.factors[-1], window.of_pose(rigid.shape.coarse, true, 0.015))
    seen = region.lines(rigid.shape, rigid.shape.fine, at, true, 4)
    points = seen.contour.points

    def distance(r: np.ndarray, level: region.Level) -> float:
        lines = replace(seen, contour=replace(seen.contour, r=r))
        H, g = region.information([(lines, False)], level, true, 1e3)
        return float(np.linalg.solve(H + started(rigid, T).information, g)[2])

    normal = points["normal"]
    wave = np.cos(3.0 * np.arctan2(normal[:, 1], normal[:, 0]))
    farther = seen.contour.jacobian(true, at.k)[:, 2] * 0.02
    assert distance(farther, at) > 0.01
    # where a pixel of the level is ten of the picture, waves of a pixel are not expected
    assert abs(distance(wave, at)) < 0.5 * abs(distance(wave, replace(at, scale=10)))


def test_a_pose_that_the_picture_speaks_against_is_doubtful_however_much_of_it_lies_on_edges(drill, rigid):
    T, _ = scene(drill, (79, 0), EXACT)
    true, picture = T @ rigid.T_object_middle, photographed(drill, T, 0)
    prior = started(rigid, T)
    window = region.Window(picture, None, None, K, rigid.shape, true, 0.0)
    at = window.level(window.factors[-1], window.of_pose(rigid.shape.coarse, true, 0.015))
    found = contest.scored(rigid.shape, rigid.shape.fine, at, true, prior, True)
    states = [
        _Colours(rigid, K).judged([one], prior, None, None, picture.shape[:2]).state
        for one in (found, replace(found, score=-1.0))
    ]
    assert found.score > contest.REFUTED
    assert states == ["tracking", "doubtful"]


def test_a_picture_without_the_object_is_not_tracked(drill, rigid):
    T, _ = scene(drill, (79, 0), EXACT)
    nothing = Thing("nothing", trimesh.creation.box((1e-3, 1e-3, 1e-3)), np.eye(3)[None])
    assert find_pose(rigid, None, K, T, picture=photographed(nothing, T, 1)).state in ("lost", "doubtful")


def test_the_turn_of_a_can_is_not_known_and_makes_the_pose_doubtful():
    one = thing("soup can", 1)
    T = from_rpy((0.02, 0.0, 0.6), (1.9, 0.1, 0.2))
    start = moved(T, 15.0, 0.02, np.random.default_rng(3))
    found = find_pose(RigidObject(mesh_of(one)), None, K, start, picture=photographed(one, T, 2))
    axis = found.T[:3, 2]
    assert np.sqrt(axis @ found.covariance[3:, 3:] @ axis) > np.radians(5.0)
    assert found.state == "doubtful"


def test_without_a_mask_and_a_picture_there_is_no_pose(rigid):
    start = from_rpy((0.0, 0.0, 0.8), (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="expected a mask, a picture or both"):
        find_pose(rigid, None, K, start)
    with pytest.raises(ValueError, match="expected a mask, a picture or both"):
        Tracker(rigid, K, start).update(None)


def test_the_creases_of_a_box_are_its_edges_between_two_visible_sides():
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    creases = Creases(Model(Mesh(np.asarray(box.vertices, float), np.asarray(box.faces, np.int32), np.zeros(12, np.uint8))))
    T = from_rpy((0.0, 0.0, 1.0), (0.6, 0.5, 0.0))
    points = creases.points(T, K, (HEIGHT, WIDTH), 2.0)
    inside = apply(inverse(T), points["position"])
    assert (np.sort(np.abs(inside), axis=1)[:, 1:] > 0.0999).all()  # on an edge: two coordinates are at their ends
    nearest = min(apply(T, box.vertices), key=lambda corner: float(np.linalg.norm(corner)))
    corner = apply(inverse(T), nearest[None])[0]
    assert ((np.abs(inside - corner) < 1e-6).sum(axis=1) >= 2).all()  # the three that meet in the corner towards the camera
    assert 200 < points["length"].sum() < 600


# --- sequences --------------------------------------------------------------------------------------------------------------


def sequence(one: Thing, count: int) -> list[np.ndarray]:
    T = from_rpy((-0.12, 0.0, 0.9), (1.2, 0.4, 0.3))
    return [perturb(T, [0.006 * i, 0.001 * i, 0.002 * i, 0.01 * i, 0.02 * i, 0.0]) for i in range(count)]


def test_a_sequence_is_tracked_through_a_gap_and_found_again(drill, rigid):
    poses = sequence(drill, 24)
    tracker = Tracker(rigid, K, moved(poses[0], 15.0, 0.02, np.random.default_rng(0)))
    rng = np.random.default_rng(1)
    for i, T in enumerate(poses):
        hidden = 10 <= i < 16
        mask = spoiled(drawn(drill, T), 0.9, rng) & (not hidden)
        found = tracker.update(mask)
        if hidden:
            assert found.state == "lost"
            assert found.covariance[0, 0] >= 1.0
        elif i not in (16, 17):  # two frames to find it again
            assert found.state == "tracking", i
            assert errors(drill, found.T, T).add < CONVERGED, i


def test_behind_a_known_occluder_the_object_is_occluded_and_not_lost(drill, rigid):
    poses = sequence(drill, 6)
    tracker = Tracker(rigid, K, poses[0])
    for T in poses[:4]:
        assert tracker.update(drawn(drill, T)).state == "tracking"
    everything = np.ones((HEIGHT, WIDTH), bool)
    assert tracker.update(drawn(drill, poses[4]), everything).state == "occluded"
    assert tracker.update(drawn(drill, poses[5])).state == "tracking"


def test_a_sequence_of_pictures_is_tracked_and_found_again(drill, rigid):
    poses = sequence(drill, 12)
    tracker = Tracker(rigid, K, moved(poses[0], 15.0, 0.02, np.random.default_rng(0)))
    nothing = Thing("nothing", trimesh.creation.box((1e-3, 1e-3, 1e-3)), np.eye(3)[None])
    for i, T in enumerate(poses):
        hidden = 6 <= i < 8
        found = tracker.update(None, picture=photographed(nothing if hidden else drill, T, 3))
        if hidden:
            assert found.state == "lost", i
        else:
            assert found.state != "lost", i
            assert errors(drill, found.T, T).add < CONVERGED, i


# --- commands ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def given(drill: Thing, tmp_path_factory) -> dict[str, Path]:
    """The files of a good call."""
    folder = tmp_path_factory.mktemp("given")
    T, mask = scene(drill, (77, 0), NOISY)
    start = moved(T, 20.0, 0.03, np.random.default_rng(0))
    drill.mesh.copy().apply_scale(1000.0).export(folder / "mesh.ply")
    cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    (folder / "init.json").write_text(json.dumps({"camera_from_object": start.tolist()}))
    (folder / "truth.json").write_text(json.dumps({"camera_from_object": T.tolist()}))
    return {path.stem: path for path in folder.iterdir()}


def command(given: dict[str, Path], *more: str, unit: str = "mm", **other: Path) -> list[str]:
    files = {name: given[name] for name in ("mesh", "mask", "camera", "init")} | other
    return [
        "search",
        "refine",
        "--mesh-unit",
        unit,
        *(word for name, path in files.items() for word in (f"--{name}", str(path))),
        *more,
    ]


def test_refine_prints_pose_covariance_overlap_and_state(given, drill, capsys):
    assert cli.main(command(given, "--json")) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["camera_from_object", "covariance", "overlap", "state"]
    T = tools.read_pose(given["truth"])
    assert errors(drill, np.array(result["camera_from_object"]), T).add < CONVERGED
    assert np.array(result["covariance"]).shape == (6, 6)
    assert np.linalg.eigvalsh(result["covariance"])[0] > 0
    assert result["state"] == "tracking"
    assert 0.8 < result["overlap"] <= 1.0


def test_refine_in_words(given, capsys):
    assert cli.main(command(given)) == 0
    assert capsys.readouterr().out.startswith("state      tracking, overlap 0.")


def test_refine_on_a_picture_without_a_mask(given, drill, capsys, tmp_path):
    T = tools.read_pose(given["truth"])
    image = tmp_path / "image.png"
    cv2.imwrite(str(image), photographed(drill, T, 1)[..., ::-1])
    argv = command(given, "--json", image=image)
    at = argv.index("--mask")
    assert cli.main(argv[:at] + argv[at + 2 :]) == 0
    assert errors(drill, np.array(json.loads(capsys.readouterr().out)["camera_from_object"]), T).add < 0.03
    at = argv.index("--image")
    argv = argv[:at] + argv[at + 2 :]
    at = argv.index("--mask")
    assert cli.main(argv[:at] + argv[at + 2 :]) == 2
    assert "expected --mask, --image or both, got neither" in capsys.readouterr().err


def test_the_benchmark_measures_folders_of_photographs(given, drill, tmp_path, capsys):
    case, T = tmp_path / "cases" / "drill", tools.read_pose(given["truth"])
    (case / "frames").mkdir(parents=True)
    drill.mesh.export(case / "mesh.ply")
    for name in ("camera.json", "mask.png"):
        (case / name).write_bytes(given[Path(name).stem].read_bytes())
    picture = photographed(drill, T, 1)[..., ::-1]
    frames = [{"file": f"frames/{i}.png", "camera_from_object": T.tolist()} for i in range(2)]
    for path in ("rgb.png", *(str(frame["file"]) for frame in frames)):
        cv2.imwrite(str(case / path), picture)
    (case / "truth.json").write_text(json.dumps({"camera_from_object": T.tolist(), "frames": frames}))
    argv = ["bench", "objects", "--cases", str(case.parent), "--starts", "1", "--json", str(tmp_path / "result.json")]
    assert cli.main(argv) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert [(row["with"], row["start"]) for row in result["cases"]] == [
        (given, start) for given in ("mask+picture", "picture") for start in ([20.0, 0.03], [30.0, 0.05])
    ]
    for row in result["cases"]:
        assert row["name"] == "drill"
        assert row["converged"] in (0.0, 1.0)
        assert row["wrong_but_tracking"] <= 1.0 - row["converged"]
        assert (row["error_of_diameter"] < CONVERGED) == (row["converged"] == 1.0)
        assert row["ms"] > 0.0
    assert result["cases"][0]["converged"] == 1.0
    (sequence,) = result["sequences"]
    assert (sequence["name"], sequence["frames"]) == ("drill", 2)
    assert cli.main(["bench", "objects", "--cases", str(tmp_path / "none")]) == 2
    assert "expected a folder of cases, found none" in capsys.readouterr().err


def wrong(given: dict[str, Path], folder: Path, what: str) -> tuple[list[str], str]:
    """A command with one thing wrong, and what its error has to say."""

    def new(suffix: str) -> Path:
        return folder / f"{len(list(folder.iterdir()))}.{suffix}"

    def changed(name: str, **values: object) -> Path:
        path = new("json")
        path.write_text(json.dumps({**json.loads(given[name].read_text()), **values}))
        return path

    def picture(array: np.ndarray) -> Path:
        path = new("png")
        cv2.imwrite(str(path), array)
        return path

    def pose(T: np.ndarray) -> Path:
        return changed("init", camera_from_object=T.tolist())

    def case(error: str, unit: str = "mm", **files: Path) -> tuple[list[str], str]:
        return command(given, unit=unit, **files), error

    T = tools.read_pose(given["init"])
    behind, mirrored, scaled, far, tiny = T.copy(), T.copy(), T.copy(), T.copy(), T.copy()
    behind[2, 3] = -1.0
    mirrored[:3, 0] *= -1
    scaled[:3, :3] *= 1.1
    far[:3, 3] *= 1000.0
    tiny[2, 3] = 20.0
    aside = T.copy()
    aside[0, 3] = 30.0
    infinite = json.loads(given["init"].read_text())["camera_from_object"]
    infinite[0][0] = float("nan")
    mask = cv2.imread(str(given["mask"]), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    text = folder / "text.png"
    text.write_text("no image")
    points = folder / "points.ply"
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(50, 3))).export(points)
    cases = {
        "empty mask": case("expected pixels that show the object", mask=picture(np.zeros_like(mask))),
        "full mask": case("check whether it is inverted", mask=picture(np.full_like(mask, 255))),
        "small mask": case("expected an image of 640 x 480", mask=picture(mask[::2, ::2])),
        "mask is text": case("expected an image that OpenCV reads", mask=text),
        "no mask": case("expected an image file, found none", mask=folder / "none.png"),
        "millimetres as metres": case("if its unit is", unit="m"),
        "points": case("expected a triangle mesh, got a file without triangles", mesh=points),
        "mesh is text": case("a triangle mesh", mesh=text),
        "no mesh": case("expected a mesh file, found none", mesh=folder / "none.ply"),
        "no camera": case("expected a readable JSON file", camera=folder / "none.json"),
        "camera is text": case("expected JSON", camera=text),
        "missing key": case("got none of fy", camera=_without(given["camera"], "fy", folder)),
        "focal length in millimetres": case(
            "check whether it is in millimetres or for another image size", camera=changed("camera", fx=4.2)
        ),
        "principal point outside": case(
            "check that width and height belong to these intrinsics", camera=changed("camera", cx=2000.0)
        ),
        "unlike focal lengths": case("fx and fy of nearly the same size", camera=changed("camera", fy=200.0)),
        "no number": case("expected a finite number, got 'wide'", camera=changed("camera", fx="wide")),
        "behind": case("expected the whole object at least 0.05 m in front of the camera", init=pose(behind)),
        "mirror image": case("without scale or mirror image", init=pose(mirrored)),
        "scaled": case("without scale or mirror image", init=pose(scaled)),
        "pose in millimetres": case("check whether it is in millimetres", init=pose(far)),
        "not finite": case("expected finite numbers", init=changed("init", camera_from_object=infinite)),
        "three rows": case("expected 4 rows of 4 numbers, got shape (3, 4)", init=pose(T[:3])),
        "other key": case("expected the key camera_from_object", init=given["camera"]),
        "tiny start": case("about as large as the mask", init=pose(tiny)),
        "outside start": case("in or near the image", init=pose(aside)),
    }
    return cases[what]


def _without(path: Path, key: str, folder: Path) -> Path:
    value = json.loads(path.read_text())
    del value[key]
    out = folder / "less.json"
    out.write_text(json.dumps(value))
    return out


WRONG = """empty mask|full mask|small mask|mask is text|no mask|millimetres as metres|points|mesh is text|no mesh|no camera
camera is text|missing key|focal length in millimetres|principal point outside|unlike focal lengths|no number|behind|mirror image
scaled|pose in millimetres|not finite|three rows|other key|tiny start|outside start"""


@pytest.mark.parametrize("what", WRONG.replace("\n", "|").split("|"))
def test_wrong_input_is_one_line_that_says_what_to_do_and_exit_code_two(what, given, tmp_path, capsys):
    argv, error = wrong(given, tmp_path, what)
    assert cli.main(argv) == 2
    out = capsys.readouterr()
    assert out.out == ""
    assert out.err.startswith("penumbra search refine: ")
    assert error in out.err
    assert len(out.err.splitlines()) == 1


BARREL: dict[str, Any] = {"k1": -0.35, "k2": 0.15, "p1": 0.001, "p2": -0.001}


def bent(mask_of, lens: Lens) -> np.ndarray:
    """A silhouette as a lens shows it. mask_of: the silhouette in a window (x0, y0, w, h) of the pinhole picture."""
    distortion = Distortion(lens)
    shown = np.repeat(mask_of(distortion.window).astype(np.float32)[..., None], 3, axis=2)
    return distortion(shown)[..., 0] > 0.5


def test_a_distorted_camera_s_mask_gives_the_pose_only_with_its_distortion(given, drill, tmp_path, capsys):
    mesh = mesh_of(drill)
    T = sequence(drill, 1)[0]
    T[:3, 3] = (0.75 * (WIDTH - K.cx) / K.fx * T[2, 3], 0.4 * (HEIGHT - K.cy) / K.fy * T[2, 3], T[2, 3])  # towards a corner
    k = (K.fx, K.fy, K.cx, K.cy)
    mask = bent(lambda window: raster.silhouette(apply(T, mesh.vertices), mesh.faces, k, window), Lens(**CAMERA, **BARREL))
    cv2.imwrite(str(tmp_path / "mask.png"), mask.astype(np.uint8) * 255)
    (tmp_path / "init.json").write_text(
        json.dumps({"camera_from_object": moved(T, 8.0, 0.015, np.random.default_rng(0)).tolist()})
    )
    away = {}
    for name, extra in (("known", BARREL), ("ignored", {})):
        (tmp_path / f"{name}.json").write_text(json.dumps(CAMERA | extra))
        files = {
            "mesh": given["mesh"],
            "camera": tmp_path / f"{name}.json",
            "mask": tmp_path / "mask.png",
            "init": tmp_path / "init.json",
        }
        words = [word for flag, path in files.items() for word in (f"--{flag}", str(path))]
        assert cli.main(["search", "refine", "--mesh-unit", "mm", "--json", *words]) == 0
        found = np.array(json.loads(capsys.readouterr().out)["camera_from_object"])
        away[name] = float(np.linalg.norm(found[:3, 3] - T[:3, 3]))
    assert away["known"] < 0.004 and away["ignored"] > 3.0 * away["known"]


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ({"k4": 0.1}, "k4: the rational, thin-prism and tilted models are not supported"),
        ({"fisheye": True}, "undistort the pictures with cv2.fisheye"),
        ({"distortion_model": "plumb_bob"}, "expected no name of a model"),
        ({"dist_coeffs": [0, 0]}, "expected the coefficients one by one, k1 k2 p1 p2 k3"),
        ({"K1": 0.1}, "got K1; did you mean k1"),
        ({"k1": True}, "k1: "),
        ({"k1": -9.0}, "folds over"),
        ({"fx": K.cx, "cx": K.fx}, "not swapped with cx"),
    ],
)
def test_another_distortion_is_refused_and_never_ignored(given, extra, words, tmp_path, capsys):
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | extra))
    files = {**{name: given[name] for name in ("mesh", "mask", "init")}, "camera": tmp_path / "camera.json"}
    argv = [word for flag, path in files.items() for word in (f"--{flag}", str(path))]
    assert cli.main(["search", "refine", "--mesh-unit", "mm", *argv]) == 2
    assert words in capsys.readouterr().err


def test_the_camera_file_of_an_object_data_set_is_read(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"depth_scale": 0.1}))
    assert tools.read_camera(tmp_path / "camera.json") == Lens(**CAMERA)


def test_track_writes_a_table_and_a_video(given, drill, tmp_path, capsys):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    poses = sequence(drill, 12)
    for i, T in enumerate(poses):
        cv2.imwrite(str(masks / f"frame{i}.png"), drawn(drill, T).astype(np.uint8) * (0 if i in (5, 6) else 255))
    init = tmp_path / "init.json"
    init.write_text(json.dumps({"camera_from_object": moved(poses[0], 15.0, 0.02, np.random.default_rng(0)).tolist()}))
    files = {"mesh": given["mesh"], "camera": given["camera"], "init": init, "masks": masks, "out": out}
    argv = ["search", "track", "--mesh-unit", "mm", *(word for name, path in files.items() for word in (f"--{name}", str(path)))]
    assert cli.main(argv) == 0
    assert capsys.readouterr().out == f"12 frames: 10 tracking, 0 occluded, 0 doubtful, 2 lost; see {out}\n"
    rows = list(csv.DictReader((out / "poses.csv").open()))
    assert [row["frame"] for row in rows] == [f"frame{i}.png" for i in range(12)]  # by number: 2 before 10
    assert [i for i, row in enumerate(rows) if row["state"] == "lost"] == [5, 6]
    last = [float(rows[-1][name]) for name in ("x", "y", "z")]
    assert np.linalg.norm(np.array(last) - poses[-1][:3, 3]) < 0.01
    video = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 12


def test_track_asks_for_a_picture_of_every_mask(given, tmp_path, capsys):
    masks, images = tmp_path / "masks", tmp_path / "images"
    masks.mkdir(), images.mkdir()
    mask = cv2.imread(str(given["mask"]))
    assert mask is not None
    for name in ("a", "b"):
        cv2.imwrite(str(masks / f"{name}.png"), mask)
    cv2.imwrite(str(images / "a.png"), mask)
    files = {"mesh": given["mesh"], "camera": given["camera"], "init": given["init"], "masks": masks, "images": images}
    argv = ["search", "track", "--mesh-unit", "mm", *(word for name, path in files.items() for word in (f"--{name}", str(path)))]
    assert cli.main(argv) == 2
    assert "expected an image of the same name for every mask, got none for 1 of 2, first b" in capsys.readouterr().err


def test_the_benchmark_writes_a_row_for_every_object_mask_and_start(tmp_path, capsys):
    path = tmp_path / "result.json"
    assert cli.main(["bench", "objects", "--objects", "duck", "--starts", "1", "--seed", "3", "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert result["seed"] == 3
    assert [(row["object"], row["mask_iou"], row["start_deg"]) for row in result["rows"]] == [
        (name, mask, degrees) for name in ("duck", "all") for mask in ("exact", "0.86") for degrees in (20.0, 30.0)
    ]
    assert all(row["converged"] in (0.0, 1.0) and row["ms_median"] > 0 for row in result["rows"])
    assert "share converged" in capsys.readouterr().out
