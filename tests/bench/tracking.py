"""`penumbra bench tracking`: an occluder passes before the moving arm, and the camera alone has to hold it.

Films of 10 s (`sim.sets.shots.passing`) are played through the services in one process (`services.replay.chain`): segmentation,
search and fusion without the skin, so that the window follows the pose predicted while nothing is seen. Scored are the camera's
own poses (errors, false reports of tracking, frames until recovered), and the fused one while everything is hidden.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from penumbra.services import flags
from penumbra.services.replay.chain import Replay
from penumbra.services.search.verdict import WRONG
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Frame, FusedPose, Message, VisionPose
from penumbra.shared.contract.topics import Topic
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Domain, Shot
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.judgements import GONE
from penumbra.tests.bench.lib.results import Part, Result, marked

BACKGROUNDS: dict[str, Domain] = {"plain": "easy", "cluttered": "wide"}
SERVICES = ("segmentation", "search", "fusion")
VISIBLE = 0.33
"""Maximum hidden share at which the arm counts as visible."""
BACK = 0.5
"""The arm counts as back in sight when less than this share is hidden again."""
SKIPPED_S = 1.0
"""Time [s] at the start that is not scored, until the arm is found."""
AFTER_S = 1.0
"""Time [s] after the arm came back that counts as after an occlusion."""
RECOVERY_GOAL = 5
ERRORS = {
    "visible_cm": "position error cm, at most a third hidden",
    "partly_hidden_cm": "position error cm, a third to 95 % hidden",
    "after_cm": "position error cm, within a second of coming back",
    "fused_while_hidden_cm": "position error cm of the predicted pose, all hidden",
    "axis_deg": "axis error deg, up to 95 % hidden",
}


@dataclass(frozen=True)
class Truth:
    """A frame of a film: stamp, T_world_target (4, 4), share hidden."""

    stamp_ns: int
    T: Array
    hidden: float


@dataclass(frozen=True)
class Film:
    """Poses of a film. vision, fused: by the stamp of the frame that they belong to."""

    truths: list[Truth]
    vision: dict[int, VisionPose]
    fused: dict[int, FusedPose]

    def errors(self, pose: VisionPose | FusedPose, truth: Truth) -> tuple[float, float]:
        """Errors of the position [m] and of the axis [rad]."""
        T = rigid.transform(pose.position, pose.orientation)
        return float(np.linalg.norm(T[:3, 3] - truth.T[:3, 3])), rigid.axis_angle_error(truth.T, T)

    def is_right(self, truth: Truth) -> bool:
        """Whether the camera's pose is tracked and not wrong."""
        pose = self.vision.get(truth.stamp_ns)
        return pose is not None and pose.state == "tracking" and bool(np.less(self.errors(pose, truth), WRONG).all())


def played(film: Iterator[Shot], arguments: dict[str, list[str]] | None = None) -> Film:
    """Plays a film through the services. arguments: of each service."""
    first = next(film)
    truths: list[Truth] = []

    def recording() -> Iterator[tuple[Topic, dict[str, str], Message]]:
        shot: Shot | None = first
        while shot is not None:
            assert shot.image is not None
            truths.append(Truth(shot.stamp_ns, shot.T_world_target, shot.hidden))
            yield topics.FRAME, {"camera": next(iter(shot.cell.cameras))}, Frame(stamp_ns=shot.stamp_ns, image=shot.image)
            shot = next(film, None)

    heard = Replay(first.cell, SERVICES, arguments).run(recording())
    vision = {item.message.stamp_ns: item.message for item in heard if item.topic is topics.VISION}
    said = [item.message for item in heard if item.topic is topics.FUSED]
    stamps = np.array([message.stamp_ns for message in said])
    fused = {truth.stamp_ns: said[int(np.argmin(np.abs(stamps - truth.stamp_ns)))] for truth in truths}
    return Film(truths, vision, fused)


def passes(film: Film) -> list[tuple[int, int, int]]:
    """The full occlusions: first and last frame of each (more than GONE hidden), and the first frame after it with less than BACK
    hidden."""
    hidden = np.array([truth.hidden for truth in film.truths])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (hidden > GONE).astype(np.int8), [0]])))
    out = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        back = np.flatnonzero(hidden[end:] < BACK)
        if len(back):
            out.append((int(begin), int(end) - 1, int(end + back[0])))
    return out


def recovery(film: Film, back: int) -> int | None:
    """Number of frames from frame `back` to the first right pose, both counted; None where there is none before the end or the
    next full occlusion."""
    for k, truth in enumerate(film.truths[back:]):
        if truth.hidden > GONE:
            break
        if film.is_right(truth):
            return k + 1
    return None


