"""`penumbra replay --smooth`: the trajectory afterwards, from files as a recorder leaves them."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from penumbra.services.command import cli
from penumbra.services.fusion.settings import with_motion
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.geometry import rigid
from penumbra.shared.recording.reading import Recording
from penumbra.shared.runtime.tap import Taken
from penumbra.tests.support.nodes import pose
from penumbra.tests.support.recorded import on_the_bus, recorded, taken

TABLE = cells.load("table")
NAMES = {"target": "forearm"}
SIGMA = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])
GAP_S = (1.5, 2.3)
BEGIN_NS = 10**18


def said(seconds: float = 4.0) -> list[Taken]:
    """The truth of the simulated cell, vision of it at 25 Hz that misses GAP_S, and a fused pose of nothing."""
    rng = np.random.default_rng(2)
    out = [each for each in on_the_bus(TABLE, 6, seconds, frames=False) if each.topic is topics.TRUTH]
    for each in out[::2]:
        truth = messages.decode(messages.Truth, each.payload)
        t = 1e-9 * (truth.stamp_ns - BEGIN_NS)
        if not GAP_S[0] < t < GAP_S[1]:
            out.append(taken(TABLE, topics.VISION, NAMES, seen(truth, rng)))
    out.append(taken(TABLE, topics.FUSED, NAMES, pose(BEGIN_NS + 10**9)))
    return sorted(out, key=lambda each: each.received_ns)


def seen(truth: messages.Truth, rng: np.random.Generator, target: str = "forearm", camera: str = "front") -> messages.VisionPose:
    """What a camera says of the truth."""
    T = rigid.perturb(rigid.transform(truth.position, truth.orientation), 0.5 * SIGMA * rng.normal(size=6))
    position, orientation = rigid.position_orientation(T)
    return messages.VisionPose(
        stamp_ns=truth.stamp_ns, target=target, frame="world", position=position, orientation=orientation,
        covariance=np.diag(SIGMA**2), hidden=0.0, overlap=1.0, state="tracking", camera=camera,
    )  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recording") / "run.mcap", "table", said())


def smoothed(path: Path, capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> dict[str, Any]:
    assert cli.main(["replay", str(path), "--smooth", "--json", *words]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def contents(path: Path) -> Counter[str]:
    return Counter(entry.channel.topic for entry in Recording(path).entries())


def test_the_new_file_has_all_of_the_recording_and_smoothed_poses_as_a_topic_of_their_own(path, tmp_path, capsys) -> None:
    out = tmp_path / "smooth.mcap"
    found = smoothed(path, capsys, "--out", str(out))
    track = found["poses"]["smoothed forearm"]
    assert track["messages"] > 700 and track["states"]["coasting"] > 0.01 and track["states"]["tracking"] > 0.8
    assert track["from_truth_mm"]["median"] < 10.0
    count = track["messages"]
    new = contents(out) - contents(path)
    key = "penumbra/table/target/forearm/pose/smoothed"
    assert new == {key: count, "/target/forearm/pose/smoothed": count}, "above all nothing in /tf, which is of the fused pose"
    assert not contents(path) - contents(out)
    assert not any(each.topic is topics.SMOOTHED for each in Recording(out).messages()), "no replay plays them"
    poses: list[Any] = [each.message for each in Recording(out).messages([topics.SMOOTHED])]
    assert {type(each) for each in poses} == {messages.SmoothedPose} and len(poses) == count
    assert {b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(poses)} == {5_000_000}
    assert all(np.linalg.eigvalsh(each.covariance)[0] > 0.0 for each in poses)
    with out.open("rb") as file:
        shown = [
            (schema.name, decoded.pose.position.x)
            for schema, _, _, decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
                topics=["/target/forearm/pose/smoothed"]
            )
            if schema is not None
        ]
    assert shown == [("foxglove.PoseInFrame", each.position[0]) for each in poses]


def test_a_file_that_has_smoothed_poses_already_is_smoothed_again_to_the_bit(path, tmp_path, capsys) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    found = [smoothed(path, capsys, "--out", str(first)), smoothed(first, capsys, "--out", str(second))]
    assert found[0] == found[1]
    assert contents(first) == contents(second)


def test_of_a_file_that_was_cut_off_the_part_before_is_smoothed_and_the_fault_reported(path, tmp_path, capsys) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(path.read_bytes()[: int(0.995 * path.stat().st_size)])
    assert Recording(cut).about
    found = smoothed(cut, capsys, "--out", str(out), code=1)
    assert "has no end" in found["faults"][0]
    assert found["poses"]["smoothed forearm"]["messages"] > 100
    assert Recording(out).is_indexed and contents(out)["/target/forearm/pose/smoothed"]


def test_what_is_of_another_frame_or_has_a_bad_covariance_is_counted_and_left_out(tmp_path, capsys) -> None:
    rng, every = np.random.default_rng(0), said(2.0)
    truth = messages.decode(messages.Truth, next(each for each in every if each.topic is topics.TRUTH).payload)
    bad = [
        taken(TABLE, topics.VISION, NAMES, seen(truth, rng, target="somebody")),
        taken(TABLE, topics.VISION, NAMES, seen(truth, rng, camera="nowhere")),
    ]
    whole = recorded(tmp_path / "whole.mcap", "table", every)
    spoilt = recorded(tmp_path / "spoilt.mcap", "table", [*bad, *every])
    good, with_bad = smoothed(whole, capsys), smoothed(spoilt, capsys)
    assert with_bad["poses"] == good["poses"]
    assert with_bad["measurements"]["forearm"]["senses"]["vision"]["refused"] == {"frame": 1, "camera": 1}


def test_a_recording_in_which_no_sense_has_seen_the_target_is_refused_and_no_file_is_left(tmp_path, capsys) -> None:
    empty = recorded(
        tmp_path / "empty.mcap", "table", [each for each in said(1.0) if each.topic not in (topics.VISION, topics.HAPTIC)]
    )
    out = tmp_path / "out.mcap"
    assert cli.main(["replay", str(empty), "--smooth", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "forearm: expected poses of vision or haptic, got none; give --in-process" in error
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--sensors"], "expected --in-process and --smooth without --sensors, --topics, --loop and --rate"),
        (["--loop"], "neither is played in real time"),
        (["--out", "README.md"], "README.md is there already: give another --out"),
    ],
)
def test_what_does_not_go_with_it_is_refused(words, text, path, capsys) -> None:
    assert cli.main(["replay", str(path), "--smooth", *words]) == 2
    assert text in capsys.readouterr().err


def test_in_words_it_says_what_was_used_and_how_far_the_poses_are_from_the_truth(path, capsys) -> None:
    assert cli.main(["replay", str(path), "--smooth"]) == 0
    out = capsys.readouterr().out
    assert "smoothed forearm:" in out and "from truth: median" in out
    assert "forearm: the gates passed" in out


def test_the_motion_of_a_recording_is_learned_into_a_file_that_fusion_reads(path, tmp_path, capsys) -> None:
    out = tmp_path / "motion.json"
    found = smoothed(path, capsys, "--motion", str(out))
    assert found["motion"] == json.loads(out.read_text())
    assert found["motion"]["gain"] >= 0.0
    assert with_motion(str(out)).damping == found["motion"]["damping"] < 0.999, "the limb rests"
    assert cli.main(["replay", str(path), "--motion", str(out)]) == 2
    assert "expected --smooth beside --motion" in capsys.readouterr().err
