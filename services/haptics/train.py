"""Makes `weights/CELL-TARGET.npz` again from a seed: `penumbra haptics train --cell table`.

Scenes are drawn from a Gaussian somewhat wider than the region of the cell's motion (which the published estimate subtracts
again), robots anywhere between the joint limits of the cell's `sim` section, upper arm and torso as in `sim/person.py`;
voltages come from the response law with noise, a model error and now and then a dead pad.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.spatial.transform import Rotation

from services.haptics.estimator import Estimator
from services.haptics.network import LOG_LIMIT, OUTPUTS, PoseNetwork, features, fingerprint
from services.haptics.solve import MODEL_ERROR
from shared import cell as cells
from shared.geometry import Array, from_rpy, pose_error
from shared.robot import robot_models
from shared.skin import Skin, link_names
from shared.surface import Surface, nearest_points
from sim.person import Person

WEIGHTS = Path(__file__).parent / "weights"
HIDDEN = (256, 256, 256, 256)
SAMPLES = 10
"""Voltage samples in the mean of one window (10 ms at 1 kHz)."""
CLOSEST = 0.005
"""Scenes in which an electrode comes nearer to the skin than this [m] are drawn again: the limb would be inside the pad."""
ENLARGED = 1.5
"""Spread of the training's poses, in standard deviations of a pose uniform in the region of the cell's motion."""
PERSONS = 8
"""Places of the shoulder among which scenes are drawn."""
DEAD = 0.02
"""Share of pads that are dead in training."""
BATCH, FRESH, START, POOL = 1024, 128, 2000, 400_000
"""Scenes in a step; of these, drawn anew (the others come from a pool that they join); in the pool at first and at most."""
CHECKPOINT_S = 20.0
BANDS = (0.0, 0.04, 0.075, 0.125, 0.175)
"""Limits of the gap bands [m] of the held-out errors."""


class Scenes:
    """Random scenes of a cell. home (4, 4), spread (6,): the training's Gaussian; expected: home and spread that the cell
    gives for the target. Raises CellError where the cell says nothing about how things move."""

    def __init__(self, cell: cells.Cell, target: str):
        if cell.sim is None:
            raise cells.CellError(f"cell {cell.name} has no `sim` section: training needs its shoulder and joint limits")
        self.skin, self.sim = Skin(cell), cell.sim
        motion = cell.sim.motion
        low, high = np.array([*motion.low, *motion.rpy_low]), np.array([*motion.high, *motion.rpy_high])
        self._low, self._high = low, high
        self.home = from_rpy((low + high)[:3] / 2.0, (low + high)[3:] / 2.0)
        self.spread = ENLARGED * (high - low) / np.sqrt(12.0)
        spread = cell.targets[target].home_spread
        self.expected = cell.targets[target].home.transform, np.repeat([spread.position, spread.rotation], 3)
        # A person's shoulder is where the cell says only roughly.
        shoulders = np.array(cell.sim.shoulder) + 0.08 * np.random.default_rng(0).standard_normal((PERSONS, 3))
        sims = [cell.sim.model_copy(update={"shoulder": tuple(shoulder)}) for shoulder in shoulders]
        self._persons = [Person(cell, sim, cell.targets[target]) for sim in sims]
        self.surface, *self._others = [Surface(mesh.vertices, mesh.faces) for mesh in self._persons[0].meshes]
        self.models = robot_models(cell)

    def draw(self, rng: np.random.Generator, count: int, motion: bool = False) -> dict[str, Any]:
        """`count` scenes, from the training's Gaussian, or uniformly from the region of the cell's motion.

        T (count, 4, 4), joints (count, j), pads (count, p, 4, 4), gap (count,) to the target, amplitude (count, n), alive
        (count, p).
        """
        kept: list[dict[str, Any]] = []
        while sum(len(k["gap"]) for k in kept) < count:
            kept.append(self._draw(rng, count, motion))
        return {name: np.concatenate([k[name] for k in kept])[:count] for name in kept[0]}

    def inputs(self, scene: dict[str, Any]) -> NDArray[np.float32]:
        """The network's input for scenes: as `estimator.py` forms it."""
        skin = self.skin
        variance = skin.noise / SAMPLES + (MODEL_ERROR * np.maximum(skin.signal(scene["amplitude"]), 0.0)) ** 2
        return features(skin, self.home, scene["amplitude"], variance, scene["alive"], scene["pads"], scene["joints"])

    def labels(self, scene: dict[str, Array]) -> NDArray[np.float32]:
        """What the network answers: the pose error about home in units of the spread (count, 6)."""
        rotation = Rotation.from_matrix(scene["T"][:, :3, :3] @ self.home[:3, :3].T).as_rotvec()
        error = np.concatenate([scene["T"][:, :3, 3] - self.home[:3, 3], rotation], axis=1)
        return (error / self.spread).astype(np.float32)

    def _draw(self, rng: np.random.Generator, count: int, motion: bool) -> dict[str, Any]:
        skin = self.skin
        T = np.tile(np.eye(4), (count, 1, 1))
        if motion:
            pose = rng.uniform(self._low, self._high, (count, 6))
            T[:, :3, 3], T[:, :3, :3] = pose[:, :3], Rotation.from_euler("xyz", pose[:, 3:]).as_matrix()
        else:
            error = self.spread * rng.standard_normal((count, 6))
            T[:, :3, 3] = self.home[:3, 3] + error[:, :3]
            T[:, :3, :3] = Rotation.from_rotvec(error[:, 3:]).as_matrix() @ self.home[:3, :3]
        low, high = np.array(self.sim.joints_low), np.array(self.sim.joints_high)
        joints = low + (high - low) * rng.uniform(-0.1, 1.1, (count, len(low)))
        links: dict[str, dict[str, Array]] = {}
        first = 0
        for name, model in self.models.items():
            links[name] = model.link_transforms(joints[:, first : first + len(model.joints)])
            first += len(model.joints)
        by_name = {"world": np.eye(4), **link_names(links)}
        pads = np.stack([np.broadcast_to(by_name[link], (count, 4, 4)) for link in skin.links], axis=1) @ skin.T_link_pads
        frames = pads[:, skin.pad_of]
        electrodes = np.einsum("snij,nj->sni", frames[..., :3, :3], skin.centroids) + frames[..., :3, 3]
        gaps = _gaps(electrodes, T, *self.surface.arrays)
        nearest = gaps
        parts = self._persons[rng.integers(PERSONS)].poses(T)[1:]
        for part, T_world_part in zip(self._others, parts, strict=True):
            nearest = np.minimum(nearest, _gaps(electrodes, T_world_part, *part.arrays))
        # What law and mesh get wrong is alike for the electrodes of a scene in part; here it is drawn for each.
        signal = skin.peak / (1.0 + skin.a2 * nearest**2) * (1.0 + MODEL_ERROR * rng.standard_normal(nearest.shape))
        amplitude = skin.a3 + skin.polarity * signal + np.sqrt(skin.noise / SAMPLES) * rng.standard_normal(nearest.shape)
        alive = rng.uniform(size=(count, len(skin.pads))) >= DEAD
        amplitude = np.where(alive[:, skin.pad_of], amplitude, skin.a3)
        free = nearest.min(axis=1) > CLOSEST
        scene = {"T": T, "joints": joints, "pads": pads, "gap": gaps.min(axis=1), "amplitude": amplitude, "alive": alive}
        return {name: value[free] for name, value in scene.items()}


