"""Renders the simulated world as a camera sees it: RGB image and class of every pixel.

A frame takes four passes: a shadow map from the lamp, a z-buffer from the camera (`shared.geometry.raster`), shading of each
pixel (textures in the bodies' own coordinates, Lambert and Blinn-Phong with shadow and ambient light), and the sensor (blur,
noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.sim.picture.appearance import CUFF, GLOSS, TEXTURE_FIELDS, Appearance, Look, noise_volume
from penumbra.sim.picture.distortion import Distortion

SHADOW_PX = 256
"""Width and height of the shadow map [px]."""
CREASE = math.cos(math.radians(50.0))
"""Cosine of the angle between the normals of two faces beyond which their common edge is shaded as a crease."""


@dataclass(frozen=True)
class Shape:
    """A mesh prepared for shading: `normals` (m, 3, 3), one per corner of every face, smooth except across creases; `corners`
    (m, 3, 3) of every face, in the body's frame."""

    mesh: Mesh
    normals: NDArray[np.float32] = field(repr=False)
    corners: NDArray[np.float32] = field(repr=False)

    @classmethod
    def of(cls, mesh: Mesh) -> Shape:
        corners = mesh.vertices[mesh.faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
        # vertices at the same place count as one, so that meshes with split vertices are smooth too
        _, vertex = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
        normals = np.empty((len(flat), 3, 3))
        _corner_normals(np.ascontiguousarray(vertex.reshape(-1)[mesh.faces]), flat, area, CREASE, normals)
        return cls(mesh, normals.astype(np.float32), corners.astype(np.float32))


@dataclass(frozen=True)
class Body:
    """One thing in the scene."""

    shape: Shape
    T_world_body: Array
    appearance: Appearance


@dataclass(frozen=True)
class Picture:
    """`image` (h, w, 3) uint8 RGB, `labels` (h, w) uint8 classes, `bodies` (h, w) uint8 index of the body seen (255: none)."""

    image: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    bodies: NDArray[np.uint8]


class Renderer:
    """Renders scenes for one camera, or for a window of its image at a coarser scale (for training on crops). The image is that
    of a pinhole camera or, with `distortion`, of the camera's lens, and then the distortion's window is rendered. Labels are
    always those of the pinhole camera.

    What a picture has in common with the previous one is kept: background, meshes, memory, and the surfaces of bodies that stand
    still, but not the shadows on them.
    """

    def __init__(
        self,
        camera: cells.Camera,
        window: tuple[int, int, int, int] | None = None,
        scale: int = 1,
        distortion: Distortion | None = None,
    ):
        self._distortion = distortion
        x0, y0, width, height = window or (distortion.window if distortion else (0, 0, camera.width, camera.height))
        self._T_camera_world = rigid.inverse(camera.T_world_camera)
        self._k = (
            camera.fx / scale,
            camera.fy / scale,
            (camera.cx - x0 - (scale - 1) / 2) / scale,
            (camera.cy - y0 - (scale - 1) / 2) / scale,
        )
        self._raster = raster.Raster(width // scale, height // scale)
        self._sky: tuple[object, NDArray[np.float32]] | None = None
        self._faces: tuple[list[Shape], _Faces] | None = None
        self._image = np.empty((*self._raster.ids.shape, 3), np.float32)
        self._blurred = np.empty((camera.height, camera.width, 3), np.float32) if distortion else np.empty_like(self._image)
        self._shadow = raster.Raster(SHADOW_PX, SHADOW_PX)
        self._surfaces = _Surfaces(*self._raster.ids.shape)

    def render(self, bodies: list[Body], look: Look, rng: np.random.Generator) -> Picture:
        """The picture of `bodies` (at most 254) under the light and sensor of `look`; `rng` draws the noise."""
        view = self._raster
        view.clear()
        faces = self._faces_of([body.shape for body in bodies])
        for index, body in enumerate(bodies):
            vertices = rigid.apply(self._T_camera_world @ body.T_world_body, body.shape.mesh.vertices)
            view.draw(vertices, body.shape.mesh.faces, *self._k, index)
        textures = np.array([body.appearance.row() for body in bodies], np.float32).reshape(-1, TEXTURE_FIELDS)
        placed = np.array([rigid.inverse(body.T_world_body) for body in bodies]).reshape(-1, 4, 4)
        lamp = np.asarray(look.lamp, float)
        T_lamp_world, lamp_f = self._cast_shadow(bodies, lamp)
        T_world_camera = rigid.inverse(self._T_camera_world)
        image, labels = self._image, np.zeros(view.ids.shape, np.uint8)
        np.copyto(image, self._background(look))
        _shade(
            view.depth,
            view.ids,
            view.triangles,
            np.array(self._k),
            T_world_camera,
            placed,
            faces.corners,
            faces.normals,
            faces.labels,
            textures,
            noise_volume(),
            lamp,
            np.asarray(look.lamp_colour, np.float32),
            np.asarray(look.ambient, np.float32),
            T_lamp_world,
            lamp_f,
            self._shadow.depth,
            self._surfaces.states(faces, placed, textures, lamp),
            *self._surfaces.arrays,
            image,
            labels,
        )
        seen = self._distortion(image) if self._distortion else image
        return Picture(_expose(seen, self._blurred, look, rng), labels, view.ids.copy())

    def _background(self, look: Look) -> NDArray[np.float32]:
        """The background at infinity (h, w, 3) in the light of a look; rendered once, as the camera stands still."""
        drawn = look.background, look.ambient, look.lamp_colour
        if self._sky is None or self._sky[0] != drawn:
            albedo = np.empty_like(self._image)
            R = rigid.inverse(self._T_camera_world)[:3, :3].copy()
            _paint_background(np.array(self._k), R, look.background.row()[None], noise_volume(), albedo)
            light = np.asarray(look.ambient, np.float32) + np.float32(0.5) * np.asarray(look.lamp_colour, np.float32)
            self._sky = drawn, albedo * light
        return self._sky[1]

    def _faces_of(self, shapes: list[Shape]) -> _Faces:
        known = self._faces and len(self._faces[0]) == len(shapes)
        if not (self._faces and known and all(a is b for a, b in zip(self._faces[0], shapes, strict=True))):
            self._faces = shapes, _Faces(shapes)
        return self._faces[1]

    def _cast_shadow(self, bodies: list[Body], lamp: Array) -> tuple[Array, float]:
        """Fills the shadow map; returns T_lamp_world and the map's focal length [px]. The map covers the movable bodies."""
        casters = [body for body in bodies if body.appearance.casts_shadow]
        self._shadow.clear()
        if not casters:
            return np.eye(4), 1.0
        centres = np.array([body.T_world_body[:3, 3] for body in casters])
        up = (0.0, 1.0, 0.0) if abs(lamp[0]) + abs(lamp[1]) < 0.1 else (0.0, 0.0, 1.0)
        T_lamp_world = rigid.inverse(rigid.look_at(lamp, np.median(centres, axis=0), up))
        placed = [rigid.apply(T_lamp_world @ body.T_world_body, body.shape.mesh.vertices) for body in casters]
        extent = max(_quantile(np.abs(v[:, :2] / np.maximum(v[:, 2:], 0.1)), 0.98) for v in placed)
        focal = (SHADOW_PX / 2 - 2) / min(max(extent, 0.15), 1.2)
        centre = SHADOW_PX / 2 - 0.5
        for body, vertices in zip(casters, placed, strict=True):
            self._shadow.draw(vertices, body.shape.mesh.faces, focal, focal, centre, centre, 0)
        return T_lamp_world, focal

    def hidden_fraction(self, picture: Picture, bodies: list[Body], index: int) -> float:
        """The share of body `index`'s own pixels in the image that something else covers; 1 where it is wholly outside."""
        body = bodies[index]
        vertices = rigid.apply(self._T_camera_world @ body.T_world_body, body.shape.mesh.vertices)
        height, width = picture.bodies.shape
        whole = np.count_nonzero(raster.silhouette(vertices, body.shape.mesh.faces, self._k, (0, 0, width, height)))
        return 1.0 - np.count_nonzero(picture.bodies == index) / whole if whole else 1.0


class _Faces:
    """Concatenated triangles of all bodies, as the shading pass reads them."""

    def __init__(self, shapes: list[Shape]):
        self.corners = np.concatenate([shape.corners for shape in shapes] or [np.zeros((0, 3, 3), np.float32)])
        self.normals = np.concatenate([shape.normals for shape in shapes] or [np.zeros((0, 3, 3), np.float32)])
        self.labels = np.concatenate([shape.mesh.labels for shape in shapes] or [np.zeros(0, np.uint8)])


class _Surfaces:
    """Results of the shading pass in earlier pictures, for pixels that show the same surface again. `arrays`, per pixel: the
    body's state that it shows (a number of `states`, 0 for none), the triangle, the albedo, and the surface in the lamp's light
    (cosine to the lamp, specular term, z of the normal)."""

    def __init__(self, height: int, width: int):
        self.arrays = (
            np.zeros((height, width), np.int32),
            np.empty((height, width), np.int32),
            np.empty((height, width, 3), np.float32),
            np.empty((height, width, 3)),
        )
        self._count = 0
        self._states = np.zeros(0, np.int32)
        self._last: tuple[_Faces, Array, NDArray[np.float32], Array] | None = None

    def states(self, faces: _Faces, T_body_world: Array, textures: NDArray[np.float32], lamp: Array) -> NDArray[np.int32]:
        """A number for each body that changes with its appearance or pose; all change with the lamp or the set of bodies."""
        last, self._last = self._last, (faces, T_body_world, textures, lamp)
        if last is None or last[0] is not faces or not np.array_equal(last[3], lamp):
            changed = np.ones(len(textures), np.bool_)
        else:
            changed = (last[1] != T_body_world).any((1, 2)) | (last[2] != textures).any(1)
        fresh = np.arange(self._count + 1, self._count + 1 + len(changed), dtype=np.int32)
        self._states = np.where(changed, fresh, self._states) if len(self._states) == len(changed) else fresh
        self._count += len(changed)
        return self._states


def _quantile(x: Array, share: float) -> float:
    """The same as `numpy.quantile`, to the last bit, in a seventh of its time."""
    where = (x.size - 1) * share
    low = int(where)
    high, t = min(low + 1, x.size - 1), where - low
    ordered = np.partition(x.ravel(), (low, high))
    a, b = float(ordered[low]), float(ordered[high])
    return a + (b - a) * t if t < 0.5 else b - (b - a) * (1.0 - t)


def _expose(image: NDArray[np.float32], blurred: NDArray[np.float32], look: Look, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The sensor: blur, shot and read noise, gamma of the display, 8 bits, and JPEG compression. `blurred`: a buffer of that
    size."""
    if look.blur_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), look.blur_px, dst=blurred), np.float32)
    noise = _grain()
    start = int(rng.integers(0, noise.size - 1))
    out = np.empty(image.shape, np.uint8)
    height, width = image.shape[:2]
    gain = np.tile(np.asarray(look.gain, np.float32), width)
    _develop(image.reshape(height, -1), noise, start, np.float32(look.noise), gain, out.reshape(height, -1))
    if look.jpeg is not None:
        _, packed = cv2.imencode(".jpg", cv2.cvtColor(out, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, look.jpeg])
        return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[..., ::-1].copy()
    return out


_GRAIN: list[NDArray[np.float32]] = []


def _grain() -> NDArray[np.float32]:
    """White Gaussian noise, drawn once; each image reads it from a random position on."""
    if not _GRAIN:
        _GRAIN.append(np.random.default_rng(0).standard_normal(1_000_003).astype(np.float32))
    return _GRAIN[0]


@kernel("f4[h, w], f4[m], i8, f4, f4[w], out u1[h, w]")
def _develop(image, noise, start, sigma, gain, out):
    """Rows (h, 3 w) of an image, with as much noise as they need from `start` on, at its end again from its beginning."""
    k = start
    for row in range(len(image)):
        first = 0
        while first < image.shape[1]:
            last = min(image.shape[1], first + len(noise) - k)
            n = last - first
            _develop_run(image[row, first:last], noise[k : k + n], sigma, gain[first:last], out[row, first:last])
            first, k = last, (k + n) % len(noise)


@inner
def _develop_run(image, noise, sigma, gain, out):
    """Values behind one another, without a branch: the compiler makes vectors of them."""
    for i in range(len(image)):
        value = image[i] * gain[i]
        value = math.sqrt(value if value > np.float32(0.0) else np.float32(0.0))  # a display's gamma, near enough
        value += sigma * noise[i] * (np.float32(0.6) + np.float32(0.4) * value)
        value = value if value > np.float32(0.0) else np.float32(0.0)
        value = value if value < np.float32(1.0) else np.float32(1.0)
        out[i] = np.uint8(np.int32(np.float64(value) * 255.0 + 0.5))


@kernel("i8[m, 3], f8[m, 3], f8[m, 3], f8, out f8[m, 3, 3]")
def _corner_normals(vertices, flat, area, crease, out):
    """Writes the area-weighted mean, at each corner, of the normals of the faces around that vertex within the crease angle."""
    m = len(vertices)
    last = 0
    for f in range(m):
        last = max(last, vertices[f, 0], vertices[f, 1], vertices[f, 2])
    count = np.zeros(last + 2, np.int64)
    for f in range(m):
        for k in range(3):
            count[vertices[f, k] + 1] += 1
    start = count  # of each vertex's faces, one behind the other
    for v in range(len(count) - 1):
        start[v + 1] += start[v]
    around = np.empty(3 * m, np.int64)
    fill = start.copy()
    for f in range(m):
        for k in range(3):
            around[fill[vertices[f, k]]] = f
            fill[vertices[f, k]] += 1
    for f in range(m):
        for k in range(3):
            v = vertices[f, k]
            x, y, z = 0.0, 0.0, 0.0
            for e in range(start[v], start[v + 1]):
                g = around[e]
                if flat[f, 0] * flat[g, 0] + flat[f, 1] * flat[g, 1] + flat[f, 2] * flat[g, 2] >= crease:
                    x, y, z = x + area[g, 0], y + area[g, 1], z + area[g, 2]
            norm = math.sqrt(x * x + y * y + z * z)
            if norm > 1e-15:
                out[f, k, 0], out[f, k, 1], out[f, k, 2] = x / norm, y / norm, z / norm
            else:
                out[f, k] = flat[f]


@inner
def _noise(volume, x, y, z):
    """Trilinear value noise in [0, 1] with a lattice of pitch 1, whose size is a power of two."""
    wrap = volume.shape[0] - 1
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    a, b, c = np.float32(x - fx), np.float32(y - fy), np.float32(z - fz)
    i, j, k = int(fx) & wrap, int(fy) & wrap, int(fz) & wrap
    i1, j1, k1 = (i + 1) & wrap, (j + 1) & wrap, (k + 1) & wrap
    one = np.float32(1.0)
    low = (volume[i, j, k] * (one - a) + volume[i1, j, k] * a) * (one - b) + (
        volume[i, j1, k] * (one - a) + volume[i1, j1, k] * a
    ) * b
    high = (volume[i, j, k1] * (one - a) + volume[i1, j, k1] * a) * (one - b) + (
        volume[i, j1, k1] * (one - a) + volume[i1, j1, k1] * a
    ) * b
    return low * (one - c) + high * c


@inner
def _texture(textures, row, x, y, z, volume, out):
    """Albedo (3,) of a row of textures (Appearance.row) at body coordinates."""
    base = 0
    if x < textures[row, CUFF]:  # below the cuff: the sleeve's colours
        base = 9
    pattern, period = int(textures[row, base]), textures[row, base + 1]
    u, v, w = x / period, y / period, z / period
    if pattern == 0:
        mix = np.float32(0.0)
    elif pattern == 1:  # blotches of two sizes
        mix = np.float32(0.65) * _noise(volume, u, v, w) + np.float32(0.35) * _noise(volume, 3.1 * u, 3.1 * v, 3.1 * w)
    elif pattern == 2:  # stripes
        mix = np.float32(1.0) if (u + v + w) - math.floor(u + v + w) < 0.5 else np.float32(0.0)
    elif pattern == 3:  # checks
        mix = np.float32((int(math.floor(u + 0.37)) + int(math.floor(v + 0.41)) + int(math.floor(w + 0.43))) & 1)
    elif pattern == 4:  # wood: stretched noise, in rings
        ring = 4.0 * _noise(volume, 0.15 * u, v, w) + 0.6 * _noise(volume, u, 5.0 * v, 5.0 * w)
        mix = np.float32(ring - math.floor(ring))
    else:
        mix = np.float32(0.0)
    mix *= textures[row, base + 2]
    for c in range(3):
        if pattern == 5:  # each channel in steps of its own
            mix = np.float32(math.floor(4.0 * _noise(volume, u + 9.0 * c, v, w)) / 3.0) * textures[row, base + 2]
        out[c] = textures[row, base + 3 + c] * (np.float32(1.0) - mix) + textures[row, base + 6 + c] * mix


@kernel("f8[4], f8[3, 3], f4[t, 20], f4[s, s, s], out f4[h, w, 3]")
def _paint_background(k, R, textures, volume, out):
    """Albedo (h, w, 3) of a texture on a sphere of 3 m around the camera, whose axes are the columns of R."""
    for row in range(out.shape[0]):
        dy = (row - k[3]) / k[1]
        for column in range(out.shape[1]):
            dx = (column - k[2]) / k[0]
            x = 3.0 * (R[0, 0] * dx + R[0, 1] * dy + R[0, 2])
            y = 3.0 * (R[1, 0] * dx + R[1, 1] * dy + R[1, 2])
            z = 3.0 * (R[2, 0] * dx + R[2, 1] * dy + R[2, 2])
            _texture(textures, 0, x, y, z, volume, out[row, column])


@inner
def _normal(corners, normals, x, y, z):
    """The normal of a triangle at a point of it, smooth between those of its corners (3, 3); all in the body's frame."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    wx, wy, wz = x - ax, y - ay, z - az
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    det = uu * vv - uv * uv
    if det < 1e-14:
        s1, s2 = 0.0, 0.0
    else:  # barycentric weights
        s1, s2 = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    s0 = 1.0 - s1 - s2
    return (
        s0 * normals[0, 0] + s1 * normals[1, 0] + s2 * normals[2, 0],
        s0 * normals[0, 1] + s1 * normals[1, 1] + s2 * normals[2, 1],
        s0 * normals[0, 2] + s1 * normals[1, 2] + s2 * normals[2, 2],
    )


@kernel(
    """f4[h, w], u1[h, w], i4[h, w], f8[4], f8[4, 4], f8[b, 4, 4], f4[m, 3, 3], f4[m, 3, 3], u1[m], f4[b, 20], f4[s, s, s],
    f8[3], f4[3], f4[3], f8[4, 4], f8, f4[l, l], i4[b], out i4[h, w], out i4[h, w], out f4[h, w, 3], out f8[h, w, 3],
    out f4[h, w, 3], out u1[h, w]"""
)
def _shade(
    depth, ids, triangles, k, R, T, corners, normals, face_labels, textures, volume,
    lamp, lamp_colour, ambient, T_lamp_world, lamp_f, shadow, states, seen, seen_triangles, albedo, light, image, labels,
):  # fmt: skip
    """Image and labels where there is a body; elsewhere they stay. `states` to `light` are those of `_Surfaces`, read where it
    knows the surface that a pixel shows, elsewhere written."""
    h, w = ids.shape
    size = shadow.shape[0]
    centre = size / 2 - 0.5
    ex, ey, ez = R[0, 3], R[1, 3], R[2, 3]
    for row in range(h):
        dy = (row - k[3]) / k[1]
        for column in range(w):
            body = ids[row, column]
            if body == 255:
                continue
            dx = (column - k[2]) / k[0]
            # the pixel's ray in the world, of unit depth
            rx = R[0, 0] * dx + R[0, 1] * dy + R[0, 2]
            ry = R[1, 0] * dx + R[1, 1] * dy + R[1, 2]
            rz = R[2, 0] * dx + R[2, 1] * dy + R[2, 2]
            z = depth[row, column]
            px, py, pz = ex + z * rx, ey + z * ry, ez + z * rz
            t = triangles[row, column]
            labels[row, column] = face_labels[t]
            if seen[row, column] != states[body] or seen_triangles[row, column] != t:
                seen[row, column], seen_triangles[row, column] = states[body], t
                x = T[body, 0, 0] * px + T[body, 0, 1] * py + T[body, 0, 2] * pz + T[body, 0, 3]
                y = T[body, 1, 0] * px + T[body, 1, 1] * py + T[body, 1, 2] * pz + T[body, 1, 3]
                q = T[body, 2, 0] * px + T[body, 2, 1] * py + T[body, 2, 2] * pz + T[body, 2, 3]
                _texture(textures, body, x, y, q, volume, albedo[row, column])
                mx, my, mz = _normal(corners[t], normals[t], x, y, q)
                # its normal in the world: the transpose of T's rotation
                nx = T[body, 0, 0] * mx + T[body, 1, 0] * my + T[body, 2, 0] * mz
                ny = T[body, 0, 1] * mx + T[body, 1, 1] * my + T[body, 2, 1] * mz
                nz = T[body, 0, 2] * mx + T[body, 1, 2] * my + T[body, 2, 2] * mz
                length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
                nx, ny, nz = nx / length, ny / length, nz / length
                lx, ly, lz = lamp[0] - px, lamp[1] - py, lamp[2] - pz
                length = math.sqrt(lx * lx + ly * ly + lz * lz)
                lx, ly, lz = lx / length, ly / length, lz / length
                diffuse = nx * lx + ny * ly + nz * lz
                shine = 0.0
                if textures[body, GLOSS] > 0.0 and diffuse > 0.0:
                    length = math.sqrt(rx * rx + ry * ry + rz * rz)
                    hx, hy, hz = lx - rx / length, ly - ry / length, lz - rz / length
                    length = math.sqrt(hx * hx + hy * hy + hz * hz) + 1e-9
                    cosine = max((nx * hx + ny * hy + nz * hz) / length, 0.0)
                    cosine *= cosine
                    cosine *= cosine
                    cosine *= cosine
                    shine = textures[body, GLOSS] * cosine * cosine
                light[row, column, 0], light[row, column, 1], light[row, column, 2] = diffuse, shine, nz
            diffuse, shine, nz = light[row, column, 0], light[row, column, 1], light[row, column, 2]
            lit = 0.0
            if diffuse > 0.0:
                sx = T_lamp_world[0, 0] * px + T_lamp_world[0, 1] * py + T_lamp_world[0, 2] * pz + T_lamp_world[0, 3]
                sy = T_lamp_world[1, 0] * px + T_lamp_world[1, 1] * py + T_lamp_world[1, 2] * pz + T_lamp_world[1, 3]
                sz = T_lamp_world[2, 0] * px + T_lamp_world[2, 1] * py + T_lamp_world[2, 2] * pz + T_lamp_world[2, 3]
                lit = 1.0
                if sz > 0.1:
                    su, sv = lamp_f * sx / sz + centre, lamp_f * sy / sz + centre
                    i, j = int(math.floor(su)), int(math.floor(sv))
                    if 0 <= i < size - 1 and 0 <= j < size - 1:
                        fu, fv = su - i, sv - j
                        edge = sz - 0.012 - 0.02 * (1.0 - diffuse)
                        lit = ((1 - fu) * (shadow[j, i] > edge) + fu * (shadow[j, i + 1] > edge)) * (1 - fv) + (
                            (1 - fu) * (shadow[j + 1, i] > edge) + fu * (shadow[j + 1, i + 1] > edge)
                        ) * fv
            diffuse *= lit
            shine *= lit
            sky = 0.75 + 0.25 * nz
            for c in range(3):
                image[row, column, c] = (
                    albedo[row, column, c] * (ambient[c] * sky + lamp_colour[c] * diffuse) + lamp_colour[c] * shine
                )
