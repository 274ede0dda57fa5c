"""The skin's pose: windows of voltages, nearest points, the network, the solve, and what the estimator publishes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from services.haptics import network as networks
from services.haptics import train
from services.haptics.estimator import Estimator
from services.haptics.nearest import nearest_points
from services.haptics.solve import MODEL_ERROR, peak, solve
from shared import cell as cells
from shared import geometry
from shared.body import target_mesh
from shared.skin import Skin
from shared.surface import Surface

MS = 1_000_000
WEIGHTS = Path(train.__file__).parent / "weights"


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


@pytest.fixture(scope="module")
def skin(table: cells.Cell) -> Skin:
    return Skin(table)


@pytest.fixture(scope="module")
def forearm(table: cells.Cell) -> Surface:
    mesh = target_mesh(table.targets["forearm"], table)
    return Surface(mesh.vertices, mesh.faces)


@pytest.fixture(scope="module")
def limb() -> Surface:
    """A forearm as a long capsule: its roll is not felt, nor, above the pads, where along itself it lies."""
    shape = trimesh.creation.capsule(height=1.2, radius=0.045, count=[64, 64])
    shape.apply_transform(geometry.from_rpy((0, 0, 0), (0, np.pi / 2, 0)))
    return Surface(np.array(shape.vertices), np.array(shape.faces))


def gaps(skin: Skin, surface: Surface, T: np.ndarray) -> np.ndarray:
    electrodes = skin.positions(skin.T_world_pads())
    return surface.nearest((electrodes - T[:3, 3]) @ T[:3, :3])[0]


def feel(skin: Skin, surface: Surface, T: np.ndarray, rng: np.random.Generator, samples: int = 10) -> np.ndarray:
    """Mean voltages (n,) of a window."""
    return skin.volts(gaps(skin, surface, T)) + np.sqrt(skin.noise / samples) * rng.standard_normal(len(skin))


def estimator(
    table: cells.Cell, skin: Skin, surface: Surface, method: str = "solve", home: np.ndarray | None = None
) -> Estimator:
    network = networks.load(WEIGHTS / "table-forearm.npz", table, "forearm")
    home = table.targets["forearm"].home.transform if home is None else home
    return Estimator(skin, surface, home, np.repeat([0.12, 0.4], 3), network, method)


def update(which: Estimator, skin: Skin, stamp_ns: int, amplitude: np.ndarray, alive: np.ndarray | None = None):
    alive = np.ones(len(skin.pads), bool) if alive is None else alive
    return which.update(stamp_ns, amplitude, np.full(len(skin), 10), alive, skin.T_world_pads())


# ---- nearest points


def test_a_pad_finds_the_nearest_point_of_a_limb_above_it(skin: Skin, limb: Surface) -> None:
    T = geometry.from_rpy((0, 0.01, 0.045 + 0.05), (0, 0.05, 0.1))
    points, _ = nearest_points(skin, skin.volts(gaps(skin, limb, T)), skin.noise / 10, np.ones(8, bool))
    pads = skin.T_world_pads()[:, :3, 3]
    truth = limb.nearest((pads - T[:3, 3]) @ T[:3, :3])[1] @ T[:3, :3].T + T[:3, 3] - pads
    # what remains is the curvature that the fit takes for granted, and the tilt that it expects
    np.testing.assert_allclose(points, truth, atol=0.005)


def test_nearest_points_are_as_uncertain_as_they_say(skin: Skin, limb: Surface) -> None:
    rng = np.random.default_rng(0)
    T = geometry.from_rpy((0, 0, 0.045 + 0.07), (0, 0, 0))
    expected, _ = nearest_points(skin, skin.volts(gaps(skin, limb, T)), skin.noise / 10, np.ones(8, bool))
    amplitude = np.array([feel(skin, limb, T, rng) for _ in range(300)])
    points, covariance = nearest_points(
        skin, amplitude, np.broadcast_to(skin.noise / 10, amplitude.shape), np.ones((300, 8), bool)
    )
    error = points - expected
    nees = np.einsum("spi,spij,spj->sp", error, np.linalg.inv(covariance), error) / 3
    assert 0.5 < nees.mean() < 1.5  # below one: the expectation helps


def test_a_dead_pad_has_only_the_expectation(skin: Skin, limb: Surface) -> None:
    alive = np.arange(8) != 2
    amplitude = skin.volts(np.full(len(skin), 0.03))
    points, covariance = nearest_points(skin, amplitude, skin.noise / 10, alive)
    np.testing.assert_allclose(points[2], [0, 0, 0.15], atol=1e-6)
    assert covariance[2, 2, 2] > 0.1**2 > covariance[3, 2, 2]


# ---- solve


def test_the_information_is_that_of_the_voltages_derivatives(skin: Skin, forearm: Surface) -> None:
    T = geometry.from_rpy((0.01, -0.02, 0.14), (0.1, -0.1, 0.2))
    step = 1e-5

    def volts(error: np.ndarray) -> np.ndarray:
        return skin.volts(gaps(skin, forearm, geometry.perturb(T, error)))

    J = np.stack([(volts(step * e) - volts(-step * e)) / (2 * step) for e in np.eye(6)], axis=1)
    variance = skin.noise / 10 + (MODEL_ERROR * (volts(np.zeros(6)) - skin.a3)) ** 2
    electrodes = skin.positions(skin.T_world_pads())
    found = solve(skin, forearm, electrodes, volts(np.zeros(6)), skin.noise / 10, T, T, 1e-9 * np.eye(6), coarse=0, fine=0)
    expected = J.T @ (J / variance[:, None])
    # an electrode whose nearest point changes face within the step differs a little
    np.testing.assert_allclose(found.information, expected, atol=5e-3 * np.abs(expected).max())
    np.testing.assert_allclose(found.gradient, 0.0, atol=1e-6)


def test_what_a_long_round_limb_does_not_show_is_published_as_unknown(skin: Skin, limb: Surface) -> None:
    T = geometry.transform([0, 0, 0.045 + 0.05])
    which = Estimator(skin, limb, T, np.repeat([0.12, 0.4], 3), None)
    estimate = update(which, skin, 1, feel(skin, limb, T, np.random.default_rng(0)))
    values, directions = np.linalg.eigh(estimate.information)
    # nothing along itself; about itself only what the facets of the mesh show, worse than 0.1 rad
    assert values[0] < 1e-6 * values[-1] and values[1] < 100.0 < values[2]
    np.testing.assert_allclose(np.abs(directions[[0, 3], [0, 1]]), 1.0, atol=0.02)


def test_the_peak_of_a_quadratic_is_found_only_along_known_directions() -> None:
    information = np.diag([1e4, 1e4, 1e4, 1e3, 1e3, 0.01])
    truth = np.array([0.01, -0.02, 0.005, 0.05, -0.03, 0.3])
    T, known = peak(np.eye(4), information, information @ truth)
    np.testing.assert_allclose(geometry.pose_error(T, np.eye(4)), [*truth[:5], 0.0], atol=1e-3)
    np.testing.assert_allclose(known, np.diag([1e4, 1e4, 1e4, 1e3, 1e3, 0.0]), atol=1e-6)


# ---- the estimator


def test_close_in_the_pose_is_known_to_millimetres_and_the_information_is_honest(
    table: cells.Cell, skin: Skin, forearm: Surface
) -> None:
    rng = np.random.default_rng(1)
    errors, nees = [], []
    for _ in range(60):
        T = geometry.from_rpy(rng.uniform((-0.05, -0.04, 0.10), (0.05, 0.04, 0.13)), rng.uniform(-0.15, 0.15, 3))
        which = estimator(table, skin, forearm)
        for i in range(5):  # a few windows, as in life
            estimate = update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, T, rng))
        assert estimate.in_range
        assert estimate.gap == pytest.approx(gaps(skin, forearm, T).min(), abs=0.01)
        error = geometry.pose_error(T, estimate.T)
        rank = (np.linalg.eigvalsh(estimate.information) > 1e-9).sum()
        nees.append(error @ estimate.information @ error / rank)
        errors.append(geometry.pose_error(T, which.pose))
    lateral, height = np.sqrt(np.mean(np.array(errors)[:, 1:3] ** 2, axis=0))
    assert lateral < 0.008 and height < 0.005
    assert np.median(nees) < 2.0


def test_published_poses_are_not_shrunk_towards_home(table: cells.Cell, skin: Skin, forearm: Surface) -> None:
    rng = np.random.default_rng(2)
    T = geometry.from_rpy((0, 0, 0.16), (0, 0, 0))  # 11 cm: much noise, so that a prior would weigh
    height = []
    for home_height in (0.13, 0.19):  # a quarter of home's spread beside the truth, either way
        which = estimator(table, skin, forearm, home=geometry.transform([0, 0, home_height]))
        estimates = [update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, T, rng)) for i in range(200)]
        weights = sum(e.information for e in estimates)
        mean = np.linalg.pinv(weights) @ sum(e.information @ geometry.pose_error(e.T, T) for e in estimates)
        height.append(mean[2])
    np.testing.assert_allclose(height, 0.0, atol=0.006)


def test_a_limb_out_of_reach_gives_no_information(table: cells.Cell, skin: Skin, forearm: Surface) -> None:
    rng = np.random.default_rng(3)
    which = estimator(table, skin, forearm)
    T = geometry.transform([0, 0, 0.60])
    estimates = [update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, T, rng)) for i in range(20)]
    assert not any(e.in_range for e in estimates)
    assert all((e.information == 0).all() and np.isfinite(e.gap) for e in estimates)


def test_a_limb_that_comes_back_elsewhere_is_found_at_once(table: cells.Cell, skin: Skin, forearm: Surface) -> None:
    rng = np.random.default_rng(4)
    which = estimator(table, skin, forearm)
    here, there = geometry.transform([0.05, -0.05, 0.11]), geometry.from_rpy((-0.05, 0.05, 0.13), (0, 0, 0.3))
    for i in range(20):
        update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, here, rng))
    for i in range(20, 23):
        update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, there, rng))
    assert np.abs(geometry.pose_error(there, which.pose)[1:3]).max() < 0.015


def test_something_else_near_one_pad_does_not_carry_the_pose_away(table: cells.Cell, skin: Skin, forearm: Surface) -> None:
    rng = np.random.default_rng(5)
    T = geometry.transform([0, 0, 0.12])
    nearest = gaps(skin, forearm, T)
    nearest[skin.of(0)] = np.minimum(nearest[skin.of(0)], 0.03)  # another hand
    amplitude = skin.volts(nearest) + np.sqrt(skin.noise / 10) * rng.standard_normal(len(skin))
    which = estimator(table, skin, forearm)
    for i in range(5):
        estimate = update(which, skin, 10 * MS * (i + 1), feel(skin, forearm, T, rng))
    estimate = update(which, skin, 60 * MS, amplitude)
    assert np.abs(geometry.pose_error(T, estimate.T)[1:3]).max() < 0.02


def test_the_pose_goes_on_with_half_of_the_pads(table: cells.Cell, skin: Skin, forearm: Surface) -> None:
    rng = np.random.default_rng(6)
    T = geometry.transform([0, 0, 0.12])
    alive = np.array([True, False] * 4)
    which = estimator(table, skin, forearm)
    for i in range(5):
        amplitude = feel(skin, forearm, T, rng)
        amplitude[~alive[skin.pad_of]] = 0.0
        estimate = update(which, skin, 10 * MS * (i + 1), amplitude, alive)
    assert estimate.in_range
    assert np.abs(geometry.pose_error(T, which.pose)[1:3]).max() < 0.015
    assert not update(which, skin, 60 * MS, amplitude, np.zeros(8, bool)).in_range


def test_the_papers_way_needs_weights_and_says_how_to_get_them(skin: Skin, forearm: Surface) -> None:
    with pytest.raises(ValueError, match="run `penumbra haptics train`"):
        Estimator(skin, forearm, np.eye(4), np.ones(6), None, "paper")


# ---- the network


def test_numpy_and_torch_give_the_same_gaussian() -> None:
    torch.manual_seed(0)
    model = train.build(30)
    torch.nn.init.normal_(model[-1].weight, std=0.05)
    rng = np.random.default_rng(0)
    mean, scale = rng.standard_normal(30), rng.uniform(0.5, 2, 30)
    x = rng.standard_normal(30).astype(np.float32)
    network = train.to_numpy(model, mean, scale, np.eye(4), np.ones(6))
    y, precision = network.gaussian(x)
    out = model(torch.from_numpy(((x - mean) / scale).astype(np.float32))[None])
    np.testing.assert_allclose(y, out[0, :6].detach(), atol=1e-5)
    label = torch.from_numpy(rng.standard_normal((1, 6)).astype(np.float32))
    error = label[0].numpy() - y
    expected = 0.5 * error @ precision @ error - 0.5 * np.linalg.slogdet(precision)[1]
    assert train.loss(out, label).item() == pytest.approx(expected, rel=1e-4)


def test_a_network_that_learnt_nothing_has_no_information() -> None:
    network = train.to_numpy(train.build(30), np.zeros(30), np.ones(30), np.eye(4), np.repeat([0.12, 0.4], 3))
    _, information = network.likelihood(np.ones(30, np.float32))
    np.testing.assert_allclose(information, 0.0, atol=1e-9)


def test_weights_of_another_cell_are_refused(table: cells.Cell) -> None:
    body = table.body.model_copy(update={"forearm_length": 0.3})
    with pytest.raises(ValueError, match="penumbra haptics train --cell table"):
        networks.load(WEIGHTS / "table-forearm.npz", table.model_copy(update={"body": body}), "forearm")


@pytest.mark.parametrize("name", ["table", "arm"])
def test_the_committed_weights_reach_what_their_card_says(name: str) -> None:
    cell = cells.load(name)
    network = networks.load(WEIGHTS / f"{name}-forearm.npz", cell, "forearm")
    card = json.loads((WEIGHTS / f"{name}-forearm.json").read_text())
    fresh = train.evaluate(train.Scenes(cell, "forearm"), network, seed=77, count=250)
    for method in ("paper", "solve"):
        for band in ("4-7.5 cm", "7.5-12.5 cm"):
            promised, got = (c[method][band]["lateral_height_axial_mm"] for c in (card["held_out"], fresh))
            # some forty scenes a band: their root mean square scatters by a tenth, more where there are outliers
            assert got[1] < 2.0 * promised[1] + 2.0


def test_training_can_be_interrupted_goes_on_and_writes_weights_with_a_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--cell", "table", "--out", str(tmp_path / "w.npz"), "--checkpoint", str(tmp_path / "c.pt"), "--scenes", "40"]
    steps = []

    def interrupted(out: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        steps.append(1)
        if len(steps) == 4:
            raise KeyboardInterrupt  # Ctrl-C in the fourth step
        return loss(out, label)

    loss = train.loss
    monkeypatch.setattr(train, "loss", interrupted)
    with pytest.raises(SystemExit, match="run the same command again"):
        train.main([*flags, "--steps", "6"])
    train.main([*flags, "--steps", "6"])
    assert "resumed" in capsys.readouterr().out and len(steps) == 4 + 3
    card = json.loads((tmp_path / "w.json").read_text())
    assert card["settings"]["network"]["steps"] == 6 and card["seed"] == 1
    assert networks.load(tmp_path / "w.npz", cells.load("table"), "forearm").weights[0].shape[1] == 256
    assert not (tmp_path / "c.pt").exists()
