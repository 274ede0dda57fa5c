"""Makes `weights/CELL-TARGET.npz` again from a seed: `penumbra haptics train --cell table`.

Poses are drawn from a Gaussian somewhat wider than the region of the cell's motion (the published estimate subtracts it again),
robots anywhere between the joint limits of the cell's `sim` section, limbs of all sizes. Voltages come from the fitted field
model with noise, a model error and an occasional dead pad. R_c is regressed on scenes outside the training set. An interrupted
run continues with --resume, from a new pool of scenes.
"""

from __future__ import annotations

import datetime
import itertools
import json
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from penumbra.services import flags, training_flags
from penumbra.services.haptics.estimator import Estimator
from penumbra.services.haptics.paper_network import PoseNetwork, Regression, Relative, features, fingerprint
from penumbra.shared import training
from penumbra.shared.body.anatomy import SIZE, SIZE_SPREAD, target_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array, from_rpy, pose_error
from penumbra.shared.geometry.surface import Surface, nearest_points
from penumbra.shared.native import kernel
from penumbra.shared.skin.layout import Skin, link_names
from penumbra.shared.skin.response import Response

WEIGHTS = Path(__file__).parent / "weights"
VALIDATION_SEED, REGRESSION_SEED = 1_000_000, 2_000_000
"""Offsets to the seed for the scenes of the card's score and of R_c: the network was trained on neither."""
HIDDEN = (256, 256, 256, 256)
"""Widths of the hidden layers, from the paper."""
SAMPLES = 10
"""Number of voltage samples in the mean of one window (10 ms at 1 kHz)."""
CLOSEST = 0.005
"""Minimum gap [m] of an electrode to the skin. Scenes with a smaller one are drawn again: the limb would be inside the pad."""
ENLARGED = 1.5
"""Spread of the training's poses, in standard deviations of a pose uniform in the region of the cell's motion."""
OUTPUTS = 6 + 21
"""Number of outputs in training: the pose and the Cholesky factor of its precision, so that unobservable directions do not
count."""
LOG_LIMIT = 8.0
"""Maximum log of a precision factor in units of the prior: 3000 times more precise than the prior."""
REGRESSED = 3000
"""Number of scenes for R_c."""
KERNELS = 500
"""Number of points that the Gaussian processes keep: each is a mean over neighbouring scenes."""
LOG_CHI2 = -1.2704
"""Mean of the log of a squared standard normal number: the log of a squared error is on average this much below the log variance.
Derived: -(Euler's constant + log 2)."""
DEAD = 0.02
"""Share of pads that are dead in training."""
START, POOL = 2000, 400_000
"""Initial and maximum number of scenes in the pool."""
BANDS = (0.0, 0.04, 0.075, 0.125, 0.175)
"""Limits of the gap bands [m] of the held-out errors."""


