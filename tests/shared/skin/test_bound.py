"""The Cramér-Rao bound of the skin's field model."""

import itertools

import numpy as np
import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.skin import bound
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response

T = rigid.from_rpy((0.02, -0.01, 0.13), (0.2, 0.1, 0.3))
SAMPLES = 20


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


def test_the_information_is_that_of_the_signals_differences_between_poses_and_sizes(table: cells.Cell) -> None:
    skin, response = Skin(table), Response(table, "forearm")
    pads = skin.T_world_pads()

    def signal(error: np.ndarray) -> np.ndarray:
        moved = rigid.perturb(T, error[:6])
        change = response.change(np.stack([rigid.inverse(pad) @ moved for pad in pads]), error[6:])
        return np.asarray(skin.gain * skin.sensitivity * change)

    steps = np.array([*np.full(3, 5e-4), *np.full(3, 3e-3), 5e-3, 5e-3])
    J = np.stack([(signal(h * e) - signal(-h * e)) / (2.0 * h) for h, e in zip(steps, np.eye(8), strict=True)], axis=1)
    variance = skin.noise / SAMPLES + (response.error * signal(np.zeros(8))) ** 2
    expected = J.T @ (J / variance[:, None])
    found = bound.information(skin, response, pads, T, (0.0, 0.0), SAMPLES)
    assert found.shape == (8, 8, 8)
    prior = bound.prior(table.targets["forearm"])
    ours, theirs = (np.sqrt(np.diag(np.linalg.inv(each + prior))) for each in (found.sum(axis=0), expected))
    np.testing.assert_allclose(ours, theirs, rtol=0.02)


def test_an_electrode_at_the_end_of_its_scale_tells_nothing(table: cells.Cell) -> None:
    near = rigid.transform((-0.04, -0.04, 0.047))  # three millimetres above a pad
    kind = table.pad_types["five"]
    found = {}
    for name, reference in (("as built", 3.3), ("never full", 100.0)):
        own = kind.model_copy(update={"chain": kind.chain.model_copy(update={"adc_reference": reference})})
        cell = table.model_copy(update={"pad_types": {"five": own}})
        skin, response = Skin(cell), Response(cell, "forearm")
        found[name] = bound.information(skin, response, skin.T_world_pads(), near, (0.0, 0.0), SAMPLES)
    less, all_of_it = (np.trace(found[name], axis1=1, axis2=2) for name in ("as built", "never full"))
    assert less.min() >= 0.0
    assert (less < 0.99 * all_of_it).any() and (less == all_of_it).any()


def test_more_pads_never_expect_a_larger_error_and_none_expect_the_homes_spread(table: cells.Cell) -> None:
    skin, response = Skin(table), Response(table, "forearm")
    information = bound.information(skin, response, skin.T_world_pads(), T, (0.0, 0.0), SAMPLES)
    prior = bound.prior(table.targets["forearm"])
    errors = [float(bound.position_error(prior + information[:count].sum(axis=0))) for count in range(9)]
    assert errors[0] == pytest.approx(np.sqrt(3.0) * table.targets["forearm"].home_spread.position)
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))
