"""Trials of the paper's experiment played through the services in one process, and the errors of every frame.

A trial (`sim.sets.trial`) is rendered once and then replayed (`services.replay.chain`) through three chains: ours, PoseCNN in
place of our vision, and the paper's own method throughout. A frame's vision is the pose of that frame, if its state is tracking.
A frame's fused pose is the one at its exposure, requested as soon as the frame's vision has been used: the paper considers no
delays. `live` is the pose published nearest to the exposure, before anything was known of the frame. Poses that are lost do not
count.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from penumbra.services.replay.chain import Replay
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import FusedPose, Truth, VisionPose, decode
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.sets.trial import HIDDEN, LEAD_S, SECONDS, Setting, Trial

EPOCH_NS = 10**18
"""Stamp [ns] of time zero of a trial."""


@dataclass(frozen=True)
class Chain:
    """Services and their flags."""

    services: tuple[str, ...]
    arguments: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)


CHAINS = {
    "procnet": Chain(("segmentation", "search", "haptics", "fusion")),
    "posecnn": Chain(("posecnn", "haptics", "fusion")),
    "faithful": Chain(
        ("segmentation", "search", "haptics", "fusion"),
        {"search": ("--method", "paper"), "haptics": ("--method", "paper"), "fusion": ("--observer", "paper")},
    ),
}
"""procnet: ours. faithful: the paper's search, network and observer."""

Played = dict[str, Any]
"""The result of `played`, which is stored as JSON."""
ERRORS = ("cm", "lateral_cm", "depth_cm", "axis_deg", "roll_deg", "attitude_deg")
"""Errors of a pose: distance of the object's centre [cm], its parts across and along the line of sight, of the limb's axis, of
the twist about it, of the whole rotation [deg]."""


def centroid(mesh: Mesh) -> Array:
    """The centre of mass (3,) [m] of a closed mesh, the point to which the paper's errors refer."""
    corners = mesh.vertices[mesh.faces]
    volumes = np.linalg.det(corners)
    return np.asarray(volumes @ corners.sum(axis=1) / (4.0 * volumes.sum()))


def errors(T_true: Array, T: Array, centre: Array, eye: ArrayLike) -> dict[str, float]:
    """A pose's ERRORS. centre (3,): in the target's frame [m]; eye (3,): where the camera stands in the world [m]."""
    middle = rigid.apply(T_true, centre)
    off = rigid.apply(T, centre) - middle
    sight = middle - np.asarray(eye)
    sight /= np.linalg.norm(sight)
    depth = float(off @ sight)
    turn = T_true[:3, :3].T @ T[:3, :3]
    x, _, _, w = Rotation.from_matrix(turn).as_quat()
    twist = (2.0 * np.arctan2(x, w) + np.pi) % (2.0 * np.pi) - np.pi
    return {
        "cm": 100.0 * float(np.linalg.norm(off)),
        "lateral_cm": 100.0 * float(np.linalg.norm(off - depth * sight)),
        "depth_cm": 100.0 * abs(depth),
        "axis_deg": float(np.degrees(rigid.axis_angle_error(T_true, T))),
        "roll_deg": float(np.degrees(abs(twist))),
        "attitude_deg": float(np.degrees(Rotation.from_matrix(turn).magnitude())),
    }


def played(trial: Trial, seconds: float = SECONDS, chains: Iterable[str] = tuple(CHAINS)) -> Played:
    """All frames of a trial: times, hidden shares, gaps, and for each chain lists of ERRORS, None where there is no pose, and the
    fused poses."""
    world, camera = trial.world, trial.camera
    messages = list(trial.record(seconds))
    ends_ns = EPOCH_NS + round(seconds * 1e9)  # no truth follows a frame that is exposed at the very end
    stamps = [m.stamp_ns for topic, _, m in messages if topic is topics.FRAME and m.stamp_ns < ends_ns]
    truths = [m for topic, _, m in messages if topic is topics.TRUTH and isinstance(m, Truth)]
    centre = centroid(world.person.meshes[0])

    def scored(pose: VisionPose | FusedPose | None) -> dict[str, float] | None:
        if pose is None or pose.state == "lost" or (isinstance(pose, VisionPose) and pose.state != "tracking"):
            return None
        T_true = world.state((pose.stamp_ns - EPOCH_NS) * 1e-9).T_world_target
        return errors(T_true, rigid.transform(pose.position, pose.orientation), centre, camera.position)

    found = {}
    for name in chains:
        chain = CHAINS[name]
        arguments = {service: list(flags) for service, flags in chain.arguments.items()}
        replay, asked = Replay(trial.cell, chain.services, arguments), dict[int, FusedPose]()
        if "fusion" not in chain.arguments:  # the paper's observer keeps no past poses
            replay.listen(topics.VISION, {}, partial(_ask, replay, asked))
        heard = replay.run(messages)
        vision = {item.message.stamp_ns: item.message for item in heard if item.topic is topics.VISION}
        fused = [item.message for item in heard if item.topic is topics.FUSED]
        said = np.array([message.stamp_ns for message in fused])
        nearest = [fused[int(np.argmin(np.abs(said - stamp)))] for stamp in stamps]
        known = [asked.get(stamp, pose) for stamp, pose in zip(stamps, nearest, strict=True)]
        found[name] = {
            "vision": _columns([scored(vision.get(stamp)) for stamp in stamps]),
            "fused": _columns([scored(pose) for pose in known]) | {"poses": [_pose(pose) for pose in known]},
            "live": _columns([scored(pose) for pose in nearest]),
        }
    return {
        "setting": dataclasses.asdict(trial.setting),
        "index": trial.index,
        "cell": trial.cell.name,
        "distance_m": round(trial.distance_m, 3),
        "picture_px": [camera.width, camera.height],
        "times_s": [round((stamp - EPOCH_NS) * 1e-9, 4) for stamp in stamps],
        "hidden": [round(_after(truths, stamp).hidden, 4) for stamp in stamps],
        "gap_m": [round(_after(truths, stamp).gap, 4) for stamp in stamps],
        "chains": found,
    }


def _ask(replay: Replay, asked: dict[int, FusedPose], pose: VisionPose, names: dict[str, str]) -> None:
    """Requests the fused pose at a frame's exposure, once the frame's vision is known."""
    answer, _ = replay.ask(topics.current_pose(replay.cell.name, pose.target), stamp_ns=str(pose.stamp_ns))
    asked[pose.stamp_ns] = decode(FusedPose, answer)


def is_scored(played: Played) -> np.ndarray:
    """Which frames (n,) count: after the lead-in, with the hidden share in the setting's band."""
    low, high = HIDDEN[Setting(**played["setting"]).occlusion]
    hidden = np.array(played["hidden"])
    return (np.array(played["times_s"]) >= LEAD_S - 1e-6) & (hidden >= low) & (hidden <= high)


def _after(truths: list[Truth], stamp_ns: int) -> Truth:
    """The first truth at or after a frame, which contains the share hidden in that frame."""
    return next((truth for truth in truths if truth.stamp_ns >= stamp_ns), truths[-1])


def _pose(pose: FusedPose) -> list[float]:
    """Position [m] and quaternion of a pose, rounded for storage."""
    return np.round([*pose.position, *pose.orientation], 6).tolist()


def _columns(rows: list[dict[str, float] | None]) -> dict[str, list[float | None]]:
    return {name: [None if row is None else round(row[name], 4) for row in rows] for name in ERRORS}
