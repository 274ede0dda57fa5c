"""Masks of files, and learning from a user's own frames and masks: the forms of the data, its errors, the way to a card."""

import json

import cv2
import numpy as np
import pytest
import torch

from penumbra.services.command import cli
from penumbra.services.segmentation import inference, prednet
from penumbra.services.segmentation.prednet import PredNet, Settings
from penumbra.services.segmentation.training import evaluate, recordings, train
from penumbra.shared.contract.labels import Label
from penumbra.sim.sets import sequences

SMALL = Settings(channels=(4, 4, 8), kernels=(3, 3, 3), decoder_channels=4)


@pytest.fixture(autouse=True)
def one_thread():
    torch.manual_seed(0)
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def scene() -> sequences.Sequence:
    return sequences.render(7, 1, sequences.Variety(frames=4, size=96))


@pytest.fixture
def weights(tmp_path):
    card = {"seed": 0, "date": "2026-01-01", "calibration": {"target_logit_offset": 0.0}, "held_out": {}}
    prednet.save(tmp_path / "net.npz", PredNet(SMALL), card)
    return tmp_path / "net.npz"


def write_pairs(folder, scene, name="", count=4):
    (folder / name).mkdir(parents=True, exist_ok=True)
    for t in range(count):
        cv2.imwrite(str(folder / name / f"{t:04d}.png"), scene.images[t % 4][..., ::-1])
        cv2.imwrite(str(folder / name / f"{t:04d}_mask.png"), scene.labels[t % 4])


def test_pairs_give_back_images_and_labels_and_folders_are_sequences(tmp_path, scene):
    write_pairs(tmp_path, scene, "first")
    write_pairs(tmp_path, scene, count=2)
    found = recordings.find(tmp_path)
    assert sorted(map(len, found)) == [1, 1, 4]
    sequence = recordings.Recorded(max(found, key=len), (96, 96))
    np.testing.assert_array_equal(sequence.images[:4], scene.images)
    np.testing.assert_array_equal(sequence.labels[:4], scene.labels)
    np.testing.assert_array_equal(sequence.labels[4:7], scene.labels[[2, 1, 0]])  # too short: forth and back
    assert np.isnan(sequence.hidden).all()


def test_images_and_masks_in_two_folders_are_the_same(tmp_path, scene):
    for kind in ("images", "masks"):
        (tmp_path / kind / "a").mkdir(parents=True)
    for t in range(4):
        cv2.imwrite(str(tmp_path / "images" / "a" / f"{t}.jpg"), scene.images[t][..., ::-1])
        cv2.imwrite(str(tmp_path / "masks" / "a" / f"{t}.png"), scene.labels[t])
    (only,) = recordings.find(tmp_path)
    _, labels = only[2].read()
    np.testing.assert_array_equal(labels, scene.labels[2])


def test_coco_polygons_and_run_lengths_are_painted_in_order(tmp_path, scene):
    cv2.imwrite(str(tmp_path / "a.png"), scene.images[0][..., ::-1])
    flat = np.zeros((96, 96), bool)
    flat[20:30, 40:43] = True
    counts = np.diff(np.flatnonzero(np.diff(np.concatenate([[2], flat.T.ravel().astype(int), [2]])))).tolist()
    one = packed([counts[0], 1, 96 * 96 - 1 - counts[0]])
    content = {
        "images": [{"id": 5, "file_name": "a.png"}],
        "categories": [{"id": 1, "name": "Upper Arm"}, {"id": 2, "name": "hand"}, {"id": 3, "name": "forearm"}],
        "annotations": [
            {"image_id": 5, "category_id": 1, "segmentation": [[10, 10, 50, 10, 50, 50, 10, 50]]},
            {"image_id": 5, "category_id": 2, "segmentation": {"size": [96, 96], "counts": counts}},
            {
                "image_id": 5,
                "category_id": 3,
                "segmentation": {"size": [96, 96], "counts": one},
            },
        ],
    }
    (tmp_path / "labels.json").write_text(json.dumps(content))
    ((frame,),) = recordings.find(tmp_path)
    _, labels = frame.read()
    wanted = np.zeros((96, 96), np.uint8)
    wanted[10:50, 10:50] = Label.UPPER_ARM
    wanted[20:30, 40:43] = Label.HAND
    wanted[20, 40] = Label.FOREARM
    np.testing.assert_array_equal(labels, wanted)


def packed(counts: list[int]) -> str:
    """COCO's packing of run lengths, as its own tools write it."""
    text = ""
    for i, count in enumerate(counts):
        value = count - counts[i - 2] if i > 2 else count
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            text += chr((bits | 32 if more else bits) + 48)
    return text


def test_run_lengths_come_back_from_their_packing():
    counts = [3, 70, 1000, 2, 5, 4096]
    assert recordings._unpack(packed(counts)) == counts


def broken_size(folder, scene):
    write_pairs(folder, scene)
    cv2.imwrite(str(folder / "0001_mask.png"), scene.labels[1][:50])


def broken_values(folder, scene):
    write_pairs(folder, scene)
    cv2.imwrite(str(folder / "0001_mask.png"), np.full((96, 96), 7, np.uint8))


