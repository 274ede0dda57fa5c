"""What the segmentation learns from beside the simulation's usual looks: posed hands, real cameras, photographs."""

import csv
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from penumbra.services.segmentation.inference import TARGET_LABELS
from penumbra.services.segmentation.training import data, pasted, photographs, recordings, street
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import UNLABELLED, Label
from penumbra.shared.perception import landmarks
from penumbra.sim.picture import limb, looks
from penumbra.sim.sets import sequences

NAMES = ["null", "bag", "coat", "jeans", "skin", "gloves", *(name for name in street.SLEEVED if name != "coat")]
NAMES += ["purse", "wallet", *street.WORN, "hair", "hat", "scarf"]


def test_a_posed_hand_is_as_large_as_the_stiff_one_and_its_forearm_is_the_same():
    body = cells.load("table").body
    rng = np.random.default_rng(0)
    reach = []
    for _ in range(20):
        mesh = limb.mesh(body, rng)
        assert set(mesh.labels) == {Label.FOREARM, Label.HAND} and mesh.faces.max() < len(mesh.vertices)
        hand = mesh.vertices[np.unique(mesh.faces[mesh.labels == Label.HAND])]
        reach.append(np.linalg.norm(hand - (body.forearm_length / 2.0, 0.0, 0.0), axis=1).max() / body.hand_length)
    assert 0.6 < min(reach) < 0.9 < max(reach) < 1.15  # fists and stretched hands


def test_sequences_as_real_cameras_show_them_have_arms_of_all_sizes():
    real = sequences.Variety(frames=1, size=96, real=1.0)
    shares = []
    for index in range(40):
        sequence = sequences.render(4, index, real)
        shares.append(np.isin(sequence.labels, TARGET_LABELS).mean())
        assert sequence.images.shape == (1, 96, 96, 3) and sequence.labels.max() <= max(Label)
    assert np.quantile(shares, 0.9) > 0.14 and np.median([share for share in shares if share > 0.0]) < 0.14


def test_a_cheap_camera_changes_a_film_s_colours_and_not_its_size():
    film = sequences.render(4, 1, sequences.Variety(frames=2, size=64)).images
    changed = [np.abs(looks.filmed(film, np.random.default_rng(seed)).astype(float) - film).mean() for seed in range(12)]
    assert looks.filmed(film, np.random.default_rng(0)).shape == film.shape and np.median(changed) > 2.0


def person() -> tuple[np.ndarray, landmarks.Pose]:
    """A person with a coat's body, two bare arms that hang down beside it, and a bag at the right hand, 200 x 120 pixels."""
    parts = np.full((200, 120), NAMES.index("null"), np.uint8)
    parts[40:130, 40:80] = NAMES.index("coat")
    parts[130:200, 45:75] = NAMES.index("jeans")
    parts[45:140, 20:30] = parts[45:140, 90:100] = parts[15:38, 50:70] = NAMES.index("skin")
    parts[140:165, 15:35] = NAMES.index("bag")
    points = np.full((33, 2), 60.0)
    points[0] = 60.0, 25.0
    places = {11: (95, 45), 13: (95, 85), 15: (95, 122), 17: (94, 135), 19: (96, 135)}
    places |= {first + 1: (120 - x, y) for first, (x, y) in places.items()}
    places |= {23: (70, 130), 25: (70, 165), 27: (70, 199), 24: (50, 130), 26: (50, 165), 28: (50, 199)}
    for index, place in places.items():
        points[index] = place
    return parts, landmarks.Pose(points, np.ones(33), 1.0)


def test_skin_is_forearm_or_hand_by_the_landmarks_and_what_nobody_knows_is_unlabelled():
    parts, pose = person()
    labels = street.masks(parts, NAMES, pose)
    for column in (25, 95):
        assert labels[60, column] == Label.UPPER_ARM
        assert labels[105, column] == Label.FOREARM
        assert labels[132, column] == Label.HAND
    assert labels[25, 60] == Label.TORSO and labels[60, 60] == Label.TORSO and labels[180, 60] == Label.TORSO
    assert labels[10, 10] == Label.BACKGROUND and labels[142, 17] == Label.OCCLUDER
    assert labels[105, 20] == UNLABELLED, "the contour is coarse"
    unsure = landmarks.Pose(pose.points, np.where(np.arange(33) == 13, 0.1, 1.0), 1.0)
    labels = street.masks(parts, NAMES, unsure)
    assert labels[105, 95] == UNLABELLED and labels[105, 25] == Label.FOREARM


