"""`penumbra bench search`: how near the search comes to the truth, and to what a mask can tell at all.

Random scenes that hide a given share of the target (`sim.sets.shots`), starts perturbed by 2 cm and 4 degrees. Exact masks come
from the renderer, network masks from the trained segmentation, which saw the frames before in the window that the service would
cut. Beside each row stand the paper's search and the Cramér-Rao bound of an exact mask (`tests.bench.lib.bound`): the median of
the position errors that an efficient estimator would make on the same pictures, the prior left out, as the published pose leaves
it out.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, rankdata

from penumbra.services import flags
from penumbra.services.search.mask_fit import Noise
from penumbra.services.search.tracker import Search, Searched
from penumbra.services.search.verdict import WRONG
from penumbra.services.segmentation.inference import Segmenter, load_segmenter
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.lookout import Window, corners_of, whole_frame, window_around
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Shot
from penumbra.tests.bench.lib import bound, results
from penumbra.tests.bench.lib.results import Part, marked

HIDDEN = (0.0, 0.3, 0.6, 0.85)
VIEWS = ((320, 240, 1.5), (640, 480, 1.5), (1280, 960, 4.5), (1280, 960, 8.0))
"""Width and height of the pictures [px], distance [m]."""
NEES_VIEW = VIEWS[1]
"""View of the NEES, of the goals for the whole chain, and of the frames for the other numbers."""
START = (0.02, np.radians(4.0))
"""Root mean square length of the starts' errors: position [m], rotation [rad]."""
PRIOR = np.diag(np.repeat(np.square(START) / 3.0, 3))
"""Covariance of the starts, the same along any axes."""
EXACT = Noise(edge=0.29, correlation=2.0, dilation=0.02)
"""Noise of an exact mask, for the search: uniform in a pixel, and the stairs of a slanted edge repeat it."""
GONE = 0.95
"""Hidden share above which nothing is left to track."""
GOALS = {0.0: (0.25, 0.4), 0.3: (0.3, 0.5), 0.6: (0.6, 1.2), 0.85: (1.5, 2.5)}
"""Goals for the position error of the whole chain at NEES_VIEW, median and mean [cm], by hidden share."""
BOUND_GOAL, FASTER_GOAL, BETTER_GOAL, AUC_GOAL = 1.2, 10.0, 5.0, 0.97
WARM_FRAMES = 4


@dataclass(frozen=True)
class Plan:
    """Numbers of scenes: per row; tracked ones per row for the NEES; per kind of frame for the detector of lost poses; of hidden
    arms. domain: looks of the scenes."""

    scenes: int
    nees: int
    lost: int
    gone: int
    domain: shots.Domain = "wide"


FULL, QUICK = Plan(40, 200, 50, 110), Plan(2, 3, 2, 2)


@dataclass(frozen=True)
class Result:
    """One search of one frame, its time [ms], and its errors: position, depth (along the line of sight) and lateral [m], axis and
    roll [rad]."""

    estimate: Searched
    shot: Shot
    ms: float

    @property
    def error(self) -> Array:
        return rigid.pose_error(self.shot.T_world_target, self.estimate.T)

    @property
    def position(self) -> float:
        return float(np.linalg.norm(self.error[:3]))

    @property
    def with_prior(self) -> float:
        """Position error [m] of the pose that is most probable given the start as a prior."""
        return float(np.linalg.norm(self.shot.T_world_target[:3, 3] - self.estimate.T_searched[:3, 3]))

    @property
    def depth(self) -> float:
        sight = self.shot.T_world_target[:3, 3] - self.shot.camera.T_world_camera[:3, 3]
        return float(abs(self.error[:3] @ sight) / np.linalg.norm(sight))

    @property
    def lateral(self) -> float:
        return float(np.sqrt(max(self.position**2 - self.depth**2, 0.0)))

    @property
    def axis(self) -> float:
        return rigid.axis_angle_error(self.shot.T_world_target, self.estimate.T)

    @property
    def roll(self) -> float:
        """Twist about the limb's axis of the rotation between the two poses."""
        x, _, _, w = Rotation.from_matrix(self.shot.T_world_target[:3, :3].T @ self.estimate.T[:3, :3]).as_quat()
        return float(abs((2.0 * np.arctan2(x, w) + np.pi) % (2.0 * np.pi) - np.pi))

    @property
    def is_wrong(self) -> bool:
        return bool(self.position > WRONG[0] or self.axis > WRONG[1])