def broken_colours(folder, scene):
    write_pairs(folder, scene)
    cv2.imwrite(str(folder / "0001_mask.png"), scene.images[1])


def broken_picture(folder, scene):
    write_pairs(folder, scene)
    (folder / "0002.png").write_bytes(b"no picture")


def without_masks(folder, scene):
    cv2.imwrite(str(folder / "a.png"), scene.images[0])


def one_mask_missing(folder, scene):
    write_pairs(folder, scene)
    (folder / "0003_mask.png").unlink()


def sizes_in_a_sequence(folder, scene):
    write_pairs(folder, scene, "a")
    cv2.imwrite(str(folder / "a" / "0001.png"), scene.images[1][:64])
    cv2.imwrite(str(folder / "a" / "0001_mask.png"), scene.labels[1][:64])


def too_few(folder, scene):
    write_pairs(folder, scene, "a")


def black_and_white(folder, scene):
    for name in "abc":
        write_pairs(folder, scene, name)
    for path in folder.rglob("*_mask.png"):
        arm = np.isin(recordings.read_mask(path), [Label.FOREARM, Label.HAND])
        cv2.imwrite(str(path), 255 * arm.astype(np.uint8))


def unknown_category(folder, scene):
    content = {"images": [], "categories": [{"id": 1, "name": "dog"}], "annotations": []}
    (folder / "labels.json").write_text(json.dumps(content))


def no_coco(folder, scene):
    (folder / "labels.json").write_text('{"images": []}')


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (broken_size, r"0001_mask.png: expected a mask of 96 x 96 as 0001.png, got 96 x 50"),
        (broken_values, r"0001_mask.png: expected classes 0 background, .*, got 7 at row 0, column 0"),
        (broken_colours, r"0001_mask.png: expected one channel of class indices .*, got colours or a palette"),
        (broken_picture, r"0002.png: expected a picture, got a file that cannot be read as one"),
        (without_masks, r"got 1 pictures and 0 masks, no two of one name"),
        (one_mask_missing, r"expected a mask for 0003, found none"),
        (sizes_in_a_sequence, r"got 96 x 96 in 0000.png and 96 x 64 in 0001.png"),
        (too_few, r"expected at least 3 sequences, .*, got 1"),
        (black_and_white, r"got only 0 and 255; .* write the arm as 4 and the hand as 5"),
        (unknown_category, r"expected categories named background, .*, got 'dog'"),
        (no_coco, r"expected COCO format"),
    ],
)
def test_a_folder_that_does_not_fit_is_refused_with_what_was_expected(tmp_path, scene, spoil, says, capsys):
    spoil(tmp_path, scene)
    with pytest.raises(recordings.DataError, match=says):
        recordings.Recordings([tmp_path], 0)
    assert train.main(["--data", str(tmp_path), "--steps", "1"]) == 2
    assert "penumbra segmentation train: " in capsys.readouterr().err


@pytest.mark.parametrize("flag", ["--alone", "--beside"])
def test_only_an_encoder_can_learn_alone(tmp_path, capsys, flag):
    assert train.main([flag, "3", "--steps", "1", "--out", str(tmp_path / "net.npz")]) == 2
    assert f"{flag}: expected a network with an encoder, got one without; add --encoder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nothing", "cuda:99"])
def test_a_device_that_is_not_there_is_refused_with_those_that_are(capsys, name):
    with pytest.raises(SystemExit):
        train.main(["--device", name, "--steps", "1"])
    assert "--device: expected a device that torch has here (cpu" in (said := capsys.readouterr().err) and repr(name) in said


def test_training_on_one_s_own_frames_keeps_some_apart_and_says_so_in_the_card(tmp_path, scene, weights):
    data = tmp_path / "mine"
    for name in "abcd":
        write_pairs(data, scene, name)
    out = tmp_path / "mine.npz"
    flags = ["--data", str(data), "--steps", "2", "--start", str(weights), "--out", str(out)]
    assert train.main([*flags, "--checkpoint", str(tmp_path / "checkpoint")]) == 0
    net, card = prednet.load(out)
    assert net.settings == SMALL and card["settings"]["steps"] == 2
    assert card["held_out"]["folder"] == "mine" and card["held_out"]["sequences"] == 1
    assert card["held_out"]["hidden share unknown"]["frames"] > 0
    assert inference.load_segmenter(out)


def test_weights_of_one_s_own_are_written_as_the_mean_with_those_that_they_began_with(tmp_path, scene, weights, capsys):
    for name in "abcd":
        write_pairs(tmp_path / "mine", scene, name)
    found = {}
    for flags in ((), ("--with-start",)):
        out = tmp_path / "mine.npz"
        words = ["--data", str(tmp_path / "mine"), "--steps", "2", "--start", str(weights), "--out", str(out), *flags]
        assert train.main([*words, "--checkpoint", str(tmp_path / "checkpoint")]) == 0
        found[flags] = prednet.load(out)
    (learned, _), (both, card) = found.values()
    begun, begun_card = prednet.load(weights)
    for a, b, c in zip(learned.parameters(), begun.parameters(), both.parameters(), strict=True):
        torch.testing.assert_close((a + b) / 2.0, c, rtol=1e-2, atol=1e-4)  # half precision
    assert any(not torch.equal(a, c) for a, c in zip(learned.parameters(), both.parameters(), strict=True))
    assert card["mean_with"] == [{key: begun_card[key] for key in ("seed", "date") if key in begun_card}]
    assert train.main(["--with-start", "--steps", "1"]) == 2
    assert "--with-start: expected --start, got none" in capsys.readouterr().err


