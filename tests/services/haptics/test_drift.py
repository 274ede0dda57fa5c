"""What is learned of gains and offsets that drift, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.haptics.drift import BLOCK_S, CALIBRATED, GAIN_SPREAD, OFFSET_SPREAD, Drift
from penumbra.services.haptics.estimator import Estimator
from penumbra.shared.body.anatomy import SIZE_SPREAD, target_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response

SAMPLES = 20
EVERY_S = 0.1
SIZE = np.array([0.03, -0.2])
"""A person's size, which the estimator does not know."""
SEEN = np.diag(np.repeat([0.005, 0.05], 3) ** 2)
"""Covariance of what a camera sees."""


@pytest.fixture(scope="module")
def response(table: cells.Cell) -> Response:
    return Response(table, "forearm")


class Bench:
    """An estimator before a skin whose electrodes have drifted by gain (n,) and offset (n,) [V]. person: what is behind the
    limb; the estimator takes its shoulder to be where people's usually are."""

    def __init__(
        self,
        table: cells.Cell,
        response: Response,
        gain: Array | None = None,
        offset: Array | None = None,
        person: Posture | None = None,
    ):
        self.skin, self.response = Skin(table), response
        n = len(self.skin)
        self.gain = np.zeros(n) if gain is None else gain
        self.offset = np.zeros(n) if offset is None else offset
        mesh = target_mesh(table.targets["forearm"], table)
        home = rigid.from_rpy((0.0, 0.0, 0.15), (0.0, 0.0, 0.0))
        surface = Surface(mesh.vertices, mesh.faces)
        usual = None if person is None else Posture.usual(table, table.targets["forearm"])
        self.estimator = Estimator(self.skin, response, surface, home, np.repeat([0.12, 0.4], 3), posture=usual)
        self.person = person
        self.rng, self.pads, self.clock_s = np.random.default_rng(3), self.skin.T_world_pads(), 0.0

    def limb(self, T: Array, size: Array = SIZE) -> Array:
        """Signals (n,) [V] of a limb and its person."""
        parts = [T, *(self.person.poses(T) if self.person else [])]
        return self.skin.gain * self.skin.sensitivity * self.response.person(self.pads, parts, size)

    def window(self, signal: Array, seen: Array | None = None) -> None:
        """A window, with the pose that a camera has just seen."""
        self.clock_s += EVERY_S
        noise = np.sqrt(self.skin.noise / SAMPLES) * self.rng.standard_normal(len(signal))
        volts = self.skin.a3 + self.skin.polarity * ((1.0 + self.gain) * signal + self.offset) + noise
        used = np.full(len(signal), SAMPLES)
        self.estimator.update(int(self.clock_s * 1e9), volts, used, self.pads, (), None if seen is None else (seen, SEEN))

    def pass_by(self, seconds: float, off: Array | None = None, other: Array | None = None) -> None:
        """A limb moves before the pads and a camera sees it, off by (6,); another thing adds (n,) [V]."""
        for t in np.arange(0.0, seconds, EVERY_S):
            way = (0.05 * np.sin(0.9 * t), 0.04 * np.sin(0.5 * t), 0.11 + 0.045 * np.sin(0.7 * t))
            T = rigid.from_rpy(way, (0.0, 0.0, 0.1 * np.sin(0.3 * t)))
            seen = rigid.perturb(T, np.zeros(6) if off is None else off)
            self.window(self.limb(T) + (0.0 if other is None else other), seen)

    def rest(self, seconds: float, signal: Array | None = None, seen: Array | None = None) -> None:
        """Nothing near, or these signals (n,) [V]."""
        for _ in range(round(seconds / EVERY_S)):
            self.window(np.zeros(len(self.skin)) if signal is None else signal, seen)


