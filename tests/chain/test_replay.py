"""A recorded quarter of a minute through all services: a changed output is a mistake, or a new reference in the same commit
(`python -m penumbra.tests.chain.test_replay`). It is played in a process of its own, in which x86 processors round alike: what a
mask shows changes the window of the next one, so that rounding becomes pixels, and later millimetres."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from penumbra.services.replay.chain import Heard, Replay
from penumbra.services.segmentation.inference import load_segmenter
from penumbra.shared.cell import description
from penumbra.shared.contract import topics
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.topics import FRAME
from penumbra.shared.perception.lookout import whole_frame
from penumbra.sim.world.world import record
from penumbra.tests.support.processors import PROCESSORS

REFERENCE = Path(__file__).parents[1] / "references" / "replay_table.json"
SEED = 11


def play() -> list[Heard]:
    """A quarter of a minute."""
    table = description.load("table")
    return Replay(table).run(record(table, SEED, 15.0))


def masks() -> list[list[int]]:
    """Pixels of every class in the masks of five seconds of whole frames, one mask a second."""
    table = description.load("table")
    window, segmenter = whole_frame(table.cameras["front"]), load_segmenter(precision="f32")
    frames: list[Any] = [message for topic, _, message in record(table, SEED, 5.0) if topic is FRAME]
    found = [np.bincount(segmenter(frame.image, window, frame.stamp_ns).ravel(), minlength=len(Label)) for frame in frames]
    return [counts.tolist() for counts in found[::20]]


def digest(heard: list[Heard], period_s: float = 1.0) -> dict[str, list[Any]]:
    """What each service said of the pose, thinned to one message a period: states and positions."""
    out: dict[str, list[Any]] = {topic.name: [] for topic in (topics.VISION, topics.HAPTIC, topics.FUSED)}
    due = dict.fromkeys(out, 0)
    for item in heard:
        name = item.topic.name
        if name not in out or item.time_ns < due[name]:
            continue
        due[name] = item.time_ns + round(period_s * 1e9)
        out[name].append([item.message.state, *np.round(item.message.position, 5).tolist()])
    return out


def write(path: Path) -> None:
    """Writes what this program gives now."""
    path.write_text(json.dumps({"mask": masks(), **digest(play())}, indent=None).replace("], [", "],\n  [") + "\n")


def written(path: Path) -> dict[str, list[Any]]:
    """What another process writes, with the instructions of x86-64-v3 on newer processors, too."""
    command = [sys.executable, "-m", "penumbra.tests.chain.test_replay", str(path)]
    subprocess.run(command, env={**os.environ, **PROCESSORS["x86-64-v3"]}, check=True)
    found: dict[str, list[Any]] = json.loads(path.read_text())
    return found


@pytest.fixture(scope="module")
def played(tmp_path_factory) -> dict[str, list]:
    return written(tmp_path_factory.mktemp("played") / "replay.json")


@pytest.fixture(scope="module")
def reference() -> dict[str, list]:
    return json.loads(REFERENCE.read_text())


def test_segmentation_gives_the_reference_s_masks(played, reference):
    ours, theirs = np.array(played["mask"]), np.array(reference["mask"])
    assert ours.shape == theirs.shape
    found = theirs[:, 1:].sum(axis=1)  # all but the background
    assert (np.abs(ours - theirs).sum(axis=1) / found).max() < 0.01


@pytest.mark.parametrize(("sense", "tolerance_m"), [("vision", 0.005), ("haptic", 0.001), ("fused", 0.003)])
def test_each_sense_gives_the_reference_s_poses(played, reference, sense, tolerance_m):
    ours, theirs = played[sense], reference[sense]
    assert len(ours) == len(theirs)
    same_state = [a[0] == b[0] for a, b in zip(ours, theirs, strict=True)]
    assert np.mean(same_state) > 0.95
    off = [np.linalg.norm(np.subtract(a[1:], b[1:])) for a, b, same in zip(ours, theirs, same_state, strict=True) if same]
    assert np.median(off) < tolerance_m


if __name__ == "__main__":
    write(Path(sys.argv[1])) if sys.argv[1:] else written(REFERENCE)