def perturbed(rng: np.random.Generator) -> Array:
    """A random pose error (6,) of a start."""
    return rng.normal(size=6) * np.sqrt(np.diag(PRIOR))


def search_of(shot: Shot, method: str, exact: bool) -> Search:
    return Search(shot.cell, method=method, noise=EXACT if exact else None)


def searched(shot: Shot, search: Search, mask: Mask, T_prior: Array | None) -> Result:
    """One update and its processor time, which excludes other processes."""
    begin = time.process_time()
    estimate = search.update(mask, T_prior, None if T_prior is None else PRIOR, shot.joints, shot.image)
    return Result(estimate, shot, 1e3 * (time.process_time() - begin))


def window_of(shot: Shot, T: Array, previous: Window | None = None) -> Window:
    """The window that the segmentation service would cut around a pose."""
    around = window_around(shot.camera, [(T, corners_of(shot.mesh.vertices))], previous)
    return around or whole_frame(shot.camera)


def around(error: Array) -> Callable[[Shot, Window | None], Window]:
    """The window around the true pose moved by an error (6,), for a frame and the window before."""
    return lambda shot, previous: window_of(shot, rigid.perturb(shot.T_world_target, error), previous)


def exact_mask(shot: Shot, window: Window) -> Mask:
    """The labels of a window at the picture's own resolution."""
    labels = np.ascontiguousarray(shot.labels[window.y0 : window.bottom, window.x0 : window.right])
    return Mask(stamp_ns=shot.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=1)


def network_masks(segmenter: Segmenter, film: list[Shot], window_at: Callable[[Shot, Window | None], Window]) -> Iterator[Mask]:
    """The masks of a film, in the window that `window_at` gives for each frame and the window before."""
    window = None
    for shot in film:
        window = window_at(shot, window)
        assert shot.image is not None
        labels = segmenter(shot.image, window, shot.stamp_ns)
        yield Mask(stamp_ns=shot.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)


def exact_results(
    seed: int, view: tuple[int, int, float], hidden: float, count: int
) -> tuple[dict[str, list[Result]], list[Shot]]:
    """Searches of exact masks by method, and the pictures."""
    out: dict[str, list[Result]] = {"contour": [], "paper": []}
    pictures = []
    for index in range(count):
        shot = shots.shot(seed, index, *view, hidden, images=False)
        T_prior = rigid.perturb(shot.T_world_target, perturbed(np.random.default_rng([seed, index, 1])))
        mask = exact_mask(shot, window_of(shot, T_prior))
        for method in out:
            search = search_of(shot, "default" if method == "contour" else method, True)
            out[method].append(searched(shot, search, mask, T_prior))
        pictures.append(shot)
    return out, pictures


def network_results(
    seed: int,
    view: tuple[int, int, float],
    hidden: float,
    count: int,
    segmenter: Segmenter,
    domain: shots.Domain = "wide",
    tracked: int = 0,
) -> tuple[dict[str, list[Result]], list[Shot]]:
    """Searches of the network's masks by method, after some frames that warm its state, and the pictures: `count` of them, and
    up to twice as many until `tracked` of them are tracked."""
    out: dict[str, list[Result]] = {"contour": [], "paper": []}
    pictures: list[Shot] = []
    while len(pictures) < count or (
        len(pictures) < 2 * count and sum(r.estimate.state == "tracking" for r in out["contour"]) < tracked
    ):
        index = len(pictures)
        film = shots.clip(seed, index, *view, hidden, domain, WARM_FRAMES)
        error = perturbed(np.random.default_rng([seed, index, 1]))
        *_, mask = network_masks(segmenter, film, around(error))
        T_prior = rigid.perturb(film[-1].T_world_target, error)
        for method in out:
            search = search_of(film[-1], "default" if method == "contour" else method, False)
            out[method].append(searched(film[-1], search, mask, T_prior))
        pictures.append(film[-1])
    return out, pictures


