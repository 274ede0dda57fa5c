"""Conversion of the bus's messages to Foxglove's schemas (https://docs.foxglove.dev/docs/sdk/schemas), for viewers.

    /camera/NAME/frame          CompressedImage (JPEG)
    /camera/NAME/calibration    CameraCalibration
    /robot/NAME/joints          JointStates
    /target/NAME/pose/SENSE     PoseInFrame, likewise .../pose/fused and .../truth
    /tf                         FrameTransforms
    /scene                      SceneUpdate: robots, pads and targets as meshes; surface points of the pads as spheres

Frames of reference: the cell's own, `camera/NAME`, `ROBOT/LINK`, and a target's name at its fused pose.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages
from penumbra.shared.contract.messages import BadMessage, decode
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.recording.entries import KEY, PUBLISHER, Channel, Entry
from penumbra.shared.runtime.tap import Taken

QUALITY = 90
"""JPEG quality of the pictures. Masks and poses from such a picture equal those from the original up to noise."""
LINKS_S = 0.04
"""Minimum period [s] of the transforms of a robot's links: viewers show no more."""
ROBOT, TARGET, PAD = Color(r=0.72, g=0.74, b=0.78, a=1.0), Color(r=0.2, g=0.85, b=0.35, a=0.8), Color(r=0.95, g=0.7, b=0.1, a=1.0)
FELT, TOUCHED = Color(r=0.3, g=0.6, b=1.0, a=0.6), Color(r=0.95, g=0.2, b=0.2, a=0.9)
LEAST_SPHERE = 0.003
"""Minimum radius [m] of a surface point, as drawn."""
PAD_SIZE = (0.061, 0.06, 0.002)
"""Size of a pad [m], as drawn."""


def channel(topic: str, kind: Any, about: Mapping[str, str] | None = None) -> Channel:
    """Channel for messages of one Foxglove schema."""
    return Channel(topic, "protobuf", kind.DESCRIPTOR.full_name, _definition(kind), tuple((about or {}).items()))


@functools.cache
def _definition(kind: Any) -> bytes:
    data: bytes = build_file_descriptor_set(kind).SerializeToString()
    return data


def unpacked(picture: bytes) -> tuple[int, NDArray[np.uint8]]:
    """Stamp [ns] and image (h, w, 3) uint8 RGB of a CompressedImage. Raises BadMessage where the bytes are not one."""
    try:
        found = CompressedImage.FromString(picture)
    except Exception as error:  # the module of protobuf's DecodeError depends on the release
        raise BadMessage("picture", f"expected a foxglove.CompressedImage, got {picture[:16]!r}… ({error!s:.100})") from None
    image = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_COLOR) if found.data else None
    if image is None:
        raise BadMessage("picture", f"expected a picture, got {len(found.data)} bytes of {found.format!r}")
    stamp_ns: int = found.timestamp.seconds * 10**9 + found.timestamp.nanos
    return stamp_ns, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


