"""Tracks a person's forearm beside a robot, also while something hides it: camera and capacitive skin, fused.

    import penumbra

    with penumbra.connect() as cell:
        for pose in cell.poses():
            print(pose.state, pose.position, pose.sigma[:3])

What a program uses is below, and is loaded when it is first used: services import `penumbra.shared` and never the client.
"""

TYPE_CHECKING = False
"""As that of `typing`, without its import: the command `penumbra` reports no Ctrl-C well before it has imported this package."""

if TYPE_CHECKING:
    from penumbra.client.aio import AsyncCell, AsyncPoses, aconnect
    from penumbra.client.cell import Cell
    from penumbra.client.connect import connect
    from penumbra.client.pose import Pose, State
    from penumbra.client.poses import Poses
    from penumbra.client.publish import Camera, Pad, Robot
    from penumbra.shared.cell.faults import CellError
    from penumbra.shared.contract.messages import Source
    from penumbra.shared.runtime.connection import BusError
    from penumbra.shared.runtime.running import Instance

__all__ = [
    "AsyncCell",
    "AsyncPoses",
    "BusError",
    "Camera",
    "Cell",
    "CellError",
    "Instance",
    "Pad",
    "Pose",
    "Poses",
    "Robot",
    "Source",
    "State",
    "aconnect",
    "connect",
]

_HOMES = {
    "penumbra.client.aio": ("AsyncCell", "AsyncPoses", "aconnect"),
    "penumbra.client.cell": ("Cell",),
    "penumbra.client.connect": ("connect",),
    "penumbra.client.pose": ("Pose", "State"),
    "penumbra.client.poses": ("Poses",),
    "penumbra.client.publish": ("Camera", "Pad", "Robot"),
    "penumbra.shared.cell.faults": ("CellError",),
    "penumbra.shared.contract.messages": ("Source",),
    "penumbra.shared.runtime.connection": ("BusError",),
    "penumbra.shared.runtime.running": ("Instance",),
}


def __getattr__(name: str) -> object:
    """A name of the client, from its module (PEP 562)."""
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module 'penumbra' has no attribute {name!r}")
    import importlib

    found = globals()[name] = getattr(importlib.import_module(home), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
