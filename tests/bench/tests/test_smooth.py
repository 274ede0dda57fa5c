"""The benchmark of the smoother: what it compares is of the same moments and knows what it says it knows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from penumbra.services.command import cli
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.settings import Subject
from penumbra.shared.contract import messages
from penumbra.shared.geometry import rigid
from penumbra.tests.bench import smooth
from penumbra.tests.support.fusion_data import HOME, SPREAD, VISION, ns


def test_the_pose_as_of_the_stamp_knows_nothing_of_later_measurements_and_the_smoothed_one_does() -> None:
    moved = rigid.perturb(HOME, [0.03, 0.0, 0.0, 0.0, 0.0, 0.0])
    told = [("vision", ns(0.05 * k), HOME if k < 20 else moved, VISION, None) for k in range(40)]
    stamps_ns = [ns(t) for t in (0.5, 0.95, 2.0)]  # the last one is after all measurements
    found = smooth.trajectories(Subject(HOME, SPREAD), list(reversed(told)), stamps_ns)
    observer = ErrorStateObserver(HOME, SPREAD)
    for source, stamp_ns, T, information, _ in told[:20]:
        observer.measure(source, stamp_ns, T, information)
    assert list(found) == stamps_ns[:2]
    poses = found[stamps_ns[1]]
    np.testing.assert_array_equal(poses["stamp"].T, observer.estimate(stamps_ns[1]).T)
    assert abs(poses["stamp"].T[0, 3] - HOME[0, 3]) < 1e-6 < abs(poses["smoothed"].T[0, 3] - HOME[0, 3])


def test_between_two_truths_the_limb_is_where_its_velocity_takes_it() -> None:
    said = [
        messages.Truth(
            stamp_ns=ns(t), target="forearm", frame="world", position=np.array([0.1 * t, 0.0, 0.0]),
            orientation=np.array([0.0, 0.0, 0.0, 1.0]), velocity=np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]), hidden=t, gap=0.1,
        )
        for t in (0.04, 0.0, 0.02)
    ]  # fmt: skip
    T, near = smooth.Truths(said).at(ns(0.026))
    assert T[0, 3] == pytest.approx(0.0026) and near.hidden == 0.02


def test_it_measures_every_situation_of_the_senses_and_shows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "smooth.json"
    assert cli.main(["bench", "smooth", "--runs", "1", "--seconds", "4", "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    row = found["situations"]["visible"]
    assert set(row["poses"]) == set(smooth.POSES) and row["moments"] > 10
    assert row["poses"]["smoothed"]["median_cm"] < 5.0
    shown = capsys.readouterr().out
    assert all(name in shown for name in found["situations"]) and "95 % band" in shown
