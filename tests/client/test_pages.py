"""What the pages about the client show works as it stands there."""

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import penumbra
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.tests.support.live import PATIENCE_S, wait_for
from penumbra.tests.support.small import small

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("call", "function"),
    [("penumbra.connect", penumbra.connect), ("cell.poses", penumbra.Cell.poses), ("cell.pose", penumbra.Cell.pose)],
)
def test_the_page_shows_the_signature_that_a_function_has(call, function):
    parameters = [each for each in inspect.signature(function).parameters.values() if each.name != "self"]
    signature = inspect.Signature([each.replace(annotation=inspect.Parameter.empty) for each in parameters])
    assert f"`{call}{signature}`" in (ROOT / "docs" / "python.md").read_text()


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.S)


def run(code: str, router: str) -> subprocess.Popen:
    code = code.replace("tcp/127.0.0.1:7447", router)
    environment = {**os.environ, "PENUMBRA_CONNECT": router}
    return subprocess.Popen([sys.executable, "-u", "-c", code], env=environment, stdout=subprocess.PIPE, text=True)


def said(code: str, router: str) -> str:
    return run(code, router).communicate(timeout=PATIENCE_S)[0]


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_the_first_program_on_a_page_prints_poses(router, page):
    code = next(code for code in blocks(page, "python") if "penumbra.connect()" in code)
    with small("table", router) as chain, chain.fusion():
        process = run(code, router)
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("lost ")
        finally:
            process.kill()
            process.wait()


def test_the_program_without_the_client_prints_the_pose_or_why_there_is_none(router):
    (code,) = (code for code in blocks("docs/python.md", "python") if "import zenoh" in code)
    with small("table", router) as chain:
        assert said(code, router).startswith("nobody answers")
        with chain.fusion():
            asked = lambda: (out := said(code, router)).startswith("{'target': 'forearm'") and out  # noqa: E731
            assert "'state': 'lost'" in wait_for(asked, 30, "the pose")
            assert said(code.replace("format=json", "format=xml"), router).startswith("refused: ")


def test_the_cell_file_of_an_own_camera_loads_and_its_camera_sees_the_arms_home(tmp_path):
    (text,) = blocks("docs/own-camera.md", "yaml")
    (tmp_path / "mine.yaml").write_text(text)
    cell = cells.load(tmp_path / "mine.yaml")
    assert cell.sim is None
    camera = cell.cameras["front"]
    home = rigid.apply(rigid.inverse(camera.T_world_camera), cell.targets["forearm"].home.transform[:3, 3])
    u, v = (camera.K @ home)[:2] / home[2]
    assert home[2] > 0 and 0 < u < camera.width and 0 < v < camera.height


def test_the_camera_s_rpy_is_what_the_page_computes_from_its_rotation():
    R = Rotation.from_rotvec([0.4, -1.2, 0.7])
    np.testing.assert_allclose(rigid.from_rpy((0, 0, 0), R.as_euler("xyz"))[:3, :3], R.as_matrix(), atol=1e-12)
