"""Messages of Penumbra as messages of ROS.

What the two have in common needs no change: SI units, right-handed frames (REP 103), quaternions (x, y, z, w), covariances 6 x 6
row by row in the order x, y, z, rotation about the fixed x, y, z axes of the message's frame, stamps since the epoch of Unix. A
camera's frame is its optical one (x right, y down, z forward), so its name ends in `_optical_frame` (REP 103). The frame of the
cell, such as `world`, is the root; a target's frame is what its pose says (for `body:forearm`: midway between elbow and wrist,
x towards the hand, z dorsal).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from penumbra.services.ros2.cdr import Types
from penumbra.services.ros2.names import safe
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell.description import Camera, Cell
from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.contract.report import Report
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
JOINT_STATE = "sensor_msgs/msg/JointState"

NOT_KNOWN = 1e6
"""Variance [m^2/s^2, rad^2/s^2] of a twist, because the fused pose does not carry its covariance: a filter that fuses it gives it
no weight. ROS cannot mark a twist's covariance as unknown; zeros would mean that it is exact."""
SECOND_NS = 1_000_000_000


def time(ros: Types, stamp_ns: int) -> Any:
    """A ROS time from a stamp [ns since the epoch]."""
    return ros.make("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND_NS, nanosec=stamp_ns % SECOND_NS)


def header(ros: Types, stamp_ns: int, frame: str) -> Any:
    return ros.make("std_msgs/msg/Header", stamp=time(ros, stamp_ns), frame_id=frame)


def point(ros: Types, xyz: Iterable[float], kind: str = "Point") -> Any:
    """x, y, z [m] as a Point, or as a Vector3."""
    x, y, z = (float(value) for value in xyz)
    return ros.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def quaternion(ros: Types, xyzw: Iterable[float]) -> Any:
    """A unit quaternion (x, y, z, w)."""
    x, y, z, w = (float(value) for value in xyzw)
    return ros.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def placed(ros: Types, position: Iterable[float], orientation: Iterable[float]) -> Any:
    """A Pose from a position [m] (3,) and a quaternion (4,)."""
    return ros.make("geometry_msgs/msg/Pose", position=point(ros, position), orientation=quaternion(ros, orientation))


def pose(ros: Types, fused: FusedPose) -> Any:
    """The fused pose in its frame, with its covariance."""
    inner = ros.make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=placed(ros, fused.position, fused.orientation),
        covariance=np.ascontiguousarray(fused.covariance).reshape(36),
    )
    return ros.make(POSE, header=header(ros, fused.stamp_ns, fused.frame), pose=inner)


def twist(ros: Types, fused: FusedPose) -> Any:
    """The velocity of the target's origin [m/s] and its angular velocity [rad/s], along the axes of the pose's frame. Its
    covariance is unknown."""
    inner = ros.make(
        "geometry_msgs/msg/Twist",
        linear=point(ros, fused.velocity[:3], "Vector3"),
        angular=point(ros, fused.velocity[3:], "Vector3"),
    )
    with_covariance = ros.make(
        "geometry_msgs/msg/TwistWithCovariance", twist=inner, covariance=(NOT_KNOWN * np.eye(6)).reshape(36)
    )
    return ros.make(TWIST, header=header(ros, fused.stamp_ns, fused.frame), twist=with_covariance)


# ---- frames


def optical_frame(camera: str) -> str:
    """Name of the frame of a camera of the cell."""
    return f"{safe(camera)}_optical_frame"


def link_frame(cell: Cell, robot: str, link: str) -> str:
    """Name of the frame of a robot's link: its name in the URDF, as robot_state_publisher uses it; in a cell of several robots
    prefixed by the robot's name."""
    return link if len(cell.robots) == 1 else f"{robot}/{link}"


def transform(ros: Types, stamp_ns: int, parent: str, child: str, T_parent_child: Array) -> Any:
    """One transform T_parent_child (4, 4)."""
    position, orientation = rigid.position_orientation(T_parent_child)
    inner = ros.make(
        "geometry_msgs/msg/Transform", translation=point(ros, position, "Vector3"), rotation=quaternion(ros, orientation)
    )
    head = header(ros, stamp_ns, parent)
    return ros.make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=inner)


def transforms(ros: Types, found: Sequence[Any]) -> Any:
    return ros.make(TF, transforms=list(found))


def target_transform(ros: Types, fused: FusedPose) -> Any:
    """The target's frame in that of its pose."""
    return transform(ros, fused.stamp_ns, fused.frame, safe(fused.target), rigid.transform(fused.position, fused.orientation))


def still_transforms(ros: Types, cell: Cell, models: Mapping[str, RobotModel], stamp_ns: int, with_links: bool) -> list[Any]:
    """The static transforms: cameras, robots' bases and pads; with_links: also links that no moving joint carries."""
    out = [
        transform(ros, stamp_ns, cell.frame, optical_frame(name), camera.T_world_camera) for name, camera in cell.cameras.items()
    ]
    for name, model in models.items():
        for k, link in enumerate(model.links):
            if k == 0:
                out.append(transform(ros, stamp_ns, cell.frame, link_frame(cell, name, link), model.T_world_base))
            elif with_links and not _moves(model, k):
                out.append(_joint(ros, cell, name, model, stamp_ns, k, model.T_parent_link[k]))
    for name, pad in cell.pads.items():
        robot, _, link = pad.link.partition("/")
        parent = link_frame(cell, robot, link) if link else cell.frame
        out.append(transform(ros, stamp_ns, parent, safe(name), pad.T_link_pad))
    return out


