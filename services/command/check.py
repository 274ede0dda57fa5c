"""`penumbra check CELL`: checks everything about a cell file that can be checked before a process starts.

The file's content is checked wherever a process loads it (`shared.cell`). This module has the slower checks: meshes, field
models, networks, and by geometry the views of cameras and the reach of pads.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.services import flags
from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.body.simplification import open_edges
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.document import Document
from penumbra.shared.cell.faults import Fault
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import response
from penumbra.shared.skin.layout import Near

SERVICES = Path(__file__).parents[1]
EMULATOR = SERVICES / "emulator"
SEGMENTATION, HAPTICS = SERVICES / "segmentation" / "weights", SERVICES / "haptics" / "weights"
LINK_FACES = 50_000
"""Number of triangles of a robot's collision meshes above which rendering a picture in the emulator takes longer than its
period."""
LINK_M = 5.0
"""Extent [m] above which a link's mesh probably has another unit."""
SAMPLES, FEWEST, JOINT_SAMPLES = 400, 40, 30
"""Number of random poses of all targets, minimum number per target, and number of joint angles, to test the reach of pads."""
VERTICES = 80
"""Number of vertices that represent a target's surface in this test."""
SPACING = 0.03
"""Maximum distance [m] from a point of the surface to the nearest of these vertices."""
FRONT = 0.3
"""Minimum share of the points within a pad's range that lie in front of it, if it faces the target. Pads at the side of a robot
have a half."""
SEEN = 0.5
"""Minimum share of the region of motion that a camera should see."""
HOME_SIGMAS = 3.0
"""Distance from its home, in standard deviations, up to which a target is expected."""
LONGER = 1.25
"""Factor on a limb's extent along x above which another extent shows that x is not its axis."""
BESIDE = 0.1
"""Distance of a mesh's origin from its bounding box, as a share of its longest side, above which it is not in the limb."""
SMALL_PX = 20.0
"""Length [px] of a target in the picture below which a camera is probably given in another unit, or much too far away."""
APART = 0.5
"""Distance [m] between the homes of two targets of the same class below which both may follow one arm. With the second person of
`table` at 0.33 m both did in 20 of 20 poses, at 0.9 m in none of 15."""

Nearby = dict[str, Near]
"""The pads that each target may come near."""


@flags.command(
    "check",
    "Checks a cell file before anything starts: keys, numbers, meshes, URDF, weights, and what cameras see and pads reach. Exit "
    "code 0: no fault; 1: faults; 2: no such cell.",
    flags.Argument("cell", metavar="CELL", shell_complete=flags.complete_cell, help="table, arm or a YAML file"),
    flags.JSON,
    example="penumbra check mine.yaml",
)
def main(options: flags.Options) -> int:
    """Print every fault and warning; returns 0 without faults, 1 with."""
    path = cells.source(options.cell)
    _, found = examine(path, is_whole=True)
    wrong, warnings = ([fault for fault in found if fault.is_warning is kind] for kind in (False, True))
    if options.json:
        both = {"faults": wrong, "warnings": warnings}
        parts = {name: [_as_json(fault) for fault in some] for name, some in both.items()}
        print(json.dumps({"file": str(path), "is_good": not wrong, **parts}))
        return int(bool(wrong))
    for fault in wrong:
        print(fault)
    for fault in warnings:
        print(f"warning: {fault}")
    print(f"{path}: {_count(wrong, 'fault')}, {_count(warnings, 'warning')}")
    return int(bool(wrong))


def refuse(cell: str | Path) -> cells.Cell:
    """Load the cell, with its warnings on stderr. Raises CellError with every fault if it has any."""
    found, faults = examine(cells.source(cell))
    for fault in faults:
        if fault.is_warning:
            print(f"warning: {fault}", file=sys.stderr)
    if found is None:
        raise cells.CellError("\n".join(str(fault) for fault in faults if not fault.is_warning))
    return found


