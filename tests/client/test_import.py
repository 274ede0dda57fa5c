"""What `import penumbra` loads, and what it offers."""

import json
import shutil
import subprocess
import sys
import typing
import zipfile
from pathlib import Path

import pytest

import penumbra

ROOT = Path(__file__).parents[2]
HEAVY = {"torch", "numba", "cv2", "pybullet", "trimesh", "scipy", "openvino", "pydantic", "yaml", "rich"}


def modules_after(code: str) -> set[str]:
    command = [sys.executable, "-c", f"{code}\nimport json, sys; print(json.dumps(list(sys.modules)))"]
    return set(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))


def test_the_package_alone_loads_nothing_of_ours_and_a_service_s_imports_no_client():
    assert not {name for name in modules_after("import penumbra") if name.startswith("penumbra.")}
    loaded = modules_after("import penumbra.shared.runtime.node, penumbra.services.fusion.service")
    assert not {name for name in loaded if name.startswith("penumbra.client")}


def test_the_whole_client_needs_no_library_of_the_services():
    loaded = modules_after("from penumbra import *")
    assert "penumbra.client.aio" in loaded
    assert not HEAVY & loaded


def test_an_editable_installation_is_found_beside_a_clone_that_is_named_penumbra(tmp_path):
    """There the clone's own folder is found first, and would be a package without content."""
    clone, site = tmp_path / "penumbra", tmp_path / "site"
    clone.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "services", "shared", "sim", "tests"):
        (clone / name).symlink_to(ROOT / name)
    for name in ("src", "penumbra"):
        shutil.copytree(ROOT / name, clone / name, symlinks=True, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    build = f"from setuptools import build_meta; build_meta.build_editable({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=clone, capture_output=True, check=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(site)
    program = f"import site; site.addsitedir({str(site)!r}); import penumbra; print(penumbra.__file__)"
    command = [sys.executable, "-E", "-S", "-c", program]  # no other installation is found
    out = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert out == f"{clone / 'src' / 'penumbra' / '__init__.py'}\n"


def test_only_async_programs_load_asyncio():
    assert "asyncio" not in modules_after("import penumbra; penumbra.connect, penumbra.Pose, penumbra.Poses")


def test_every_name_is_there_for_programs_editors_and_type_checkers():
    assert set(penumbra.__all__) <= set(dir(penumbra))
    for name in penumbra.__all__:
        assert getattr(penumbra, name) is not None
    assert typing.get_args(penumbra.State) == ("tracking", "coasting", "lost")
    with pytest.raises(AttributeError, match="no attribute 'conect'"):
        _ = penumbra.conect
