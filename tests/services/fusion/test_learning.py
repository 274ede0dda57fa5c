"""What is learned of how limbs move, from measurements of limbs that move in a known way."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from penumbra.services.fusion.learning import learned
from penumbra.services.fusion.settings import FusionSettings, Subject, with_motion
from penumbra.services.fusion.smoother import NothingMeasuredError, Smoother
from penumbra.shared.contract.senses import SENSES
from penumbra.shared.geometry.rigid import perturb
from penumbra.tests.support.fusion_data import HOME, SPREAD, VISION, Errors, motion, ns

STEADY = FusionSettings(learning=(0.0, 0.0))
TRUE = replace(STEADY, jerk=(40.0, 40.0), motion_time=(0.15, 0.15))


def watched(seconds: float, seed: int) -> Smoother:
    """Vision at 20 Hz of a limb that moves as in TRUE."""
    rng, period, of = np.random.default_rng(seed), 0.05, Smoother(Subject(HOME, SPREAD), STEADY)
    F, Q = motion(period, TRUE)
    kick, state, errors = np.linalg.cholesky(Q), np.zeros((3, 6)), Errors(SENSES[0].errors, period, rng)
    for k in range(round(seconds / period)):
        T = perturb(HOME, state[0])
        of.measure("vision", ns(k * period), perturb(T, -errors.draw(VISION)), VISION)
        state = F @ state + kick @ rng.normal(size=(3, 6))
        state[0, 3:] = np.clip(state[0, 3:], -0.5, 0.5)  # turns that wander off are no small ones any more
    return of


def test_the_motion_that_measurements_were_made_with_is_learned_and_makes_others_of_it_more_likely() -> None:
    found = learned([watched(10.0, 0), watched(10.0, 1)], STEADY)
    assert found.gain > 0.05 and found.measurements > 350
    assert np.allclose(np.log(found.settings.jerk[0] / TRUE.jerk[0]), 0.0, atol=np.log(3.0))
    assert np.allclose(np.log(found.settings.motion_time[0] / TRUE.motion_time[0]), 0.0, atol=np.log(2.0))


def test_too_little_is_refused() -> None:
    with pytest.raises(NothingMeasuredError, match="motion: expected 50 measurements or more to learn from, got 39; record"):
        learned([watched(2.0, 0)])


def test_a_file_of_learned_motion_makes_the_settings_and_any_other_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "motion.json"
    path.write_text(json.dumps({"jerk": [1.0, 2.0], "motion_time": [0.3, 0.4], "damping": 0.6, "measurements": 300}))
    assert with_motion(str(path)) == FusionSettings(jerk=(1.0, 2.0), motion_time=(0.3, 0.4), damping=0.6)
    for wrong in ("{}", "no json", '{"jerk": [1, 2], "motion_time": [0.3, 0], "damping": 0.6}', '{"jerk": 1}'):
        path.write_text(wrong)
        with pytest.raises(ValueError, match="expected"):
            with_motion(str(path))
    with pytest.raises(ValueError, match="expected a file of penumbra replay --motion"):
        with_motion(str(tmp_path / "none.json"))