class Scenes:
    """Random scenes of a cell. home (4, 4), spread (6,): the training's Gaussian; expected: home and spread of the target in the
    cell; posture: where the rest of the person usually is. Raises CellError if the cell has no `sim` section."""

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
        mesh = target_mesh(cell.targets[target], cell)
        self.surface, self.response = Surface(mesh.vertices, mesh.faces), Response(cell, target)
        self.posture = Posture.usual(cell, cell.targets[target])
        self.models = robot_models(cell)

    def draw(self, rng: np.random.Generator, count: int, motion: bool = False) -> dict[str, Any]:
        """`count` scenes, from the training's Gaussian, or uniformly from the region of the cell's motion.

        T (count, 4, 4), size (count, 2), joints (count, j), pads (count, p, 4, 4), gap (count,) to the target, amplitude
        (count, n), alive (count, p).
        """
        kept: list[dict[str, Any]] = []
        while sum(len(k["gap"]) for k in kept) < count:
            kept.append(self._draw(rng, count, motion))
        return {name: np.concatenate([k[name] for k in kept])[:count] for name in kept[0]}

    def inputs(self, scene: dict[str, Any]) -> NDArray[np.float32]:
        """The network's input for scenes, computed as in `estimator.py`."""
        skin = self.skin
        signal = skin.signal(scene["amplitude"])
        variance = skin.noise / SAMPLES + (self.response.error * np.maximum(signal, 0.0)) ** 2
        variance = np.where(scene["alive"][..., skin.pad_of], variance, np.inf)
        return features(skin, self.home, signal, variance, scene["pads"], scene["joints"])

    def labels(self, scene: dict[str, Array]) -> NDArray[np.float32]:
        """The network's labels: the pose error about home in units of the spread (count, 6)."""
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
        size = SIZE + SIZE_SPREAD * np.sqrt(3.0) * rng.uniform(-1.0, 1.0, (count, 2))
        gap, ahead = np.empty(count), np.empty(count, np.bool_)
        electrodes, normals_out = np.ascontiguousarray(electrodes), np.ascontiguousarray(frames[..., :3, 2])
        _gaps(electrodes, normals_out, T, np.exp(size), *self.surface.arrays, gap, ahead)
        parts = np.stack([T, *self._rest_of_person(rng, T)], axis=1)
        change = np.stack([self.response.person(*scene) for scene in zip(pads, parts, size, strict=True)])
        signal = skin.gain * skin.sensitivity * change * (1.0 + self.response.error * rng.standard_normal(change.shape))
        amplitude = skin.a3 + skin.polarity * signal + np.sqrt(skin.noise / SAMPLES) * rng.standard_normal(change.shape)
        alive = rng.uniform(size=(count, len(skin.pads))) >= DEAD
        free = (gap > CLOSEST) & ahead
        scene = {"T": T, "size": size, "joints": joints, "pads": pads, "gap": gap, "amplitude": amplitude, "alive": alive}
        return {name: value[free] for name, value in scene.items()}

    def _rest_of_person(self, rng: np.random.Generator, T: Array) -> list[Array]:
        """Poses (count, 4, 4) of upper arm and torso behind limbs (count, 4, 4), with shoulders as the estimator expects them."""
        if self.posture is None:
            return []
        shoulder = self.posture.shoulder + self.posture.spread * rng.standard_normal((len(T), 3))
        return replace(self.posture, shoulder=shoulder).poses(T)


@kernel("""f8[s, n, 3], f8[s, n, 3], f8[s, 4, 4], f8[s, 2], f8[m, 3, 3], f8[3, m], f8[m], f8[m, 7, 3], out f8[s], out b1[s]""")
def _gaps(electrodes, normals_out, T, factors, corners, centers, radii, normals, out, ahead):  # type: ignore[no-untyped-def]
    """Writes the smallest gaps (s,) of electrodes (s, n, 3) to a surface at poses (s, 4, 4), stretched by factors (s, 2) along x
    and across (about, where it is stretched), and whether the nearest point lies in front of its electrode, whose pad looks along
    normals_out (s, n, 3)."""
    n = electrodes.shape[1]
    distance, local, nearest, gradient = np.empty(n), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    for s in range(len(T)):
        for e in range(n):
            x, y, z = electrodes[s, e, 0] - T[s, 0, 3], electrodes[s, e, 1] - T[s, 1, 3], electrodes[s, e, 2] - T[s, 2, 3]
            for i in range(3):
                local[e, i] = (x * T[s, 0, i] + y * T[s, 1, i] + z * T[s, 2, i]) / factors[s, 0 if i == 0 else 1]
        nearest_points(local, corners, centers, radii, normals, distance, nearest, gradient)
        k = np.argmin(distance)
        out[s] = distance[k] * factors[s, 1]
        toward = 0.0
        for i in range(3):
            for j in range(3):
                toward += normals_out[s, k, i] * T[s, i, j] * (nearest[k, j] - local[k, j])
        ahead[s] = toward > 0.0


def build(inputs: int) -> torch.nn.Sequential:
    """The paper's network: four fully connected layers of 256 ReLU units, and a linear layer to mean and precision factor."""
    layers: list[torch.nn.Module] = []
    for width in HIDDEN:
        layers += [torch.nn.Linear(inputs, width), torch.nn.ReLU()]
        inputs = width
    last = torch.nn.Linear(inputs, OUTPUTS)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)  # start at the prior: mean zero, precision one
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


