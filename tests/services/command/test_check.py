"""`penumbra check`: broken cell files are refused before a process starts, each with file, line and what to do."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from penumbra.services.command import check, cli
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells

BUILT_IN = {name: (cells.BUILT_IN / f"{name}.yaml").read_text() for name in ("table", "arm")}
LOOK = "    look_at: [0.05, 0.0, 0.15]\n"
P3 = "  p3: {type: five, position: [0.12, -0.04, 0.0]}\n"
_TABLE, _ARM = BUILT_IN["table"], BUILT_IN["arm"]
NO_PADS = _TABLE[_TABLE.index("pad_types:") : _TABLE.index("    size: {")]
MESH = "targets:\n  forearm:\n    mesh: {}.stl\n"
BOUNDS = _ARM[_ARM.index("    joints:") : _ARM.index("  table: [")]
DISC = "{disc: 0.0151, centre: [0.00018, 0.00001], "

# (cell, what is replaced, by what, text on the line that is reported, words of the reason)
BROKEN = {
    "a pad twice": ("table", "  p1: {", "  p0: {", "  p0: {type: five, position: [-0.04", "each key once, got p0 again (line 33"),
    "cameras again": ("table", "targets:\n", "cameras: {}\ntargets:\n", "cameras: {}", "each key once, got cameras again"),
    "a key mistyped": ("table", "width:", "widht:", "widht:", "got widht; did you mean width"),
    "a key too many": ("table", "    rate_hz: 20\n", "    rate_hz: 20\n    colour: 3\n", "colour", "got colour; remove it"),
    "a key that is ours": ("table", "frame: world", "folder: /tmp", "folder:", "expected no such key, got folder"),
    "a key missing": ("table", "    fx: 554.26\n", "", "  front:", "add `fx:` (focal length along the columns [px])"),
    "a tab": ("table", "    height", "\theight", "\theight", "got a tab; indent with spaces"),
    "two colons": ("table", "name: table", "name: ta: ble", "name: ta", "put a text with a colon in quotes"),
    "an open bracket": ("table", "0.0, 0.15]", "0.0, 0.15", "pad_types:", "close the bracket"),
    "an indentation": ("table", "    height: 480", "   height: 480", "   height", "indentation of the keys before"),
    "two documents": ("table", "frame: world", "---\nframe: world", "---", "another after a line `---`; remove that line"),
    "a number in words": ("table", "width: 640", "width: wide", "width:", "expected a whole number, got 'wide'"),
    "half a pixel": ("table", "width: 640", "width: 640.5", "width:", "expected a whole number, got 640.5"),
    "a boolean": ("table", "rate_hz: 20", "rate_hz: yes", "rate_hz:", "expected a number, got true"),
    "no rate": ("table", "rate_hz: 20", "rate_hz: 0", "rate_hz:", "expected a number above 0, got 0 (pictures per second [Hz])"),
    "a huge rate": ("table", "rate_hz: 20", "rate_hz: 1e+6", "rate_hz:", "expected a number of at most 1000"),
    "a NaN": ("table", "cx: 319.5", "cx: .nan", "cx:", "expected a finite number, got nan"),
    "a pose with infinity": ("table", "[0.35, -1.15, 0.90]", "[0.35, -.inf, 0.90]", "position: [0.35", "finite number, got -inf"),
    "two coordinates": ("table", "[0.35, -1.15, 0.90]", "[0.35, -1.15]", "position: [0.35", "3 numbers, got a list of 2"),
    "four coordinates": ("table", "[0.35, -1.15, 0.90]", "[0.35, -1.15, 0.9, 1]", "position: [0.35", "expected 3 numbers, got 4"),
    "principal point": ("table", "cx: 319.5", "cx: 9999", "cx:", "principal point in the picture, from 0 to 639, got 9999"),
    "fx and cx swapped": ("table", "fx: 554.26", "fx: 319.5", "fx:", "check that fx is not swapped with cx"),
    "focal length in mm": ("table", "fx: 554.26", "fx: 4.2", "fx:", "in millimetres or for another image size"),
    "fisheye": ("table", LOOK, LOOK + "    fisheye: [0.1]\n", "fisheye", "undistort the pictures with cv2.fisheye"),
    "rational model": ("table", LOOK, LOOK + "    k4: 0.1\n", "k4", "thin-prism and tilted models are not supported"),
    "vector of distortion": ("table", LOOK, LOOK + "    D: [0, 0]\n", "    D:", "one by one, k1 k2 p1 p2 k3"),
    "folding distortion": ("table", LOOK, LOOK + "    k1: -6\n", "k1", "a distortion that fills the picture"),
    "looks at itself": ("table", "look_at: [0.05, 0.0, 0.15]", "look_at: [0.35, -1.15, 0.9]", "look_at", "got its own position"),
    "no direction": ("table", LOOK, "", "  front:", "expected either look_at or rpy, got neither"),
    "degrees": ("table", LOOK, "    rpy: [-90, 0, 0]\n", "rpy: [-90", "[rad]; either this or look_at); give radians"),
    "a source of another kind": (
        "table", LOOK, LOOK + "    source: {url: 'http://192.0.2.1/film'}\n", "source:", "expected v4l2:/dev/video0, rtsp://HOST/PATH"
    ),
    "a source mistyped": ("table", LOOK, LOOK + "    source: {url: 'flie:a.mp4'}\n", "source:", "did you mean file"),
    "a source in a word": ("table", LOOK, LOOK + "    source: file:a.mp4\n", "source:", "'file:a.mp4'; write {url: file:a.mp4}"),
    "an adapter without a class": (
        "table", LOOK, LOOK + "    source: {url: 'adapter:my_camera'}\n", "source:", "as in adapter:my_camera:Camera"
    ),
    "a camera in a loop": (
        "table", LOOK, LOOK + "    source: {url: 'v4l2:/dev/video', loop: true}\n", "source:", "or folder: only, got it with"
    ),
    "a film's clock": (
        "table", LOOK, LOOK + "    source: {url: 'file:a.mp4', synchronised: true}\n", "source:", "expected it with rtsp: only"
    ),
    "unknown design": ("table", "p3: {type: five", "p3: {type: six", "  p3:", "expected one of five, got 'six'"),
    "pads in one place": ("table", P3, P3.replace("0.12", "0.04"), "  p3:", "expected a place of its own, got that of p2"),
    "no such electrode": (
        "table", P3, P3.replace("0.0]}", "0.0], boards: [{channels: {x: [0]}}]}"), "  p3:", "electrodes c, r, l, t, b, got 'x'",
    ),
    "negative noise": ("table", "noise: 6.2e-6", "noise: -1", "rest:", "expected a number of at least 0, got -1"),
    "disc and arc": ("table", DISC, DISC + "arc: [0.01, 0.02], ", "      c: {", "expected either disc (a radius) or arc"),
    "board in mm": ("table", "size: [0.061, 0.060]", "size: [61, 60]", "board:", "expected a number of at most 1, got 61"),
    "unknown body": ("table", "body:forearm", "body:leg", "mesh:", "expected body:forearm, or a mesh file beside the cell file"),
    "no mesh": ("table", "body:forearm", "arm.stl", "mesh:", "got no file"),
    "a mesh in mm": ("table", "body:forearm", "mm.stl", "mesh:", "if its unit is mm, scale it by 0.001"),
    "a mesh in km": ("table", "body:forearm", "km.stl", "mesh:", "got 0.00046 m"),
    "an empty mesh": ("table", "body:forearm", "empty.obj", "mesh:", "export it"),
    "a garbage mesh": ("table", "body:forearm", "garbage.stl", "mesh:", "export it again"),
    "no field model": ("table", "body:forearm", "limb.stl", "  p0:", "fit it once with `penumbra skin model --cell"),
    "unknown class": ("table", "[forearm, hand]", "[forearm, hnad]", "labels:", "got 'hnad'; did you mean hand"),
    "bounds exchanged": ("table", "low: [-0.08", "low: [0.5", "    low:", "lower bounds that do not exceed high"),
    "no target": ("table", BUILT_IN["table"][BUILT_IN["table"].index("targets:") :], "targets: {}\n", "targets:", "got 0"),
    "no URDF": ("arm", "panda/panda.urdf", "ur5.urdf", "urdf:", "give a URDF beside the cell file"),
    "a cyclic URDF": ("arm", "panda/panda.urdf", "cyclic.urdf", "urdf:", "got a cycle"),
    "a URDF without meshes": ("arm", "panda/panda.urdf", "lone.urdf", "urdf:", "none.obj of a mesh"),
    "a xacro": ("arm", "panda/panda.urdf", "arm.xacro", "urdf:", "convert it with `xacro"),
    "unknown joint": ("arm", "panda_joint7]", "elbow]", "joints:", "no moving joint elbow"),
    "few bounds": ("arm", "1.70, 0.485]", "1.70]", "joints_low:", "expected 7 values, one for each joint"),
    "a bound beyond the limits": ("arm", "2.10, 1.085]", "9.10, 1.085]", "joints_high:", "panda_joint6 within its limits"),
    "a pad moved on its robot": ("arm", "-1.756]", "-1.7]", "  p2:", "field model of the pads p2 for target forearm, got none"),
    "no such link": ("arm", "panda/panda_hand", "panda/thumb", "  p0:", "robot panda has no link 'thumb'"),
    "backed by the world": ("arm", "link: panda/panda_hand, ", "", "  p0:", "leave backed out"),
    "no room over the table": (
        "table", BUILT_IN["table"][BUILT_IN["table"].index("    low:") : BUILT_IN["table"].index("    rpy_low:")],
        "    low: [-0.08, -0.06, -0.3]\n    high: [0.08, 0.06, 0.0]\n",
        "  motion:", "keeps the person clear of robot, pads and table, got none",
    ),
    "a region in the robot": (
        "arm", "low: [-0.06, -0.32, 0.50]\n    high: [0.14, -0.06, 0.74]", "low: [0.49, 0.09, 0.1]\n    high: [0.51, 0.11, 0.3]",
        "  motion:", "move or widen the region",
    ),
    "a second person in the floor": (
        "table", "\nsim:\n",
        "\n  other:\n    mesh: body:forearm\n    labels: [hand]\n    home: {position: [0.0, 2.0, -0.5]}\nsim:\n",
        "    home: {position: [0.0, 2.0", "keeps the person clear",
    ),
    "a slow person": ("table", "speed: 0.25", "speed: 1.0e-9", "    speed:", "expected a number of at least 0.01"),
    "a long name": ("table", "  forearm:\n", f"  {300 * 'f'}:\n", "fff", "at most 64 letters"),
    "a picture too large": (
        "table", "width: 640\n    height: 480\n    fx: 554.26\n    fy: 554.26\n    cx: 319.5\n    cy: 239.5",
        "width: 6400\n    height: 4800\n    fx: 5542\n    fy: 5542\n    cx: 3199\n    cy: 2399",
        "width:", "which is what a message may carry, got 30720000",
    ),
    "a load of nobody": ("arm", "  table: [", "  payloads: {ur5: {mass: 1, link: tip}}\n  table: [", "payloads", "one of panda"),
}  # fmt: skip
"""Broken cell files. Each is a built-in one with one change."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Files beside the cell files: meshes and URDFs, good ones and broken ones."""
    out = tmp_path_factory.mktemp("cells")
    mesh = anatomy.forearm_mesh(cells.Body())
    for name, scale in (("limb", 1.0), ("mm", 1e3), ("km", 1e-3)):
        trimesh.Trimesh(scale * mesh.vertices, mesh.faces).export(out / f"{name}.stl")
    (out / "empty.obj").write_text("v 0 0 0\n")
    (out / "garbage.stl").write_text("no mesh")
    link = '<link name="{0}"><collision><geometry><mesh filename="none.obj"/></geometry></collision></link>'
    turned = mesh.vertices[:, [1, 2, 0]]  # no mirror image: the surface stays outside
    for name, vertices, faces in (
        ("upright", turned, mesh.faces),
        ("beside", mesh.vertices + np.array([0.0, 0.0, 0.5]), mesh.faces),
        ("inverted", mesh.vertices, mesh.faces[:, ::-1]),
    ):
        trimesh.Trimesh(vertices, faces, process=False).export(out / f"{name}.stl")
    drawn = (cells.BUILT_IN / "panda" / "panda.urdf").read_text().replace("meshes/", f"{cells.BUILT_IN}/panda/meshes/")
    shape = "<visual><geometry><sphere radius='0.1'/></geometry></visual>"
    (out / "drawn.urdf").write_text(drawn.replace("</robot>", f"<link name='tool'>{shape}</link><joint name='end' type='fixed'>"
                                    "<parent link='panda_hand'/><child link='tool'/></joint></robot>"))  # fmt: skip
    (out / "arm.xacro").write_text('<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>')
    (out / "lone.urdf").write_text(f'<robot name="lone">{link.format("base")}</robot>')
    joint = '<joint name="{0}{1}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
    joints = "".join(joint.format(*pair) for pair in ("bc", "cb"))
    (out / "cyclic.urdf").write_text(f'<robot name="odd"><link name="a"/><link name="b"/><link name="c"/>{joints}</robot>')
    return out


