"""Recordings as files: what is in them for replays and for viewers, and what is left of one that was not closed."""

import os
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.recording import provenance, reading
from penumbra.shared.recording.entries import as_on_the_bus
from penumbra.shared.recording.faults import RecordingError
from penumbra.shared.recording.foxglove import Viewers
from penumbra.shared.recording.reading import Recording
from penumbra.tests.support.nodes import pose
from penumbra.tests.support.recorded import entries, new_file, on_the_bus, recorded, taken

ARM = cells.load("arm")
TABLE = cells.load("table")


@pytest.fixture(scope="module")
def said():
    """A third of a second of a cell with a robot, and a fused pose."""
    fused = taken(ARM, topics.FUSED, {"target": "forearm"}, pose(10**18 + 5_000_000))
    return [*on_the_bus(ARM, 3, 0.3), fused]


@pytest.fixture(scope="module")
def path(said, tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("recording") / "arm.mcap", "arm", said)


def shown(path):
    """The messages for viewers, by topic, as a reader of MCAP that knows nothing of us decodes them."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        for schema, channel, message, decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
            topics=[topic for topic in topics_of(path) if topic.startswith("/")]
        ):
            assert schema is not None
            found.setdefault(channel.topic, []).append((schema.name, message, decoded))
    return found


def topics_of(path):
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {channel.topic for channel in summary.channels.values()}


def stamp_of(message):
    return message.timestamp.seconds * 10**9 + message.timestamp.nanos


# ---- what a replay takes


def test_every_message_but_frames_is_kept_to_the_bit_with_its_publisher_its_number_and_its_arrival(path, said):
    kept = {(entry.channel.topic, entry.log_ns): entry for entry in Recording(path).entries() if not entry.channel.definition}
    expected = [each for each in said if each.topic is not topics.FRAME]
    assert len(expected) > 100 and len(kept) == len(expected)
    for each in expected:
        entry = kept[each.key, each.received_ns]
        assert (entry.data, entry.number, entry.stamp_ns) == (each.payload, each.number, each.stamp_ns)
        assert dict(entry.channel.about) == {"key": each.key, "publisher": each.publisher.hex()}


def test_frames_are_read_from_their_pictures_with_their_stamps_and_colours(path, said):
    frames: dict[Any, Any] = {
        (each.key, each.message.stamp_ns): each.message for each in Recording(path).messages([topics.FRAME])
    }
    originals = {(e.key, e.stamp_ns): messages.decode(messages.Frame, e.payload) for e in said if e.topic is topics.FRAME}
    assert frames.keys() == originals.keys() and frames
    for key, original in originals.items():
        image = frames[key].image.astype(float)
        assert image.shape == original.image.shape
        assert np.abs(image - original.image).mean() < 6.0, "JPEG changes little; red and blue exchanged would change much"


def test_with_raw_frames_every_byte_is_kept_and_each_frame_is_there_once(said, tmp_path):
    path = recorded(tmp_path / "raw.mcap", "arm", said, keeps_frames=True)
    frames = [messages.encode(each.message) for each in Recording(path).messages([topics.FRAME])]
    assert frames == [each.payload for each in said if each.topic is topics.FRAME]


def test_messages_come_back_in_the_order_of_their_arrival_with_key_and_names(path, said):
    found = list(Recording(path).messages())
    assert Counter(each.key for each in found) == Counter(each.key for each in said)
    assert {each.publisher for each in found} == {bytes(range(12)).hex()}
    voltages = next(each for each in found if each.topic is topics.VOLTAGES)
    assert voltages.key == topics.VOLTAGES.at(cell="arm", **voltages.names)


def test_the_file_says_what_it_is_of(path):
    recording = Recording(path)
    assert recording.about["cell"] == "arm" and recording.about["wire_version"] == str(messages.VERSION)
    assert recording.attachments["cell.yaml"] == cells.source("arm").read_bytes()
    assert recording.cell() == ARM
    with path.open("rb") as file:
        (weights,) = (each.metadata for each in make_reader(file).iter_metadata() if each.name == provenance.WEIGHTS)
    assert "services/segmentation/weights/prednet.npz" in weights and all(len(digest) == 64 for digest in weights.values())


def test_a_cell_of_ones_own_is_read_from_the_file_where_its_own_file_is_gone(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(cells.source("table").read_text().replace("name: table", "name: mine"))
    path = recorded(tmp_path / "own.mcap", str(own), [])
    expected = cells.load(own)
    own.unlink()
    assert Recording(path).cell().model_dump() == expected.model_dump(), "without the folder"


def test_a_message_of_another_release_is_left_out_and_counted_and_a_file_of_such_alone_is_refused(tmp_path):
    good = taken(TABLE, topics.FUSED, {"target": "forearm"}, pose(10**18))
    other = replace(good, payload=good.payload.replace(b"\xa7version\x01", b"\xa7version\x02"))
    assert other.payload != good.payload
    for name, both in (("both", [good, other]), ("other", [other])):
        file = new_file(tmp_path / f"{name}.mcap")
        for each in both:
            file.write(as_on_the_bus(each))
        file.close()
    recording = Recording(tmp_path / "both.mcap")
    assert [each.topic for each in recording.messages()] == [topics.FUSED]
    assert recording.unread == {"version": 1}
    with pytest.raises(RecordingError, match="expected wire version 1, got 2"):
        list(Recording(tmp_path / "other.mcap").messages())


# ---- what viewers show


def test_viewers_find_the_picture_in_its_camera_s_frame_at_the_frame_s_stamp(path, said):
    pictures = shown(path)["/camera/side/frame"]
    stamps = [each.stamp_ns for each in said if each.topic is topics.FRAME and each.names == {"camera": "side"}]
    assert [stamp_of(picture) for _, _, picture in pictures] == stamps
    for schema, _, picture in pictures:
        assert (schema, picture.frame_id, picture.format) == ("foxglove.CompressedImage", "camera/side", "jpeg")
        camera = ARM.cameras["side"]
        image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None and image.shape == (camera.height, camera.width, 3)


def test_viewers_find_the_camera_s_intrinsics_and_where_it_stands(path):
    found = shown(path)
    camera = ARM.cameras["side"]
    ((schema, _, calibration),) = found["/camera/side/calibration"]
    assert (schema, calibration.frame_id) == ("foxglove.CameraCalibration", "camera/side")
    assert (calibration.width, calibration.height) == (camera.width, camera.height)
    assert np.array(calibration.K).reshape(3, 3) == pytest.approx(camera.K)
    assert np.array(calibration.P).reshape(3, 4)[:, :3] == pytest.approx(camera.K)
    first = {each.child_frame_id: each for each in found["/tf"][0][2].transforms}
    placed = first["camera/side"]
    assert placed.parent_frame_id == ARM.frame
    assert (placed.translation.x, placed.translation.y, placed.translation.z) == pytest.approx(camera.position)


def test_viewers_find_joints_by_name_and_links_where_they_are(path, said):
    found = shown(path)
    joints = [messages.decode(messages.Joints, each.payload) for each in said if each.topic is topics.JOINTS]
    states = [state for _, _, state in found["/robot/panda/joints"]]
    assert [[joint.position for joint in state.joints] for state in states] == [q.position.tolist() for q in joints]
    assert [joint.name for joint in states[0].joints] == list(ARM.robots["panda"].joints)
    model = robot_models(ARM)["panda"]
    second = next(each for _, _, each in found["/tf"][1:] if any(t.child_frame_id.startswith("panda/") for t in each.transforms))
    q = next(q.position for q in joints if q.stamp_ns == stamp_of(second.transforms[0]))
    for each in second.transforms:
        T = model.link_transforms(q)[each.child_frame_id.removeprefix("panda/")]
        assert (each.translation.x, each.translation.y, each.translation.z) == pytest.approx(T[:3, 3])


def test_viewers_find_poses_in_the_cell_s_frame_and_the_target_moves_with_the_fused_one(path):
    found = shown(path)
    ((schema, message, fused),) = found["/target/forearm/pose/fused"]
    assert (schema, fused.frame_id, stamp_of(fused)) == ("foxglove.PoseInFrame", "world", 10**18 + 5_000_000)
    assert message.publish_time == 10**18 + 5_000_000
    assert (fused.pose.position.z, fused.pose.orientation.w) == (0.2, 1.0)
    (moved,) = (t for _, _, each in found["/tf"][1:] for t in each.transforms if t.child_frame_id == "forearm")
    assert (moved.parent_frame_id, moved.translation.z) == ("world", 0.2)
    assert len(found["/target/forearm/truth"]) == 15


def test_viewers_find_a_scene_of_meshes_in_the_frames_that_move(path):
    ((schema, _, scene),) = shown(path)["/scene"]
    assert schema == "foxglove.SceneUpdate"
    by_name = {entity.id: entity for entity in scene.entities}
    arm = by_name["target forearm"]
    assert (arm.frame_id, arm.frame_locked) == ("forearm", True)
    mesh = anatomy.target_mesh(ARM.targets["forearm"], ARM)
    assert list(arm.triangles[0].indices) == mesh.faces.ravel().tolist()
    assert len(arm.triangles[0].points) == len(mesh.vertices)
    assert by_name["panda/panda_link3"].frame_id == "panda/panda_link3"
    assert {f"pad {name}" for name in ARM.pads} <= by_name.keys()


def test_viewers_find_points_of_surfaces_as_spheres_where_they_are_and_touched_ones_apart():
    def felt(at_ns, touched=(), **surface):
        points = {
            pad: messages.SurfacePoint("panda/panda_link5", (0.1, distance, 0.3), distance, 0.01, 0.02, distance)
            for pad, distance in surface.items()
        }
        message = messages.HapticPose(
            stamp_ns=10**18 + at_ns, sample_stamp_ns=10**18, target="forearm", frame="world", position=np.zeros(3),
            orientation=np.array([0.0, 0.0, 0.0, 1.0]), information=np.eye(6), gap=0.1, state="object", surface=points,
            contact="touch" if touched else "none", touched=touched,
        )  # fmt: skip
        return taken(ARM, topics.HAPTIC, {"target": "forearm"}, message)

    viewers = Viewers(ARM)
    scenes = [
        [SceneUpdate.FromString(entry.data) for entry in viewers.of(each) if entry.channel.topic == "/scene"]
        for each in (felt(0, ("p3",), p2=0.05, p3=0.004), felt(1_000_000, p2=0.05), felt(50_000_000))
    ]
    (entity,) = scenes[0][0].entities
    assert [sphere.pose.position.y for sphere in entity.spheres] == [0.05, 0.004]
    assert entity.frame_id == "world" and entity.spheres[0].size.x == pytest.approx(0.02)
    assert entity.spheres[1].color.r > entity.spheres[0].color.r
    assert not scenes[1], "no more often than a viewer shows"
    assert [each.id for each in scenes[2][0].entities] == [entity.id] and not scenes[2][0].entities[0].spheres


# ---- files that were not closed


def left_of(path, wanted=topics.TOPICS):
    recording = Recording(path)
    return list(recording.messages(wanted)), recording.fault


def test_of_a_killed_writer_all_that_was_flushed_is_read(said, tmp_path):
    path = tmp_path / "killed.mcap"
    child = os.fork()
    if child == 0:  # pragma: no cover
        file = new_file(path, "arm")
        for number, entry in enumerate(entries(ARM, said)):
            file.write(entry)
            if number == 100:
                file.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    whole = list(entries(ARM, said))[:101]
    found = [entry for entry in Recording(path).entries() if entry.channel.topic not in ("/scene", "/camera/side/calibration")]
    assert [entry.data for entry in found[1:]] == [entry.data for entry in whole], "the first is where things stand"
    messages, fault = left_of(path)
    assert messages and "its recorder was killed, or it was cut off" in fault
    assert not Recording(path).is_indexed


def test_a_file_cut_at_any_byte_is_read_up_to_its_last_whole_chunk(path, tmp_path):
    data = path.read_bytes()
    counts = []
    for share in (0.999, 0.9, 0.7, 0.5):
        cut = tmp_path / f"{share}.mcap"
        cut.write_bytes(data[: int(share * len(data))])
        messages, fault = left_of(cut)
        assert fault
        counts.append(len(messages))
    assert counts == sorted(counts, reverse=True) and counts[0] == len(list(Recording(path).messages()))


@pytest.fixture(scope="module")
def chunks(said, tmp_path_factory):
    """A file of many chunks, and the first byte of each."""
    path = tmp_path_factory.mktemp("recording") / "chunks.mcap"
    file = new_file(path, "arm")
    for number, entry in enumerate(entries(ARM, sorted(said, key=lambda each: each.received_ns))):
        file.write(entry)
        if number % 20 == 0:
            file.flush()
    file.close()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) > 6
    return path, summary.chunk_indexes


def damaged(path, at, length=40):
    data = bytearray(path.read_bytes())
    data[at : at + length] = bytes(byte ^ 0xA5 for byte in data[at : at + length])
    return data


@pytest.mark.parametrize("offset", [0, 3, 60], ids=["its opcode", "its length", "its content"])
@pytest.mark.parametrize("which", [0, 4, -1])
def test_a_damaged_chunk_is_left_out_and_reported_with_its_place_and_the_rest_is_read(chunks, which, offset, tmp_path):
    path, index = chunks
    hurt = index[which]
    (tmp_path / "damaged.mcap").write_bytes(damaged(path, hurt.chunk_start_offset + offset))
    recording = Recording(tmp_path / "damaged.mcap")
    lost = [each for each in Recording(path).entries() if hurt.message_start_time <= each.log_ns <= hurt.message_end_time]
    found = list(recording.entries())
    assert len(list(Recording(path).entries())) - len(lost) <= len(found) < len(list(Recording(path).entries()))
    (gap,) = recording.gaps
    assert gap.begin <= hurt.chunk_start_offset < gap.end
    assert gap.seconds >= round((hurt.message_end_time - hurt.message_start_time) * 1e-9, 3)
    assert f"is damaged after byte {gap.begin}: {gap.seconds:.2f} s of messages are missing" in recording.fault
    assert "no end" not in recording.fault


def test_a_wrong_length_beside_the_chunks_loses_none_of_them(chunks, tmp_path):
    path, index = chunks
    after = index[3].chunk_start_offset + index[3].chunk_length
    (tmp_path / "damaged.mcap").write_bytes(damaged(path, after + 3, 1))
    recording = Recording(tmp_path / "damaged.mcap")
    assert len(list(recording.entries())) == len(list(Recording(path).entries()))
    assert f"is damaged after byte {after}: " in recording.fault


def test_a_file_that_is_damaged_and_cut_off_says_both(chunks, tmp_path):
    path, index = chunks
    cut = damaged(path, index[2].chunk_start_offset + 60)[: index[-1].chunk_start_offset + 20]
    (tmp_path / "both.mcap").write_bytes(cut)
    messages, fault = left_of(tmp_path / "both.mcap")
    assert messages and "is damaged after byte" in fault and "and has no end (it breaks off after byte" in fault
    mended = reading.mend(tmp_path / "both.mcap", tmp_path / "mended.mcap")
    assert mended.fault and not left_of(tmp_path / "mended.mcap")[1]


def test_without_an_index_messages_whose_topics_only_a_damaged_part_named_are_counted(chunks, tmp_path):
    path, index = chunks
    (tmp_path / "both.mcap").write_bytes(damaged(path, index[0].chunk_start_offset + 60)[: index[-1].chunk_start_offset])
    recording = Recording(tmp_path / "both.mcap")
    found = sum(1 for _ in recording.entries())
    left_out = int(recording.fault.partition("left out: ")[2].split()[0])
    assert left_out > 0 and recording.fault.endswith("messages whose topics only a damaged part named")
    assert found + left_out < sum(1 for _ in Recording(path).entries())


def test_a_mended_file_has_an_index_and_all_that_could_be_read(path, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-1000])
    mended = reading.mend(cut, tmp_path / "mended.mcap")
    again = Recording(tmp_path / "mended.mcap")
    assert again.is_indexed and "killed" in mended.fault
    assert [entry.data for entry in again.entries()] == [entry.data for entry in Recording(cut).entries()]
    assert not again.fault and again.about == Recording(path).about and again.cell() == ARM
    assert mended.messages == len(list(again.entries()))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "cannot be read: No such file"),
        (b"", "expected an MCAP file"),
        (b"\x89MCAP0\r\n", "expected metadata 'penumbra', got none"),
    ],
)
def test_what_is_no_recording_is_refused(content, text, tmp_path):
    path = tmp_path / "what.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=text):
        Recording(path)


FILLS = """
import resource, signal, sys
from pathlib import Path
from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.tests.support.recorded import entries, new_file, on_the_bus
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
file = new_file(Path(sys.argv[1]))
try:
    for entry in entries(cells.load("table"), on_the_bus(cells.load("table"), 3, 60.0, frames=False)):
        file.write(entry)
        if file.messages % 50 == 0:
            file.flush()
except OSError as error:
    print(error.strerror, file.messages)
    file.cut()
"""


@pytest.mark.parametrize("limit", [300_000, 300_007, 300_060])
def test_a_file_that_the_disk_takes_no_more_of_is_a_whole_file(limit, tmp_path):
    """A limit of the size of files is as sudden as a full disk."""
    path = tmp_path / "full.mcap"
    done = subprocess.run([sys.executable, "-c", FILLS, str(path), str(limit)], capture_output=True, text=True, check=True)
    why, written = done.stdout.rsplit(maxsplit=1)
    assert why == os.strerror(27) and path.stat().st_size <= limit
    recording = Recording(path)
    count = len(list(recording.entries()))
    assert not recording.fault, "it has an end"
    assert int(written) - 101 <= count <= int(written)
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == count, "any reader of MCAP reads it"
