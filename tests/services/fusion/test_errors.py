"""How large the fused errors are: as large as the covariance says, and never much larger than the better sense's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.settings import FusionSettings
from penumbra.shared import chi_square
from penumbra.shared.contract import senses
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.tests.support.fusion_data import HOME, SKIN, SPREAD, VISION, Errors, motion, ns, without_roll

ERRORS = senses.Errors(0.8, 1.0, 1e-4)
SENSES = tuple(dataclasses.replace(sense, errors=ERRORS) for sense in senses.SENSES)
MATCHED = FusionSettings(velocity_spread=(0.4, 0.4), jerk=(8.0, 8.0), learning=(0.0, 0.0))
PERIOD = {"vision": 0.05, "haptic": 0.01}


# ---- consistency: the truth moves and the senses err as the filter assumes


def normalised_error(
    there: dict[str, tuple[float, float]], settings: FusionSettings, seed: int, seconds: float = 1.0, wrong: float = np.inf
) -> float:
    """Squared error in units of the covariance (6 degrees of freedom) after a run.

    there: sense -> from and until when [s]. wrong: from when on [s] the skin is off by 10 cm.
    """
    rng = np.random.default_rng(seed)
    spread = (0.05, 0.15)
    T = perturb(HOME, rng.normal(size=6) * np.repeat(spread, 3))
    rates = rng.normal(size=(2, 6)) * settings.velocity_spread[0] / np.array([[1.0], [settings.motion_time[0]]])
    observer = ErrorStateObserver(HOME, spread, settings, SENSES)
    h = 0.01
    F, Q = motion(h, settings)
    kick = np.linalg.cholesky(Q)
    errors = {name: Errors(ERRORS, PERIOD[name], rng) for name in there}
    for k in range(round(seconds / h) + 1):
        for name, (begin, end) in there.items():
            if not begin <= k * h <= end or k % round(PERIOD[name] / h):
                continue
            seen = np.diag(1.0 / np.square([0.01, 0.01, 0.02, 0.03, 0.03, 0.03]))
            if name == "haptic":
                seen = without_roll(T, SKIN)
            measured = perturb(T, -errors[name].draw(seen))
            if name == "haptic":
                seen = without_roll(measured, SKIN)
                measured = measured @ rigid.from_rpy([0, 0, 0], [rng.normal(), 0, 0])  # a roll that is made up
                if k * h >= wrong:
                    measured = perturb(measured, [0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
            observer.measure(name, ns(k * h), measured, seen)
        if k * h < seconds:
            way, *rates = F @ [np.zeros(6), *rates] + kick @ rng.normal(size=(3, 6))
            T = perturb(T, way)
    estimate = observer.estimate(ns(seconds))
    e = pose_error(T, estimate.T)
    return float(e @ np.linalg.solve(estimate.covariance, e))


@pytest.mark.parametrize(
    ("there", "settings"),
    [
        pytest.param({"vision": (0.0, 9.0)}, MATCHED, id="visible"),
        pytest.param({"haptic": (0.0, 9.0)}, MATCHED, id="haptic only"),
        pytest.param({"vision": (0.0, 0.5), "haptic": (0.4, 9.0)}, MATCHED, id="hand-over"),
        pytest.param(
            {"vision": (0.0, 0.5), "haptic": (0.4, 9.0)},
            dataclasses.replace(MATCHED, learning=(0.1, 5.0)),
            id="hand-over, learning",
        ),
    ],
)
def test_errors_are_as_large_as_the_covariance_says(there: dict[str, tuple[float, float]], settings: FusionSettings) -> None:
    runs = 30
    total = sum(normalised_error(there, settings, seed) for seed in range(runs))
    # fixed seeds: the band catches a wrong filter, not bad luck
    low, high = chi2.ppf([0.001, 0.999], 6 * runs)
    assert low < total < high


def test_errors_are_as_large_as_the_covariance_says_while_how_a_wrong_sense_changes_is_used() -> None:
    runs, both = 30, {"vision": (0.0, 9.0), "haptic": (0.0, 9.0)}
    total = sum(normalised_error(both, MATCHED, seed, wrong=0.5) for seed in range(runs))
    low, high = chi2.ppf([0.001, 0.999], 6 * runs)
    assert low < total < high


# ---- a sense whose covariance allows for rare errors


def seen_by(errors: senses.Errors, pose: Callable[[float], Array], seconds: float) -> ErrorStateObserver:
    """One that saw a limb at `pose(t)` at 20 Hz, stated to 3 cm and 0.1 rad, without any other sense."""
    vision = dataclasses.replace(senses.SENSES[0], errors=errors)
    observer = ErrorStateObserver(HOME, SPREAD, senses=(vision,))
    stated = np.diag(1.0 / np.square(np.repeat([0.03, 0.1], 3)))
    for t in np.arange(0.0, seconds, 0.05):
        observer.measure("vision", ns(t), pose(t), stated)
    return observer


def test_a_limb_is_followed_by_typical_errors_and_the_rare_ones_are_in_the_covariance() -> None:
    def setting_out(t: float) -> Array:
        return perturb(HOME, [0.3 * max(0.0, t - 1.0), 0.0, 0.0, 0.0, 0.0, 0.0])

    def lag(errors: senses.Errors) -> float:
        return float(pose_error(setting_out(1.25), seen_by(errors, setting_out, 1.3).estimate(ns(1.25)).T)[0])

    def variance(errors: senses.Errors) -> float:
        return float(seen_by(errors, lambda _: HOME, 3.0).estimate(ns(2.95)).covariance[0, 0])

    stated, typical = senses.Errors(0.5, 0.7), senses.Errors(0.5, 0.7, typical=0.2, sure=10.0)
    assert 0.0 < lag(typical) < 0.6 * lag(stated)
    assert 0.8 * 0.03**2 < variance(typical) < 0.03**2  # all but a tenth of the stated variance may last
    unsure = dataclasses.replace(typical, sure=1e-3)  # all of the variance is typical where a direction is hardly known
    assert lag(unsure) == pytest.approx(lag(stated), rel=1e-3)


# ---- senses whose errors last: fused must not be worse than the better one

CAMERA = rigid.look_at([0.35, -1.15, 0.90], [0.05, 0.0, 0.15])[:3, 3]


def reaches(rng: np.random.Generator) -> Callable[[float], Array]:
    """Minimum-jerk reaches of 1.2 s with rests of 0.4 s between random poses above a table; the pose at a time."""
    low, high = np.array([-0.08, -0.06, 0.07, -0.5, -0.25, -0.35]), np.array([0.08, 0.06, 0.25, 0.5, 0.25, 0.35])
    goals = rng.uniform(low, high, (40, 6))

    def at(t: float) -> Array:
        i, s = int(t // 1.6), min(1.0, (t % 1.6) / 1.2)
        x = goals[i] + (goals[i + 1] - goals[i]) * s**3 * (10 - 15 * s + 6 * s**2)
        return rigid.from_rpy(x[:3], x[3:])

    return at


def seen_by_camera(T: Array) -> Array:
    """Information of a camera's pose: 12 mm along its ray, 2 mm across."""
    ray = (T[:3, 3] - CAMERA) / np.linalg.norm(T[:3, 3] - CAMERA)
    across = np.eye(3) - np.outer(ray, ray)
    out = np.diag([0.0, 0, 0, 1 / 0.02**2, 1 / 0.02**2, 1 / 0.02**2])
    out[:3, :3] = across / 0.002**2 + np.outer(ray, ray) / 0.012**2
    return out


