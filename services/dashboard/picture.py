"""Encodes the camera's picture for a page: a JPEG, the mask as runs, and the outline of each pose."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.lens import Undistortion

MOST_WIDE = 640
"""Maximum width [px]: a wider picture is reduced by an integer factor. The page shows it 500 px wide beside the scene, and OpenCV
takes 0.1 ms for a half and 1.5 ms for three quarters."""
QUALITY = 75
"""Quality of the JPEG, from 0 to 100."""
TOLERANCE_PX = 0.7
"""Maximum distance [px] of an outline from the silhouette's edge."""

cv2.setNumThreads(1)  # its second thread busy-waits between two pictures and wastes 1.4 % of a core


class Painter:
    """Makes the pictures of one camera."""

    def __init__(self, cell: cells.Cell, camera: str):
        self.name, self.camera = camera, cell.cameras[camera]
        self._undistort = Undistortion(self.camera.lens)
        self._meshes = {name: anatomy.target_mesh(target, cell) for name, target in cell.targets.items()}
        self._T_camera_world = rigid.inverse(self.camera.T_world_camera)

    def message(
        self, frame: messages.Frame, mask: messages.Mask | None, poses: Mapping[str, messages.FusedPose], now_ns: int
    ) -> bytes:
        """The message to a page: the length of a header, the header (JSON), the runs of the mask, the JPEG; see `camera.js`."""
        image: NDArray[Any] = self._undistort(frame.image)
        if (part := -(-self.camera.width // MOST_WIDE)) > 1:
            image = cv2.resize(image, (self.camera.width // part, self.camera.height // part), interpolation=cv2.INTER_AREA)
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
        runs = run_lengths(mask.labels) if mask is not None else np.zeros((0, 2), np.uint16)
        header: dict[str, Any] = {
            "camera": self.name,
            "size": [self.camera.width, self.camera.height],
            "age": (now_ns - frame.stamp_ns) * 1e-9,
            "runs": len(runs),
            "mask": None
            if mask is None
            else {"x": mask.x0, "y": mask.y0, "scale": mask.scale, "width": mask.labels.shape[1], "height": mask.labels.shape[0]},
            "outlines": {
                name: {"state": pose.state, "lines": self.outline(name, pose)}
                for name, pose in poses.items()
                if pose.state != "lost"
            },
        }
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)  # align the runs to a multiple of their size
        return struct.pack("<I", len(text)) + text + runs.tobytes() + jpeg.tobytes()

    def outline(self, target: str, pose: messages.FusedPose) -> list[list[int]]:
        """The edges of a target's silhouette in the picture, each as x, y, x, y ... [px]."""
        mesh = self._meshes[target]
        T = self._T_camera_world @ rigid.transform(pose.position, pose.orientation)
        points = rigid.apply(T, mesh.vertices)
        window = self._window(points)
        if not (window[2] and window[3]):
            return []
        k = (self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)
        covered = raster.silhouette(points, mesh.faces, k, window).view(np.uint8)
        found, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=window[:2])
        return [cv2.approxPolyDP(line, TOLERANCE_PX, True).ravel().astype(int).tolist() for line in found]

    def _window(self, points: NDArray[np.float64]) -> tuple[int, int, int, int]:
        """The bounding window (x0, y0, width, height) in the picture of points (n, 3) in the camera's frame."""
        camera = self.camera
        if points[:, 2].min() < raster.NEAR:
            return 0, 0, camera.width, camera.height
        u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
        v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
        x0, x1 = (min(max(int(edge), 0), camera.width) for edge in (u.min() - 1.0, u.max() + 2.0))
        y0, y1 = (min(max(int(edge), 0), camera.height) for edge in (v.min() - 1.0, v.max() + 2.0))
        return x0, y0, x1 - x0, y1 - y0


def run_lengths(labels: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Run-length encoding (n, 2) of a mask, row after row: label and length."""
    flat = labels.ravel()
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    lengths = np.diff(np.concatenate([starts, [flat.size]]))
    longest = np.iinfo(np.uint16).max
    if lengths.max() > longest:  # split runs that are longer than the number type allows
        cuts = np.arange(0, flat.size, longest)
        starts = np.union1d(starts, cuts)
        lengths = np.diff(np.concatenate([starts, [flat.size]]))
    return np.stack([flat[starts], lengths], axis=1).astype(np.uint16)