def row(masks: str, view: tuple[int, int, float], hidden: float, method: str, results: list[Result], bounds: dict[str, float]):
    """A row of the table as JSON: medians, and the 90th percentiles and means beside them."""
    measured = {
        "position_cm": (100.0, [r.position for r in results]),
        "lateral_cm": (100.0, [r.lateral for r in results]),
        "depth_cm": (100.0, [r.depth for r in results]),
        "axis_deg": (180.0 / np.pi, [r.axis for r in results]),
        "roll_deg": (180.0 / np.pi, [r.roll for r in results]),
    }
    medians = {key: round(scale * float(np.median(values)), 4) for key, (scale, values) in measured.items()}
    p90 = {key: round(scale * float(np.quantile(values, 0.9)), 4) for key, (scale, values) in measured.items()}
    mean = round(100.0 * float(np.mean(measured["position_cm"][1])), 4)
    tracked = [100.0 * r.position for r in results if r.estimate.state == "tracking"]
    width, height, distance_m = view
    return {
        "masks": masks,
        "width": width,
        "height": height,
        "distance_m": distance_m,
        "occlusion": hidden,
        "method": method,
        **medians,
        "position_cm": {"median": medians["position_cm"], "p90": p90["position_cm"], "mean": mean},
        "p90": {key: value for key, value in p90.items() if key != "position_cm"},
        **bounds,
        "ms": round(float(np.median([r.ms for r in results])), 3),
        "searched_cm": round(100.0 * float(np.median([r.with_prior for r in results])), 4),
        "tracked_cm": {"median": round(float(np.median(tracked)), 4), "mean": round(float(np.mean(tracked)), 4)}
        if tracked
        else None,
        "not_tracking": round(float(np.mean([r.estimate.state != "tracking" for r in results])), 4),
        "frames": len(results),
    }


def bounds_of(pictures: Iterable[Shot]) -> dict[str, float]:
    """The bound of pictures [cm]: median position error for a round limb, the same where the mesh's flat sides show its roll,
    the same with the prior of the start, and the root mean square for the round limb."""
    pictures = list(pictures)
    round_limb = [bound.information(shot) for shot in pictures]
    with_prior = [each + np.linalg.inv(PRIOR) for each in round_limb]
    with_facets = [bound.information(shot, facets=True) for shot in pictures]
    return {
        "bound_cm": round(100.0 * float(np.median(bound.position_errors(round_limb))), 4),
        "bound_facets_cm": round(100.0 * float(np.median(bound.position_errors(with_facets))), 4),
        "bound_prior_cm": round(100.0 * float(np.median(bound.position_errors(with_prior))), 4),
        "bound_rms_cm": round(100.0 * bound.position_rms(round_limb), 4),
    }


def nees(results: list[Result]) -> dict[str, Any]:
    """Normalised estimation error squared of the tracked poses without the roll (5 degrees of freedom): its mean, the band in
    which that lies with 95 % if the covariances are true, and its median (4.35 expected)."""
    values = []
    for result in results:
        if result.estimate.state != "tracking":
            continue
        basis = np.zeros((5, 6))
        basis[:3, :3] = np.eye(3)
        basis[3:, 3:] = result.shot.T_world_target[:3, 1:3].T
        error = basis @ result.error
        values.append(float(error @ np.linalg.solve(basis @ result.estimate.covariance @ basis.T, error)))
    if not values:
        return {"frames": 0, "mean": None, "median": None, "band": None}
    n = 5 * len(values)
    band = [round(float(chi2.ppf(p, n)) / len(values), 3) for p in (0.025, 0.975)]
    return {
        "frames": len(values),
        "mean": round(float(np.mean(values)), 3),
        "median": round(float(np.median(values)), 3),
        "band": band,
    }


def auc(scores: Array, positive: np.ndarray) -> float | None:
    """Area under the ROC curve: the probability that a positive scores above a negative, ties counted half."""
    n, p = int((~positive).sum()), int(positive.sum())
    if not n or not p:
        return None
    return float((rankdata(scores)[positive].sum() - p * (p + 1) / 2.0) / (n * p))