def to_numpy(model: torch.nn.Sequential, mean: Array, scale: Array, scenes: Scenes, regression: Regression) -> PoseNetwork:
    """The trained network with the inputs' normalisation folded into its first layer; of the outputs only the pose is kept."""
    linear = [layer for layer in model if isinstance(layer, torch.nn.Linear)]
    W = [layer.weight.detach().numpy().T.astype(np.float64) for layer in linear]
    b = [layer.bias.detach().numpy().astype(np.float64) for layer in linear]
    b[0] = b[0] - (mean / scale) @ W[0]
    W[0] = W[0] / scale[:, None]
    W[-1], b[-1] = W[-1][:, :6], b[-1][:6]
    weights, biases = tuple(w.astype(np.float32) for w in W), tuple(v.astype(np.float32) for v in b)
    return PoseNetwork(weights, biases, scenes.home, scenes.spread, regression)


NOTHING_KNOWN = Regression(np.zeros((1, 4)), np.ones((5, 4)), np.ones(5), np.zeros((1, 5)), np.zeros(5))


def regress(scenes: Scenes, network: PoseNetwork, seed: int, count: int = REGRESSED) -> Regression:
    """R_c over the relative pose, from the network's errors in `count` scenes of the cell's motion."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    scene = scenes.draw(np.random.default_rng(seed), count, motion=True)
    x = scenes.inputs(scene)
    poses, logs = np.empty((count, 4)), np.empty((count, 5))
    for i in range(count):
        T = network.posterior(x[i])
        relative = Relative.of(scenes.skin, scenes.surface, scene["pads"][i], scene["alive"][i][scenes.skin.pad_of], T)
        error = pose_error(scene["T"][i], T)
        parts = np.concatenate([relative.frame @ error[:3], relative.frame[1:] @ error[3:]])
        poses[i], logs[i] = relative.pose, np.log(parts**2 + 1e-12) - LOG_CHI2
    # Means over neighbours: logs of single squared errors scatter by about two, and thousands of points are slow.
    order = np.argsort(poses[:, 0])
    groups = [
        cell for part in np.array_split(order, KERNELS // 10) for cell in np.array_split(part[np.argsort(poses[part, 1])], 10)
    ]
    points = np.array([poses[group].mean(axis=0) for group in groups])
    values = np.array([logs[group].mean(axis=0) for group in groups])
    spread = points.std(axis=0) + 1e-3
    lengths, amplitudes, weights, means = np.empty((5, 4)), np.empty(5), np.empty((len(points), 5)), values.mean(axis=0)
    for j in range(5):
        kernel = ConstantKernel(1.0, (1e-2, 1e2)) * RBF(spread, [(0.2 * s, 20.0 * s) for s in spread]) + WhiteKernel(
            0.5, (1e-3, 10.0)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a length at its bound: that part of the pose does not matter
            process = GaussianProcessRegressor(kernel, random_state=0).fit(points, values[:, j] - means[j])
        lengths[j], amplitudes[j] = process.kernel_.k1.k2.length_scale, process.kernel_.k1.k1.constant_value
        weights[:, j] = process.alpha_
    found = Regression(points, lengths, amplitudes, weights, means)
    # Errors have longer tails than a Gaussian: variances are scaled until the squared errors have them on average.
    squares = np.exp(logs + LOG_CHI2) / np.array([found.variances(pose) for pose in poses])
    return Regression(points, lengths, amplitudes, weights, means + np.log(np.mean(np.minimum(squares, 25.0), axis=0)))


def evaluate(scenes: Scenes, network: PoseNetwork, seed: int, count: int = 4000) -> dict[str, dict[str, Any]]:
    """Errors of single windows of unseen scenes by gap band: root mean squares across, away and along the limb [mm], of its
    direction [deg], and the normalised squared error per direction of the network's pose by R_c, or of the published one per
    known direction; for the network alone, and for the solve from scratch. The scenes are uniform in the region of the cell's
    motion."""
    results: dict[str, dict[str, Any]] = {}
    home, spread = scenes.expected
    samples = np.full(len(scenes.skin), SAMPLES)
    scene = scenes.draw(np.random.default_rng(seed), count, motion=True)
    for method in ("paper", "solve"):
        given = scenes.skin, scenes.response, scenes.surface, home, spread, network, method
        estimator = Estimator(*given, posture=scenes.posture)
        rows = []
        for i in range(count):
            estimator.reset()
            used = scene["alive"][i][scenes.skin.pad_of]
            estimate = estimator.update(
                1, scene["amplitude"][i], np.where(used, samples, 0), scene["pads"][i], scene["joints"][i]
            )
            T = scene["T"][i]
            relative = Relative.of(scenes.skin, scenes.surface, scene["pads"][i], used, estimator.pose)
            error = pose_error(T, estimator.pose)
            along, across, away = relative.frame @ error[:3]
            angle = float(np.arccos(np.clip(T[:3, 0] @ estimator.pose[:3, 0], -1.0, 1.0)))
            if method == "paper":
                parts = np.concatenate([relative.frame @ error[:3], relative.frame[1:] @ error[3:]])
                nees = float(np.mean(parts**2 / network.regression.variances(relative.pose)))
            else:
                difference = pose_error(T, estimate.T)
                rank = int((np.linalg.eigvalsh(estimate.information) > 1e-9).sum())
                nees = float(difference @ estimate.information @ difference / rank) if rank else np.nan
            rows.append([across, away, along, angle, nees])
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


def save(network: PoseNetwork, path: Path, key: str) -> None:
    """Save the weights as half-precision arrays: rounding changes a pose by less than a tenth of its error."""
    arrays: dict[str, Any] = {"home": network.home, "spread": network.spread, "fingerprint": np.array(key)}
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays[f"weight{i}"], arrays[f"bias{i}"] = W.astype(np.float16), b.astype(np.float32)
    own = network.regression
    parts = {"points": own.points, "lengths": own.lengths, "amplitudes": own.amplitudes, "kernel_weights": own.weights}
    arrays |= {name: part.astype(np.float32) for name, part in parts.items()} | {"means": own.means}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


class Pool:
    """Pool of training scenes, to which every step adds new ones: drawing a whole batch would take longer than learning from it.
    mean, scale (f,): of the inputs of its first scenes, which normalise all others."""

    def __init__(self, scenes: Scenes, seed: int):
        self.scenes = scenes
        first = scenes.draw(np.random.default_rng(seed), START)
        x, y = scenes.inputs(first), scenes.labels(first)
        self.mean, self.scale = x.mean(axis=0).astype(np.float64), x.std(axis=0).astype(np.float64) + 1e-3
        self._x, self._y = np.empty((POOL, x.shape[1]), np.float32), np.empty((POOL, 6), np.float32)
        self._x[:START], self._y[:START], self._drawn = x, y, START

    def batch(self, rng: np.random.Generator, schedule: Schedule) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised inputs (b, f) and labels (b, 6) from the pool, after new scenes have joined it."""
        new = self.scenes.draw(rng, schedule.fresh)
        place = np.arange(self._drawn, self._drawn + schedule.fresh) % POOL
        self._x[place], self._y[place] = self.scenes.inputs(new), self.scenes.labels(new)
        self._drawn += schedule.fresh
        rows = rng.integers(min(self._drawn, POOL), size=schedule.batch)
        x = ((self._x[rows] - self.mean) / self.scale).astype(np.float32)
        return torch.from_numpy(x), torch.from_numpy(self._y[rows])

    def close(self) -> None:
        """Nothing to stop: scenes are drawn on demand."""


