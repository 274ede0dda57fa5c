"""Quantiles of the chi-square distribution: squared Mahalanobis distances that a gate lets pass."""

from __future__ import annotations

QUANTILES = {
    0.99: (6.634896601021217, 9.210340371976182, 11.344866730144368, 13.276704135987625, 15.086272469388991, 16.811893829770927),
    0.999: (
        10.827566170662733,
        13.815510557964274,
        16.26623619623813,
        18.466826952903173,
        20.515005652432876,
        22.457744484825323,
    ),
    0.9999: (
        15.136705226623397,
        18.420680743952364,
        21.10751346616021,
        23.512742444990838,
        25.744831959055876,
        27.856341236013918,
    ),
}
"""By the share of squares that are below, for 1 to 6 degrees of freedom."""


def quantile(share: float, rank: int) -> float:
    """The quantile of `share` for `rank` degrees of freedom, 1 to 6. Raises ValueError for a share that is not in the table."""
    if share not in QUANTILES:
        raise ValueError(f"share of a gate: expected one of {', '.join(map(str, QUANTILES))}, got {share}")
    return QUANTILES[share][rank - 1]