CONFIDENCES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)
"""Bounds of the confidences that are compared with the share of right poses."""
KINDS = ("good start", "bad start", "wrong mask", "no prior", "absent")


@dataclass(frozen=True)
class Judgement:
    """A frame of one of KINDS: the estimate, whether its pose is wrong, whether the mask shows the target.

    Where the search gives up, it reports the start's pose. With a good start and a mask that shows something else this pose is
    right by chance: such a frame counts as one that should be doubted.
    """

    kind: str
    estimate: Searched
    is_wrong: bool
    is_shown: bool

    @property
    def is_told(self) -> bool:
        return self.estimate.state == "tracking"

    @property
    def confidence(self) -> float:
        """0 where the search did not say."""
        return self.estimate.confidence or 0.0

    @property
    def should_be_doubted(self) -> bool:
        return self.is_wrong or not (self.is_shown or self.is_told)


def lost_frames(
    seed: int,
    count: int,
    segmenter: Segmenter,
    domain: shots.Domain,
    view: tuple[int, int, float] = NEES_VIEW,
    hands: shots.Hands = "stiff",
    has_image: bool = True,
    spreads: tuple[float, ...] = (1.0,),
) -> Iterator[Judgement]:
    """Frames of all KINDS. has_image: whether the search gets the image as well; spreads: factors, in turn, on the standard
    deviations of the starts, which the search knows; bad starts are not as near as it is told."""
    for index in range(count):
        rng = np.random.default_rng([seed, index, 2])
        spread = spreads[index % len(spreads)]

        def judgement(kind: str, shot: Shot, mask: Mask, T_prior: Array | None, spread: float = spread) -> Judgement:
            search, covariance = search_of(shot, "default", False), None if T_prior is None else spread**2 * PRIOR
            estimate = search.update(mask, T_prior, covariance, shot.joints, shot.image if has_image else None)
            is_wrong = Result(estimate, shot, 0.0).is_wrong or kind == "absent"
            return Judgement(kind, estimate, is_wrong, shows_target(mask, shot))

        film = shots.clip(seed, index, *view, HIDDEN[index % len(HIDDEN)], domain, 3, hands=hands)
        last = film[-1]
        near, far = spread * perturbed(rng), np.concatenate([_length(rng, 0.08, 0.4), _length(rng, 0.3, 1.5)])
        T_near, T_far = (rigid.perturb(last.T_world_target, error) for error in (near, far))
        *_, mask = network_masks(segmenter, film, around(near))
        yield judgement("good start", last, mask, T_near)
        yield judgement("wrong mask", last, spoiled(mask, rng), T_near)
        *_, mask = network_masks(segmenter, film, around(far))
        yield judgement("bad start", last, mask, T_far)
        *_, mask = network_masks(segmenter, film, lambda shot, previous: whole_frame(shot.camera))
        yield judgement("no prior", last, mask, None)
        empty = shots.clip(seed, index, *view, 0.0, domain, 3, present=False)
        T_prior = rigid.perturb(empty[-1].T_world_target, near) if index % 2 else None
        *_, mask = network_masks(segmenter, empty, around(near))
        yield judgement("absent", empty[-1], mask, T_prior)


def shows_target(mask: Mask, shot: Shot) -> bool:
    """Whether the IoU of the target's pixels in the mask and in the truth is at least a half."""
    target = (Label.FOREARM, Label.HAND)
    ours = np.zeros(shot.labels.shape, bool)
    h, w = (n * mask.scale for n in mask.labels.shape)
    ours[mask.y0 : mask.y0 + h, mask.x0 : mask.x0 + w] = np.kron(
        np.isin(mask.labels, target), np.ones((mask.scale, mask.scale), bool)
    )
    theirs = np.isin(shot.labels, target)
    return bool((ours & theirs).sum() >= 0.5 * max((ours | theirs).sum(), 1))


def _length(rng: np.random.Generator, low: float, high: float) -> Array:
    v = rng.normal(size=3)
    return rng.uniform(low, high) * v / np.linalg.norm(v)


