"""The experiment: runs keep to their bands, errors are exact, and a killed benchmark goes on."""

import json

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from penumbra.shared.body import anatomy
from penumbra.shared.geometry import rigid
from penumbra.sim.sets import trial
from penumbra.sim.sets.trial import SETTINGS, Setting
from penumbra.tests.bench import table1
from penumbra.tests.bench.lib import campaign, page, pictures, trials
from penumbra.tests.bench.lib.results import markdown

EYE = (0.0, 0.0, -2.0)
"""A camera that looks along z."""
SEEDS = (3, 4)


def result(setting=SETTINGS[0], index=0, errors=(1.0, 2.0, 3.0), fused=(0.5, 1.0, 1.5), hidden=0.1):
    """A played trial of three scored frames whose errors are made up; None: no pose."""

    def columns(values):
        return {name: list(values) for name in trials.ERRORS}

    chain = {"vision": columns(errors), "fused": {**columns(fused), "poses": [[0.0] * 6 + [1.0]] * 3}, "live": columns(fused)}
    return {
        "setting": {"reach": setting.reach, "distance": setting.distance, "occlusion": setting.occlusion},
        "index": index,
        "cell": "table",
        "distance_m": 2.0,
        "times_s": [trial.LEAD_S, trial.LEAD_S + 0.05, trial.LEAD_S + 0.1],
        "hidden": [hidden] * 3,
        "gap_m": [0.05] * 3,
        "chains": dict.fromkeys(trials.CHAINS, chain),
    }


