"""The rules of the house, as tests."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SCIPY = {"scipy.linalg", "scipy.special"}
"""What any of it brings along."""


def test_the_floors_import_only_downwards_and_services_do_not_know_each_other():
    result = subprocess.run(["lint-imports"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


LEARNING = {
    "haptics/shapes.py",
    "haptics/train.py",
    "skin/bearer.py",
    "skin/model.py",
    "skin/calibration/characterise.py",
    "skin/placing/shading.py",
    "command/check.py",
}
"""Commands that use the simulated world outside a folder `training`; without a real pad, one is characterised in it, what the
emulator could not start with is found by its own code, and a link's shading is computed from its field."""


def test_only_the_emulator_and_what_learns_know_the_simulated_world():
    for path in ROOT.glob("services/**/*.py"):
        imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
        names |= {node.module for node in imports if isinstance(node, ast.ImportFrom) and node.module}
        if any(name.startswith("penumbra.sim") for name in names):
            place = path.relative_to(ROOT / "services")
            assert place.parts[0] == "emulator" or "training" in place.parts or place.as_posix() in LEARNING, path


def test_only_the_robots_bodies_know_pybullet():
    """It prints when it is imported, and has wheels up to CPython 3.11 only: whatever imports it must be able to do without."""
    knowing = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("s*/**/*.py") if "import pybullet" in path.read_text()}
    assert knowing == {"sim/world/dynamics.py"}


@pytest.mark.parametrize(
    ("service", "heavy"),
    [
        ("fusion", {"numba", "torch", "cv2", "pybullet", "trimesh", *SCIPY}),
        ("haptics", {"numba", "torch", "cv2", "pybullet", "trimesh", *SCIPY}),
        ("search", {"numba", "torch", "pybullet", "trimesh", *SCIPY}),
        ("segmentation", {"numba", "torch", "pybullet", "trimesh", *SCIPY}),
        ("posecnn", {"numba", "openvino", "pybullet", "trimesh", *SCIPY}),
        ("emulator", {"numba", "torch", "pybullet", "trimesh", *SCIPY}),
        ("camera", {"numba", "torch", "openvino", "pybullet", "trimesh", *SCIPY}),
        ("ros2", {"numba", "torch", "pybullet", "trimesh", *SCIPY}),
        ("skin", {"torch", "numba", "pybullet", "trimesh", *SCIPY}),
        ("robot", {"torch", "numba", "cv2", "pybullet", "trimesh", *SCIPY}),
        ("dashboard", {"aiohttp", "cv2", "torch", "numba", "pybullet", "trimesh", *SCIPY}),
        ("router", {"torch", "numba", "pybullet", "trimesh", *SCIPY}),
    ],
)
def test_a_service_imports_only_what_it_needs_to_start(service, heavy):
    code = f"import sys, json, penumbra.services.{service}.service; print(json.dumps(list(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not heavy & set(json.loads(out.splitlines()[-1]))


def test_every_package_says_in_its_init_what_it_is_for():
    folders = [Path("shared"), Path("sim"), Path("services")]
    for folder in (*folders, *(p.parent.relative_to(ROOT) for p in (ROOT / "services").glob("*/__init__.py"))):
        text = (ROOT / folder / "__init__.py").read_text()
        assert text.startswith('"""'), f"{folder}/__init__.py has no docstring"


def test_a_container_has_no_rights_and_only_one_with_a_published_port_has_a_way_out():
    compose = yaml.safe_load((ROOT / "compose.yaml").read_text())
    isolated = {name for name, network in compose["networks"].items() if network and network.get("internal")}
    for name, service in compose["services"].items():
        assert service["read_only"] and service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert set(service["networks"]) <= isolated or "ports" in service, name
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", [])), name


def test_every_weight_file_has_a_card_with_its_seed_and_held_out_score():
    weights = [p for p in ROOT.glob("services/*/weights/*") if p.suffix in {".npz", ".pt"}]
    assert weights
    for path in weights:
        text = path.with_suffix(".json").read_text()
        assert {"date", "held_out"} <= json.loads(text).keys(), path.name
        assert '"seed"' in text, path.name
