"""Compiles all kernels for all processors: `python -m penumbra.shared.native.build [--check]`.

Writes lib/*.so, which are committed, and lib/manifest.json: which versions of the compilers made them, from which sources, and
what came out. The same sources and versions give the same bytes, so anyone can compare: `--check` builds again, writes nothing,
and fails where something differs. Needs numba (the extra `native`), all extras of the services whose kernels it imports, and a
linker for each architecture (Debian's binutils-x86-64-linux-gnu and binutils-aarch64-linux-gnu).
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import click
from rich.progress import track

from penumbra.shared.native import KERNELS
from penumbra.shared.native.machine import FOLDER

ROOT = Path(__file__).parents[3]
FLOORS = ("penumbra/shared", "penumbra/sim", "penumbra/services")
MANIFEST = "manifest.json"
AGAIN = "run python -m penumbra.shared.native.build"
_LINK = ["-shared", "--strip-all", "--build-id=none", "--hash-style=gnu", "-znoexecstack", "-zrelro", "-znow"]


def import_kernels() -> None:
    """Imports all modules that define kernels."""
    for floor in FLOORS:
        for path in sorted((ROOT / floor).rglob("*.py")):
            if "\n@kernel(" in path.read_text():
                importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def build(folder: Path) -> dict[str, Any]:
    """Builds all libraries in a folder, and returns the manifest."""
    from penumbra.shared.native.compiler import TARGETS, compiled, lower

    kernels = [KERNELS[name] for name in sorted(KERNELS)]
    lowered = [lower(each) for each in track(kernels, "numba", disable=not sys.stderr.isatty())]
    libraries = {}
    for name, target in TARGETS.items():
        library = folder / f"{name}.so"
        link(compiled(kernels, target, lowered), target.triple.split("-")[0], library)
        libraries[library.name] = hashlib.sha256(library.read_bytes()).hexdigest()
    return {"versions": versions(), "libraries": libraries, "kernels": {each.name: each.fingerprint for each in kernels}}


def link(code: bytes, architecture: str, library: Path) -> None:
    """Links an object file into a shared library, without other libraries: every Python has the functions of libc and libm it
    needs."""
    with tempfile.NamedTemporaryFile(suffix=".o") as file:
        file.write(code)
        file.flush()
        subprocess.run([_linker(architecture), *_LINK, "-o", library, file.name], check=True)


def versions() -> dict[str, str]:
    """Versions of the tools that determine the libraries' bytes, beside the sources."""
    from penumbra.shared.native.compiler import VERSIONS

    linker = subprocess.run([_linker("x86_64"), "--version"], check=True, capture_output=True, text=True).stdout.splitlines()[0]
    return {"python": ".".join(platform.python_version_tuple()[:2]), **VERSIONS, "linker": linker}


def _linker(architecture: str) -> str:
    return f"{architecture}-linux-gnu-ld"


@click.command(help=__doc__, context_settings={"max_content_width": 100})
@click.option("--check", is_flag=True, help="build, and compare with what is there")
def main(check: bool) -> int:
    """Returns 1 where `check` finds a difference."""
    if os.environ.get("PYTHONHASHSEED") != "0":  # the order of sets decides on the order of some instructions
        command = [sys.executable, "-m", "penumbra.shared.native.build", *sys.argv[1:]]
        os.execve(sys.executable, command, {**os.environ, "PYTHONHASHSEED": "0"})
    import_kernels()
    with tempfile.TemporaryDirectory() as folder:
        manifest = build(Path(folder) if check else FOLDER)
    text = json.dumps(manifest, indent=2) + "\n"
    if not check:
        (FOLDER / MANIFEST).write_text(text)
        print(f"{len(manifest['kernels'])} kernels for {', '.join(manifest['libraries'])} in {FOLDER}")
    elif (FOLDER / MANIFEST).read_text() != text:
        print(f"{FOLDER / MANIFEST}: expected\n{text}\nfrom the sources and compilers here; {AGAIN}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(standalone_mode=False))
