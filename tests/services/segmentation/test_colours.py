import numpy as np
import pytest

from penumbra.services.segmentation.colours import Colours
from penumbra.shared.contract.labels import Label

SKIN, WALL, WOOD = (205, 160, 135), (110, 125, 150), (150, 100, 60)
ARM, FAR = np.s_[20:60, 30:110], np.s_[90:120, 30:110]
PERIOD_S = 0.05


def picture(rng, **places):
    """A wall with an arm at ARM and what else is told, by name; every pixel with noise."""
    image = np.empty((128, 128, 3))
    image[:] = WALL
    image[ARM] = SKIN
    for colour, place in places.values():
        image[place] = colour
    return np.clip(image + rng.normal(0.0, 6.0, image.shape), 0, 255).astype(np.uint8)


def margins(seen, sure=1.0):
    """Of a network that takes the pixels `seen` for the target."""
    margin = np.full((128, 128), -sure, np.float32)
    margin[seen] = sure
    return margin


def logits(margin):
    """Of forearm and background, all others being far from it."""
    out = np.full((len(Label), *margin.shape), -50.0, np.float32)
    out[Label.FOREARM], out[Label.BACKGROUND] = margin, 0.0
    return out


def masked(colours, image, margin, elapsed_s=PERIOD_S):
    return colours.classes(image, logits(margin), elapsed_s) == Label.FOREARM


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_an_arm_of_which_the_network_sees_the_edges_becomes_whole(rng):
    margin = margins(ARM)
    margin[24:56, 34:106] = -1.0  # the inside
    found = masked(Colours(), picture(rng), margin)
    assert found[ARM].mean() > 0.97
    found[18:62, 28:112] = False
    assert not found.any(), "nothing beyond the blurred edge"


def test_a_thing_of_the_same_colours_is_the_target_s_only_where_the_network_sees_some_of_it(rng):
    image = picture(rng, thing=(SKIN, FAR))
    margin = margins(ARM)
    assert not masked(Colours(), image, margin)[FAR].any()
    margin[90:120, 30:50] = 1.0  # a quarter of it
    assert masked(Colours(), image, margin)[FAR].mean() > 0.9


def test_sure_masks_stay_as_they_are(rng):
    wrong = margins(ARM, sure=9.0)
    wrong[FAR] = 9.0
    assert np.array_equal(masked(Colours(), picture(rng), wrong), wrong > 0)


@pytest.mark.parametrize("seen", [np.s_[0:0, 0:0], np.s_[:, :]], ids=["nothing", "everything"])
def test_where_all_is_one_nothing_is_said(rng, seen):
    margin = margins(seen, sure=200.0)
    assert np.array_equal(masked(Colours(), picture(rng), margin), margin > 0)


def test_what_was_seen_before_helps_while_little_is_seen(rng):
    """Of the arm a piece is left beside a board, and of this the network sees hardly any."""
    board = picture(rng, board=(WOOD, np.s_[10:70, 30:90]))
    piece, hardly = np.s_[20:60, 90:110], margins(np.s_[37:43, 96:104], sure=6.0)
    alone, informed = Colours(), Colours()
    for _ in range(5):
        masked(informed, picture(rng), margins(ARM))
    assert masked(alone, board, hardly)[piece].mean() < 0.2
    assert masked(informed, board, hardly)[piece].mean() > 0.8
    informed.forget()
    assert np.array_equal(masked(informed, board, hardly), masked(Colours(), board, hardly))


def test_colours_fade(rng):
    """After minutes an arm beside a board counts as it would in a first frame."""
    board = picture(rng, board=(WOOD, np.s_[10:70, 30:90]))
    hardly = margins(np.s_[37:43, 96:104], sure=6.0)
    found = []
    for elapsed_s in (PERIOD_S, 120.0):
        colours = Colours()
        for _ in range(5):
            masked(colours, picture(rng), margins(ARM))
        found.append(masked(colours, board, hardly, elapsed_s))
    new = masked(Colours(), board, hardly)
    assert (found[0] != new).sum() > 100
    assert np.array_equal(found[1], new)


def test_a_sleeve_that_goes_on_beyond_the_elbow_is_not_the_forearm_s(rng):
    """The network calls one half of an arm of one colour the upper arm, and the other the forearm."""
    found = logits(margins(np.s_[20:60, 70:110]))
    found[Label.UPPER_ARM, 20:60, 30:70] = 1.0
    classes = Colours().classes(picture(rng), found, PERIOD_S)
    assert (classes[20:60, 32:68] == Label.UPPER_ARM).mean() > 0.97
    assert (classes[20:60, 72:108] == Label.FOREARM).mean() > 0.97