def test_offsets_are_learned_while_nothing_is_near_with_their_uncertainty(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    n = len(bench.skin)
    bench.offset = 1e-3 * np.random.default_rng(0).standard_normal(n)
    bench.rest(60.0)
    error = bench.estimator.drift.offset - bench.offset
    sigma = bench.estimator.drift.sigma[1]
    assert np.sqrt(np.mean(error**2)) < 2e-4 and sigma.max() < 2e-4
    assert 0.3 < np.mean((error / sigma) ** 2) < 2.0  # of forty electrodes
    np.testing.assert_allclose(bench.estimator.drift.gain, 0.0, atol=1e-12)


def test_a_limb_at_rest_that_no_camera_sees_is_not_learned_away(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    bench.rest(60.0, bench.limb(rigid.from_rpy((0.0, 0.0, 0.12), (0.0, 0.0, 0.0))))
    assert not bench.estimator.drift.offset.any() and not bench.estimator.drift.gain.any()


def test_gains_of_single_electrodes_and_offsets_are_learned_where_a_camera_sees_the_limb(
    table: cells.Cell, response: Response
) -> None:
    rng, n = np.random.default_rng(1), len(Skin(table))
    bench = Bench(table, response, 0.01 * rng.standard_normal(n), 5e-4 * rng.standard_normal(n))
    bench.pass_by(300.0)
    drift = bench.estimator.drift
    own = drift.gain - bench.gain - (drift.gain - bench.gain).mean()
    assert np.std(own) < 0.7 * np.std(bench.gain)
    assert np.std(drift.offset - bench.offset) < 0.4 * np.std(bench.offset)
    assert np.mean(((drift.offset - bench.offset) / drift.sigma[1]) ** 2) < 2.0


def test_what_the_camera_is_off_by_is_not_taken_for_drift(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    bench.pass_by(120.0, off=np.array([0.0, 0.0, 0.008, 0.0, 0.03, 0.0]))
    drift = bench.estimator.drift
    assert np.abs(drift.gain).mean() < 2.0 * drift.sigma[0].mean() and np.abs(drift.gain).mean() < 0.02
    assert np.sqrt(np.mean(drift.offset**2)) < 2e-4


@pytest.mark.parametrize("offset", [(0.12, -0.1, -0.15), (0.0, 0.0, 0.12), (-0.1, 0.1, 0.1)])
def test_where_the_shoulder_is_is_learned_while_a_camera_sees_the_limb(
    table: cells.Cell, response: Response, offset: tuple[float, float, float]
) -> None:
    usual = Posture.usual(table, table.targets["forearm"])
    assert usual is not None
    bench = Bench(table, response, person=replace(usual, shoulder=usual.shoulder + np.array(offset)))
    bench.pass_by(60.0)
    drift = bench.estimator.drift
    error, covariance = drift.shoulder[0] - offset, drift.shoulder[1]
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(offset)
    assert error @ np.linalg.solve(covariance, error) < 9.0
    assert np.sqrt(np.mean(drift.offset**2)) < 2e-4  # what the person adds is not taken for drift


def test_an_electrode_with_a_fault_is_left_out_while_a_camera_sees_the_limb(table: cells.Cell, response: Response) -> None:
    offset = np.zeros(len(Skin(table)))
    offset[3] = 0.015
    bench = Bench(table, response, offset=offset)
    bench.pass_by(30.0)
    assert np.abs(np.delete(bench.estimator.drift.offset, 3)).max() < 5e-4
    assert abs(bench.estimator.drift.offset[3]) < 5e-3


def test_another_thing_beside_the_limb_is_not_learned_away(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    thing = 10.0 * bench.limb(rigid.from_rpy((0.3, 0.1, 0.06), (0.0, 0.0, 1.5)))
    bench.pass_by(30.0, other=thing)
    assert np.abs(bench.estimator.drift.offset).max() < 1e-3 and np.abs(bench.estimator.drift.gain).max() < 0.01


def test_an_object_at_rest_is_not_learned_away(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    thing = bench.limb(rigid.from_rpy((0.0, 0.0, 0.10), (0.0, 0.0, 0.0))) * np.random.default_rng(2).uniform(0.5, 1.5, 40)
    bench.rest(30.0, thing)
    assert bench.estimator.identity.verdict == "object"
    assert not bench.estimator.drift.offset.any()


def test_a_rest_that_has_jumped_is_learned_anew_and_one_too_far_off_is_not(table: cells.Cell, response: Response) -> None:
    bench = Bench(table, response)
    bench.offset[3], bench.offset[7] = 0.004, -0.03
    bench.rest(30.0)
    assert bench.estimator.drift.offset[3] == pytest.approx(0.004, abs=5e-4)
    assert bench.estimator.drift.offset[7] == pytest.approx(0.0, abs=5e-4)


def test_uncertainty_grows_until_it_is_that_of_an_old_calibration(table: cells.Cell) -> None:
    skin = Skin(table)
    drift = Drift(skin, 0.0, np.array([*SIZE_SPREAD, 0.1, 0.1, 0.1]))
    new = drift.sigma
    np.testing.assert_allclose(new[0], CALIBRATED[0], rtol=0.02)
    np.testing.assert_allclose(new[1], CALIBRATED[1])
    drift.predict(10.0 * BLOCK_S)
    assert (drift.sigma[0] > new[0]).all() and (drift.sigma[1] > new[1]).all()
    drift.predict(1e6)
    np.testing.assert_allclose(drift.sigma[0], GAIN_SPREAD, rtol=0.02)  # beside the mean of all
    np.testing.assert_allclose(drift.sigma[1], OFFSET_SPREAD)


def test_a_pose_is_less_certain_after_an_hour_without_voltages(table: cells.Cell, response: Response) -> None:
    T = rigid.from_rpy((0.0, 0.0, 0.14), (0.0, 0.0, 0.0))
    found = []
    for waits_s in (0.0, 3600.0):
        bench = Bench(table, response)
        bench.rest(1.0)
        bench.clock_s += waits_s
        signal = bench.limb(T)
        bench.rest(1.0, signal, T)
        used = np.full(len(signal), SAMPLES)
        stamp_ns = int((bench.clock_s + EVERY_S) * 1e9)
        estimate = bench.estimator.update(stamp_ns, bench.skin.a3 + bench.skin.polarity * signal, used, bench.pads)
        found.append(np.linalg.eigvalsh(estimate.information)[-1])
    assert found[1] < 0.5 * found[0]
