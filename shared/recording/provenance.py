"""Provenance of a recording, for its later use elsewhere."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
import time
from pathlib import Path

from penumbra.shared.cell import description as cells
from penumbra.shared.contract.messages import VERSION
from penumbra.shared.recording.reading import ABOUT, CELL

ROOT = Path(__file__).parents[2]
PACKAGES = ("eclipse-zenoh", "msgspec", "numpy", "openvino", "opencv-python-headless", "scipy", "torch")
"""Packages whose version may explain a result."""
WEIGHTS = "weights"
"""Name of the metadata that contain the SHA-256 of weights, by their paths."""


def about(cell: str | Path) -> dict[str, dict[str, str]]:
    """Metadata of a recording of a cell, by name. cell: a built-in name or a YAML file."""
    path = cells.source(cell)
    return {
        ABOUT: {
            "penumbra": _version("penumbra"),
            "wire_version": str(VERSION),
            "cell": cells.load(cell).name,
            "cell_file": str(path.resolve()),
            "cell_sha256": _digest(path),
            "host": platform.node(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **{name: _version(name) for name in PACKAGES},
        },
        WEIGHTS: {str(path.relative_to(ROOT)): _digest(path) for path in weights()},
    }


def attachments(cell: str | Path) -> dict[str, bytes]:
    """Attachments of a recording: the cell file."""
    return {CELL: cells.source(cell).read_bytes()}


def weights() -> list[Path]:
    """Committed weights of this installation: those of the services, and those of the built-in cells' skins."""
    folders = [*ROOT.glob("services/*/weights"), ROOT / "shared" / "cell" / "built_in" / "skin"]
    return sorted(path for folder in folders for path in folder.glob("*") if path.suffix in (".npz", ".pt"))


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
