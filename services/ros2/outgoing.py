"""Publishes the cell's data on the ROS node: poses, frames, pictures, markers, diagnostics. Messages without a reader are not
made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from penumbra.services.command import snapshot
from penumbra.services.ros2 import convert
from penumbra.services.ros2.cdr import Types
from penumbra.services.ros2.markers import Colour, Markers
from penumbra.services.ros2.names import Profile, safe, within
from penumbra.services.ros2.participant import Participant, Publisher
from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell.description import Cell
from penumbra.shared.contract.messages import Frame, FusedPose, Mask, Voltages
from penumbra.shared.contract.report import Report
from penumbra.shared.contract.topics import FUSED
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.runtime.node import LatestMessages
from penumbra.shared.skin.layout import link_names, pad_poses

FRAMES_KEPT = 4
"""Number of frames of a camera that wait for their masks."""
MASKED_NS = 1_000_000_000
"""Time [ns] after the last mask after which pictures are sent without: a cell with PoseCNN has none."""
JPEG_QUALITY = 80


class Scene:
    """Current state of the cell. Each entry of `poses` (by target) and `joints` (by robot) is replaced as a whole by the reader
    of its topic."""

    def __init__(self, cell: Cell, models: dict[str, RobotModel], voltages: LatestMessages | None, now_ns: Callable[[], int]):
        self.cell, self.models = cell, models
        self.poses: dict[str, FusedPose] = {}
        self.joints: dict[str, Array] = {}
        self.now_ns = now_ns
        self._voltages = voltages

    def pose(self, target: str) -> FusedPose | None:
        """The newest pose; None if fusion has been silent for longer than a reader accepts."""
        found = self.poses.get(target)
        return found if found is not None and self.now_ns() - found.stamp_ns < 1e9 * FUSED.oldest_s else None

    def volts(self) -> dict[str, Array]:
        """Mean amplitudes [V] of each pad from which voltages were received."""
        found: dict[str, Voltages | None] = {pad: self._voltages.get(pad=pad) for pad in self.cell.pads} if self._voltages else {}
        return {pad: message.volts.mean(axis=0) for pad, message in found.items() if message is not None}

    def pads(self) -> dict[str, Array]:
        """T_world_pad of every pad whose pose is known."""
        joints = dict(self.joints)
        links = {name: model.link_transforms(joints[name]) for name, model in self.models.items() if name in joints}
        return pad_poses(self.cell, link_names(links))


class Poses:
    """Publishes pose, twist and, if tf is given, frame of each target."""

    def __init__(self, ros: Types, participant: Participant, cell: Cell, space: str, tf: Publisher | None):
        self._ros, self._tf = ros, tf
        self._publishers = {
            target: (
                participant.publisher(within(space, f"{safe(target)}/pose"), convert.POSE),
                participant.publisher(within(space, f"{safe(target)}/twist"), convert.TWIST),
            )
            for target in cell.targets
        }

    def send(self, fused: FusedPose) -> None:
        """Publish a pose. A lost one is not sent: ROS has no field for that state."""
        if fused.state == "lost":
            return
        pose, twist = self._publishers[fused.target]
        if pose.is_wanted():
            pose.publish(convert.pose(self._ros, fused))
        if twist.is_wanted():
            twist.publish(convert.twist(self._ros, fused))
        if self._tf is not None and self._tf.is_wanted():
            self._tf.publish(convert.transforms(self._ros, [convert.target_transform(self._ros, fused)]))


class Overlay:
    """Publishes the picture of one camera with mask, silhouette and pads, and its camera model. The pose of its first target is
    drawn."""

    def __init__(self, ros: Types, participant: Participant, scene: Scene, camera: str, space: str):
        self._ros, self._scene, self._camera = ros, scene, camera
        self._target = next(iter(scene.cell.targets))
        base = within(space, safe(camera))
        self._picture = participant.publisher(f"{base}/overlay/compressed", convert.COMPRESSED_IMAGE, Profile(2))
        self._info = participant.publisher(f"{base}/camera_info", convert.CAMERA_INFO, Profile(2))
        self._frames: tuple[Frame, ...] = ()
        self._masked_ns = 0

    def on_frame(self, frame: Frame, names: dict[str, str]) -> None:
        self._frames = (*self._frames, frame)[-FRAMES_KEPT:]
        if frame.stamp_ns - self._masked_ns > MASKED_NS:
            self._send(frame, None)

    def on_mask(self, mask: Mask, names: dict[str, str]) -> None:
        self._masked_ns = mask.stamp_ns
        if (frame := next((each for each in self._frames if each.stamp_ns == mask.stamp_ns), None)) is not None:
            self._send(frame, mask)

    def _send(self, frame: Frame, mask: Mask | None) -> None:
        if self._info.is_wanted():
            self._info.publish(
                convert.camera_info(self._ros, self._scene.cell.cameras[self._camera], self._camera, frame.stamp_ns)
            )
        pose = self._scene.pose(self._target)
        if pose is None or not self._picture.is_wanted():
            return
        scene = self._scene
        drawn = snapshot.draw(scene.cell, self._camera, self._target, frame, mask, pose, dict(scene.joints), scene.volts())
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        self._picture.publish(convert.compressed_image(self._ros, self._camera, frame.stamp_ns, np.asarray(jpeg)))


class Shown:
    """Publishes the markers."""

    def __init__(self, ros: Types, participant: Participant, scene: Scene, space: str):
        cell = scene.cell
        self._scene = scene
        meshes = {name: anatomy.target_mesh(target, cell) for name, target in cell.targets.items()}
        self._markers = Markers(ros, cell.frame, meshes, {name: cell.pad_types[pad.type] for name, pad in cell.pads.items()})
        self._publisher = participant.publisher(within(space, "markers"), convert.MARKERS, Profile(1))

    def send(self) -> None:
        if not self._publisher.is_wanted():
            return
        poses = [pose for target in self._scene.cell.targets if (pose := self._scene.pose(target)) is not None]
        markers = [marker for pose in poses for marker in self._markers.target(pose, colour(pose))]
        levels = snapshot.pad_levels(self._scene.cell, self._scene.volts())
        markers += self._markers.pads(self._scene.now_ns(), self._scene.pads(), levels)
        self._publisher.publish(self._markers.array(markers))


def colour(pose: FusedPose) -> Colour:
    """Red, green, blue from 0 to 1, as in `penumbra snapshot`."""
    red, green, blue = (value / 255.0 for value in snapshot.LINES[pose.state])
    return red, green, blue


class Diagnosis:
    """Publishes the health of all processes, and the targets' states."""

    def __init__(self, ros: Types, participant: Participant, scene: Scene):
        self._ros, self._scene = ros, scene
        self._publisher = participant.publisher("/diagnostics", convert.DIAGNOSTICS)

    def send(self, reports: Sequence[Report], now_ns: int) -> None:
        cell = self._scene.cell
        poses: dict[str, Any] = {target: self._scene.pose(target) for target in cell.targets}
        self._publisher.publish(convert.diagnostics(self._ros, cell.name, now_ns, reports, poses, now_ns))