@dataclass(frozen=True)
class NetworkSettings:
    """inputs: the network's input size; trained_for: the fingerprint of the cell and target."""

    inputs: int
    trained_for: str


@dataclass(frozen=True)
class Schedule:
    """Training schedule."""

    peak_rate: float = 1e-3
    """Adam's maximum learning rate, of one cycle. Adam's usual value (Kingma and Ba 2015, arXiv:1412.6980)."""
    rise: float = 0.02
    """Share of the training in which the rate rises to its peak. Chosen."""
    batch: int = 1024
    """Number of scenes per step. Chosen."""
    fresh: int = 128
    """Number of new scenes per step; they join the pool. Chosen for time: an eighth of a batch."""
    clip: float = 20.0
    """Maximum norm of a gradient. Chosen."""
    averaging: float = 0.998
    """Share of the averaged (exported) weights that a step keeps. Chosen: an average over about five hundred steps."""


class Trainer(training.Trainer[torch.nn.Sequential, Pool]):
    """The network being trained."""

    SETTINGS = NetworkSettings
    schedule: Schedule

    def __init__(self, settings: NetworkSettings, schedule: Schedule, seed: int):
        torch.manual_seed(seed)
        net = build(settings.inputs)
        super().__init__(settings, schedule, seed, net, torch.optim.Adam(net.parameters()))

    def train_step(self, data: Pool, progress: float) -> dict[str, float]:
        """One step of gradient descent; returns the loss."""
        schedule = self.schedule
        x, y = data.batch(np.random.default_rng([self.seed, 1, self.step]), schedule)
        value = loss(self.net(x), y)
        self.descend(value, schedule.peak_rate * training.one_cycle(progress, schedule.rise), schedule.clip, schedule.averaging)
        return {"loss": value.item()}


