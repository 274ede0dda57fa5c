"""What `import penumbra` loads, and what it offers."""

import json
import subprocess
import sys
import typing

import pytest

import penumbra

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


def test_only_async_programs_load_asyncio():
    assert "asyncio" not in modules_after("import penumbra; penumbra.connect, penumbra.Pose, penumbra.Poses")


def test_every_name_is_there_for_programs_editors_and_type_checkers():
    assert set(penumbra.__all__) <= set(dir(penumbra))
    for name in penumbra.__all__:
        assert getattr(penumbra, name) is not None
    assert typing.get_args(penumbra.State) == ("tracking", "coasting", "lost")
    with pytest.raises(AttributeError, match="no attribute 'conect'"):
        _ = penumbra.conect