def test_what_is_held_out_is_not_learned_from(tmp_path, scene):
    for name in "abcdefghijklmnopqrstu":
        write_pairs(tmp_path, scene, name, 1)
    data = recordings.Recordings([tmp_path], 3)
    parts = [[data[i] for i in range(data.count)], data.calibration, data.held_out]
    names = [{piece._frames[0].picture for piece in part} for part in parts]
    assert [len(part) for part in names] == [17, 2, 2]
    assert len(set.union(*names)) == 21


def test_a_small_folder_is_learned_from_as_often_as_a_large_one(tmp_path, scene):
    for folder, count in (("large", 12), ("small", 4)):
        for k in range(count):
            write_pairs(tmp_path / folder, scene, f"{k}", 1)
    data = recordings.Recordings([tmp_path / "large", tmp_path / "small"], 3)
    drawn = [data[i]._frames[0].picture.parent.parent.name for i in range(data.count)]
    assert drawn.count("large") == drawn.count("small") == 10
    assert len(data.calibration) == len(data.held_out) == 2


def test_pictures_get_a_mask_of_their_size_and_an_overlay(tmp_path, scene, weights):
    picture = np.zeros((99, 130, 3), np.uint8)
    picture[:96, :96] = scene.images[0]
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), picture)
    flags = ["--out", str(tmp_path / "out"), "--weights", str(weights)]
    assert cli.main(["segmentation", "infer", str(tmp_path / "a.png"), str(tmp_path / "b.png"), *flags]) == 0
    first, second = (cv2.imread(str(tmp_path / "out" / f"{name}_mask.png"), cv2.IMREAD_UNCHANGED) for name in "ab")
    assert first is not None and first.shape == (99, 130) and first.max() <= max(Label)
    assert first[96:].any() and first[:, 128:].any(), "nothing is left over at the edges"
    np.testing.assert_array_equal(first, second)  # each stands for itself
    overlay = cv2.imread(str(tmp_path / "out" / "a_overlay.png"))
    assert overlay is not None and overlay.shape == (99, 130, 3)


def test_a_film_gets_a_mask_a_frame_and_an_overlay_film(tmp_path, scene, weights):
    path = tmp_path / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (96, 96))
    for image in scene.images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    assert cli.main(["segmentation", "infer", str(path), "--out", str(tmp_path / "out"), "--weights", str(weights)]) == 0
    assert sorted(p.name for p in (tmp_path / "out" / "film_masks").iterdir()) == [f"{i:06d}.png" for i in range(4)]
    overlay = cv2.VideoCapture(str(tmp_path / "out" / "film_overlay.mp4"))
    assert overlay.get(cv2.CAP_PROP_FPS) == 10.0 and overlay.read()[1].shape == (96, 96, 3)


def test_files_that_cannot_be_read_are_named(tmp_path, weights, capsys):
    broken, film = tmp_path / "a.png", tmp_path / "b.mp4"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    film.write_bytes(b"no film")
    for path, says in (
        (broken, "cannot be read; check that it is whole"),
        (film, "of which OpenCV reads no frame"),
        (tmp_path / "c", "found no file"),
    ):
        assert cli.main(["segmentation", "infer", str(path), "--out", str(tmp_path), "--weights", str(weights)]) == 2
        error = capsys.readouterr().err
        assert says in error and str(path) in error


def test_weights_without_their_card_are_missed_by_name(tmp_path, scene, weights, capsys):
    cv2.imwrite(str(tmp_path / "a.png"), scene.images[0])
    weights.with_suffix(".json").unlink()
    command = ["segmentation", "infer", str(tmp_path / "a.png"), "--out", str(tmp_path), "--weights", str(weights)]
    assert cli.main(command) == 2
    assert f"{weights}: expected weights (.npz) with their card net.json beside them, got no card" in capsys.readouterr().err


def test_contour_offsets_measure_what_a_mask_is_too_large_by():
    truth = np.zeros((80, 80), np.uint8)
    truth[20:60, 20:60] = Label.FOREARM
    truth[20:60, 60:] = Label.OCCLUDER
    for grow in (-2, 0, 1, 3):
        found = np.zeros((80, 80), bool)
        found[20 - grow : 60 + grow, 20 - grow : 60] = True
        offsets = evaluate.contour_offsets(found, truth)
        assert len(offsets) == 3 * 40  # the side towards the occluder is not the target's own
        assert np.median(offsets) == pytest.approx(grow)
    assert len(evaluate.contour_offsets(np.zeros((80, 80), bool), truth)) == 0