def link_transforms(ros: Types, cell: Cell, robot: str, model: RobotModel, stamp_ns: int, position: Array) -> list[Any]:
    """The links that a robot's joints move, each in its parent's frame. position (n,) [rad or m] as in `Joints`."""
    T_world = list(model.link_transforms(position).values())
    return [
        _joint(ros, cell, robot, model, stamp_ns, k, rigid.inverse(T_world[model.parents[k]]) @ T_world[k])
        for k in range(1, len(model.links))
        if _moves(model, k)
    ]


def _moves(model: RobotModel, k: int) -> bool:
    """Whether one of the cell's joints carries link k."""
    return model.description.joints[k - 1].name in model.joints


def _joint(ros: Types, cell: Cell, robot: str, model: RobotModel, stamp_ns: int, k: int, T_parent_link: Array) -> Any:
    parent, child = model.links[model.parents[k]], model.links[k]
    return transform(ros, stamp_ns, link_frame(cell, robot, parent), link_frame(cell, robot, child), T_parent_link)


# ---- the camera


def camera_info(ros: Types, camera: Camera, name: str, stamp_ns: int) -> Any:
    """The camera model of the overlaid picture, which is undistorted: a pinhole without distortion."""
    whole = ros.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return ros.make(
        CAMERA_INFO,
        header=header(ros, stamp_ns, optical_frame(name)),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=camera.K.reshape(9),
        r=np.eye(3).reshape(9),
        p=np.hstack([camera.K, np.zeros((3, 1))]).reshape(12),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )


def compressed_image(ros: Types, camera: str, stamp_ns: int, jpeg: np.ndarray) -> Any:
    """A message with a picture that is already JPEG, bytes (n,) uint8."""
    return ros.make(
        COMPRESSED_IMAGE,
        header=header(ros, stamp_ns, optical_frame(camera)),
        format="rgb8; jpeg compressed bgr8",
        data=jpeg.reshape(-1),
    )


# ---- health

LEVELS = {"ok": "OK", "starting": "WARN", "degraded": "WARN", "down": "ERROR"}
"""Levels of DiagnosticStatus by the status of a health report."""
STATES = {"tracking": "OK", "coasting": "WARN", "lost": "ERROR"}
"""Levels of DiagnosticStatus by the state of a fused pose."""


def diagnostics(
    ros: Types, cell: str, stamp_ns: int, reports: Sequence[Report], poses: Mapping[str, FusedPose | None], now_ns: int
) -> Any:
    """The health of every process, and the state of every target: STALE if there is no pose."""
    out = [_status(ros, cell, report) for report in sorted(reports, key=lambda report: (report.service, report.instance))]
    out += [_state(ros, cell, target, fused, now_ns) for target, fused in poses.items()]
    return ros.make(DIAGNOSTICS, header=header(ros, stamp_ns, ""), status=out)


def _status(ros: Types, cell: str, report: Report) -> Any:
    values = {
        "status": report.status,
        "pid": report.pid,
        "uptime_s": report.uptime_s,
        "cpu": report.cpu,
        "memory_mb": report.memory_mb,
        "replicas": report.replicas,
        **{f"{key} [Hz]": round(topic.rate_hz, 1) for key, topic in report.topics.items()},
        **{f"{key} [Hz, published]": round(topic.rate_hz, 1) for key, topic in report.published.items()},
    }
    message = "; ".join(report.reasons) or report.status
    return _diagnostic(
        ros, LEVELS[report.status], f"penumbra {cell}: {report.service} {report.instance}", message, report.host, values
    )


def _state(ros: Types, cell: str, target: str, fused: FusedPose | None, now_ns: int) -> Any:
    name = f"penumbra {cell}: target {target}"
    if fused is None:
        return _diagnostic(ros, "STALE", name, "no fused pose", cell, {})
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(fused.covariance[:3, :3]).max()))
    values = {
        "state": fused.state,
        "age_s": round((now_ns - fused.stamp_ns) * 1e-9, 3),
        "largest sigma of the position [m]": f"{sigma_m:.4f}",
        **{f"{sense} weight": round(source.weight, 3) for sense, source in fused.sources.items()},
        **{f"{sense} age_s": round(source.age_s, 3) for sense, source in fused.sources.items()},
    }
    return _diagnostic(ros, STATES[fused.state], name, fused.state, cell, values)


def _diagnostic(ros: Types, level: str, name: str, message: str, hardware: str, values: Mapping[str, Any]) -> Any:
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    return ros.make(
        kind,
        level=ros.constant(kind, level),
        name=name,
        message=message,
        hardware_id=hardware,
        values=[ros.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()],
    )
