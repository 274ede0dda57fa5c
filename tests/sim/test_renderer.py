"""The simulated camera: geometry of labels, light and shadow, and what is hidden."""

from typing import Any

import numpy as np
import pytest
import trimesh

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.sim.picture import appearance, renderer

GREY = appearance.Appearance(appearance.Texture((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))


def box(extents, label) -> renderer.Shape:
    solid = trimesh.creation.box(extents)
    labels = np.full(len(solid.faces), label, np.uint8)
    return renderer.Shape.of(anatomy.Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int32), labels))


@pytest.fixture
def table() -> description.Cell:
    return description.load("table")


def look(**changes) -> appearance.Look:
    plain = appearance.Appearance(appearance.Texture((0.1, 0.1, 0.3), (0.1, 0.1, 0.3)), casts_shadow=False)
    settings: dict[str, Any] = {
        "lamp": (0.0, 0.0, 2.0),
        "lamp_colour": (0.7,) * 3,
        "ambient": (0.3,) * 3,
        "background": plain,
        "blur_px": 0.0,
    }
    return appearance.Look(**settings | {"noise": 0.0} | changes)


def scene(table, *more):
    forearm = renderer.Shape.of(anatomy.forearm_mesh(table.body))
    return [renderer.Body(forearm, rigid.from_rpy((0, 0, 0.2), (0, 0, 0)), GREY), *more]


def test_nothing_hides_a_lone_arm_and_a_wall_before_it_hides_it_all(table):
    view, rng = renderer.Renderer(table.cameras["front"]), np.random.default_rng(0)
    alone = scene(table)
    picture = view.render(alone, look(), rng)
    assert view.hidden_fraction(picture, alone, 0) == 0.0
    assert {Label.FOREARM, Label.HAND, Label.BACKGROUND} == set(np.unique(picture.labels))
    wall = renderer.Body(box((2.0, 0.01, 2.0), Label.OCCLUDER), rigid.transform((0, -0.6, 0.3)), GREY)
    covered = scene(table, wall)
    picture = view.render(covered, look(), rng)
    assert view.hidden_fraction(picture, covered, 0) == 1.0


def test_a_crop_is_the_same_picture_as_that_part_of_the_whole(table):
    bodies, rng = scene(table), np.random.default_rng(0)
    whole = renderer.Renderer(table.cameras["front"]).render(bodies, look(), rng)
    crop = renderer.Renderer(table.cameras["front"], (208, 152, 160, 120)).render(bodies, look(), rng)
    np.testing.assert_array_equal(crop.labels, whole.labels[152:272, 208:368])
    assert np.abs(crop.image.astype(int) - whole.image[152:272, 208:368]).max() <= 1


def test_what_is_kept_of_earlier_pictures_is_not_seen_in_later_ones(table):
    camera, red = table.cameras["front"], appearance.Appearance(appearance.Texture((0.8, 0.1, 0.1), (0.8, 0.1, 0.1)), gloss=0.4)
    top = renderer.Body(box((1.2, 0.8, 0.02), Label.BACKGROUND), rigid.transform((0, 0, -0.01)), GREY)
    arm = scene(table)[0]
    wall = box((2.0, 0.01, 2.0), Label.OCCLUDER)
    away, before = (renderer.Body(wall, rigid.transform((0, y, 0.3)), GREY) for y in (-5.0, -0.6))
    painted = renderer.Body(arm.shape, arm.T_world_body, red)
    turned = renderer.Body(arm.shape, arm.T_world_body @ rigid.from_rpy((0, 0, 0), (1.0, 0, 0)), red)
    one, other = look(), look(lamp=(1.0, -1.0, 2.0))
    pictures = [
        ([arm, top, away], one),
        ([arm, top, away], one),
        ([painted, top, before], one),  # it changes while it cannot be seen
        ([painted, top, away], one),
        ([turned, top, away], one),
        ([turned, top, away], other),
        ([top, turned, away], other),
        ([top], other),
        ([arm, top, away], one),
    ]
    view = renderer.Renderer(camera)
    for bodies, light in pictures:
        image = view.render(bodies, light, np.random.default_rng(0)).image
        fresh = renderer.Renderer(camera).render(bodies, light, np.random.default_rng(0)).image
        np.testing.assert_array_equal(image, fresh)


def test_the_table_is_darker_in_the_arm_s_shadow(table):
    ground = appearance.Appearance(GREY.texture, casts_shadow=False)
    top = renderer.Body(box((1.2, 0.8, 0.02), Label.BACKGROUND), rigid.transform((0, 0, -0.01)), ground)
    view, rng = renderer.Renderer(table.cameras["front"]), np.random.default_rng(0)
    bare = view.render([top], look(), rng).image
    shaded = view.render(scene(table, top), look(), rng)
    where = rigid.apply(rigid.inverse(table.cameras["front"].T_world_camera), (0.02, 0.0, 0.0))  # right under the arm
    u, v = (table.cameras["front"].K @ (where / where[2]))[:2].round().astype(int)
    assert shaded.labels[v, u] == Label.BACKGROUND
    assert shaded.image[v, u].mean() < 0.75 * bare[v, u].mean()


def test_an_image_has_the_noise_asked_for(table):
    bodies = scene(table)
    view = renderer.Renderer(table.cameras["front"])
    noisy = look(noise=0.02)
    first, second = (view.render(bodies, noisy, np.random.default_rng(seed)).image.astype(float) for seed in (1, 2))
    spread = (first - second)[:100, :100].std() / np.sqrt(2) / 255
    assert 0.6 * 0.02 <= spread <= 1.05 * 0.02  # less in the dark, as _develop says


def test_looks_are_drawn_from_the_seed_alone():
    assert appearance.look(np.random.default_rng(5)) == appearance.look(np.random.default_rng(5))
    assert appearance.person(np.random.default_rng(5)) != appearance.person(np.random.default_rng(6))