def felt_by_skin(T: Array, made_up: Array) -> Array:
    """Information of a skin's pose `made_up` of a limb at T: from 1 mm close by to 10 mm and more at 15 cm."""
    gap = np.clip(T[2, 3] - 0.04, 0.02, 0.15)
    worse = float(np.exp(np.interp(gap, [0.02, 0.15], np.log([1.0, 12.0]))))
    return without_roll(made_up, [0.002 * worse, 0.001 * worse, 0.0012 * worse, 1.0, 0.006 * worse, 0.01 * worse])


@pytest.mark.parametrize("lie", [1.0, 2.0], ids=["honest covariances", "errors twice as large as the senses say"])
def test_fused_is_never_much_worse_than_the_better_sense_although_their_errors_last(lie: float) -> None:
    errors: dict[str, dict[str, list[float]]] = {
        s: {"vision": [], "haptic": [], "fused": []} for s in ("visible", "both", "hidden")
    }
    for seed in range(2):
        rng = np.random.default_rng(seed)
        at = reaches(rng)
        observer = ErrorStateObserver(HOME, SPREAD)
        draw = {"vision": Errors(senses.Errors(0.95, 4.0), 0.05, rng), "haptic": Errors(senses.Errors(0.6, 0.7), 0.01, rng)}
        waiting: list[tuple[float, float, str, Array, Array]] = []
        newest: dict[str, tuple[float, float]] = {}
        for k in range(1200):
            t = 0.01 * k
            T = at(t)
            situation = ("visible", "both", "hidden")[int(t // 2) % 3]
            if k % 5 == 0 and situation != "hidden":
                seen = seen_by_camera(T)
                waiting.append((t + 0.055, t, "vision", perturb(T, -lie * draw["vision"].draw(seen)), seen))
            if situation != "visible":
                measured = perturb(T, -lie * draw["haptic"].draw(felt_by_skin(T, T)))
                waiting.append((t + 0.003, t, "haptic", measured, felt_by_skin(T, measured)))
            for message in [m for m in waiting if m[0] <= t]:
                waiting.remove(message)
                _, stamp, source, pose, seen = message
                observer.measure(source, ns(stamp), pose, seen)
                newest[source] = stamp, float(np.linalg.norm(pose_error(at(stamp), pose)[:3]))
            if t % 2 < 0.2:  # the situation has just changed
                continue
            errors[situation]["fused"].append(float(np.linalg.norm(pose_error(T, observer.estimate(ns(t)).T)[:3])))
            for source, (stamp, error) in newest.items():
                if t - stamp < (0.15 if source == "vision" else 0.03):
                    errors[situation][source].append(error)
    for situation, found in errors.items():
        median = {name: float(np.median(values)) for name, values in found.items() if len(values) > 100}
        # each sense against the truth at its own stamp, as if it were not late; fused against the truth now
        assert median.pop("fused") <= 1.1 * min(median.values()), situation


# ---- what is learned from the innovations


def test_a_limb_that_is_faster_than_expected_is_followed() -> None:
    rng = np.random.default_rng(0)
    learning, stubborn = ErrorStateObserver(HOME, SPREAD), ErrorStateObserver(HOME, SPREAD, FusionSettings(learning=(0.0, 0.0)))
    errors: dict[int, list[float]] = {id(learning): [], id(stubborn): []}
    for k in range(160):
        t = 0.05 * k
        s = min(t % 1.0 / 0.35, 1.0)  # every second a reach of 30 cm in 0.35 s by minimum jerk, to and fro: 1.6 m/s, 14 m/s^2
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        T = perturb(HOME, [0.0, 0.3 * (way if int(t) % 2 == 0 else 1.0 - way), 0.0, 0.0, 0.0, 0.0])
        measured = perturb(T, 0.003 * rng.normal(size=6))
        for observer in (learning, stubborn):
            observer.measure("vision", ns(t), measured, VISION)
            if t > 2.0:
                errors[id(observer)].append(float(np.linalg.norm(pose_error(T, observer.estimate(ns(t)).T)[:3])))
    assert np.mean(errors[id(learning)]) < 0.2 * np.mean(errors[id(stubborn)]), "it loses the limb at each reach"
    assert learning.log.counts["vision"].gated < 5


def test_a_fast_hand_that_rests_is_expected_to_set_out_as_it_did_before() -> None:
    observers = {speed: ErrorStateObserver(HOME, SPREAD) for speed in ("fast", "slow")}
    for k in range(100):
        t = 0.05 * k
        s = min(t % 1.0 / 0.35, 1.0) if t < 4.0 else 0.0
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        moved = 0.3 * (way if int(t) % 2 == 0 else 1.0 - way) if t < 4.0 else 0.0
        for speed, observer in observers.items():
            T = perturb(HOME, [0.0, moved if speed == "fast" else 0.01 * moved, 0.0, 0.0, 0.0, 0.0])
            observer.measure("vision", ns(t), T, VISION)
    sigma = {speed: float(observer.estimate(ns(5.05)).covariance[1, 1] ** 0.5) for speed, observer in observers.items()}
    # within 0.1 s a reach of 0.35 s has gone 5 cm
    assert 3.0 * sigma["fast"] > 0.05 > 3.0 * sigma["slow"]


def test_after_a_rest_of_seconds_a_fast_limb_is_no_longer_followed_wherever_one_sense_says() -> None:
    """A state that expects a fast hand is so uncertain between two pictures that a wrong skin passes the gate."""
    rng, observer, errors = np.random.default_rng(1), ErrorStateObserver(HOME, SPREAD), []
    sigma = 0.5 * np.sqrt(np.diag(np.linalg.inv(VISION)))
    for k in range(1200):  # it swings for two seconds, rests for eight, and then the skin is off by 10 cm
        T = perturb(HOME, [0.3 * np.sin(0.02 * np.pi * k) if 100 <= k < 300 else 0.0, *np.zeros(5)])
        off = np.array([0.0, 0.1 if k >= 1100 else 0.0, *np.zeros(4)])
        observer.measure("haptic", ns(k * 0.01), perturb(T, off + sigma * rng.normal(size=6)), VISION)
        if k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), perturb(T, sigma * rng.normal(size=6)), VISION)
        errors.append(float(np.linalg.norm(observer.estimate(ns(k * 0.01)).T[:3, 3] - T[:3, 3])))
    assert max(errors[1100:]) < 0.03


