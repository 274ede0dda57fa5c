"""Markers of the cell for RViz: the target's mesh at the fused pose, the ellipsoid of its position, and the pads, lit by their
signal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from penumbra.services.ros2 import convert
from penumbra.services.ros2.cdr import Types
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell.pads import PadType
from penumbra.shared.chi_square import quantile
from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

MARKER = "visualization_msgs/msg/Marker"
LIFETIME_S = 1
"""Time [s] after which markers vanish if no new ones arrive."""
WITHIN = 0.9
"""Share of the position's probability within the ellipsoid."""
THICKNESS = 0.002
"""Minimum thickness [m] at which a pad is drawn."""
SEEN = 0.35
"""Opacity of the ellipsoid."""
Colour = tuple[float, float, float]


class Markers:
    """Makes the markers of a cell. meshes: of the targets, by name, in their own frames; kinds: the design of each pad."""

    def __init__(self, ros: Types, frame: str, meshes: Mapping[str, Mesh], kinds: Mapping[str, PadType]):
        self._ros, self._frame, self._kinds = ros, frame, kinds
        self._numbers = {name: k for k, name in enumerate((*meshes, *kinds))}
        self._points = {
            name: [convert.point(ros, vertex) for vertex in mesh.vertices[mesh.faces].reshape(-1, 3)]
            for name, mesh in meshes.items()
        }

    def target(self, fused: FusedPose, colour: Colour) -> list[Any]:
        """The mesh and the position's ellipsoid, in a colour; removes both if the pose is lost."""
        if fused.state == "lost":
            return [self._gone(fused.stamp_ns, space, fused.target) for space in ("target", "covariance")]
        mesh = self._marker(
            fused.stamp_ns, "target", fused.target, "TRIANGLE_LIST", fused.position, fused.orientation, (1.0, 1.0, 1.0),
            (*colour, 0.8), self._points[fused.target],
        )  # fmt: skip
        lengths, orientation = ellipsoid(fused.covariance[:3, :3])
        around = self._marker(
            fused.stamp_ns, "covariance", fused.target, "SPHERE", fused.position, orientation, 2.0 * lengths, (*colour, SEEN)
        )
        return [mesh, around]

    def pads(self, stamp_ns: int, poses: Mapping[str, Array], levels: Mapping[str, float]) -> list[Any]:
        """A box for each pad whose pose T_world_pad is known, brighter with its level from 0 to 1."""
        out = []
        for name, T in poses.items():
            board, level = self._kinds[name].board, levels.get(name, 0.0)
            position, orientation = rigid.position_orientation(T)
            size = (*board.size, max(board.thickness, THICKNESS))
            lit = (0.25 + 0.75 * level, 0.25 + 0.6 * level, 0.35 * (1.0 - level), 0.9)
            out.append(self._marker(stamp_ns, "pads", name, "CUBE", position, orientation, size, lit))
        return out

    def array(self, markers: Sequence[Any]) -> Any:
        return self._ros.make(convert.MARKERS, markers=list(markers))

    def _gone(self, stamp_ns: int, space: str, name: str) -> Any:
        zero, none = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        return self._marker(stamp_ns, space, name, "CUBE", zero, none, zero, (0.0, 0.0, 0.0, 0.0), action="DELETE")

    def _marker(
        self, stamp_ns: int, space: str, name: str, kind: str, position: Any, orientation: Any, scale: Any,
        colour: tuple[float, float, float, float], points: Sequence[Any] = (), action: str = "ADD",
    ) -> Any:  # fmt: skip
        make = self._ros.make
        head = convert.header(self._ros, stamp_ns, self._frame)
        red, green, blue, opacity = colour
        return make(
            MARKER,
            header=head,
            ns=space,
            id=self._numbers[name],
            type=self._ros.constant(MARKER, kind),
            action=self._ros.constant(MARKER, action),
            pose=convert.placed(self._ros, position, orientation),
            scale=convert.point(self._ros, scale, "Vector3"),
            color=make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=opacity),
            lifetime=make("builtin_interfaces/msg/Duration", sec=LIFETIME_S, nanosec=0),
            frame_locked=False,
            points=points,
            colors=[],
            texture_resource="",
            texture=make(
                convert.COMPRESSED_IMAGE, header=convert.header(self._ros, 0, ""), format="", data=np.zeros(0, np.uint8)
            ),
            uv_coordinates=[],
            text=name,
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Half axes (3,) [m] of the ellipsoid with the probability WITHIN, and the quaternion (4,) of its axes.

    covariance: (3, 3) [m^2].
    """
    values, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    T = np.eye(4)
    T[:3, :3] = axes
    return np.sqrt(quantile(WITHIN, 3) * np.maximum(values, 0.0)), rigid.position_orientation(T)[1]