def examine(path: Path, is_whole: bool = False) -> tuple[cells.Cell | None, list[Fault]]:
    """The cell of a file, None if it has faults, and its faults and warnings: only those of the file itself if it has any.
    is_whole: also the checks that a start leaves to the emulator, which would repeat them."""
    try:
        reading = cells.read(path)
    except cells.CellError as error:
        return None, [_located(path, str(error))]
    if reading.cell is None:
        return None, list(reading.faults)
    cell, document = reading.cell, reading.document
    found = list(_meshes(cell, document))
    if all(fault.is_warning for fault in found):  # the other checks need the meshes
        near = {target: Near.of(cell, target) for target in cell.targets}
        for look in (_robots, _models, _networks, _sources, _cameras, _pads, _homes, _shoulders, _neighbours):
            found += look(cell, document, near)
    if is_whole and all(fault.is_warning for fault in found):
        found += _motion(cell, document)
    is_good = all(fault.is_warning for fault in found)
    return cell if is_good else None, sorted(found, key=lambda fault: (fault.is_warning, fault.line))


def _located(path: Path, text: str) -> Fault:
    """The fault of an error whose text begins with file and line."""
    head, _, reason = text.removeprefix(f"{path}:").partition(": ")
    return Fault(path, int(head), "", reason) if head.isdecimal() else Fault(path, 1, "", text.removeprefix(f"{path}: "))


def _as_json(fault: Fault) -> dict[str, str | int]:
    return {"file": str(fault.path), "line": fault.line, "place": fault.place, "reason": fault.reason}


def _count(faults: list[Fault], name: str) -> str:
    return f"{len(faults) or 'no'} {name}{'' if len(faults) == 1 else 's'}"


def _meshes(cell: cells.Cell, document: Document) -> Iterator[Fault]:
    """Meshes of targets and links that cannot be read or have another unit; meshes with holes or too many triangles."""
    for name, target in cell.targets.items():
        if target.mesh.startswith("body:"):
            continue
        place = f"targets.{name}.mesh"
        try:
            vertices, faces = anatomy.read(cell.folder / target.mesh)
        except cells.CellError as error:
            yield document.fault(place, str(error))
            continue
        if (count := len(faces)) > anatomy.MOST_FACES:
            what = f"expected at most {anatomy.MOST_FACES} triangles, got {count}; every start simplifies it to that"
            yield document.fault(place, f"{what}, which takes time: save a simplified mesh", is_warning=True)
        if holes := open_edges(faces):
            what = f"expected a closed surface, got {holes} edges without a second triangle"
            yield document.fault(place, f"{what}; close the holes, gaps to the skin may be wrong there", is_warning=True)
        for reason in _limb_faults(vertices, faces):
            yield document.fault(place, reason, is_warning=True)
    for name, robot in cell.robots.items():
        place = f"robots.{name}.urdf"
        try:
            meshes = RobotModel(robot, cell.folder).meshes
        except cells.CellError as error:
            yield document.fault(place, str(error))
            continue
        for link, mesh in meshes.items():
            if (extent := float(np.ptp(mesh.vertices, axis=0).max())) > LINK_M:
                what = f"expected collision meshes in metres, got {extent:.3g} m for link {link}"
                yield document.fault(place, f'{what}; give <mesh scale="0.001 0.001 0.001"> if the file is in millimetres')
        if (count := sum(len(mesh.faces) for mesh in meshes.values())) > LINK_FACES:
            what = f"expected at most {LINK_FACES} triangles in all collision meshes, got {count}"
            yield document.fault(place, f"{what}; simplify them, pictures of the emulator take long", is_warning=True)