@njit(cache=True, nogil=True)
def _gaps(electrodes, T, corners, centers, radii, normals):  # type: ignore[no-untyped-def]
    """Signed gaps (s, n) of electrodes (s, n, 3) to a surface at poses (s, 4, 4)."""
    n = electrodes.shape[1]
    out, nearest, gradient = np.empty((len(T), n)), np.empty((n, 3)), np.empty((n, 3))
    for s in range(len(T)):
        R = np.ascontiguousarray(T[s, :3, :3])
        nearest_points((electrodes[s] - T[s, :3, 3]) @ R, corners, centers, radii, normals, out[s], nearest, gradient)
    return out


def build(inputs: int) -> torch.nn.Sequential:
    """The paper's network: four fully connected layers of 256 ReLU units, and a linear layer to mean and precision factor."""
    layers: list[torch.nn.Module] = []
    for width in HIDDEN:
        layers += [torch.nn.Linear(inputs, width), torch.nn.ReLU()]
        inputs = width
    last = torch.nn.Linear(inputs, OUTPUTS)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)  # begin at the prior: mean zero, precision one
    return torch.nn.Sequential(*layers, last)


def loss(out: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
    """Mean negative log-likelihood of labels (b, 6) under the Gaussians of outputs (b, 27)."""
    rows, columns = np.tril_indices(6)
    diagonal = torch.from_numpy(rows == columns)
    log_diagonal = torch.clamp(out[:, 6:][:, diagonal], max=LOG_LIMIT)
    L = out.new_zeros(len(out), 6, 6)
    L[:, rows, columns] = torch.where(diagonal, torch.exp(torch.clamp(out[:, 6:], max=LOG_LIMIT)), out[:, 6:])
    whitened = torch.einsum("bij,bi->bj", L, label - out[:, :6])
    return (0.5 * (whitened**2).sum(1) - log_diagonal.sum(1)).mean()


def to_numpy(model: torch.nn.Sequential, mean: Array, scale: Array, home: Array, spread: Array) -> PoseNetwork:
    """The trained network with the inputs' normalisation folded into its first layer."""
    linear = [layer for layer in model if isinstance(layer, torch.nn.Linear)]
    W = [layer.weight.detach().numpy().T.astype(np.float64) for layer in linear]
    b = [layer.bias.detach().numpy().astype(np.float64) for layer in linear]
    b[0] = b[0] - (mean / scale) @ W[0]
    W[0] = W[0] / scale[:, None]
    return PoseNetwork(tuple(w.astype(np.float32) for w in W), tuple(v.astype(np.float32) for v in b), home, spread)


def evaluate(scenes: Scenes, network: PoseNetwork, seed: int, count: int = 4000) -> dict[str, dict[str, Any]]:
    """Errors of single windows of unseen scenes by gap band: root mean squares across, away and along the limb [mm], of its
    direction [deg], and the normalised squared error per known direction; network alone, and solve from its start without
    a past. The scenes are uniform in the region of the cell's motion."""
    scene = scenes.draw(np.random.default_rng(seed), count, motion=True)
    results: dict[str, dict[str, Any]] = {}
    home, spread = scenes.expected
    for method in ("paper", "solve"):
        estimator = Estimator(scenes.skin, scenes.surface, home, spread, network, method)
        rows = []
        for i in range(count):
            estimator.reset()
            samples = np.full(len(scenes.skin), SAMPLES)
            estimate = estimator.update(
                1, scene["amplitude"][i], samples, scene["alive"][i], scene["pads"][i], scene["joints"][i]
            )
            # Errors are those of the most probable pose; the published one is far off where it says that it does not know.
            T = estimator.pose if method == "solve" else network.posterior(scenes.inputs({k: v[i] for k, v in scene.items()}))
            rows.append(_errors(scenes, scene, i, T, estimate.T, estimate.information))
        table = np.array(rows)
        results[method] = {}
        for low, high in itertools.pairwise(BANDS):
            inside = table[(scene["gap"] >= low) & (scene["gap"] < high)]
            if not len(inside):
                continue
            rms = np.sqrt(np.mean(inside[:, :4] ** 2, axis=0))
            known = inside[np.isfinite(inside[:, 4]), 4]
            results[method][f"{100 * low:g}-{100 * high:g} cm"] = {
                "scenes": len(inside),
                "lateral_height_axial_mm": [round(1e3 * float(v), 2) for v in rms[:3]],
                "axis_deg": round(float(np.degrees(rms[3])), 2),
                "nees_per_direction_median_mean": [round(float(np.median(known)), 2), round(float(np.mean(known)), 2)]
                if len(known)
                else None,
            }
    return results


def _errors(scenes: Scenes, scene: dict[str, Array], i: int, T_most_probable: Array, T: Array, information: Array) -> list[float]:
    truth = scene["T"][i]
    axial = truth[:3, 0]
    electrodes = scenes.skin.positions(scene["pads"][i])
    distance, _, gradient = scenes.surface.nearest((electrodes - truth[:3, 3]) @ truth[:3, :3])
    away = truth[:3, :3] @ gradient[np.argmin(distance)]
    away -= (away @ axial) * axial
    away /= np.linalg.norm(away) + 1e-9
    error = pose_error(truth, T_most_probable)[:3]
    angle = np.arccos(np.clip(axial @ T_most_probable[:3, 0], -1.0, 1.0))
    difference = pose_error(truth, T)
    rank = int((np.linalg.eigvalsh(information) > 1e-9).sum())
    nees = difference @ information @ difference / rank if rank else np.nan
    return [error @ np.cross(axial, away), error @ away, error @ axial, float(angle), nees]


def save(network: PoseNetwork, path: Path, key: str) -> None:
    """The weights as half-precision arrays: their rounding changes a pose by less than a tenth of its error."""
    arrays: dict[str, Any] = {"home": network.home, "spread": network.spread, "fingerprint": np.array(key)}
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays[f"weight{i}"], arrays[f"bias{i}"] = W.astype(np.float16), b.astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="penumbra haptics train", description="Train the skin's pose network for a cell.")
    parser.add_argument("--cell", default="table", help="built-in cell or YAML file (default: %(default)s)")
    parser.add_argument("--target", help="the target's name (default: the first)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=12_000, help="training steps (default: %(default)s)")
    parser.add_argument("--minutes", type=float, help="stop the schedule after this time instead of --steps")
    parser.add_argument("--scenes", type=int, default=4000, help="held-out scenes for the card (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="weights file (default: the one that the service loads)")
    parser.add_argument("--checkpoint", type=Path, help="resume here and save here (default: runs/haptics-CELL-TARGET.pt)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    cell = cells.load(options.cell)
    target = cell.one("targets", options.target)
    scenes = Scenes(cell, target)
    out = options.out or WEIGHTS / f"{cell.name}-{target}.npz"
    checkpoint = options.checkpoint or Path("runs") / f"haptics-{cell.name}-{target}.pt"
    model, mean, scale, steps, seconds = _train(scenes, fingerprint(cell, target), options, checkpoint)
    network = to_numpy(model, mean, scale, scenes.home, scenes.spread)
    save(network, out, fingerprint(cell, target))
    schedule = f"--minutes {options.minutes:g}" if options.minutes else f"--steps {options.steps}"
    card = {
        "made_by": f"penumbra haptics train --cell {options.cell} --target {target} --seed {options.seed} {schedule}",
        "date": time.strftime("%Y-%m-%d"),
        "seed": options.seed,
        "settings": {
            "network": {"hidden": HIDDEN, "steps": steps, "batch": BATCH, "minutes": round(seconds / 60, 1)},
            "data": {"samples_per_window": SAMPLES, "model_error": MODEL_ERROR, "dead_pads": DEAD, "closest_m": CLOSEST},
            "prior": {"home": scenes.home.round(6).tolist(), "spread": scenes.spread.round(6).tolist()},
            "fingerprint": fingerprint(cell, target),
        },
        "held_out_seed": options.seed + 1_000_000,
        "held_out": evaluate(scenes, network, options.seed + 1_000_000, options.scenes),
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
    print(f"{out} and its card: {json.dumps(card['held_out'], indent=1)}")
    checkpoint.unlink(missing_ok=True)


def _train(
    scenes: Scenes, key: str, options: argparse.Namespace, checkpoint: Path
) -> tuple[torch.nn.Sequential, Array, Array, int, float]:
    """The trained model, mean and scale of its inputs, steps and seconds; goes on from the checkpoint of an interrupted run."""
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    first = scenes.draw(rng, START)
    x, y = scenes.inputs(first), scenes.labels(first)
    mean, scale = x.mean(axis=0).astype(np.float64), x.std(axis=0).astype(np.float64) + 1e-3
    pool_x, pool_y = np.empty((POOL, x.shape[1]), np.float32), np.empty((POOL, 6), np.float32)
    pool_x[:START], pool_y[:START], filled = x, y, START
    model = build(x.shape[1])
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    step, before = 0, 0.0
    if checkpoint.is_file():
        state = torch.load(checkpoint, weights_only=True)
        if state["key"] == key and state["seed"] == options.seed:
            model.load_state_dict(state["model"])
            optimizer.load_state_dict(state["optimizer"])
            step, before = state["step"], state["seconds"]
            rng = np.random.default_rng([options.seed, step])
            print(f"resumed {checkpoint} at step {step}")
    began = saved = time.monotonic()

    def save_checkpoint() -> None:
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        state = {"key": key, "seed": options.seed, "step": step, "seconds": before + time.monotonic() - began}
        torch.save({**state, "model": model.state_dict(), "optimizer": optimizer.state_dict()}, checkpoint)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        total = int(60 * options.minutes) if options.minutes else options.steps
        bar = progress.add_task("training", total=total)
        try:
            while True:
                seconds = before + time.monotonic() - began
                done = seconds / (60 * options.minutes) if options.minutes else step / options.steps
                if done >= 1.0:
                    return model, mean, scale, step, seconds
                fresh = scenes.draw(rng, FRESH)
                place = np.arange(filled, filled + FRESH) % POOL
                pool_x[place], pool_y[place], filled = scenes.inputs(fresh), scenes.labels(fresh), filled + FRESH
                rows = rng.integers(min(filled, POOL), size=BATCH)
                x_batch = torch.from_numpy(((pool_x[rows] - mean) / scale).astype(np.float32))
                for group in optimizer.param_groups:
                    group["lr"] = 1e-3 * min(1.0, (step + 1) / 200) * (0.5 * (1 + math.cos(math.pi * done)) + 0.002)
                value = loss(model(x_batch), torch.from_numpy(pool_y[rows]))
                optimizer.zero_grad()
                value.backward()
                torch.nn.utils.clip_grad_norm_(model.parameters(), 20.0)
                optimizer.step()
                step += 1
                if step % 20 == 0:
                    progress.update(bar, completed=int(done * total), description=f"training, loss {value.item():.2f}")
                if time.monotonic() - saved > CHECKPOINT_S:
                    saved = time.monotonic()
                    save_checkpoint()
        except KeyboardInterrupt:
            save_checkpoint()
            raise SystemExit(f"interrupted at step {step}; run the same command again to go on from {checkpoint}") from None


if __name__ == "__main__":
    main()