@pytest.fixture
def folder(tmp_path):
    for name in ("images", "masks"):
        (tmp_path / name).mkdir()
    rng = np.random.default_rng(0)
    for index in range(6):
        mask = np.full((80, 96), Label.BACKGROUND, np.uint8)
        mask[20:60, 30:60] = Label.FOREARM
        mask[:10] = UNLABELLED
        cv2.imwrite(str(tmp_path / "masks" / f"{index}.png"), mask)
        cv2.imwrite(str(tmp_path / "images" / f"{index}.png"), rng.integers(0, 255, (80, 96, 3), dtype=np.uint8))
    return tmp_path


def test_photographs_are_turned_moved_and_seen_nearer_with_their_labels_and_unlabelled_outside(folder):
    recorded = recordings.Recordings([folder], 1)
    films = [data.moved(recorded[0], 3, 64, np.random.default_rng(seed)) for seed in range(8)]
    assert all(film.shape == (3, 64, 64, 4) for film in films)
    values = set(np.unique([film[..., 3] for film in films]))
    assert values == {Label.BACKGROUND, Label.FOREARM, UNLABELLED}
    assert any((film[0, ..., 3] != film[2, ..., 3]).any() for film in films)


def test_what_is_pasted_lies_in_front_with_its_labels():
    below = np.zeros((2, 32, 32, 6), np.uint8)
    over = np.full((2, 32, 32, 6), 200, np.uint8)
    over[..., 3] = Label.BACKGROUND
    over[:, :, :8, 3], over[:, :, 8:16, 3] = Label.ROBOT, Label.OCCLUDER
    out = data.pasted(below, over, np.random.default_rng(0))
    assert (out[:, :, :8, 3] == Label.ROBOT).all() and (out[:, :, 8:16, 3] == Label.OCCLUDER).all()
    assert (out[:, :, :13, :3] == 200).all() and not out[:, :, 20:, :4].any() and not below.any()
    assert (out[..., 4] == 200).all(), "what is known of the robot"


def test_the_people_of_another_recording_hide_what_is_behind_them():
    film, over = np.zeros((2, 32, 32, 4), np.uint8), np.full((2, 32, 32, 4), 200, np.uint8)
    film[..., 3], over[..., 3] = Label.HAND, Label.BACKGROUND
    over[:, 16:, :, 3], over[:, :, 24:, 3] = Label.FOREARM, UNLABELLED
    out = data.covered(film, over, data.PERSON)
    assert (out[:, 16:, :24, 3] == Label.FOREARM).all() and (out[:, 20:, :20, :3] == 200).all()
    assert (out[:, :16, :, 3] == Label.HAND).all() and (out[:, :, 24:, 3] == Label.HAND).all() and not out[:, :12, :, :3].any()


def test_recordings_and_simulated_sequences_are_mixed_by_their_share_and_both_are_scored(folder):
    tiny = sequences.Variety(frames=data.VARIETY.frames, size=data.VARIETY.size)

    def learned(seed, index):
        sequence = sequences.render(seed, 0, tiny)
        return sequences.Sequence(sequence.images, np.full_like(sequence.labels, Label.TORSO), sequence.hidden)

    simulated = data.Simulated(1, 2, learned, lambda seed, index: sequences.render(seed, index, tiny), most=1)
    mixed = data.Mixed(recordings.Recordings([folder], 1), simulated, 0.5, 1)
    simulated.count = data.ENDLESS
    share = np.mean([(mixed[index][..., 3] == Label.TORSO).all() for index in range(30)])
    assert 0.2 < share < 0.8  # 30 draws of a half
    plain = [mixed.plain(index) for index in range(30)]
    assert all(film.shape == (1, data.VARIETY.size, data.VARIETY.size, 4) for film in plain)
    assert set(np.unique([film[..., 3] for film in plain])) == {Label.BACKGROUND, Label.FOREARM, UNLABELLED}
    for kept in (list(mixed.calibration), list(mixed.held_out)):
        is_recorded = [bool(np.isnan(sequence.hidden).all()) for sequence in kept]
        assert is_recorded == [False, False, True, True]
        assert all(sequence.images.shape[1:3] == (data.VARIETY.size,) * 2 for sequence in kept)
    assert {"seed", "folder", "sequences", "simulated"} <= mixed.sources[1].keys()


MADE_UP = photographs.STREET, photographs.HANDS, "somebody/pictures", "nobody/cloned"