def broken(folder: Path, what: str) -> Path:
    cell, old, new, _, _ = BROKEN[what]
    assert BUILT_IN[cell].count(old) >= 1
    path = folder / "mine.yaml"
    path.write_text(BUILT_IN[cell].replace(old, new, 1))
    return path


def run(capsys, *argv: str) -> tuple[int, str]:
    code = cli.main(["check", *argv])
    return code, capsys.readouterr().out


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_cell_is_refused_with_file_and_line(what, folder, capsys):
    path = broken(folder, what)
    *_, shown, words = BROKEN[what]
    code, out = run(capsys, str(path))
    assert code == 1
    first = out.splitlines()[0]
    lines = path.read_text().splitlines()
    assert first.startswith(f"{path}:"), first
    line = int(first.removeprefix(f"{path}:").partition(":")[0])
    assert shown in lines[line - 1], (line, lines[line - 1], first)
    assert words in out
    for foreign in ("permitted", "<unicode", "Input should", "pydantic", "yaml.", "charset"):
        assert foreign not in out


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_built_in_cell_has_neither_faults_nor_warnings(name, capsys):
    code, out = run(capsys, name, "--json")
    assert code == 0
    assert json.loads(out) == {"file": str(cells.source(name)), "is_good": True, "faults": [], "warnings": []}


