"""`penumbra calibrate camera` and `hand-eye` as a person uses them: from a folder or a running cell into the cell file."""

import csv
import json

import cv2
import numpy as np
import pytest

from penumbra.services.calibrate import live, views
from penumbra.services.command import cli
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Frame, Joints
from penumbra.shared.geometry import rigid
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.charuco import LENS, MOUNT, held

CELL = """\
# my cell
name: mine
cameras:
  front:                      # a webcam on a tripod
    width: 640
    height: 480
    fx: 554.26                # from the data sheet
    fy: 554.26
    cx: 319.5
    cy: 239.5
    position: [1.0, -0.5, 0.8]
    look_at: [0.4, 0.0, 0.4]  # about
robots:
  panda: {urdf: panda/panda.urdf, base: {position: [0.1, 0.0, 0.0], rpy: [0.0, 0.0, 0.2]},
          joints: [panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5, panda_joint6, panda_joint7]}
targets:
  forearm: {mesh: "body:forearm", labels: [forearm, hand], home: {position: [0.0, 0.0, 0.2]}}
"""
NEUTRAL = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.9, 0.8])
LENS_LINES = {"fx: 554.26  ": f"fx: {LENS.fx}  ", "fy: 554.26": f"fy: {LENS.fy}", "cx: 319.5": f"cx: {LENS.cx}"}