@pytest.fixture
def sources(tmp_path):
    """Tables and made-up clones: two labelled pictures, a large one and one on white, one without people, and one hand."""
    rng = np.random.default_rng(0)
    (tmp_path / "tables" / "masks").mkdir(parents=True)
    digits, pictures = tmp_path / "Sign-Language-Digits-Dataset" / "Dataset" / "5", tmp_path / "pictures"
    digits.mkdir(parents=True)
    pictures.mkdir()
    (tmp_path / "clothing-co-parsing").mkdir()
    lines = [f"{name},{'0' * 40},MIT,Somebody" for name in MADE_UP]
    (tmp_path / "tables" / "repositories.csv").write_text("\n".join(["repository,commit,licence,copyright", *lines]))
    lines = [
        "close,large,somebody/pictures,large.png,,960,480,",
        "close,white,somebody/pictures,white.png,,120,90,white",
        "close,elsewhere,nobody/cloned,1.png,,120,90,",
        "scene,desk,somebody/pictures,desk.png,,120,90,",
    ]
    header = "kind,name,repository,path,frame,width,height,backdrop"
    (tmp_path / "tables" / "pictures.csv").write_text("\n".join([header, *lines]))
    cv2.imwrite(str(pictures / "large.png"), np.full((1000, 2000, 3), 90, np.uint8))
    cv2.imwrite(str(pictures / "desk.png"), rng.integers(100, 140, (90, 120, 3), dtype=np.uint8))
    white, mask = np.full((90, 120, 3), 255, np.uint8), np.zeros((90, 120), np.uint8)
    white[50:, 40:60], mask[50:, 40:60] = (90, 120, 200), Label.HAND
    white[20:50, 30:90] = 20  # what it holds
    cv2.imwrite(str(pictures / "white.png"), white)
    cv2.imwrite(str(tmp_path / "tables" / "masks" / "white.png"), mask)
    cv2.imwrite(str(tmp_path / "tables" / "masks" / "large.png"), np.full((480, 960), Label.FOREARM, np.uint8))
    cv2.imwrite(str(digits / "1.JPG"), arm())
    return tmp_path


def arm() -> np.ndarray:
    """A hand with a narrower wrist before a grey wall, 100 x 100 BGR."""
    image = np.full((100, 100, 3), 180, np.uint8)
    cv2.ellipse(image, (50, 45), (22, 28), 0, 0, 360, (90, 120, 200), -1)
    image[60:, 40:60] = (90, 120, 200)
    return cv2.blur(image, (3, 3)).astype(np.uint8)