def test_a_sense_that_is_noisier_than_it_says_is_doubted_and_not_refused() -> None:
    rng = np.random.default_rng(0)
    observer = ErrorStateObserver(HOME, SPREAD)
    seen = np.diag(1.0 / np.square([0.002, 0.002, 0.002, 0.02, 0.02, 0.02]))
    errors = []
    for k in range(300):
        observer.measure("haptic", ns(0.01 * k), perturb(HOME, 3.0 * rng.normal(size=6) / np.sqrt(np.diag(seen))), seen)
        estimate = observer.estimate(ns(0.01 * k))
        if k == 100:
            at_first = observer.log.counts["haptic"].gated
        if k >= 100:
            errors.append(float(np.linalg.norm(pose_error(HOME, estimate.T)[:3])))
    assert observer.log.counts["haptic"].gated - at_first < 10
    assert np.median(errors) < 0.007  # a single measurement is 10 mm off
    assert np.sqrt(estimate.covariance[0, 0]) > 0.004


@pytest.mark.parametrize("share", chi_square.QUANTILES)
@pytest.mark.parametrize("rank", range(1, 7))
def test_gates_are_quantiles_of_chi_square(rank: int, share: float) -> None:
    # ppf loses digits where the share is close to one
    assert chi_square.quantile(share, rank) == pytest.approx(chi2.ppf(share, rank), rel=1e-11)


def test_a_gate_that_is_in_no_table_is_refused() -> None:
    with pytest.raises(ValueError, match=r"share of a gate: expected one of 0.9, 0.99, 0.999, 0.9999, got 0.5"):
        chi_square.quantile(0.5, 3)