class Viewers:
    """Makes entries for viewers from the messages of a cell. keeps_frames: whether the raw frames are stored too; otherwise a
    replay decodes them from the JPEG pictures."""

    def __init__(self, cell: cells.Cell, keeps_frames: bool = False):
        self._cell, self._keeps_frames = cell, keeps_frames
        self._models = robot_models(cell)
        self._frames: dict[tuple[str, bytes], Channel] = {}
        self._placed_ns: dict[str, int] = {}
        self._tf, self._scene = channel("/tf", FrameTransforms), channel("/scene", SceneUpdate)
        self._joints = {name: channel(f"/robot/{name}/joints", JointStates) for name in cell.robots}
        self._poses: dict[str, Channel] = {}
        self._felt_ns: dict[str, int] = {}

    def stage(self, now_ns: int) -> Iterator[Entry]:
        """Static entries for the beginning of a file: calibrations, poses of cameras and bases, and all meshes."""
        cell, at = self._cell, _time(now_ns)
        for name, camera in cell.cameras.items():
            yield Entry(channel(f"/camera/{name}/calibration", CameraCalibration), now_ns, now_ns, _calibration(name, camera, at))
        places = {f"camera/{name}": camera.T_world_camera for name, camera in cell.cameras.items()}
        places |= {name: target.home.transform for name, target in cell.targets.items()}
        for name, model in self._models.items():
            resting = model.link_transforms(np.clip(np.zeros(len(model.joints)), model.lower, model.upper))
            places |= {f"{name}/{link}": T for link, T in resting.items()}
        yield self._transforms(now_ns, now_ns, places)
        entities = [
            _entity(f"{name}/{link}", f"{name}/{link}", mesh, ROBOT, at)
            for name, model in self._models.items()
            for link, mesh in model.meshes.items()
        ]
        entities += [
            _entity(name, f"target {name}", anatomy.target_mesh(target, cell), TARGET, at)
            for name, target in cell.targets.items()
        ]
        for name, pad in cell.pads.items():
            entity = SceneEntity(
                timestamp=at, frame_id=cell.frame if pad.link == "world" else pad.link, id=f"pad {name}", frame_locked=True
            )
            size = Vector3(x=PAD_SIZE[0], y=PAD_SIZE[1], z=PAD_SIZE[2])
            entity.cubes.add(pose=_pose(*rigid.position_orientation(pad.T_link_pad)), size=size, color=PAD)
            entities.append(entity)
        yield Entry(self._scene, now_ns, now_ns, SceneUpdate(entities=entities).SerializeToString())

    def of(self, taken: Taken) -> Iterator[Entry]:
        """Entries of one message; none where viewers do not show it. Raises BadMessage for a message that cannot be decoded."""
        if not _is_shown(taken.topic.message):
            return
        match decode(taken.topic.message, taken.payload):
            case messages.Frame() as frame:
                yield self._picture(taken, frame)
            case messages.Joints() as joints:
                yield from self._robot(taken, joints)
            case pose:
                yield from self._target(taken, pose)

    def _picture(self, taken: Taken, frame: messages.Frame) -> Entry:
        name = taken.names["camera"]
        known = self._frames.get((name, taken.publisher))
        if known is None:
            about = {} if self._keeps_frames else {KEY: taken.key, PUBLISHER: taken.publisher.hex()}
            known = self._frames[name, taken.publisher] = channel(f"/camera/{name}/frame", CompressedImage, about)
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
        picture = CompressedImage(
            timestamp=_time(frame.stamp_ns), frame_id=f"camera/{name}", data=jpeg.tobytes(), format="jpeg"
        ).SerializeToString()
        return Entry(known, taken.received_ns, frame.stamp_ns, picture, taken.number)

    def _robot(self, taken: Taken, joints: messages.Joints) -> Iterator[Entry]:
        name, q = taken.names["robot"], joints.position
        model = self._models[name]
        if len(q) != len(model.joints):
            raise BadMessage("joints", f"robot {name}: expected {len(model.joints)} joints, got {len(q)}")
        found = JointStates(
            timestamp=_time(joints.stamp_ns),
            joints=[JointState(name=joint, position=angle) for joint, angle in zip(model.joints, q.tolist(), strict=True)],
        )
        yield Entry(self._joints[name], taken.received_ns, joints.stamp_ns, found.SerializeToString(), taken.number)
        if joints.stamp_ns - self._placed_ns.get(name, 0) >= LINKS_S * 1e9:
            self._placed_ns[name] = joints.stamp_ns
            places = {f"{name}/{link}": T for link, T in model.link_transforms(q).items()}
            yield self._transforms(taken.received_ns, joints.stamp_ns, places)

    def _target(self, taken: Taken, pose: Any) -> Iterator[Entry]:
        """Entries of a pose message of any sense."""
        name, at = taken.names["target"], _time(pose.stamp_ns)
        placed = _pose(pose.position, pose.orientation)
        found = PoseInFrame(timestamp=at, frame_id=pose.frame, pose=placed)
        known = self._poses.get(taken.key)
        if known is None:
            known = self._poses[taken.key] = channel("/" + taken.key.split("/", 2)[2], PoseInFrame)
        yield Entry(known, taken.received_ns, pose.stamp_ns, found.SerializeToString(), taken.number)
        if isinstance(pose, messages.FusedPose):
            moved = FrameTransform(
                timestamp=at,
                parent_frame_id=pose.frame,
                child_frame_id=name,
                translation=Vector3(x=placed.position.x, y=placed.position.y, z=placed.position.z),
                rotation=placed.orientation,
            )
            yield Entry(self._tf, taken.received_ns, pose.stamp_ns, FrameTransforms(transforms=[moved]).SerializeToString())
        if isinstance(pose, messages.HapticPose) and pose.stamp_ns - self._felt_ns.get(name, 0) >= LINKS_S * 1e9:
            self._felt_ns[name] = pose.stamp_ns
            felt = SceneUpdate(entities=[_felt(name, pose, at)])
            yield Entry(self._scene, taken.received_ns, pose.stamp_ns, felt.SerializeToString())

    def _transforms(self, log_ns: int, stamp_ns: int, places: Mapping[str, Array]) -> Entry:
        at = _time(stamp_ns)
        transforms = []
        for name, T in places.items():
            position, orientation = rigid.position_orientation(T)
            (x, y, z), turned = position.tolist(), _quaternion(orientation)
            transforms.append(
                FrameTransform(
                    timestamp=at,
                    parent_frame_id=self._cell.frame,
                    child_frame_id=name,
                    translation=Vector3(x=x, y=y, z=z),
                    rotation=turned,
                )
            )
        return Entry(self._tf, log_ns, stamp_ns, FrameTransforms(transforms=transforms).SerializeToString())