@pytest.fixture(scope="module")
def drawn():
    """A trial of every second setting: all reaches, distances and shares hidden, of both cells in turn."""
    return [trial.draw(setting, SEEDS[k // 2 % 2], k % 2) for k, setting in enumerate(SETTINGS[::2])]


def test_a_pose_is_off_by_what_it_was_moved_by_along_and_across_the_line_of_sight():
    T = rigid.from_rpy((0.1, 0.2, 0.0), (0.0, 0.0, 0.3))
    eye = rigid.apply(T, (0.0, 0.0, -2.0))
    moved = rigid.perturb(T, (0.03, 0.0, 0.04, 0.0, 0.0, 0.0))
    found = trials.errors(T, moved, np.zeros(3), eye)
    assert found["cm"] == pytest.approx(5.0)
    assert (found["lateral_cm"], found["depth_cm"]) == (pytest.approx(3.0), pytest.approx(4.0))
    for angle in ("axis_deg", "roll_deg", "attitude_deg"):
        assert found[angle] == pytest.approx(0.0, abs=1e-5)  # the arc cosine of 1 less one rounding


def test_a_turn_about_the_origin_moves_the_centre_and_a_twist_about_the_axis_is_roll_alone():
    T = rigid.from_rpy((0.0, 0.0, 0.5), (0.2, -0.1, 0.4))
    twisted, tilted = T.copy(), T.copy()
    twisted[:3, :3] = T[:3, :3] @ Rotation.from_rotvec((np.radians(7.0), 0.0, 0.0)).as_matrix()
    tilted[:3, :3] = T[:3, :3] @ Rotation.from_rotvec((0.0, np.radians(10.0), 0.0)).as_matrix()
    found = trials.errors(T, twisted, np.array([0.1, 0.0, 0.0]), EYE)
    assert (found["cm"], found["axis_deg"]) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-5))
    assert (found["roll_deg"], found["attitude_deg"]) == (pytest.approx(7.0), pytest.approx(7.0))
    found = trials.errors(T, tilted, np.array([0.1, 0.0, 0.0]), EYE)
    assert found["cm"] == pytest.approx(100.0 * 2.0 * 0.1 * np.sin(np.radians(5.0)))  # the chord of the turn
    assert (found["axis_deg"], found["roll_deg"]) == (pytest.approx(10.0), pytest.approx(0.0, abs=1e-6))


@pytest.mark.slow
def test_the_centre_of_mass_of_a_box_is_its_middle_and_that_of_the_forearm_lies_in_it(drawn):
    from penumbra.shared.contract.labels import Label
    from penumbra.sim.picture.occluder import box

    np.testing.assert_allclose(trials.centroid(box((0.1, 0.2, 0.3), (1.0, 2.0, 3.0), Label.OCCLUDER)), (1.0, 2.0, 3.0))
    cell = drawn[0].cell
    mesh = anatomy.target_mesh(next(iter(cell.targets.values())), cell)
    x, y, z = trials.centroid(mesh)
    assert -0.05 < x < 0.1 and abs(y) < 0.01 and abs(z) < 0.01


@pytest.mark.slow
def test_every_trial_keeps_its_gap_distance_and_hidden_share_without_being_rendered(drawn):
    for one in drawn:
        setting, world = one.setting, one.world
        low, high = trial.GAP_M[setting.reach]
        gaps = [world.gaps(world.state(t)).min() for t in trial.frame_times(trial.LEAD_S)]
        assert low <= min(gaps) and max(gaps) <= high, setting
        low, high = trial.DISTANCE_M[setting.distance]
        assert low <= one.distance_m <= high, setting
        shown = trial.Coarse(world)
        levels = [(t, world.occlusion.at(world.occlusion_clock.at(t))) for t in trial.frame_times(trial.LEAD_S)]
        hidden = np.array([shown.hidden(t, level) for t, level in levels])
        low, high = trial.HIDDEN[setting.occlusion]
        assert np.mean((hidden >= low) & (hidden <= high)) >= trial.IN_BAND, setting


@pytest.mark.slow
def test_the_pictures_are_a_region_of_one_sensor_that_holds_the_limb(drawn):
    for one in drawn:
        camera, binning = one.camera, trial.BINNING[one.setting.distance]
        assert camera.fx == camera.fy == trial.FOCAL_PX / binning
        assert camera.width <= trial.SENSOR_PX[0] // binning and camera.height <= trial.SENSOR_PX[1] // binning
        # the principal point stays that of the sensor: its middle, seen from the region's corner
        assert (camera.cx - (trial.SENSOR_PX[0] // binning - 1) / 2.0) % trial.STEP_PX == pytest.approx(0.0, abs=1e-9)
        middle = next(iter(one.cell.targets.values())).home.position
        assert 0.0 <= camera.cx < camera.width and 0.0 <= camera.cy < camera.height
        np.testing.assert_allclose(camera.look_at, middle)


@pytest.mark.slow
def test_trials_differ_by_seed_and_index_and_are_the_same_again(drawn):
    first = drawn[0]
    again, other = trial.draw(first.setting, SEEDS[0], 0), trial.draw(first.setting, SEEDS[0], 2)
    assert (again.seed, again.occlusion) == (first.seed, first.occlusion)
    assert again.cell.model_dump() == first.cell.model_dump()
    assert other.cell.name == first.cell.name and other.seed != first.seed
    size, changed = (next(iter(each.cell.targets.values())).size for each in (first, other))
    assert size is not None and size != changed and abs(np.log(size.length)) <= np.log1p(trial.SIZE)
    assert trial.draw(first.setting, SEEDS[0], 1).cell.name == "arm"


@pytest.mark.slow
def test_a_coarse_picture_tells_the_hidden_share_of_the_full_one(drawn):
    one = next(each for each in drawn if each.setting.occlusion == "medium")
    camera, time_s = next(iter(one.cell.cameras)), 1.5
    level = one.world.occlusion.at(one.world.occlusion_clock.at(time_s))
    assert trial.Coarse(one.world).hidden(time_s, level) == pytest.approx(one.world.view(camera, time_s).hidden, abs=0.02)


def test_only_frames_after_the_lead_in_and_in_the_band_are_scored():
    played = result(Setting("inside", "short", "medium"))
    lead = trial.LEAD_S
    played["times_s"], played["hidden"] = [lead - 0.1, lead, lead + 0.05], [0.5, 0.5, 0.7]
    assert trials.is_scored(played).tolist() == [False, True, False]


def test_a_score_is_the_mean_over_frames_with_a_pose_and_tells_how_many_have_none():
    first = result(errors=(1.0, None, 3.0), fused=(0.5, None, None))
    second = result(errors=(None, None, 8.0), fused=(1.0, 1.0, 2.0))
    found = table1.score([first, second])
    assert (found["trials"], found["frames"]) == (2, 6)
    assert found["ours"][:2] == [4.0, pytest.approx(1.125)]
    assert found["no_pose"][:2] == [pytest.approx(0.5), pytest.approx(1 / 3, abs=1e-3)]
    assert found["lost"]["multimodal_procnet"] == found["no_pose"][1]
    both = found["fused_against_vision"]["procnet"]  # the first frame of the first, the last of the second
    assert (both["frames"], both["vision_cm"], both["fused_cm"]) == (2, 4.5, 1.25)
    assert both["added_cm_ci95"] == [-6.0, -0.5]


def test_the_confidence_interval_draws_whole_runs():
    rng = np.random.default_rng(1)
    means = rng.normal(5.0, 1.0, 20)
    interval = table1.bootstrap([np.full(40, mean) for mean in means])
    assert interval is not None
    low, high = interval
    wide = 1.96 * means.std() / np.sqrt(20)
    assert (low, high) == (pytest.approx(means.mean() - wide, abs=0.15), pytest.approx(means.mean() + wide, abs=0.15))
    assert table1.bootstrap([np.array([1.0, 2.0]), np.zeros(0)]) is None


def test_the_table_has_the_papers_layout_and_tells_which_goals_are_missed():
    easy = [result(setting, k, errors=(0.2,) * 3, fused=(0.1,) * 3) for setting in SETTINGS for k in range(2)]
    for each in easy:
        low, high = trial.HIDDEN[each["setting"]["occlusion"]]
        each["hidden"] = [(low + high) / 2.0] * 3
    found = json.loads(json.dumps(table1.table(easy, seed=7)))
    paper = table1.reference()
    for reach in table1.REACHES.values():
        for distance in table1.DISTANCES.values():
            assert found[reach][distance].keys() == paper[reach][distance].keys()
            for occlusion, cell in found[reach][distance].items():
                assert cell["paper"] == paper[reach][distance][occlusion]
                assert len(cell["ours"]) == len(cell["ours_ci95"]) == len(found["columns"])
    assert found["columns"][:4] == paper["columns"]
    assert all(goal["met"] == 16 and not goal["missed"] for goal in found["goals"].values())
    poor = [each | {"chains": result(errors=(19.0,) * 3, fused=(19.5,) * 3)["chains"]} for each in easy]
    assert all(goal["met"] == 0 for goal in table1.table(poor, 7)["goals"].values())
    assert "| 0.10 [0.10, 0.10] / 1.59 |" in markdown(table1.tables(found))


@pytest.mark.slow
def test_one_run_goes_through_the_services_and_a_page_is_made_of_it(tmp_path):
    setting, seconds = Setting("inside", "short", "light"), trial.LEAD_S + 0.15
    job = campaign.Job("one", "penumbra.tests.bench.table1:one", ({**vars(setting)}, 5, 0, seconds))
    with campaign.bar(Console(quiet=True)) as progress:
        (played,) = campaign.run([job], tmp_path, 1, progress, "trials")
    assert len(played["times_s"]) == round(seconds * trial.RATE_HZ) and trials.is_scored(played).sum() == 3
    assert set(played["chains"]) == set(trials.CHAINS)
    fused = np.array(played["chains"]["procnet"]["fused"]["cm"], dtype=float)
    assert np.nanmedian(fused[10:]) < 3.0  # the skin feels it and the camera sees it
    found = table1.table([played], 5)
    assert found["haptic_range_inside"]["short_0_3m"]["light"]["frames"] == 3
    assert found["haptic_range_outside"]["long_6_10m"]["medium"]["ours"] == [None] * len(table1.COLUMNS)
    for name in page.CAPTIONS:
        pictures.table(found, tmp_path / f"{name}.png")
    page.write(found, tmp_path, tmp_path / "index.html", quick=True)
    html = (tmp_path / "index.html").read_text()
    assert html.count("data:image/png;base64,") == len(page.CAPTIONS) and "href=" not in html and "src='http" not in html
    assert " / 1.59" in html and "A quick run" in html


CALLS: list[int] = []


def count(k):
    """What a job of the next test calls."""
    CALLS.append(k)
    if k == 2 and len(CALLS) == 3:
        raise KeyboardInterrupt
    return {"k": k}


def test_a_killed_benchmark_goes_on_where_it_was_and_computes_nothing_twice(tmp_path, monkeypatch):
    jobs = [campaign.Job(f"job-{k}", f"{__name__}:count", (k,)) for k in range(4)]
    CALLS.clear()
    with campaign.bar(Console(quiet=True)) as progress:
        with pytest.raises(KeyboardInterrupt):
            campaign.run(jobs, tmp_path, 1, progress, "jobs")
        assert campaign.run(jobs, tmp_path, 1, progress, "jobs") == [{"k": k} for k in range(4)]
        assert CALLS == [0, 1, 2, 2, 3]
        monkeypatch.setattr(campaign, "fingerprint", lambda: "other code")
        campaign.run(jobs, tmp_path, 1, progress, "jobs")
    assert CALLS[5:] == [0, 1, 2, 3]


@pytest.mark.slow
def test_several_processes_give_the_same_results_in_the_same_order(tmp_path):
    jobs = [campaign.Job(f"job-{k}", f"{__name__}:count", (k,)) for k in (5, 3, 4)]
    with campaign.bar(Console(quiet=True)) as progress:
        assert campaign.run(jobs, tmp_path, 2, progress, "jobs") == [{"k": 5}, {"k": 3}, {"k": 4}]


def test_the_fingerprint_changes_with_any_weight_cell_or_line_of_code(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "ROOT", tmp_path)
    monkeypatch.setattr(campaign, "DEPENDS", ("shared",))
    (tmp_path / "shared").mkdir()
    seen = set()
    for name in ("a.py", "a.yaml", "a.npz"):
        (tmp_path / "shared" / name).write_text("1")
        seen.add(campaign.fingerprint())
    (tmp_path / "shared" / "a.npz").write_text("2")
    seen.add(campaign.fingerprint())
    (tmp_path / "shared" / "a.pyc").write_text("not code of ours")
    assert len(seen) == 4 and campaign.fingerprint() in seen