def spoiled(mask: Mask, rng: np.random.Generator) -> Mask:
    """A mask that is wrong about where the target is: mirrored, turned by 180 degrees, moved away, or with the upper arm's region
    called the target and the target background."""
    labels = mask.labels
    kind = rng.integers(4)
    if kind == 0:
        labels = labels[:, ::-1]
    elif kind == 1:
        labels = labels[::-1, ::-1]
    elif kind == 2:
        labels = np.roll(labels, rng.choice([-1, 1], 2) * np.array(labels.shape) // 4, axis=(0, 1))
    else:
        table = np.arange(256, dtype=np.uint8)
        table[[Label.FOREARM, Label.HAND, Label.UPPER_ARM]] = Label.BACKGROUND, Label.BACKGROUND, Label.FOREARM
        labels = table[labels]
    return Mask(stamp_ns=mask.stamp_ns, labels=np.ascontiguousarray(labels), x0=mask.x0, y0=mask.y0, scale=mask.scale)


def gone_frames(seed: int, count: int, segmenter: Segmenter, domain: shots.Domain) -> Iterator[Searched]:
    """Estimates from frames in which more than GONE of the target is hidden."""
    for index in range(count):
        film = shots.clip(seed, index, *NEES_VIEW, (0.975, 0.99, 1.0)[index % 3], domain, 5)
        error = perturbed(np.random.default_rng([seed, index, 3]))
        search = search_of(film[-1], "default", False)
        for shot, mask in zip(film, network_masks(segmenter, film, around(error)), strict=True):
            found = searched(shot, search, mask, rigid.perturb(shot.T_world_target, error))
            if shot.hidden > GONE:
                yield found.estimate


def rows_of(seed: int, plan: Plan, masks: tuple[str, ...]) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """All rows of the table, and the NEES at NEES_VIEW by kind of mask and share hidden."""
    segmenter = load_segmenter() if "network" in masks else None
    rows: list[dict[str, Any]] = []
    consistency: dict[str, dict[str, Any]] = {kind: {} for kind in masks}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("rows", total=len(masks) * len(VIEWS) * len(HIDDEN))
        for kind in masks:
            for view in VIEWS:
                for hidden in HIDDEN:
                    if kind == "exact" or segmenter is None:
                        results, pictures = exact_results(seed, view, hidden, plan.scenes)
                    elif view == NEES_VIEW:
                        results, pictures = network_results(seed, view, hidden, plan.nees, segmenter, plan.domain, plan.nees)
                    else:
                        results, pictures = network_results(seed, view, hidden, plan.scenes, segmenter, plan.domain)
                    bounds = bounds_of(pictures)
                    rows += [row(kind, view, hidden, method, found, bounds) for method, found in results.items()]
                    if view == NEES_VIEW:
                        consistency[kind][f"{hidden:g}"] = nees(results["contour"])
                    progress.advance(task)
    return rows, consistency


def overall(parts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The NEES over all shares hidden, beside its parts."""
    used = [part for part in parts.values() if part["frames"]]
    n = sum(part["frames"] for part in used)
    mean = sum(part["mean"] * part["frames"] for part in used) / n if n else None
    band = [round(float(chi2.ppf(p, 5 * n)) / n, 3) for p in (0.025, 0.975)] if n else None
    return {"mean": None if mean is None else round(mean, 3), "band": band, "frames": n, "by_occlusion": parts}


def judged(seed: int, plan: Plan) -> dict[str, Any]:
    """The search's own judgement: as a detector of wrong poses, and where nothing is left to see."""
    segmenter = load_segmenter()
    frames = list(lost_frames(seed, plan.lost, segmenter, plan.domain))
    doubts = np.array([1.0 - frame.confidence for frame in frames])
    area = auc(doubts, np.array([frame.should_be_doubted for frame in frames]))
    by_error = auc(doubts, np.array([frame.is_wrong for frame in frames]))
    kinds = {}
    for kind in KINDS:
        chosen = [frame for frame in frames if frame.kind == kind]
        kinds[kind] = {
            "frames": len(chosen),
            "wrong": sum(frame.is_wrong for frame in chosen),
            "not shown": sum(not frame.is_shown for frame in chosen),
            "tracking": sum(frame.is_told for frame in chosen),
            "wrong and tracking": sum(frame.is_told and frame.is_wrong for frame in chosen),
        }
    gone = list(gone_frames(seed, plan.gone, segmenter, plan.domain))
    return {
        "lost_auc": None if by_error is None else round(by_error, 4),
        "lost_auc_giving_up_right": None if area is None else round(area, 4),
        "lost": kinds,
        "reliability": reliability(frames),
        "false_tracking": sum(estimate.state == "tracking" for estimate in gone),
        "hidden_frames": len(gone),
    }


def reliability(frames: Sequence[Judgement]) -> list[dict[str, Any]]:
    """By bounds of the confidence: the number of frames, their mean confidence, and the share that should not be doubted."""
    rows = []
    for low, high in itertools.pairwise(CONFIDENCES):
        chosen = [frame for frame in frames if low <= frame.confidence < high]
        if chosen:
            mean = float(np.mean([frame.confidence for frame in chosen]))
            right = float(np.mean([not frame.should_be_doubted for frame in chosen]))
            rows.append({"low": low, "high": high, "frames": len(chosen), "confidence": round(mean, 3), "right": round(right, 3)})
    return rows


def measure(seed: int, plan: Plan, parts: tuple[str, ...]) -> dict[str, Any]:
    """The whole benchmark; `parts` of exact, network, judged."""
    masks = tuple(part for part in parts if part != "judged")
    exact_results(seed + 1, VIEWS[0], 0.3, 1)  # compiles and warms up
    if "network" in masks:
        network_results(seed + 1, VIEWS[0], 0.3, 1, load_segmenter())
    result: dict[str, Any] = {"seed": seed, "domain": plan.domain}
    result["rows"], consistency = rows_of(seed, plan, masks)
    result["nees"] = overall(consistency["network"]) if "network" in masks else {}
    if "exact" in masks:
        result["nees"]["exact"] = overall(consistency["exact"])
    return result | (judged(seed, plan) if "judged" in parts else {})


def tables(result: dict[str, Any]) -> list[Part]:
    """Errors beside the bound and the paper's search, consistency, and the search's own judgement."""
    parts: list[Part] = [_errors(result, kind) for kind in dict.fromkeys(row["masks"] for row in result["rows"])]
    consistent = Table("masks", "hidden", "mean", "95 % band", "median (4.35)", "frames", title="NEES, 5 degrees of freedom")
    for name, part in (("network", result["nees"]), ("exact", result["nees"].get("exact", {}))):
        for hidden, each in part.get("by_occlusion", {}).items():
            if each["frames"]:
                low, high = each["band"]
                mean = marked(f"{each['mean']:.2f}", low <= each["mean"] <= high)
                consistent.add_row(
                    name, f"{float(hidden):.0%}", mean, f"{low:.2f} to {high:.2f}", f"{each['median']:.2f}", str(each["frames"])
                )
    if consistent.row_count:
        parts.append(consistent)
    if "lost_auc" in result:
        parts += _judged(result)
    return parts


def _errors(result: dict[str, Any], kind: str) -> Table:
    """The rows of one kind of masks."""
    table = Table(
        "picture", "hidden", "position cm", "mean", "tracked: median / mean", "bound cm", "with prior / bound", "paper's method",
        "lateral cm", "depth cm", "axis deg", "roll deg", "ms / paper's", "not tracking", "goal",
        title=f"{kind.capitalize()} masks, seed {result['seed']}, {result['domain']} domain: median (90th percentile)",
    )  # fmt: skip
    papers = {_key(row): row for row in result["rows"] if row["method"] == "paper"}
    for row in result["rows"]:
        if row["masks"] != kind or row["method"] == "paper":
            continue
        position, paper, tracked = row["position_cm"], papers[_key(row)], row["tracked_cm"]
        cells = [f"{row[key]:.2f} ({row['p90'][key]:.2f})" for key in ("lateral_cm", "depth_cm", "axis_deg", "roll_deg")]
        table.add_row(
            f"{row['width']} x {row['height']}, {row['distance_m']:g} m", f"{row['occlusion']:.0%}",
            f"{position['median']:.2f} ({position['p90']:.2f})", f"{position['mean']:.2f}",
            f"{tracked['median']:.2f} / {tracked['mean']:.2f}" if tracked else "-", f"{row['bound_cm']:.2f}",
            f"{row['searched_cm']:.2f} / {row['bound_prior_cm']:.2f}", f"{paper['position_cm']['median']:.2f}", *cells,
            f"{row['ms']:.1f} / {paper['ms']:.1f}", f"{row['not_tracking']:.0%}", _goal(row, paper),
        )  # fmt: skip
    return table


def _judged(result: dict[str, Any]) -> list[Part]:
    """Tables of the search's own judgement."""
    kinds = Table(
        "frames with", *next(iter(result["lost"].values())), title="Poses that the search calls tracked, and wrong ones"
    )
    for kind, each in result["lost"].items():
        kinds.add_row(kind, *map(str, each.values()))
    area = result["lost_auc"]
    told = "-" if area is None else marked(f"{area:.3f}", area >= AUC_GOAL)
    false = marked(f"{result['false_tracking']} of {result['hidden_frames']}", result["false_tracking"] == 0)
    reliable = Table("confidence", "frames", "mean confidence", "right", title="How often a pose is right, by its confidence")
    for row in result["reliability"]:
        reliable.add_row(
            f"{row['low']:g} to {min(row['high'], 1.0):g}", str(row["frames"]), f"{row['confidence']:.2f}", f"{row['right']:.2f}"
        )
    return [
        kinds,
        reliable,
        f"Wrong poses doubted: area under the ROC curve {told} (goal {AUC_GOAL}); {result['lost_auc_giving_up_right']} if giving "
        "up on a mask of something else is right, whatever the start.",
        f"More than {GONE:.0%} hidden and tracking: {false} (goal 0).",
    ]


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["masks"], row["width"], row["distance_m"], row["occlusion"]


def _goal(row: dict[str, Any], paper: dict[str, Any]) -> str:
    """The values of a row beside its goals."""
    position = row["position_cm"]
    if row["masks"] == "exact":
        ratio = position["median"] / row["bound_cm"]
        better, faster = paper["position_cm"]["median"] / max(position["median"], 1e-9), paper["ms"] / row["ms"]
        return ", ".join([
            f"{marked(f'{ratio:.2f}', ratio <= BOUND_GOAL)} of bound (<= {BOUND_GOAL:g})",
            f"{marked(f'{better:.0f}', better >= BETTER_GOAL)} x better ({BETTER_GOAL:g})",
            f"{marked(f'{faster:.1f}', faster >= FASTER_GOAL)} x faster ({FASTER_GOAL:g})",
        ])  # fmt: skip
    if (row["width"], row["height"], row["distance_m"]) != NEES_VIEW:
        return ""
    median, mean = GOALS[row["occlusion"]]
    is_met = position["median"] <= median and position["mean"] <= mean
    return marked(f"median <= {median:g}, mean <= {mean:g}", is_met)


@results.benchmark(
    "search",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws scenes and starts"),
    flags.Option("--frames", type=flags.positive, help=f"scenes of each row (default {FULL.scenes}; at least 200 for the NEES)"),
    flags.Option("--quick", is_flag=True, help="a few scenes of everything, to see that it runs"),
    flags.Option("--domain", choices=("wide", "easy"), default="wide", help="looks of the network's scenes"),
    flags.Option("--parts", choices=("exact", "network", "judged"), takes="many", default=["exact", "network", "judged"]),
    example="penumbra bench search --quick --json search.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    plan = replace(QUICK if options.quick else FULL, domain=options.domain)
    if options.frames:
        plan = Plan(options.frames, max(options.frames, 200), options.frames, options.frames, options.domain)
    started = time.monotonic()
    result = measure(options.seed, plan, tuple(options.parts))
    report.save({**result, "wall_s": round(time.monotonic() - started, 1)})


if __name__ == "__main__":
    raise SystemExit(main())
