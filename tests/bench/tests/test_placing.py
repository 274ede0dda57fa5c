"""The benchmark of pads' places: what it measures is what it says."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.table import Table

from penumbra.services.skin.placing.layout import Placing, Wish
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.tests.bench import placing as bench


def test_the_true_signals_are_those_of_the_field_model_before_the_pads_that_feel_the_limb() -> None:
    found = Placing(cells.load("table"), Wish())
    sensing = found.sensing(tuple(found.present.values()))
    scenes = found.drawing.draw(found.room, 2, 7)
    far = replace(scenes, targets=scenes.targets + 3.0 * np.eye(4)[:, 3] * np.eye(4)[2][:, None])
    assert not np.any(bench._signals(found, sensing, far, 1))
    sizeless = replace(sensing, size=np.zeros(2))
    for k, signal in enumerate(bench._signals(found, sizeless, scenes, 1)):
        T_pads = scenes.pads(sensing.pads)[k]
        change = sensing.response.change(np.stack([rigid.inverse(T) for T in T_pads]) @ scenes.targets[k])
        expected = sensing.skin.gain * sensing.skin.sensitivity * change
        felt = signal > 3.0 * np.sqrt(sensing.skin.noise / bench.SAMPLES)
        assert felt.any()
        np.testing.assert_allclose(signal[felt], expected[felt], rtol=0.4)  # limbs of other sizes


@pytest.mark.slow
def test_the_benchmark_compares_errors_with_the_bound_for_each_layout(tmp_path) -> None:
    path = tmp_path / "placing.json"
    assert bench.main(["--cell", "table", "--scenes", "6", "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert [(row["pads"], row["prior"]) for row in result["rows"]] == [
        (pads, prior) for pads in ("8 present", "8 proposed") for prior in ("home", "track")
    ]
    home, track = result["rows"][:2]
    assert track["expected_cm"] < min(home["expected_cm"], 100.0 * np.sqrt(3.0) * bench.TRACKING[0])
    assert all(0.3 < row["median_ratio"] < 3.0 for row in result["rows"])
    assert [part.row_count for part in bench.tables(result) if isinstance(part, Table)] == [2, 4]
