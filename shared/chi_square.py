"""Quantiles of the chi-square distribution: thresholds of gates on squared Mahalanobis distances."""

from __future__ import annotations

QUANTILES = {
    0.9: (2.7055434540954, 4.6051701859881, 6.2513886311703, 7.7794403397349, 9.2363568997811, 10.6446406756684),
    0.99: (6.6348966010212, 9.2103403719762, 11.3448667301444, 13.2767041359876, 15.0862724693890, 16.8118938297709),
    0.999: (10.8275661706627, 13.8155105579643, 16.2662361962381, 18.4668269529032, 20.5150056524329, 22.4577444848253),
    0.9999: (15.1367052266234, 18.4206807439524, 21.1075134661602, 23.5127424449908, 25.7448319590559, 27.8563412360139),
}
"""Quantiles for 1 to 6 degrees of freedom, by probability."""


def quantile(share: float, rank: int) -> float:
    """Quantile at probability `share` for `rank` degrees of freedom, 1 to 6. Raises ValueError for a probability that is not in
    the table."""
    if share not in QUANTILES:
        raise ValueError(f"share of a gate: expected one of {', '.join(map(str, QUANTILES))}, got {share}")
    return QUANTILES[share][rank - 1]