def test_several_faults_are_reported_at_once_in_the_order_of_their_lines(folder, capsys):
    text = BUILT_IN["table"].replace("width: 640", "width: wide").replace("rate_hz: 20", "rate_hz: no").replace("p7:", "p6:")
    path = folder / "three.yaml"
    path.write_text(text.replace("speed: 0.25", "speed: .inf"))
    code, out = run(capsys, str(path), "--json")
    found = json.loads(out)
    assert code == 1 and not found["is_good"]
    assert [fault["place"] for fault in found["faults"]] == [
        "cameras.front.width",
        "cameras.front.rate_hz",
        "pads.p6",
        "sim.motion.speed",
    ]
    assert all(fault["file"] == str(path) and fault["line"] for fault in found["faults"])


def test_an_unknown_cell_is_answered_with_those_there_are(capsys):
    assert cli.main(["check", "kitchen"]) == 2
    assert "give one of arm, table" in capsys.readouterr().err


WARNINGS = {
    "a renamed cell": ("table", "name: table", "name: mine", "name:", "train it with `penumbra haptics train --cell"),
    "a camera that looks away": ("table", "look_at: [0.05, 0.0, 0.15]", "look_at: [0.35, -5, 0.9]", "look_at", "sees none"),
    "a camera that looks beside": ("table", "look_at: [0.05, 0.0, 0.15]", "look_at: [0.8, 0, 0.15]", "look_at", "sees most"),
    "a film elsewhere": ("table", LOOK, LOOK + "    source: {url: 'file:a.mp4'}\n", "source:", "got nothing at"),
    "an adapter elsewhere": (
        "table", LOOK, LOOK + "    source: {url: 'adapter:my_camera:Camera'}\n", "source:", "expected the module my_camera beside"
    ),
    "a pad far away": ("table", P3, P3.replace("0.12", "3.0"), "  p3:", "nothing can reach it"),
    "a pad turned over": ("table", P3, P3.replace("0.0]}", "0.0], rpy: [3.1416, 0, 0]}"), "  p3:", "points away from it"),
    "a home elsewhere": ("table", "position: [0.0, 0.0, 0.20]", "position: [0.0, 0.0, 2.0]", "home:", "in or near sim.motion"),
    "a camera in mm": (
        "table", "[0.35, -1.15, 0.90]", "[350, -1150, 900]", "position: [350", "0.17 px for forearm, 1.5e+03 m away; give metres",
    ),
    "an arm upright": ("table", NO_PADS, MESH.format("upright"), "mesh:", "x axis, got its longest side along z"),
    "an arm beside its origin": ("table", NO_PADS, MESH.format("beside"), "mesh:", "got it 0.45 m beside it"),
    "an arm inside out": ("table", NO_PADS, MESH.format("inverted"), "mesh:", "got a surface that is inside out"),
    "a shoulder far away": ("table", "    labels:", "    shoulder: [0, 0, 3]\n    labels:", "shoulder:", "at home, got 2.8 m"),
    "another arm in reach": (
        "table", "\nsim:\n",
        "\n  other:\n    mesh: body:forearm\n    labels: [hand]\n    home: {position: [0.0, 0.4, 0.25]}\nsim:\n",
        "    home: {position: [0.0, 0.4", "at least 0.5 m apart, got 0.4 m from forearm; both may follow the same arm",
    ),
    "a link that hides nothing": ("arm", "panda/panda.urdf", "drawn.urdf", "urdf:", "got none of tool"),
    "a joint that nobody measures": (
        "arm", BOUNDS, BOUNDS.replace("panda_joint2, ", "").replace(", -0.20, -0.15", ", -0.15").replace(" 0.00, 0.15", " 0.15"),
        "    joints:", "got none of panda_joint2; add them",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WARNINGS)
def test_what_a_process_can_start_with_is_a_warning(what, folder, capsys):
    cell, old, new, shown, words = WARNINGS[what]
    assert old in BUILT_IN[cell]
    path = folder / "odd.yaml"
    path.write_text(BUILT_IN[cell].replace(old, new, 1))
    code, out = run(capsys, str(path))
    assert code == 0
    warning = next(line for line in out.splitlines() if words in line)
    line = int(warning.removeprefix(f"warning: {path}:").partition(":")[0])
    assert shown in path.read_text().splitlines()[line - 1]


def test_a_mesh_with_too_many_triangles_is_simplified_and_one_with_holes_is_reported(folder, capsys):
    fine = trimesh.creation.capsule(radius=0.04, height=0.25, count=[300, 300])
    turned = fine.vertices[:, [2, 0, 1]]
    trimesh.Trimesh(turned, fine.faces[:-40], process=False).export(folder / "fine.ply")
    path = folder / "fine.yaml"
    path.write_text(BUILT_IN["table"].replace("body:forearm", "fine.ply"))
    found = [fault for fault in check.examine(path)[1] if fault.place == "targets.forearm.mesh"]
    assert all(fault.is_warning for fault in found)
    assert any("at most 4000 triangles" in fault.reason for fault in found)
    assert any("expected a closed surface" in fault.reason for fault in found)
    cell = cells.load(path)
    mesh = anatomy.target_mesh(cell.targets["forearm"], cell)
    assert 1000 < len(mesh.faces) <= 4100
    assert mesh.vertices.min(axis=0) == pytest.approx(turned.min(axis=0), abs=1e-3)
    assert mesh.vertices.max(axis=0) == pytest.approx(turned.max(axis=0), abs=1e-3)


def test_the_check_takes_no_longer_than_a_few_of_its_imports():
    """1.7 times as long where it was written; a grid over all poses would be minutes."""
    code = (
        "import time; from penumbra.services.command import check, cli; imported = time.process_time();"
        "cli.main(['check', 'arm']); print((time.process_time() - imported) / imported)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(out.splitlines()[-1]) < 2.5


def test_up_starts_nothing_with_a_broken_cell(folder):
    path = broken(folder, "a garbage mesh")
    command = [sys.executable, "-m", "penumbra", "up", "--cell", str(path), "--seconds", "60"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, env={**os.environ, "PENUMBRA_CONNECT": ""})
    assert ended.returncode == 2
    assert f"penumbra up: {path}:" in ended.stderr and "garbage.stl" in ended.stderr
    assert "started" not in ended.stdout


def test_no_python_is_needed_to_copy_a_built_in_cell_with_its_robot(tmp_path, capsys):
    """A copy beside nothing else still finds the built-in robot."""
    shutil.copy(cells.BUILT_IN / "arm.yaml", tmp_path / "copy.yaml")
    assert run(capsys, str(tmp_path / "copy.yaml"))[0] == 0