def export(trainer: Trainer, pool: Pool, out: Path, held_out: int) -> dict[str, Any]:
    """Regress R_c, score the averaged weights on held-out scenes, and write them with their card; returns the card."""
    scenes, seed = pool.scenes, trainer.seed
    network = to_numpy(trainer.average, pool.mean, pool.scale, scenes, NOTHING_KNOWN)
    network = replace(network, regression=regress(scenes, network, seed + REGRESSION_SEED))
    save(network, out, trainer.settings.trained_for)
    card = {
        "seed": seed,
        "date": datetime.date.today().isoformat(),
        "settings": {
            "network": {"hidden": HIDDEN, "steps": trainer.step, "minutes": round(trainer.minutes, 1)},
            "schedule": asdict(trainer.schedule),
            "data": {"samples_per_window": SAMPLES, "model_error": "of the response", "dead_pads": DEAD, "closest_m": CLOSEST},
            "prior": {"home": scenes.home.round(6).tolist(), "spread": scenes.spread.round(6).tolist()},
            "fingerprint": trainer.settings.trained_for,
        },
        "held_out_seed": seed + VALIDATION_SEED,
        "held_out": evaluate(scenes, network, seed + VALIDATION_SEED, held_out),
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
    return card


@flags.command(
    "haptics train",
    "Trains the skin's pose network for a cell, and writes weights and card.",
    *training_flags.of_every("haptics", 15.0),
    flags.CELL,
    flags.Option("--target", show_default="the cell's first", help="the target's name"),
    flags.Option("--out", type=Path, show_default="the file that the service loads", help="weights file"),
    flags.Option("--held-out", type=flags.positive, default=4000, help="scenes for the card's score"),
    example="penumbra haptics train --cell mine.yaml --minutes 15",
)
def main(options: flags.Options) -> int:
    """Train, then write weights and card."""
    cell = cells.load(options.cell)
    target = cell.one("targets", options.target)
    out = options.out or WEIGHTS / f"{cell.name}-{target}.npz"
    scenes, trained_for = Scenes(cell, target), fingerprint(cell, target)
    if options.resume and options.checkpoint.is_file():
        trainer = Trainer.restore(options.checkpoint, Schedule())
        if trainer.settings.trained_for != trained_for:
            raise SystemExit(
                f"{options.checkpoint}: expected a checkpoint for target {target} of cell {cell.name} ({trained_for}), got one "
                f"for another cell ({trainer.settings.trained_for}): give its --cell, another --checkpoint, or leave --resume out"
            )
        pool = Pool(scenes, trainer.seed)
    else:
        pool = Pool(scenes, options.seed)
        trainer = Trainer(NetworkSettings(len(pool.mean), trained_for), Schedule(), options.seed)
    if not training.complete(trainer, pool, options):
        return 130
    card = export(trainer, pool, out, options.held_out)
    print(f"{out} and its card: {json.dumps(card['held_out'], indent=1)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