@functools.cache
def _is_shown(kind: Any) -> bool:
    """Whether messages of a class are frames, joints or poses."""
    return kind in (messages.Frame, messages.Joints) or {"frame", "position", "orientation"} <= set(kind.__struct_fields__)


def _time(stamp_ns: int) -> Timestamp:
    seconds, nanos = divmod(stamp_ns, 10**9)
    return Timestamp(seconds=seconds, nanos=nanos)


def _quaternion(orientation: Array) -> Quaternion:
    x, y, z, w = orientation.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _pose(position: Array, orientation: Array) -> Pose:
    x, y, z = position.tolist()
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=_quaternion(orientation))


def _calibration(name: str, camera: cells.Camera, at: Timestamp) -> bytes:
    """Intrinsics in Foxglove's form: K (3 x 3), R (3 x 3), P (3 x 4), and distortion in OpenCV's order."""
    K = camera.K
    calibration = CameraCalibration(
        timestamp=at,
        frame_id=f"camera/{name}",
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        D=[camera.k1, camera.k2, camera.p1, camera.p2, camera.k3],
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )
    data: bytes = calibration.SerializeToString()
    return data


def _felt(name: str, pose: messages.HapticPose, at: Timestamp) -> SceneEntity:
    """Surface points of a target's pads: spheres whose radius is the standard deviation of the distance, in another colour for
    touched pads. An entity without points removes the previous ones."""
    entity = SceneEntity(timestamp=at, frame_id=pose.frame, id=f"surface {name}", frame_locked=True)
    for pad, point in pose.surface.items():
        x, y, z = point.position
        side = 2.0 * max(point.along, LEAST_SPHERE)
        entity.spheres.add(
            pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
            size=Vector3(x=side, y=side, z=side),
            color=TOUCHED if pad in pose.touched else FELT,
        )
    return entity


def _entity(frame: str, name: str, mesh: Mesh, colour: Color, at: Timestamp) -> SceneEntity:
    """A mesh in the coordinates of a frame of reference, attached to that frame."""
    triangles = TriangleListPrimitive(
        pose=Pose(orientation=Quaternion(w=1.0)),
        points=[Point3(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()],
        color=colour,
        indices=mesh.faces.ravel().tolist(),
    )
    return SceneEntity(timestamp=at, frame_id=frame, id=name, frame_locked=True, triangles=[triangles])
