"""The weights of the search's verdict (`services.search.verdict`): `python -m penumbra.tests.bench.lib.verdicts` fits them and
prints them beside those in use.

A logistic regression on the frames of `penumbra bench search` in which right and wrong poses are told apart: of all its views,
with stiff and posed hands, with and without an image, with starts that are known to 1, 3 and 8 times the errors of the benchmark,
and on frames of targets that are all but hidden.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize

from penumbra.services import flags
from penumbra.services.search.verdict import WEIGHTS, Findings
from penumbra.services.segmentation.inference import load_segmenter
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.sets import shots
from penumbra.tests.bench.lib.judgements import gone_frames, lost_frames
from penumbra.tests.bench.lib.searches import VIEWS

CONDITIONS: tuple[tuple[shots.Hands, bool, float], ...] = (("stiff", True, 1.0), ("posed", True, 0.5), ("stiff", False, 0.33))
"""Hands, whether there is an image, and the number of scenes relative to the first."""
SPREADS = (1.0, 3.0, 8.0)
"""Factors on the standard deviations of the starts."""
DAMPING = 1e-4
"""Weight of the squared weights of standardised features, so that none is infinite."""


def frames(seed: int, count: int) -> Iterator[tuple[Findings, bool]]:
    """What the search found in frames of all conditions, and whether the pose is right. count: of scenes of each view in the
    first condition."""
    segmenter = load_segmenter()
    for view in VIEWS:
        for hands, has_image, share in CONDITIONS:
            seed += 1
            drawn = lost_frames(seed, math.ceil(share * count), segmenter, "wide", view, hands, has_image, SPREADS)
            for frame in drawn:
                if frame.estimate.findings is not None:
                    yield frame.estimate.findings, frame.is_shown and not frame.is_wrong
    for estimate in gone_frames(seed + 1, count, segmenter, "wide"):
        if estimate.findings is not None:
            yield estimate.findings, False


def fitted(features: Array, is_right: Array) -> Array:
    """The most likely weights (k,) of features (n, k), the first of which is one, for poses that are right or not (n,)."""
    mean, scale = features.mean(axis=0), features.std(axis=0)
    mean[0], scale[0] = 0.0, 1.0
    standard = (features - mean) / scale

    def unlikely(weights: Array) -> tuple[float, Array]:
        odds = standard @ weights
        damped = DAMPING * np.concatenate([[0.0], weights[1:]])
        cost = float(np.mean(np.logaddexp(0.0, odds) - is_right * odds) + weights @ damped)
        return cost, standard.T @ (1.0 / (1.0 + np.exp(-odds)) - is_right) / len(odds) + 2.0 * damped

    weights = minimize(unlikely, np.zeros(features.shape[1]), jac=True).x / scale
    weights[0] -= float(weights @ mean)
    return np.asarray(weights, np.float64)


@flags.command(
    "verdicts",
    "Fits the weights of the search's verdict.",
    flags.Option("--seed", type=int, default=21000, help="draws scenes, masks and starts"),
    flags.Option("--count", type=flags.positive, default=120, help="scenes of each view"),
    example="python -m penumbra.tests.bench.lib.verdicts --seed 21000",
)
def main(options: flags.Options) -> int:
    """Prints the fitted weights beside those in use."""
    found = list(frames(options.seed, options.count))
    features = np.array([list(each.features.values()) for each, _ in found])
    is_right = np.array([right for _, right in found], np.float64)
    weights = fitted(features, is_right)
    print(f"{len(found)} frames, {int(is_right.sum())} of them right")
    for name, weight in zip(WEIGHTS, weights, strict=True):
        print(f"{name:15} {weight:7.2f}   in use: {WEIGHTS[name]:7.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