def scored(films: list[Film]) -> dict[str, Any]:
    """The numbers of the films with one background."""
    errors: dict[str, list[float]] = {key: [] for key in ERRORS if key != "axis_deg"}
    axis, false_tracking, gone, tracked, seen, recoveries = [], 0, 0, 0, 0, []
    for film in films:
        begin_ns = film.truths[0].stamp_ns + SKIPPED_S * 1e9
        after_ns = [film.truths[back].stamp_ns for _, _, back in passes(film)]
        for truth in film.truths:
            pose = film.vision.get(truth.stamp_ns)
            if truth.stamp_ns < begin_ns or pose is None:
                continue
            is_tracked = pose.state == "tracking"
            if truth.hidden > GONE:
                gone += 1
                false_tracking += is_tracked
                errors["fused_while_hidden_cm"].append(100.0 * film.errors(film.fused[truth.stamp_ns], truth)[0])
                continue
            seen, tracked = seen + 1, tracked + is_tracked
            if is_tracked:
                position, angle = film.errors(pose, truth)
                errors["visible_cm" if truth.hidden <= VISIBLE else "partly_hidden_cm"].append(100.0 * position)
                if any(0.0 <= (truth.stamp_ns - back_ns) * 1e-9 < AFTER_S for back_ns in after_ns):
                    errors["after_cm"].append(100.0 * position)
                axis.append(np.degrees(angle))
        recoveries += [recovery(film, back) for _, _, back in passes(film)]
    return {
        "films": len(films),
        "seconds": round(sum((f.truths[-1].stamp_ns - f.truths[0].stamp_ns) * 1e-9 for f in films), 1),
        **{key: _spread(values) for key, values in errors.items()},
        "axis_deg": _spread(axis),
        "tracked": round(tracked / max(seen, 1), 4),
        "passes": len(recoveries),
        "recovery_frames": recoveries,
        "not_recovered": sum(frames is None for frames in recoveries),
        "slow_recoveries": sum(frames is None or frames > RECOVERY_GOAL for frames in recoveries),
        "false_tracking": false_tracking,
        "hidden_frames": gone,
    }


def _spread(values: list[float]) -> dict[str, float | int | None]:
    if not values:
        return {"median": None, "p90": None, "max": None}
    median, p90 = np.quantile(values, [0.5, 0.9])
    return {"median": round(float(median), 3), "p90": round(float(p90), 3), "max": round(float(max(values)), 3)}


def tables(result: Result) -> list[Part]:
    """Errors, tracked frames and recoveries on each background."""
    table = Table("", *BACKGROUNDS, "goal", title=f"Films, seed {result['seed']}: median / 90th percentile / largest")
    rows = result["rows"]
    for key, name in ERRORS.items():
        columns = ("-" if row[key]["median"] is None else "{median} / {p90} / {max}".format(**row[key]) for row in rows)
        table.add_row(name, *columns, "")
    table.add_row("frames tracked, up to 95 % hidden", *(f"{row['tracked']:.1%}" for row in rows), "")
    recovered = (
        ", ".join(marked("-" if n is None else str(n), n is not None and n <= RECOVERY_GOAL) for n in row["recovery_frames"])
        for row in rows
    )
    table.add_row("frames until recovered", *recovered, f"<= {RECOVERY_GOAL}")
    false = (marked(f"{row['false_tracking']} of {row['hidden_frames']}", not row["false_tracking"]) for row in rows)
    table.add_row("more than 95 % hidden and tracking", *false, "0")
    return [table]


@results.benchmark(
    "tracking",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws persons, motions, occluders and looks"),
    flags.Option("--films", type=flags.positive, default=4, help="films with each background"),
    flags.Option("--seconds", type=flags.above_zero, default=10.0, help="length of a film"),
    flags.Option("--quick", is_flag=True, help="one film of 4 s each, to see that it runs"),
    example="penumbra bench tracking --quick --json tracking.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    count, seconds = (1, 4.0) if options.quick else (options.films, options.seconds)
    started = time.monotonic()
    films: dict[str, list[Film]] = {name: [] for name in BACKGROUNDS}
    jobs = [(name, index) for name in BACKGROUNDS for index in range(count)]
    for name, index in track(jobs, "films", console=Console(stderr=True), transient=True):
        films[name].append(played(shots.passing(options.seed, index, domain=BACKGROUNDS[name], seconds=seconds)))
    rows = [{"background": name, **scored(each)} for name, each in films.items()]
    report.save({"seed": options.seed, "rows": rows, "wall_s": round(time.monotonic() - started, 1)})


if __name__ == "__main__":
    raise SystemExit(main())