def _limb_faults(vertices: Array, faces: NDArray[np.int32]) -> Iterator[str]:
    """Faults in words of a limb's mesh (vertices (n, 3) [m], faces (m, 3)) that lies or is turned otherwise than is assumed."""
    corners = vertices[faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    longest = int(np.argmax(high - low))
    if (high - low)[longest] > LONGER * (high - low)[0]:
        what = f"expected the limb along the mesh's x axis, got its longest side along {'xyz'[longest]}"
        yield f"{what}; turn the mesh, an arm's joints and home are assumed so"
    outside = float(np.linalg.norm(np.maximum(np.maximum(low, -high), 0.0)))
    if outside > BESIDE * (high - low).max():
        what = f"expected the mesh's origin in the limb, got it {outside:.2g} m beside it"
        yield f"{what}; move the origin to the limb's middle, which home and poses are of"
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0
    if volume < 0.0 and not open_edges(faces):
        what = "expected triangles counter-clockwise seen from outside, got a surface that is inside out"
        yield f"{what}; flip its normals, or gaps to the skin are wrong"


def _robots(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Links that are drawn but hide nothing, and joints that carry those of the cell and are not among them."""
    for name, model in robot_models(cell).items():
        robot = model.description
        if bare := [link.name for link in robot.links if link.is_drawn and not link.solids]:
            what = f"expected a <collision> of each link with a <visual>, got none of {', '.join(bare)}"
            yield document.fault(f"robots.{name}.urdf", f"{what}; add it, only collision shapes hide the arm", is_warning=True)
        carriers = {joint.child: joint for joint in robot.joints}
        passed: set[str] = set()  # moving joints between the base and those of the cell
        for joint in robot.joints:
            link = joint.parent if joint.name in model.joints else ""
            while link in carriers:
                passed.add(carriers[link].name)
                link = carriers[link].parent
        if fixed := [each for each in robot.moving if each in passed and each not in model.joints]:
            what = f"expected every moving joint between the base and the joints of the cell, got none of {', '.join(fixed)}"
            yield document.fault(f"robots.{name}.joints", f"{what}; add them, or they count as fixed", is_warning=True)


def _models(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Pads without a field model for a target that comes near them, and pads of one target with different electrodes."""
    try:
        known = response.networks(cell)
    except cells.CellError as error:
        yield document.fault("pads", str(error))
        return
    for target, found in near.items():
        pads = found.cell.pads
        sizes = {name: len(cell.pad_types[pad.type].electrodes) for name, pad in pads.items()}
        for name, size in sizes.items():
            first, expected = next(iter(sizes.items()))
            if size != expected:
                what = f"expected as many electrodes as pad {first} has, {expected}, got {size}"
                yield document.fault(f"pads.{name}.type", f"{what}; give pads near one target equally many")
        if missing := [pad for pad in pads if response.fingerprint(cell, pad, target) not in known]:
            what = f"expected a field model of the pads {', '.join(missing)} for target {target}, got none: their design, their "
            what += f"mounting or the limb is new; fit it once with `penumbra skin model --cell {document.path}`"
            yield document.fault(f"pads.{missing[0]}", what)


def _networks(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Missing weights. Without its network the skin also finds a pose, from the target's home."""
    if cell.cameras and SEGMENTATION.parent.is_dir() and not any(SEGMENTATION.glob("*.npz")):
        what = f"expected weights of the segmentation in {SEGMENTATION}, got none"
        yield document.fault("cameras", f"{what}; make them with `penumbra segmentation train`")
    if not HAPTICS.parent.is_dir():  # not installed here
        return
    from penumbra.services.haptics import paper_network

    for target, found in near.items():
        if not found.cell.pads:
            continue
        path = HAPTICS / f"{cell.name}-{target}.npz"
        try:
            paper_network.load(path, found.cell, target)
        except (FileNotFoundError, ValueError) as error:
            is_missing = isinstance(error, FileNotFoundError)
            got = f"got no {path.name}" if is_missing else f"got that of other pads or another limb in {path.name}"
            what = f"expected a haptic network for target {target} of cell {cell.name}, {got}; train it with "
            what += f"`penumbra haptics train --cell {document.path}` (until then the skin starts from the target's home)"
            yield document.fault("name", what, is_warning=True)


def _sources(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Missing films, folders and modules: they may be where the process that reads them runs."""
    for name, source in cell.sources.items():
        if source.is_played and not (path := source.path(cell.folder)).exists():
            what = f"expected a film or a folder of pictures, got nothing at {path}"
            yield document.fault(f"cameras.{name}.source.url", f"{what}; correct it, or put it there", is_warning=True)
    cameras = {f"cameras.{name}": source for name, source in cell.sources.items()}
    robots = {f"robots.{name}": source for name, source in cell.joint_sources.items()}
    for part, each in (cameras | robots).items():
        module = each.place.partition(":")[0]
        if each.kind == "adapter" and not PathFinder.find_spec(module.partition(".")[0], [str(cell.folder), *sys.path]):
            what = f"expected the module {module} beside the cell file or installed, got none"
            yield document.fault(f"{part}.source.url", f"{what}; correct it, or put it there", is_warning=True)


def _cameras(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Cameras that see no target, or little of the region in which it moves; targets that nothing senses."""
    homes = {name: _around(target) for name, target in cell.targets.items()}
    lengths = {name: np.ptp(anatomy.target_mesh(target, cell).vertices, axis=0).max() for name, target in cell.targets.items()}
    seen: set[str] = set()
    for name, camera in cell.cameras.items():
        shown = {target for target, points in homes.items() if _share_seen(camera, points) > 0.0}
        seen |= shown
        place = f"cameras.{name}.{'rpy' if camera.look_at is None else 'look_at'}"
        if not shown:
            what = "expected a camera that sees the home of a target, got one that sees none"
            yield document.fault(place, f"{what}; correct its position and direction", is_warning=True)
        elif cell.sim is not None and next(iter(cell.targets)) in shown:
            share = _share_seen(camera, _grid(cell.sim.motion.low, cell.sim.motion.high))
            if share < SEEN:
                what = f"expected a camera that sees most of sim.motion, got one that sees {share:.0%} of it"
                yield document.fault(place, f"{what}; correct its position and direction, or the region", is_warning=True)
        for target in sorted(shown):
            away = float(np.linalg.norm(np.subtract(cell.targets[target].home.position, camera.position)))
            if lengths[target] * camera.fx < SMALL_PX * away:
                size = f"{lengths[target] * camera.fx / away:.2g} px for {target}, {away:.3g} m away"
                what = (
                    f"expected a target at least {SMALL_PX:g} px long in the picture, got {size}; give metres, or move the camera"
                )
                yield document.fault(f"cameras.{name}.position", what, is_warning=True)
    for name in cell.targets:
        if name not in seen and not near[name].cell.pads:
            what = "expected a camera or pads that sense this target, got none"
            yield document.fault(f"targets.{name}", f"{what}; add one, or correct the target's home", is_warning=True)


def _around(target: cells.Target) -> Array:
    """Points (n, 3) [m] around a target's home."""
    room = target.home_spread.position
    return _grid(np.subtract(target.home.position, room), np.add(target.home.position, room))


def _grid(low: ArrayLike, high: ArrayLike) -> Array:
    """A grid of points (n, 3) in a box."""
    axes = np.linspace(np.asarray(low, float), np.asarray(high, float), 6).T
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def _share_seen(camera: cells.Camera, points: Array) -> float:
    """The share of points (n, 3) [m] in the world that lie in a camera's picture."""
    local = rigid.apply(rigid.inverse(camera.T_world_camera), points)
    local = local[local[:, 2] > 0.0]
    pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = (pixels >= 0.0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    return float(np.count_nonzero(inside & camera.lens.is_seen(pixels)) / len(points))


def _pads(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Pads that no target comes near, or only from behind."""
    rng = np.random.default_rng(0)
    nearest, facing = dict.fromkeys(cell.pads, np.inf), dict.fromkeys(cell.pads, False)
    links = _drawn_links(cell, rng)
    for target, found in near.items():
        unreached = {name: pad for name, pad in found.cell.pads.items() if not facing[name]}
        if not unreached:
            continue
        skin = _drawn_skin(cell, target, max(SAMPLES // len(near), FEWEST), rng)
        squares = (skin**2).sum(axis=1)
        for name, pad in unreached.items():
            T = links[pad.link] @ pad.T_link_pad
            places, axes = T[:, :3, 3], T[:, :3, 2]
            gaps = np.sqrt(np.maximum((places**2).sum(axis=1)[:, None] + squares - 2.0 * places @ skin.T, 0.0))
            nearest[name] = min(nearest[name], float(gaps.min()))
            is_felt = gaps < cell.pad_types[pad.type].range + SPACING
            is_in_front = axes @ skin.T > (axes * places).sum(axis=1)[:, None]
            facing[name] = bool(np.count_nonzero(is_felt & is_in_front) > FRONT * np.count_nonzero(is_felt))
    for name, pad in cell.pads.items():
        reach = cell.pad_types[pad.type].range
        if nearest[name] > reach + SPACING:
            got = "none that comes near" if np.isinf(nearest[name]) else f"{nearest[name]:.2g} m at the nearest"
            what = f"expected a target that comes within {reach:g} m, got {got}; move the pad, nothing can reach it"
            yield document.fault(f"pads.{name}.position", what, is_warning=True)
        elif not facing[name]:
            what = "expected a pad whose z axis points towards the target, got one that points away from it"
            yield document.fault(f"pads.{name}.rpy", f"{what}; turn it", is_warning=True)


def _motion(cell: cells.Cell, document: Document) -> Iterator[Fault]:
    """Regions in which the emulator finds no initial pose."""
    if cell.sim is None or not EMULATOR.is_dir():
        return
    from penumbra.sim.world.actor import Actor
    from penumbra.sim.world.motion import joint_motions

    robots, scripts = robot_models(cell), joint_motions(cell, cell.sim, 0)
    for name in cell.targets:
        try:
            Actor(cell, cell.sim, name, 0, robots, scripts)
        except cells.CellError as error:
            is_first = name == next(iter(cell.targets))
            yield document.fault("sim.motion" if is_first else f"targets.{name}.home", str(error).removeprefix("sim.motion: "))


def _drawn_skin(cell: cells.Cell, name: str, count: int, rng: np.random.Generator) -> Array:
    """Points (n, 3) [m] of a target's surface in the world at all its possible poses: in the emulator's region, or around its
    home."""
    target = cell.targets[name]
    home, spread = target.home, target.home_spread
    if cell.sim is None:
        middle, half = (*home.position, *home.rpy), HOME_SIGMAS * np.repeat([spread.position, spread.rotation], 3)
        low, high = np.subtract(middle, half), np.add(middle, half)
    else:
        shift = np.subtract(home.position, next(iter(cell.targets.values())).home.position)  # each person has its own region
        motion = cell.sim.motion
        low, high = np.array([*(motion.low + shift), *motion.rpy_low]), np.array([*(motion.high + shift), *motion.rpy_high])
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 6)
    poses = np.concatenate([corners, rng.uniform(low, high, (count, 6))])
    vertices = anatomy.target_mesh(target, cell).vertices
    vertices = vertices[:: max(1, len(vertices) // VERTICES)]
    return np.concatenate([rigid.apply(rigid.from_rpy(pose[:3], pose[3:]), vertices) for pose in poses])


def _drawn_links(cell: cells.Cell, rng: np.random.Generator) -> dict[str, Array]:
    """T_world_link (n, 4, 4) of the world and of every robot's links over the joints' ranges, by the names that pads use."""
    out = {"world": np.eye(4)[None]}
    first = 0
    for name, model in robot_models(cell).items():
        low, high = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
        if cell.sim is not None:
            these = slice(first, first + len(model.joints))
            low, high = np.array(cell.sim.joints_low[these]), np.array(cell.sim.joints_high[these])
        first += len(model.joints)
        q = np.concatenate([[low, high, (low + high) / 2.0], rng.uniform(low, high, (JOINT_SAMPLES, len(low)))])
        out |= {f"{name}/{link}": T for link, T in model.link_transforms(q).items()}
    return {link: np.broadcast_to(T, (len(T), 4, 4)) for link, T in out.items()}


def _homes(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """A first target whose home is outside of the emulator's region of motion."""
    if cell.sim is None:
        return
    name, target = next(iter(cell.targets.items()))
    room = HOME_SIGMAS * target.home_spread.position
    low, high = np.subtract(cell.sim.motion.low, room), np.add(cell.sim.motion.high, room)
    if np.any(np.less(target.home.position, low) | np.greater(target.home.position, high)):
        what = f"expected a home in or near sim.motion, {list(cell.sim.motion.low)} to {list(cell.sim.motion.high)}"
        what += f", got {list(target.home.position)}"
        yield document.fault(f"targets.{name}.home", f"{what}; correct one of them", is_warning=True)


def _shoulders(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Shoulders from which the arm does not reach the home."""
    for name, target in cell.targets.items():
        if target.shoulder is None:
            continue
        length = 0.5 * cell.body.forearm_length * (target.size.length if target.size else 1.0)
        elbow = rigid.apply(target.home.transform, np.array([[-length, 0.0, 0.0]]))[0]
        away, reach = float(np.linalg.norm(elbow - target.shoulder)), cell.body.upper_arm_length
        if away > reach + HOME_SIGMAS * target.home_spread.position:
            what = f"expected a shoulder within the upper arm's length, {reach:g} m, of the elbow at home, got {away:.2g} m"
            yield document.fault(f"targets.{name}.shoulder", f"{what}; correct one of them", is_warning=True)


def _neighbours(cell: cells.Cell, document: Document, near: Nearby) -> Iterator[Fault]:
    """Targets of the same classes so near one another that both may follow one limb."""
    for (first, one), (second, other) in itertools.combinations(cell.targets.items(), 2):
        apart = float(np.linalg.norm(np.subtract(one.home.position, other.home.position)))
        if set(one.labels) & set(other.labels) and apart < APART:
            what = f"expected homes of targets of one class at least {APART:g} m apart, got {apart:.2g} m from {first}"
            yield document.fault(f"targets.{second}.home", f"{what}; both may follow the same arm, track one", is_warning=True)