def seen(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


def test_a_hand_is_cut_out_by_its_colour_and_parted_at_the_wrist():
    cutout = pasted.hand(arm())
    assert cutout is not None and cutout.solid.shape == (pasted.SIDE, pasted.SIDE)
    truth = cv2.resize((arm()[..., 0] < 135).astype(np.uint8), (pasted.SIDE, pasted.SIDE)).astype(np.uint8)
    assert (cutout.solid & truth).sum() / (cutout.solid | truth).sum() > 0.95
    assert cutout.labels[90, 100] == Label.HAND and cutout.labels[190, 100] == Label.FOREARM
    assert cutout.labels[90, 10] == Label.BACKGROUND
    assert pasted.hand(np.full((100, 100, 3), 180, np.uint8)) is None
    assert pasted.hand(np.ascontiguousarray(arm()[::-1])) is None, "an arm from above"


def test_what_is_pasted_into_a_scene_has_its_classes_where_it_is_seen():
    cutout = pasted.hand(arm())
    assert cutout is not None
    sides = set()
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scene, labels = np.full((240, 320, 3), (60, 60, 60), np.uint8), np.zeros((240, 320), np.uint8)
        pasted.paste(scene, labels, cutout, pasted.from_side(cutout, 240, 320, rng), rng)
        target = np.isin(labels, TARGET_LABELS)
        skin = scene[..., 2].astype(int) - scene[..., 0] > 40
        assert (skin & target).sum() > 0.95 * target.sum() > 0 and not (skin & (labels == Label.BACKGROUND)).any()
        ends = {"above": labels[0], "below": labels[-1], "left": labels[:, 0], "right": labels[:, -1]}
        sides |= {side for side, edge in ends.items() if np.isin(edge, TARGET_LABELS).any()}
    assert sides == {"above", "below", "left", "right"}


def test_clones_become_folders_to_train_on_and_what_is_missing_is_named(sources, monkeypatch, capsys):
    monkeypatch.setattr(photographs, "SCENE", (90, 120))
    call = [str(sources), "--tables", str(sources / "tables"), "--out", str(sources / "out"), "--models", str(sources / "none")]
    assert photographs.main(call) == 0
    said = capsys.readouterr()
    assert "expected clones of nobody/cloned as well" in said.err and not (sources / "out" / "street").exists()
    assert "street is left out" in said.err and "penumbra segmentation models" in said.err
    close, scenes = (sources / "out" / kind for kind in ("close", "scenes"))
    assert {path.stem for path in (close / "images").iterdir()} == {"large", "white"}
    assert seen(close / "images" / "large.jpg").shape == (480, 960, 3)
    assert (recordings.read_mask(close / "masks" / "large.png") == Label.FOREARM).all()
    names = {"desk", "hands-000", *(f"white-{index}" for index in range(photographs.REPEATS))}
    assert {path.stem for path in (scenes / "masks").iterdir()} == names
    assert not recordings.read_mask(scenes / "masks" / "desk.png").any()
    image, mask = seen(scenes / "images" / "white-0.jpg"), recordings.read_mask(scenes / "masks" / "white-0.png")
    assert (mask == Label.HAND).sum() > 600 and image.min(2).max() < 180, "no white is left"
    (made_of,) = recordings.Recordings([scenes, scenes], 1).origins
    assert made_of["folder"] == "scenes" and made_of["sequences"] > 0 and made_of["times"] == 2
    assert {one["repository"]: one["licence"] for one in made_of["sources"]}.keys() == {"somebody/pictures", photographs.HANDS}
    before = {path.name: path.read_bytes() for path in scenes.rglob("*.*")}
    assert photographs.main(call) == 0 and before == {path.name: path.read_bytes() for path in scenes.rglob("*.*")}


def test_missing_clones_are_got_at_the_commit_of_the_table_with_nothing_but_the_pictures(sources, monkeypatch, capsys):
    monkeypatch.setattr(photographs, "SCENE", (90, 120))
    published = sources / "published" / "nobody" / "cloned"

    def git(*words: str) -> str:
        identity = ("-c", "user.name=nobody", "-c", "user.email=nobody")
        return subprocess.run(
            ["git", *identity, *words], cwd=published, check=True, capture_output=True, text=True
        ).stdout.strip()

    published.mkdir(parents=True)
    git("init", "--quiet")
    image = np.full((90, 120, 3), 200, np.uint8)
    for name in ("arms [1].png", "arms 1.png"):
        cv2.imwrite(str(published / name), image)
    git("add", ".")
    git("commit", "--quiet", "--message", "the one of the table")
    commit = git("rev-parse", "HEAD")
    cv2.imwrite(str(published / "arms [1].png"), image[:50])
    git("commit", "--quiet", "--all", "--message", "a later one")
    tables = sources / "tables"
    cv2.imwrite(str(tables / "masks" / "elsewhere.png"), np.full((90, 120), Label.HAND, np.uint8))
    pictures, repositories = tables / "pictures.csv", tables / "repositories.csv"
    pictures.write_text(pictures.read_text().replace("nobody/cloned,1.png", "nobody/cloned,arms [1].png"))
    call = [str(sources), "--tables", str(tables), "--out", str(sources / "out"), "--models", str(sources / "none")]
    call += ["--get", str(sources / "published")]

    assert photographs.main(call) == 0
    assert "nobody/cloned: expected git to clone commit 000000" in capsys.readouterr().err and not (sources / "cloned").exists()
    repositories.write_text(repositories.read_text().replace(f"nobody/cloned,{'0' * 40}", f"nobody/cloned,{commit}"))
    assert photographs.main(call) == 0
    assert "nobody/cloned" not in capsys.readouterr().err
    assert {path.name for path in (sources / "cloned").iterdir()} == {".git", "arms [1].png"}
    assert (recordings.read_mask(sources / "out" / "close" / "masks" / "elsewhere.png") == Label.HAND).all()


def test_a_clone_of_another_commit_is_refused(sources, capsys):
    cv2.imwrite(str(sources / "pictures" / "white.png"), np.zeros((91, 120, 3), np.uint8))
    call = [str(sources), "--tables", str(sources / "tables"), "--out", str(sources / "out"), "--models", str(sources / "none")]
    assert photographs.main(call) == 2
    assert "expected 120 x 90, got 120 x 91; check out the commit" in capsys.readouterr().err
    assert photographs.main([str(sources / "none"), *call[1:]]) == 2


def test_the_project_has_a_mask_of_the_right_size_for_each_photograph_that_it_names():
    tables = Path(__file__).parents[1] / "training" / "photographs"
    rows = {kind: list(csv.DictReader((tables / f"{kind}.csv").open())) for kind in ("repositories", "pictures")}
    repositories = {row["repository"] for row in rows["repositories"]}
    assert {row["repository"] for row in rows["pictures"]} | {photographs.STREET, photographs.HANDS} == repositories
    close = {row["name"]: row for row in rows["pictures"] if row["kind"] == "close"}
    assert {path.stem for path in (tables / "masks").iterdir()} == set(close)
    for name, row in close.items():
        mask = recordings.read_mask(tables / "masks" / f"{name}.png")
        assert mask.shape == (int(row["height"]), int(row["width"])) and np.isin(mask, TARGET_LABELS).any(), name
