"""The haptic benchmark: its bound, and that it measures what it says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from penumbra.shared.geometry import rigid
from penumbra.sim.skin import field
from penumbra.tests.bench import haptics as bench


@pytest.fixture(scope="module")
def rig() -> bench.Rig:
    return bench.Rig("bare")


def test_limbs_are_placed_at_their_gap_in_front_of_the_pads_in_use(rig: bench.Rig) -> None:
    for count in bench.PADS:
        T, size = rig.place(np.random.default_rng(count), 0.05, count)
        assert rig.gap(T, size, count) == pytest.approx(0.05, abs=1e-4)
        assert len(rig.chosen[count]) == count and T[2, 3] > 0.05
        np.testing.assert_allclose(rig.axes(T, count) @ rig.axes(T, count).T, np.eye(6), atol=1e-12)


@pytest.mark.slow
def test_the_bounds_information_is_that_of_the_full_fields_derivatives(rig: bench.Rig) -> None:
    rng = np.random.default_rng(3)
    T, size = rig.place(rng, 0.06, 8)
    signal = rig.signal(field.limb(rig.mesh, *np.exp(size)), T, 8)

    def moved(error: np.ndarray) -> np.ndarray:
        return rig.signal(field.limb(rig.mesh, *np.exp(size + error[6:])), rigid.perturb(T, error[:6]), 8)

    steps = np.array([1e-3, 1e-3, 1e-3, 0.02, 0.01, 0.01, 0.02, 0.02])
    J = np.stack([(moved(s * e) - moved(-s * e)) / (2.0 * s) for s, e in zip(steps, np.eye(8), strict=True)], axis=1)
    full = J.T @ (J / (rig.skin.noise / bench.SAMPLES)[:, None])
    for spread in (bench.BROAD, bench.TRACKING):
        axes = rig.axes(T, 8)
        ours, theirs = (np.sqrt(bench._bound(each, axes, spread)) for each in (rig.information(signal, T, size), full))
        np.testing.assert_allclose(ours, theirs, rtol=0.08)


@pytest.mark.slow
def test_the_observer_is_not_sure_of_a_wrong_axis_of_a_limb_that_rests_far_from_the_hull() -> None:
    """Windows that were taken where their likelihoods peak led its yaw away by 74 degrees: 10 in place of 0.3."""
    assert bench.resting(bench.Rig("hull"), 4131, 0.125, 2).fused < 1.0


@pytest.mark.slow
def test_the_benchmark_writes_rows_as_promised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "QUICK", bench.Plan(1, 1, 1, 1, 1.2, 1))
    for name, value in (("GAPS", (0.03, 0.10)), ("PADS", (8, 1)), ("RESTING_GAPS", (0.03,)), ("REST_S", 1.5)):
        monkeypatch.setattr(bench, name, value)
    flags = ["--quick", "--array", "bare", "--method", "solve"]
    assert bench.main([*flags, "--json", str(tmp_path / "b.json"), "--picture", str(tmp_path / "b.png")]) == 0
    result = json.loads((tmp_path / "b.json").read_text())
    assert {(row["gap_m"], row["pads"], row["prior"], row["speed"]) for row in result["rows"]} == {
        (gap, pads, prior, speed) for gap in (0.03, 0.10) for pads in (8, 1) for prior in (False, True) for speed in (0.0, 0.5)
    }
    for row in result["rows"]:
        assert set(row["rmse_mm"]) == set(row["bound_mm"]) == {"lateral", "height", "axial"}
        assert set(row["rmse_deg"]) == set(row["bound_deg"]) == {"pitch", "yaw"}
        assert all(value > 0.0 for value in row["bound_mm"].values())
    near, far = (row for row in result["rows"] if row["pads"] == 8 and row["prior"] and row["speed"] == 0.0)
    assert near["bound_mm"]["height"] < far["bound_mm"]["height"] < 20.0
    assert near["rmse_mm"]["height"] < 10.0
    assert set(result["nees"]) >= {"mean", "band"} and result["ms"] > 0.0
    assert (tmp_path / "b.png").stat().st_size > 10_000