@pytest.fixture
def own_cell(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(CELL)
    return path


@pytest.fixture
def with_lens(own_cell):
    """The cell file with the lens that takes the pictures."""
    lens = f"    cy: {LENS.cy}\n" + "".join(f"    {name}: {getattr(LENS, name)}\n" for name in ("k1", "k2", "p1", "p2"))
    text = CELL.replace("    cy: 239.5\n", lens)
    for old, new in LENS_LINES.items():
        text = text.replace(old, new)
    own_cell.write_text(text)
    return own_cell


@pytest.fixture(scope="module")
def lens_pictures(photographer, tmp_path_factory):
    """A folder of fourteen pictures of a board in somebody's hand, and one of nothing."""
    folder = tmp_path_factory.mktemp("lens")
    rng = np.random.default_rng(0)
    for i, T in enumerate(held(photographer.board, 14, rng)):
        cv2.imwrite(str(folder / f"{i:02d}.png"), photographer.picture(T, rng))
    cv2.imwrite(str(folder / "nothing.png"), np.full((LENS.height, LENS.width), 90, np.uint8))
    return folder


@pytest.fixture(scope="module")
def posed(photographer, tmp_path_factory):
    """T_world_camera, and (joints, picture) of fourteen poses of the Panda with the board on its last link."""
    path = tmp_path_factory.mktemp("cell") / "mine.yaml"
    path.write_text(CELL)
    model = RobotModel(cells.load(path).robots["panda"])
    rng = np.random.default_rng(1)
    middle = np.array([*photographer.board.size, 0.0]) / 2.0
    T_world_board = model.link_transforms(NEUTRAL)["panda_link7"] @ MOUNT
    T_world_camera = T_world_board @ rigid.transform(middle + np.array([0.02, -0.03, -0.9]))
    T_world_camera = rigid.perturb(T_world_camera, [0.0, 0.0, 0.0, 0.05, -0.1, 0.02])
    out: list[tuple[np.ndarray, np.ndarray]] = []
    while len(out) < 14:
        q = NEUTRAL + rng.uniform(-0.3, 0.3, 7)
        T = rigid.inverse(T_world_camera) @ model.link_transforms(q)["panda_link7"] @ MOUNT
        if photographer.corners("", T, rng) is not None:
            picture = photographer.picture(T, rng)
            if photographer.board.find(picture) is not None:
                out.append((q + 2e-4 * rng.standard_normal(7), picture))
    return T_world_camera, out


def write_poses(folder, poses, order=range(7), scale=1.0):
    """Pictures and joints.csv, with the columns in an order of their own."""
    folder.mkdir()
    with (folder / "joints.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*(f"panda_joint{1 + k}" for k in order), "picture"])
        for i, (q, picture) in enumerate(poses):
            cv2.imwrite(str(folder / f"{i:02d}.png"), picture)
            writer.writerow([*(scale * q[k] for k in order), f"{i:02d}.png"])
    return folder


def changed(before, after):
    """The lines that are gone and those that are new."""
    old, new = before.splitlines(), after.splitlines()
    return [line for line in old if line not in new], [line for line in new if line not in old]


def test_a_folder_of_pictures_gives_the_lens_and_the_cell_file_keeps_its_comments(own_cell, lens_pictures, capsys):
    command = ["calibrate", "camera", "--cell", str(own_cell), "--pictures", str(lens_pictures)]
    assert cli.main([*command, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert own_cell.read_text() == CELL
    assert "-    cx: 319.5" in shown and "+    k1: -0.2" in shown
    assert "the board is not found in 1 pictures: nothing.png" in shown
    assert cli.main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    gone, new = changed(CELL, own_cell.read_text())
    assert [line.split(":")[0].strip() for line in gone] == ["fx", "fy", "cx", "cy"]
    assert [line.split(":")[0].strip() for line in new] == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert new[0].endswith("  # from the data sheet")
    lens = cells.load(own_cell).cameras["front"].lens
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert abs(getattr(lens, name) - getattr(LENS, name)) < 4 * found[name]["deviation"], name
    before = own_cell.read_text()
    assert cli.main([*command, "--dry-run"]) == 0
    assert "nothing changes" in capsys.readouterr().out and own_cell.read_text() == before


def test_a_folder_of_poses_gives_the_cameras_place_whatever_the_order_of_the_joints(with_lens, posed, tmp_path, capsys):
    T_world_camera, poses = posed
    folder = write_poses(tmp_path / "poses", poses, order=[6, 0, 2, 1, 3, 5, 4])
    before = with_lens.read_text()
    assert cli.main(["calibrate", "hand-eye", "--cell", str(with_lens), "--pictures", str(folder), "--json"]) == 0
    out = capsys.readouterr()
    found = json.loads(out.out)
    gone, new = changed(before, with_lens.read_text())
    assert [line.split(":")[0].strip() for line in gone] == ["position", "look_at"]
    assert [line.split(":")[0].strip() for line in new] == ["position", "rpy", "pose_spread"]
    assert new[1].endswith("  # about")
    camera = cells.load(with_lens).cameras["front"]
    error = rigid.pose_error(T_world_camera, camera.T_world_camera)
    assert np.abs(error / np.sqrt(np.diag(found["covariance"]))).max() < 4.0
    assert np.linalg.norm(error[:3]) < 2e-3 and np.linalg.norm(error[3:]) < np.radians(0.15)
    assert camera.pose_spread is not None and camera.pose_spread.position == pytest.approx(
        found["deviation"]["position"], abs=1e-6
    )
    mount = rigid.pose_error(MOUNT, np.array(found["T_link_board"]))
    assert np.linalg.norm(mount[:3]) < 2e-3
    assert len(found["leave_one_out"]) == 14 and "verdict: good" in out.err


def test_a_pose_with_the_joints_of_another_is_named(with_lens, posed, tmp_path, capsys):
    poses = list(posed[1])
    poses[3] = (poses[4][0], poses[3][1])
    folder = write_poses(tmp_path / "poses", poses, scale=np.degrees(1))
    command = ["calibrate", "hand-eye", "--cell", str(with_lens), "--pictures", str(folder), "--degrees", "--out"]
    assert cli.main([*command, str(tmp_path / "new.yaml")]) == 0
    assert "03.png is left out: it does not fit the others" in capsys.readouterr().out
    assert cells.load(tmp_path / "new.yaml").cameras["front"].pose_spread is not None


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (
            lambda folder: (folder / "joints.csv").unlink(),
            "expected a file of joint angles with the columns picture, panda_joint1",
        ),
        (
            lambda folder: edit_joints(folder, "panda_joint3", "elbow"),
            "panda_joint2,elbow,panda_joint4".replace(",", ", "),
        ),
        (lambda folder: edit_joints(folder, "02.png", "x.png"), "no joints of 1 pictures: 02.png"),
        (lambda folder: edit_joints(folder, "\n", "\n1.0,2.0\n", 1), "joints.csv:2: expected a number for every joint"),
        (lambda folder: cv2.imwrite(str(folder / "big.png"), np.zeros((600, 800), np.uint8)), "expected pictures of one size"),
        (lambda folder: (folder / "note.jpg").write_text("no picture"), "expected a picture, got something that OpenCV cannot"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(with_lens, posed, tmp_path, capsys, spoil, text):
    folder = write_poses(tmp_path / "poses", posed[1][:9])
    spoil(folder)
    before = with_lens.read_text()
    cli.main(["calibrate", "hand-eye", "--cell", str(with_lens), "--pictures", str(folder), "--dry-run"])
    out = capsys.readouterr()
    assert text in out.out + out.err
    assert with_lens.read_text() == before


def edit_joints(folder, old, new, count=-1):
    path = folder / "joints.csv"
    path.write_text(path.read_text().replace(old, new, count))


def test_angles_in_degrees_are_taken_for_what_they_are(with_lens, posed, tmp_path, capsys):
    folder = write_poses(tmp_path / "poses", posed[1][:9], scale=np.degrees(1))
    assert cli.main(["calibrate", "hand-eye", "--cell", str(with_lens), "--pictures", str(folder)]) == 2
    assert "beyond theirs; for degrees give --degrees" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["camera", "--pictures", "nowhere"], "nowhere: expected a folder of pictures"),
        (["camera", "--pictures", ".", "--save", "x"], "--save belongs to pictures of the running cell"),
        (["hand-eye", "--joints", "x.csv"], "--joints and --degrees belong to --pictures"),
        (["hand-eye", "--pictures", ".", "--link", "tip"], "--link: expected one of panda_link0, "),
        (["camera", "--camera", "back", "--pictures", "."], "no camera 'back'"),
        (["camera", "--cell", "table", "--pictures", "."], "the built-in cell table is not overwritten"),
        (["camera", "--connect", "tcp/127.0.0.1:9"], "no router"),
        (["cameras"], "did you mean camera?"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(own_cell, capsys, monkeypatch, arguments, text):
    monkeypatch.chdir(own_cell.parent)
    cell = [] if "--cell" in arguments or arguments == ["cameras"] else ["--cell", str(own_cell)]
    assert cli.main(["calibrate", *arguments, *cell]) == 2
    assert text in capsys.readouterr().err


# ---- from the bus


class Stage:
    """A camera, and a robot, on the bus: each scene stands for a while, and begins again after the last one."""

    TURNS = 12
    """Pictures of one scene."""

    def __init__(self, endpoint, path, scenes):
        self.scenes, self.turn = scenes, 0
        self.node = Node("driver", cells.load(path), bus.Connection(connect=(endpoint,)))
        self.node.every(0.1, self.show)
        self.node.every(0.02, self.move)

    def scene(self):
        return self.scenes[self.turn // self.TURNS % len(self.scenes)]

    def show(self):
        _, picture = self.scene()
        self.node.publish(topics.FRAME, Frame(stamp_ns=self.node.now_ns(), image=picture), camera="front")
        self.turn += 1

    def move(self):
        q, _ = self.scene()
        if q is not None:
            self.node.publish(topics.JOINTS, Joints(stamp_ns=self.node.now_ns(), position=q), robot="panda")


@pytest.mark.slow
def test_a_running_cell_gives_poses_when_the_robot_stands_and_they_can_be_read_again(with_lens, posed, router, tmp_path, capsys):
    T_world_camera, poses = posed
    stage = Stage(router, with_lens, poses[:10])
    kept = tmp_path / "kept"
    command = ["calibrate", "hand-eye", "--cell", str(with_lens), "--connect", router, "--poses", "10", "--save", str(kept)]
    with stage.node.open(5.0):
        assert cli.main(command) == 0
    assert "0 of 10: hold it still" in capsys.readouterr().out
    found = cells.load(with_lens).cameras["front"]
    error = rigid.pose_error(T_world_camera, found.T_world_camera)
    assert np.linalg.norm(error[:3]) < 3e-3 and np.linalg.norm(error[3:]) < np.radians(0.3)
    assert len(list(kept.glob("*.png"))) == 10 and (kept / views.JOINTS).is_file()
    assert cli.main(["calibrate", "hand-eye", "--cell", str(with_lens), "--pictures", str(kept)]) == 0
    again = rigid.pose_error(found.T_world_camera, cells.load(with_lens).cameras["front"].T_world_camera)
    assert np.abs(again).max() < 2e-5, "the same pictures give the same place, but for the digits that are kept"


@pytest.mark.slow
def test_a_running_cell_gives_the_views_that_add_something(own_cell, lens_pictures, router, tmp_path, capsys):
    pictures = [cv2.imread(str(path)) for path in sorted(lens_pictures.glob("[01]*.png"))]
    stage = Stage(router, own_cell, [(None, picture) for picture in pictures])
    command = ["calibrate", "camera", "--cell", str(own_cell), "--connect", router, "--views", "9", "--save", str(tmp_path / "k")]
    with stage.node.open(5.0):
        assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert "1 of 9: " in out and "side tilted towards the camera by 15 degrees or more" in out
    assert cells.load(own_cell).cameras["front"].fx == pytest.approx(LENS.fx, rel=0.02)
    assert len(list((tmp_path / "k").glob("*.png"))) == 9


def test_a_camera_that_sends_nothing_is_missed(own_cell, router, monkeypatch, capsys):
    monkeypatch.setattr(live, "PATIENCE_S", 0.2)
    assert cli.main(["calibrate", "camera", "--cell", str(own_cell), "--connect", router]) == 2
    assert "camera front: expected pictures within 0.2 s, got none; start what publishes them" in capsys.readouterr().err
