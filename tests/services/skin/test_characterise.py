"""`penumbra skin characterise`: on a small part of the emulated experiment, and on recordings."""

import csv
import json

import cv2
import numpy as np
import pytest

from penumbra.services.command import cli
from penumbra.services.skin.calibration import law, recording
from penumbra.services.skin.calibration.characterise import Places, Regression, characterise, emulated, places
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Law
from penumbra.shared.geometry.rigid import inverse
from penumbra.shared.geometry.surface import Surface
from penumbra.sim.skin import characterisation

CELL = cells.load("table")
KIND = CELL.pad_types["five"]


@pytest.fixture(scope="module")
def poses():
    return characterisation.poses(CELL, "forearm", "five", 0.03)


@pytest.fixture(scope="module")
def recorded():
    """Every third pose of a coarse experiment."""
    return emulated(CELL, "p0", "forearm", samples=30, step=0.05, seed=2, sparse=3)


def test_the_experiment_holds_the_pad_at_every_distance_and_angle_of_the_paper_and_touches_nothing(poses):
    held = {(round(p.gap, 4), p.angle) for p in poses if p.scan == "distance"}
    assert held == {(round(0.005 * k, 4), 10.0 * a) for k in range(2, 41) for a in range(10)}
    assert {p.part for p in poses if p.scan == "plane"} == {"forearm", "hand"} and poses[0].scan == "empty"
    mesh = target_mesh(CELL.targets["forearm"], CELL)
    surface = Surface(mesh.vertices, mesh.faces)
    half = np.array(KIND.board.size) / 2
    edge = np.linspace(-1.0, 1.0, 31)
    board = np.array([(x * half[0], y * half[1], 0.0) for x in edge for y in edge])
    for pose in poses[1:]:
        gap = surface.nearest(board @ pose.T_limb_pad[:3, :3].T + pose.T_limb_pad[:3, 3])[0].min()
        if pose.scan == "distance":
            assert gap == pytest.approx(pose.gap, abs=5e-4)  # the grid of points on the board is coarser while it is placed
        else:
            assert gap > pose.gap - 5e-4
    flat, upright = (next(p for p in poses if p.scan == "distance" and p.angle == angle) for angle in (0.0, 90.0))
    assert inverse(flat.T_limb_pad)[2, 2] == pytest.approx(-1.0)  # it looks down
    assert upright.T_limb_pad[2, 2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
def test_a_characterisation_of_the_emulated_skin_writes_its_tables_pictures_and_summary(recorded, tmp_path):
    found = characterise(CELL, "p0", recorded, tmp_path)
    assert list(found["electrodes"]) == list(KIND.electrodes) and set(found["planes"]) == {"forearm", "hand"}
    for name, row in found["electrodes"].items():
        assert row["noise"] == pytest.approx(KIND.rest.noise, rel=0.1)  # 1000 samples and more
        assert row["gain"] == pytest.approx(1.0, rel=0.25)  # the law as designed is of a median forearm's middle
        assert row["held_out"] < 2.0, name  # the regression says what places say that it has not seen, and how well
    centre, arcs = found["electrodes"]["c"], [found["electrodes"][name] for name in "rltb"]
    assert centre["reach_m"] > max(arc["reach_m"] for arc in arcs)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"distances.csv", "distances.png", "angles.png", "snr.png"} | {
        f"plane_{part}.{kind}" for part in ("hand", "forearm") for kind in ("csv", "png")
    }
    for path in tmp_path.glob("*.png"):
        picture = cv2.imread(str(path))
        assert picture is not None and picture.std() > 10.0, path.name  # something is drawn
    with (tmp_path / "distances.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * found["places"]
    near = [row for row in rows if row["electrode"] == "c" and float(row["signal_V"]) > 0.05]
    assert near
    for row in near:
        assert float(row["low_V"]) < float(row["regression_V"]) < float(row["high_V"])
        assert float(row["regression_V"]) == pytest.approx(float(row["signal_V"]), rel=0.1)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_samples(poses):
    one, same, other = (characterisation.measure(CELL, "forearm", "five", poses[1:2], 10, seed)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_a_recorded_data_set_goes_through_the_same_command(recorded, tmp_path, capsys):
    distances = recorded.where((recorded.labels["scan"] != "plane") & (recorded.numbers["angle_deg"] == 0.0))
    recording.write(tmp_path / "mine.csv", distances, "a real pad")
    command = ["skin", "characterise", "--data", str(tmp_path / "mine.csv"), "--out", str(tmp_path / "out"), "--json"]
    assert cli.main(command) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == found
    assert found["planes"] == {}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"distances.csv", "distances.png", "snr.png", "summary.json"}
    fit = found["electrodes"]["c"]
    one = Law(**{key: fit[key] for key in ("a1", "a2", "a3", "polarity", "noise")})
    assert law.snr_db(one, fit["reach_m"]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--data", "nowhere.csv"], "expected a CSV file"),
        (["--pad", "p9"], "no pad 'p9'"),
        (["--step", "1"], "expected a step from 0.002 to 0.05 m, got '1'"),
        (["--samples", "2"], "expected 10 to 10000 samples, got '2'"),
    ],
)
def test_a_wrong_command_is_reported(arguments, text, tmp_path, capsys):
    code: str | int | None
    try:
        code = cli.main(["skin", "characterise", "--out", str(tmp_path), *arguments])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert text in capsys.readouterr().err


def test_a_recording_without_distances_is_refused(recorded, tmp_path, capsys):
    recording.write(tmp_path / "r.csv", recorded.where(recorded.labels["scan"] == "plane"), "only a plane")
    assert cli.main(["skin", "characterise", "--data", str(tmp_path / "r.csv"), "--out", str(tmp_path / "out")]) == 2
    assert "expected at least 4 gaps" in capsys.readouterr().err


def test_places_are_means_with_the_deviation_of_means():
    gap = np.repeat([0.05, np.inf, 0.05], [4, 2, 4])
    volts = np.repeat([[0.3], [0.2], [0.32]], [4, 2, 4], axis=0)
    volts[0] = np.nan
    numbers = {name: np.zeros(10) for name in recording.NUMBERS}
    found = places(recording.Recording(gap, volts, ("c",), {}, numbers), np.array([0.2]), np.array([1.0]), np.array([7e-6]))
    assert isinstance(found, Places) and found.gap.tolist() == [0.05, np.inf]
    assert found.signal[0, 0] == pytest.approx((3 * 0.1 + 4 * 0.12) / 7) and found.deviation[0, 0] == pytest.approx(1e-3)


def test_the_regression_is_within_its_own_band_close_in_and_far_out():
    rng = np.random.default_rng(6)
    gap = np.geomspace(0.01, 0.2, 40)
    truth = Law(a1=2.66, a2=3e4, a3=0.2, noise=6.2e-6)
    deviation = np.full(40, 3e-4)
    found = Regression(np.log(gap)[:, None], law.signal(truth, gap) + deviation * rng.standard_normal(40), deviation)
    between = np.sqrt(gap[1:] * gap[:-1])
    assert found.misfit(np.log(between)[:, None], law.signal(truth, between), np.full(39, 1e-9)) < 2.0
    mean, low, high = found.signal(np.log(between)[:, None])
    assert np.all(low <= mean) and np.all(mean <= high)
    assert (
        abs(mean[-1] / law.signal(truth, between[-1]) - 1.0) < 0.15 and abs(mean[0] / law.signal(truth, between[0]) - 1.0) < 0.01
    )
