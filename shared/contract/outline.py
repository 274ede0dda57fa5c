"""Summary of a cell for programs without the cell file. Fusion answers with it on `topics.description`, as JSON."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from penumbra.shared.contract.messages import VERSION, BadMessage

if TYPE_CHECKING:
    from penumbra.shared.cell.description import Cell

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class CameraOutline:
    """A camera: size of its images [px], rate, intrinsic matrix K (3 x 3) [px], T_world_camera (4 x 4) of its optical frame."""

    width: int
    height: int
    rate_hz: float
    K: Matrix
    T_world_camera: Matrix


@dataclass(frozen=True)
class PadOutline:
    """A pad: its electrodes in the order of the columns of its voltages, and the reference of its converter [V], the limit of
    voltages."""

    electrodes: tuple[str, ...]
    limit_V: float


@dataclass(frozen=True)
class Outline:
    """A cell: its name and fixed frame, and its targets, cameras, robots (joints in the order of `Joints.position`) and pads by
    name, in the order of the cell file. sim: whether the emulator can stand in for its sensors. wire_version: of the messages on
    its bus."""

    name: str
    frame: str
    targets: tuple[str, ...]
    cameras: dict[str, CameraOutline]
    robots: dict[str, tuple[str, ...]]
    pads: dict[str, PadOutline]
    sim: bool = False
    wire_version: int = VERSION

    def encode(self) -> bytes:
        """The outline as JSON."""
        return json.dumps(dataclasses.asdict(self)).encode()


_DECODER = msgspec.json.Decoder(Outline)


def of(cell: Cell) -> Outline:
    """The outline of a cell."""
    types = {name: cell.pad_types[pad.type] for name, pad in cell.pads.items()}
    return Outline(
        name=cell.name,
        frame=cell.frame,
        targets=tuple(cell.targets),
        cameras={
            name: CameraOutline(camera.width, camera.height, camera.rate_hz, camera.K.tolist(), camera.T_world_camera.tolist())
            for name, camera in cell.cameras.items()
        },
        robots={name: tuple(robot.joints) for name, robot in cell.robots.items()},
        pads={name: PadOutline(tuple(type.electrodes), type.chain.adc_reference) for name, type in types.items()},
        sim=cell.sim is not None,
    )


def decode(payload: bytes) -> Outline:
    """The outline in an answer. Raises BadMessage where it is not one, or comes from a release with other messages."""
    try:
        outline = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BadMessage("outline", f"expected the description of a cell, got {payload[:60]!r} ({error!s:.200})") from None
    if outline.wire_version != VERSION:
        why = f"expected wire version {VERSION}, got {outline.wire_version} from cell {outline.name}"
        raise BadMessage("version", f"{why}: run one release of Penumbra everywhere")
    return outline
