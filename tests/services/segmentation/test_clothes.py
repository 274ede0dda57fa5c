"""Sleeves and gloves change what an arm looks like and nothing else."""

import numpy as np
import pytest

from penumbra.services.segmentation.training import clothes
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.sim.picture.appearance import BLOTCHES, CHECKS, PLAIN, STRIPES, Texture

FAR_PX = clothes.RIM_PX + 3
"""Beyond the rim and the soft edge."""


@pytest.fixture
def film():
    """Three frames: an arm across grey noise, its hand to the right, shaded from dark to bright."""
    film = np.full((3, 64, 96, 4), Label.BACKGROUND, np.uint8)
    film[..., :3] = np.random.default_rng(1).integers(90, 110, film.shape[:-1])[..., None]
    film[:, 24:40, 8:60, 3], film[:, 24:40, 60:80, 3] = Label.FOREARM, Label.HAND
    film[:, 24:40, 8:80, :3] = (np.linspace(0.6, 1.0, 16)[:, None, None] * [220, 170, 140]).astype(np.uint8)[None]
    return film


@pytest.mark.parametrize("seed", range(12))
def test_only_arms_change_and_their_classes_stay(film, seed):
    worn = clothes.worn(film, np.random.default_rng(seed))
    arm = np.zeros((64, 96), bool)
    arm[24 - FAR_PX : 40 + FAR_PX, 8 - FAR_PX : 80 + FAR_PX] = True
    assert (worn[..., 3] == film[..., 3]).all()
    assert (worn[:, ~arm] == film[:, ~arm]).all()
    assert (worn[:, 24:40, 8:80] != film[:, 24:40, 8:80]).any()


def test_a_sleeve_keeps_the_shading_and_loses_the_colour_of_skin(film):
    blue = Texture((0.05, 0.1, 0.6), (0.05, 0.1, 0.6))
    covered = film[0, ..., 3] == Label.FOREARM
    dyed = clothes._dyed(film[0], covered, blue, np.zeros(covered.shape, np.float32))
    red, _, azure = np.moveaxis(dyed[26:38, 12:56].astype(int), -1, 0)
    assert (azure > 2 * red).all()
    assert (np.diff(azure.mean(1)) > 0).all()  # as bright to dark as the arm was


def test_the_unlabelled_rim_of_an_arm_is_clothed_too(film):
    film[:, 24:26, 8:60, 3] = UNLABELLED
    black = Texture((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    dyed = clothes._dyed(film[0], film[0, ..., 3] == Label.FOREARM, black, np.zeros((64, 96), np.float32))
    assert dyed[24:26, 12:56].mean() < 0.5 * film[0, 24:26, 12:56, :3].mean()


def test_a_film_without_arms_stays_as_it_is(film):
    film[np.isin(film[..., 3], TARGET_LABELS), 3] = Label.TORSO
    assert clothes.worn(film, np.random.default_rng(0)) is film


@pytest.mark.parametrize("pattern", [PLAIN, BLOTCHES, STRIPES, CHECKS])
def test_patterns_mix_two_colours_within_their_contrast(pattern):
    mixed = clothes._pattern(Texture((0, 0, 0), (1, 1, 1), pattern, contrast=0.5), (48, 48), np.random.default_rng(2))
    assert mixed.min() >= 0.0 and mixed.max() <= 0.5 + 1e-6
    assert (mixed.std() > 0.05) == (pattern != PLAIN)
