"""The benchmarks of the segmentation: what recovery is, the form of the JSON file, that variants learn from the same data."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from penumbra.services.segmentation import files, inference, prednet
from penumbra.services.segmentation.prednet import PredNet, Settings
from penumbra.services.segmentation.training import recordings
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED
from penumbra.sim.sets import sequences
from penumbra.tests.bench import ablation, segmentation
from penumbra.tests.bench.lib import photographs


def test_recovery_is_counted_from_half_free_again_to_the_overlap_of_before():
    hidden = [0.0] * 12 + [0.6] + [1.0] * 8 + [0.8, 0.4, 0.2, 0.0, 0.0, 0.0]
    iou = [0.9] * 12 + [0.8] + [np.nan] * 8 + [0.2, 0.5, 0.7, 0.8, 0.82, 0.9]
    assert segmentation.recoveries(hidden, iou) == [4]  # 0.82 is the first of at least 0.9 * 0.9
    unseen = [0.3] * 13 + iou[13:]
    assert segmentation.recoveries(hidden, unseen) == [None]  # nothing to return to
    assert segmentation.recoveries(hidden[:22], iou[:22]) == [None]  # the film ends
    assert segmentation.recoveries(hidden, iou[:20] + [0.1] * 7) == [6]  # never: one more than the frames watched
    twice = segmentation.recoveries(hidden + hidden[1:], iou + iou[1:])
    assert twice == [4, 4]


@pytest.mark.slow
def test_the_benchmark_writes_the_agreed_numbers(tmp_path, capsys):
    assert segmentation.main(["--seed", "3", "--frames", "20", "--films", "0", "--json", str(tmp_path / "out.json")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert set(found) >= {"seed", "rows", "recovery_frames", "ms_per_frame", "run"}
    assert [row["occlusion"] for row in found["rows"]] == [[0.0, 0.33], [0.33, 0.66], [0.66, 0.95]]
    keys = {"occlusion", "frames", "iou", "area_bias", "contour_mean_px", "contour_rms_px"}
    assert all(set(row) >= keys for row in found["rows"])
    assert 0 < sum(row["frames"] for row in found["rows"]) <= 22
    assert "0.93" in capsys.readouterr().out  # the goal beside it


@pytest.mark.slow
def test_a_network_that_has_priors_is_measured_without_with_right_and_with_wrong_ones(tmp_path, capsys):
    net = PredNet(Settings((4, 4, 8), (3, 3, 3), 4, priors=2))
    prednet.save(tmp_path / "net.npz", net, {"calibration": {"target_logit_offset": 0.0}})
    flags = ["--seed", "3", "--frames", "20", "--films", "0", "--weights", str(tmp_path / "net.npz")]
    assert segmentation.main([*flags, "--json", str(tmp_path / "out.json")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    measured = [found[name] for name in ("rows", "with_priors", "with_wrong_priors")]
    assert all([row["frames"] for row in rows] == [row["frames"] for row in measured[0]] for rows in measured)
    assert len({json.dumps(rows) for rows in measured}) == 3
    assert "with wrong priors" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_the_ablation_trains_each_variant_as_long_and_scores_it(tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "SCHEDULE", replace(ablation.SCHEDULE, patches=((0.0, 32, 1),), seen=((0, 1.0),)))
    monkeypatch.setattr(ablation, "SEQUENCES", 3)
    monkeypatch.setattr(ablation, "HELD_OUT", 2)
    tiny = Settings(channels=(4, 4), kernels=(3, 3))
    small = {"hGRU": (tiny, 0.3), "ConvLSTM, no prediction loss": (replace(tiny, cell="convlstm"), 0.0)}
    monkeypatch.setattr(ablation, "VARIANTS", small)
    flags = ["--steps", "2", "--seed", "5", "--json", str(tmp_path / "out.json")]
    assert ablation.main(flags) == 0
    found = json.loads((tmp_path / "out.json").read_text())["variants"]
    assert [(one["variant"], one["steps"]) for one in found] == [(name, 2) for name in small]
    assert all(sum(row["frames"] for row in one["rows"]) > 0 for one in found)


def test_the_authors_variants_are_of_one_size_and_differ_in_one_thing_each():
    reference, others = Settings(), [value for name, value in ablation.VARIANTS.items() if name != "hGRU"]
    for settings, error_weight in others:
        differs = [settings.delay != reference.delay, settings.cell != reference.cell, error_weight != 0.3]
        assert sum(differs) == 1
        assert settings.channels == reference.channels


@pytest.mark.parametrize("index", [0, 1])
def test_easy_scenes_show_the_target_and_are_a_function_of_seed_and_index(index):
    first, again = ablation.easy(9, index), ablation.easy(9, index)
    np.testing.assert_array_equal(first.images, again.images)
    assert first.images.shape == (8, ablation.SIDE, ablation.SIDE, 3) and first.labels.max() > 0


@pytest.fixture
def photograph(tmp_path):
    """A folder with one picture, as large as a photograph and two thirds of it beside the arm, and its mask."""
    drawn = sequences.render(11, 4, sequences.Variety(frames=5, size=192))
    image, mask = np.zeros((300, 400, 3), np.uint8), np.zeros((300, 400), np.uint8)
    image[60:252, 120:312], mask[60:252, 120:312] = drawn.images[-1], drawn.labels[-1]
    for folder, picture in (("images", image[..., ::-1]), ("masks", mask)):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "arm.png"), picture)
    return tmp_path


def test_photographs_are_scored_without_their_unlabelled_pixels(photograph, tmp_path, capsys):
    (photograph / "index.json").write_text("[]")  # what else lies there does not matter
    written = tmp_path / "out.json"
    call = ["--photographs", str(photograph), "--pictures", str(tmp_path / "seen"), "--json", str(written)]
    assert segmentation.main(call) == 0
    found = json.loads(written.read_text())
    assert set(found) == {"photographs", "run"}
    (row,) = found["photographs"].pop("rows")
    assert set(row) == {"name", "iou"} and row["name"] == "arm" and 0.0 < row["iou"] < 1.0
    assert found["photographs"] == {"pictures": 1, "iou_mean": row["iou"], "iou_median": row["iou"]}
    assert files.read(tmp_path / "seen" / "arm.png").shape == (300, 400, 3)
    assert "0.75" in capsys.readouterr().out  # the goal beside it

    path = photograph / "masks" / "arm.png"
    mask = recordings.read_mask(path)
    (frame,) = recordings.find(photograph)[0]
    before = photographs.measure(inference.load_segmenter(), [frame])["photographs"]["rows"][0]["iou"]
    assert before == row["iou"]
    target = np.isin(mask, TARGET_LABELS)
    cv2.imwrite(str(path), np.where(target, mask, UNLABELLED).astype(np.uint8))
    (more,) = photographs.measure(inference.load_segmenter(), [frame])["photographs"]["rows"]
    assert more["iou"] > before  # what was found beside the arm is no fault any more


def test_the_window_of_a_photograph_is_as_the_service_would_choose_it():
    target = np.zeros((480, 640), bool)
    target[200:240, 100:300] = True  # 40 px wide: 0.04 m are 18 px
    window = photographs.window_about(target)
    assert (window.width, window.height, window.scale) == (256, 96, 1)
    assert window.x0 <= 100 - 17 and window.right >= 300 + 17 and window.y0 <= 200 - 17 and window.bottom >= 240 + 17
    large = photographs.window_about(target.repeat(2, 0).repeat(2, 1))
    assert large == replace(window, x0=2 * window.x0, y0=2 * window.y0, scale=2)


def test_a_folder_without_masks_is_told(tmp_path, capsys):
    assert segmentation.main(["--photographs", str(tmp_path / "none")]) == 2
    assert "expected a folder with frames and masks" in capsys.readouterr().err
