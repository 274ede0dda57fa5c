"""What the page shows, made of messages and reports; slots and credit; the file of the scene."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import numpy as np
import pytest

from penumbra.services.dashboard import files, scene, state
from penumbra.services.dashboard.hub import MOMENT, MOST_PAGES, PICTURE, SLOW, Hub, Offer, Page
from penumbra.services.dashboard.picture import Painter, run_lengths
from penumbra.services.dashboard.timeline import KEPT, Timeline
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages
from penumbra.shared.contract.report import Report, TopicReport
from penumbra.shared.geometry import rigid
from penumbra.tests.support.nodes import pose

TABLE, ARM = cells.load("table"), cells.load("arm")
NOW = 10**18


def vision(**changes):
    values: dict[str, Any] = {
        "stamp_ns": NOW,
        "target": "forearm",
        "camera": "front",
        "frame": "world",
        "position": np.zeros(3),
        "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
        "covariance": np.eye(6),
        "overlap": 0.9,
        "hidden": 0.83,
        "state": "occluded",
    }
    return messages.VisionPose(**(values | changes))


def haptic(**changes):
    values: dict[str, Any] = {
        "stamp_ns": NOW,
        "target": "forearm",
        "frame": "world",
        "sample_stamp_ns": NOW,
        "position": np.zeros(3),
        "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
        "information": np.eye(6),
        "gap": 0.31,
        "state": "out_of_range",
    }
    return messages.HapticPose(**(values | changes))


def truth(x):
    return messages.Truth(
        stamp_ns=NOW,
        target="forearm",
        frame="world",
        position=np.array([x, 0.0, 0.2]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(6),
        hidden=0.4,
        gap=0.1,
    )


# ---- slots and credit


@pytest.fixture
def taken():
    """What a page is sent now, None where it is sent nothing."""
    loop = asyncio.new_event_loop()
    yield lambda page: loop.run_until_complete(_taken(page))
    loop.close()


async def _taken(page):
    task = asyncio.create_task(page.next())
    await asyncio.sleep(0)  # to where it has a message, or waits for one
    if task.done():
        return task.result()[1]
    task.cancel()
    return None


def test_a_page_is_sent_the_newest_message_and_the_next_only_after_it_has_shown_that_one(taken):
    page = Page("front")
    for number in range(5):
        page.offer(PICTURE, bytes([number]))
    assert taken(page) == b"\x04"
    for number in range(5, 9):
        page.offer(PICTURE, bytes([number]))
    assert taken(page) is None
    page.offer(MOMENT, b"moment")
    assert taken(page) == b"moment", "streams do not wait for each other"
    page.shown(PICTURE)
    assert taken(page) == b"\x08"
    page.shown(PICTURE)
    assert taken(page) is None, "what was shown is not sent again"


def test_a_page_that_shows_nothing_keeps_one_message_a_stream(taken):
    page = Page()
    for number in range(1000):
        for stream in (MOMENT, PICTURE, SLOW):
            page.offer(stream, f"{stream} {number}".encode())
    assert [taken(page) for _ in range(4)] == [b"moment 999", b"picture 999", b"slow 999", None]


def test_the_hub_knows_what_its_pages_can_take(taken):
    hub, one, other = Hub(), Page("front"), Page("side")
    assert hub.wanted.pages == 0
    hub.open(one)
    hub.open(other)
    assert (hub.wanted.pages, hub.wanted.cameras, hub.wanted.ready) == (2, {"front", "side"}, {"front", "side"})
    hub.offer(Offer(PICTURE, b"front", "front"), Offer(MOMENT, b"now"))
    assert [taken(page) for page in (one, one, one, other, other)] == [b"now", b"front", None, b"now", None]
    assert hub.wanted.moment
    hub.look()
    assert hub.wanted.ready == {"side"} and not hub.wanted.moment, "nobody has shown the last moment"
    one.shown(PICTURE)
    hub.close(other)
    assert (hub.wanted.pages, hub.wanted.cameras, hub.wanted.ready) == (1, {"front"}, {"front"})
    for _ in range(MOST_PAGES - 1):
        hub.open(Page())
    assert hub.is_full


def test_an_unknown_stream_is_refused():
    with pytest.raises(ValueError, match="expected one of moment, picture, slow, got 'all'"):
        Page().shown("all")


# ---- poses


def shown(seen: state.Seen, now_ns: int) -> dict[str, Any]:
    return state.target(seen, now_ns, state.numbers(seen, now_ns))


def test_a_target_is_shown_with_its_error_its_deviations_and_what_the_senses_say():
    seen = state.Seen(pose(NOW), truth(0.02), {"front": vision()}, haptic(gap=0.05, state="in_range"))
    found = shown(seen, NOW + 5_000_000)
    assert found["state"] == "tracking" and found["age"] == pytest.approx(0.005)
    assert found["error"]["position"] == pytest.approx(0.02)
    assert found["sigma"] == pytest.approx([0.01] * 6) and found["spread"] == pytest.approx(0.01)
    assert found["truth"]["hidden"] == 0.4
    assert found["sources"]["vision"] == {"age": 0.05, "weight": 0.7}
    assert found["senses"]["vision front"]["pose"] is None, "a sense that must not be used has no pose"
    assert found["senses"]["haptic"]["pose"][:3] == [0, 0, 0] and found["senses"]["haptic"]["gap"] == 0.05
    json.dumps(found)


def test_what_is_old_is_not_shown_as_if_it_were_now():
    seen = state.Seen(pose(NOW), truth(0.0), {"front": vision()}, haptic())
    assert shown(seen, NOW + 2_000_000_000) == {"state": "none"}
    fresh = state.Seen(pose(NOW + 3_000_000_000), truth(0.0), {"front": vision()}, haptic())
    found = shown(fresh, NOW + 3_000_000_000)
    assert found["truth"] is None and found["error"] is None and found["senses"] == {}
    assert shown(state.Seen(), NOW) == {"state": "none"}


def test_the_ellipsoid_is_that_of_the_covariance():
    rng = np.random.default_rng(4)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        covariance = root @ root.T
        found = state.ellipsoid(covariance)
        R = rigid.transform(np.zeros(3), found["orientation"])[:3, :3]
        np.testing.assert_allclose(R @ np.diag(np.square(found["radii"])) @ R.T, covariance, atol=2e-3 * covariance.max())


# ---- reasons


def test_a_lost_pose_has_a_reason_from_each_sense():
    seen = state.Seen(pose(NOW), None, {"front": vision()}, haptic())
    assert state.reasons(seen, ["vision", "haptic"], [], NOW) == [
        "vision of front: too little to see, 83% hidden",
        "haptic: nothing in range, gap 31 cm",
    ]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"state": "in_range", "contact": "touch", "touched": ("p3",)}, "the limb touches p3"),
        ({"state": "object", "contact": "grip", "touched": ("p1", "p4")}, "an object holds p1, p4"),
        ({"state": "unidentified", "contact": "touch", "touched": ("p1",)}, "something touches p1"),
        ({"state": "in_range", "gap": 0.05}, ""),
    ],
)
def test_what_touches_is_said_before_the_gap(values, words):
    seen = state.Seen(pose(NOW), None, {}, haptic(**values))
    assert shown(seen, NOW)["senses"]["haptic"]["contact"] == words
    assert state.reasons(seen, ["haptic"], [], NOW) == [f"haptic: {words or 'in range, gap 5 cm'}"]


def test_a_silent_sense_is_explained_by_its_process():
    seen = state.Seen(pose(NOW), None, {"front": vision()}, None)
    reports = [Report("search", "a", "degraded", ["no camera/front/mask for 4.0 s"]), Report("fusion", "b", "ok")]
    assert state.reasons(seen, ["vision", "haptic"], reports, NOW + 4_000_000_000) == [
        "vision is silent for 4.0 s: search is degraded (no camera/front/mask for 4.0 s)",
        "haptic has sent nothing: haptics does not run",
    ]
    assert state.reasons(seen, ["haptic"], [], NOW) == ["haptic has sent nothing"], "without reports nothing is said of processes"


def test_a_sense_that_the_cell_does_not_have_is_not_missed():
    assert state.reasons(state.Seen(vision={"front": vision(state="lost")}), ["vision"], [], NOW) == [
        "vision of front: the target is not found, 83% hidden"
    ]


# ---- the timeline


def test_the_timeline_has_an_entry_a_change_and_none_for_a_flicker():
    timeline = Timeline()
    for time_s, now in ((0.0, "lost"), (1.0, "tracking"), (2.0, "tracking"), (3.0, "coasting"), (3.1, "tracking"), (9.0, "lost")):
        timeline.state("forearm", now, time_s, [f"why at {time_s}"])
    assert [(entry["time"], entry["state"]) for entry in timeline.entries] == [(0.0, "lost"), (1.0, "tracking"), (9.0, "lost")]
    assert timeline.entries[-1]["why"] == "why at 9.0"
    assert len({entry["number"] for entry in timeline.entries}) == 3


def test_the_timeline_tells_of_processes_that_come_go_and_are_not_well():
    def row(name, status, why=""):
        return {"id": name, "name": name, "status": status, "why": why}

    timeline = Timeline()
    timeline.processes([row("fusion", "ok"), row("search", "ok")], 0.0)
    assert not timeline.entries, "who is there at first is no news"
    for time_s in (1.0, 2.0, 3.0):
        timeline.processes([row("fusion", "ok"), row("search", "degraded", "no mask")], time_s)
    timeline.processes([row("fusion", "degraded"), row("haptics", "starting")], 4.0)
    timeline.processes([row("fusion", "ok"), row("haptics", "starting")], 5.0)
    timeline.processes([row("fusion", "failed"), row("haptics", "ok")], 6.0)
    timeline.processes([row("fusion", "failed"), row("haptics", "ok")], 7.0)
    found = {(entry["time"], entry["about"], entry["state"], entry["why"]) for entry in timeline.entries}
    assert found == {
        (2.0, "search", "degraded", "no mask"),
        (4.0, "search", "ended", ""),
        (4.0, "haptics", "starting", ""),
        (6.0, "fusion", "failed", ""),
        (7.0, "haptics", "ok", ""),
    }, "what one look alone finds is no news"


def test_the_timeline_is_bounded():
    timeline = Timeline()
    for number in range(3 * KEPT):
        timeline.state("forearm", "lost" if number % 2 else "tracking", float(number), ())
    assert len(timeline.entries) == KEPT and timeline.entries[-1]["number"] == 3 * KEPT


# ---- processes and rates


def test_processes_have_the_names_and_restarts_of_the_launcher_and_keep_their_rows():
    running = {"state": "running", "is_running": True, "note": ""}
    processes = {
        "fusion 1": {"pid": 7, "restarts": 2} | running,
        "search": {"pid": None, "state": "failed", "is_running": False, "restarts": 5, "note": "exit code 1"},
        "router": {"pid": 3, "restarts": 0} | running,
    }
    reports = [
        Report("launcher", "l", "ok", host="here", pid=1, report={"processes": processes}),
        Report("fusion", "f", "degraded", ["no vision"], host="here", pid=7, cpu=0.12),
        Report("camera", "c", "ok", host="there", pid=7),
    ]
    found = state.processes(reports)
    rows = {row["id"]: row for row in found["rows"]}
    assert found["can_restart"]
    assert (rows["fusion 1"]["status"], rows["fusion 1"]["why"], rows["fusion 1"]["restarts"]) == ("degraded", "no vision", 2)
    assert (rows["search"]["status"], rows["search"]["why"], rows["search"]["service"]) == ("failed", "exit code 1", "search")
    assert rows["c"]["name"] == "camera" and not rows["c"]["can_restart"], "on another host, where this launcher is not"
    assert not rows["router"]["can_restart"]
    assert not state.processes(reports[1:])["can_restart"]


def test_rates_are_those_of_all_replicas():
    key = "penumbra/table/target/forearm/pose/fused"
    reports = [Report("fusion", name, "ok", published={key: TopicReport(rate_hz=100.0)}) for name in "ab"]
    reports.append(Report("search", "s", "ok", topics={key: TopicReport(delay_s=0.002, dropped=3, bad={"past": 2})}))
    (row,) = state.rates(reports, ["fused"])
    assert (row["rate"], row["nominal"], row["delay"], row["dropped"], row["refused"]) == (200.0, 200, 0.002, 3, 2)


# ---- picture and scene


def unpacked(payload):
    (length,) = struct.unpack_from("<I", payload)
    return json.loads(payload[4 : 4 + length]), payload[4 + length :]


@pytest.mark.parametrize("shape", [(7, 9), (300, 300)])
def test_runs_are_the_mask(shape):
    rng = np.random.default_rng(1)
    for labels in (rng.integers(0, 3, shape).astype(np.uint8), np.full(shape, 4, np.uint8)):
        runs = run_lengths(labels)
        np.testing.assert_array_equal(np.repeat(runs[:, 0], runs[:, 1]), labels.ravel())


def test_a_picture_has_the_outline_of_each_pose_and_the_masks_runs_before_a_jpeg():
    painter = Painter(TABLE, "front")
    frame = messages.Frame(stamp_ns=NOW, image=np.full((480, 640, 3), 90, np.uint8))
    mask = messages.Mask(stamp_ns=NOW, labels=np.eye(40, dtype=np.uint8), x0=10, y0=20, scale=4)
    header, rest = unpacked(painter.message(frame, mask, {"forearm": pose(NOW)}, NOW + 10_000_000))
    assert header["mask"] == {"x": 10, "y": 20, "scale": 4, "width": 40, "height": 40} and header["age"] == pytest.approx(0.01)
    runs = np.frombuffer(rest, np.uint16, 2 * header["runs"]).reshape(-1, 2)
    np.testing.assert_array_equal(np.repeat(runs[:, 0], runs[:, 1]).reshape(40, 40), mask.labels)
    assert rest[runs.nbytes :].startswith(b"\xff\xd8\xff")
    (line,) = header["outlines"]["forearm"]["lines"]
    camera = TABLE.cameras["front"]
    middle = rigid.apply(rigid.inverse(camera.T_world_camera), [[0.0, 0.0, 0.2]])[0]
    u, v = (camera.K @ middle / middle[2])[:2]
    points = np.array(line).reshape(-1, 2)
    assert points[:, 0].min() < u < points[:, 0].max() and points[:, 1].min() < v < points[:, 1].max()
    behind = {"forearm": pose(NOW, x=50.0)}
    header, _ = unpacked(painter.message(frame, None, behind, NOW))
    assert header["outlines"]["forearm"]["lines"] == [], "outside of the picture"
    header, _ = unpacked(painter.message(frame, None, {}, NOW))
    assert header["mask"] is None and header["outlines"] == {}


@pytest.mark.parametrize("cell", [TABLE, ARM], ids=lambda cell: cell.name)
def test_the_scene_holds_every_mesh_as_it_is(cell):
    header, rest = unpacked(scene.pack(cell))
    names = {f"link/{robot}/{link}" for robot, model in robot_models(cell).items() for link in model.meshes}
    assert set(header["meshes"]) == names | {f"target/{name}" for name in cell.targets}
    assert set(header["pads"]) == set(cell.pads) and header["is_simulated"]
    for name, where in header["meshes"].items():
        vertices = np.frombuffer(rest, "<f4", 3 * where["vertices"], 4 * where["at"]).reshape(-1, 3)
        faces = np.frombuffer(rest, "<u4", 3 * where["faces"], 4 * where["at"] + vertices.nbytes).reshape(-1, 3)
        assert faces.max() == len(vertices) - 1
        if name.startswith("link/"):
            _, robot, link = name.split("/")
            np.testing.assert_allclose(vertices, robot_models(cell)[robot].meshes[link].vertices, atol=1e-6)


def test_links_are_described_so_that_their_joints_alone_say_where_they_are():
    q = np.linspace(-0.4, 0.4, len(ARM.robots["panda"].joints))
    links = scene.describe(ARM)["links"]
    expected = robot_models(ARM)["panda"].link_transforms(q)
    assert set(links) == {f"panda/{link}" for link in expected} and {pad.link for pad in ARM.pads.values()} <= set(links)
    assert sorted(link["joint"] for link in links.values() if link["joint"] is not None) == list(range(len(q)))
    found = {None: np.eye(4)}
    for name, link in links.items():
        (x, y, z, *orientation), along = link["pose"], np.zeros(6)
        if link["joint"] is not None:
            along[slice(3) if link["slides"] else slice(3, 6)] = np.multiply(q[link["joint"]], link["axis"])
        T_parent_link = rigid.transform([x, y, z], orientation) @ rigid.perturb(np.eye(4), along)
        found[name] = found[link["parent"]] @ T_parent_link
        np.testing.assert_allclose(found[name], expected[name.partition("/")[2]], atol=1e-7)


# ---- the page's files


def test_the_page_needs_nothing_from_elsewhere_and_is_small():
    found = files.read()
    assert sum(len(file.compressed) for file in found.values()) < 520_000
    for path, file in found.items():
        if "vendor" not in path:
            assert (
                b"http://" not in file.content.replace(b"http://www.w3.org/2000/svg", b"") and b"https://" not in file.content
            ), path
            assert b"<script>" not in file.content and b"onclick=" not in file.content, "the page's policy forbids inline code"


def test_what_is_not_ours_in_the_page_has_its_licence_beside_it():
    vendor = files.PAGE / "vendor"
    for library, names in {"three": ("three.core.js", "three.module.js"), "uPlot": ("uPlot.js", "uPlot.css")}.items():
        assert "Permission is hereby granted" in (vendor / f"{library}.LICENSE.txt").read_text()
        assert all((vendor / name).is_file() for name in names)
