"""The settings of the search of a target."""

from __future__ import annotations

from dataclasses import dataclass, field

from penumbra.shared.chi_square import quantile

ONE_IN_10 = quantile(0.9, 6)
"""Squared Mahalanobis distance that one in 10 right poses exceeds."""
ONE_IN_100 = quantile(0.99, 6)
"""Squared Mahalanobis distance that one in 100 right poses exceeds."""
ONE_IN_10_000 = quantile(0.9999, 6)
"""Squared Mahalanobis distance that one in 10,000 right poses exceeds."""


@dataclass(frozen=True)
class SearchSettings:
    """Settings of `tracker.Search`. Every field states its unit and where its value comes from.

    "Chosen" means by hand; `penumbra bench search` shows what a change does. An overlap is the share of the scored pixels of mask
    and silhouette that both have, in [0, 1]; a misfit is a mean squared offset of the contour, 1 to 3 where the pose is right.
    """

    # ---- Whether a pose is right

    fits: float = 0.8
    """Least overlap of a pose that is right. Measured: masks of the network reach 0.93 to 0.97 at the right pose."""
    fits_well: float = 0.9
    """Overlap from which no other explanation is looked for. Chosen between `fits` and what right poses reach."""
    fits_expected: float = 0.6
    """Least overlap of a pose that the image confirms where a sure prediction expects it. Chosen: a mask that takes an occluder
    for the wall behind it is no reason to give up."""
    fits_shaped: float = 0.75
    """The same of a limb that is not quite the mesh. Chosen: a surface 8 mm off that of a forearm of 4 cm radius costs a tenth;
    with 0.7, poses of wrong limbs were tracked in a film."""
    wrong_misfit: float = 6.0
    """Misfit from which a pose is wrong whatever its overlap. Chosen: twice what one right pose in a hundred exceeds."""
    other_shape: tuple[float, float] = (0.001, 0.012)
    """Standard deviation [m] of a limb's surface from the mesh's: the least that is no error of a mask, and the largest of a
    pose that is right. Chosen: bodies differ by a tenth of a forearm's radius of 4 cm, and a sleeve adds a few millimetres."""
    shape_known: tuple[int, int] = (5, 20)
    """Number of pictures in which a limb was the mesh from which it is of no other shape, and the largest that is counted: a
    person's shape stays, and a mask that is wrong for a moment is none. Pictures in which it is lost count back. Chosen."""
    gate: float = ONE_IN_10_000
    """Squared Mahalanobis distance between the prediction and another pose, above which the other pose is rejected."""

    # ---- Whether enough of the target shows

    hidden: float = 0.95
    """Largest hidden share with which a pose is measured where a sure prediction expects it. Chosen."""
    turning: tuple[float, float] = (0.05, 0.1)
    """Hidden share from which a roll is off by more than its covariance says, and by how much more [rad]: it is looked for near
    the prediction. Measured in 30 replays, of limbs that are hidden by a third to two thirds: where a roll is called sure to 12
    degrees it is off by more than three standard deviations in 2 to 4 % of the pictures, in which limbs turn by 30 to 50 degrees
    a second. Chosen: twice as much makes covariances too cautious where limbs rest."""
    least_points: float = 3.0
    """Least number of independent points of contour of such a pose. Chosen: where two thirds of a limb are hidden
    6 m away, 3.4 to 3.6 are left in a picture 1280 pixels wide."""
    recognised: float = 0.5
    """Largest hidden share of a shape that nothing sure expects. Chosen: a smaller piece may be anything."""
    recognised_points: float = 8.0
    """Least number of independent points of contour of such a shape. Chosen: two more than a pose has unknowns."""
    covers: float = 0.5
    """Share of the silhouette that must be covered, or outside the picture, for a target that does not show enough to be called
    occluded. Otherwise it is lost. Chosen."""

    # ---- What the prediction says

    sure: tuple[float, float] = (0.1, 0.1)
    """Largest standard deviation of the position of a prediction that is called sure: across the line of sight [m], and along it
    as a share of the distance, where that is more, for a camera hardly sees it. Chosen."""
    expected: float = ONE_IN_10
    """Squared Mahalanobis distance up to which a pose is where the prediction says."""
    prior_inflation: float = 2.0
    """Factor on the prediction's standard deviations before it regularises the fit. Chosen: the prediction shall only keep the
    fit from diverging."""
    prior_floor: tuple[float, float] = (0.02, 0.09)
    """Standard deviations [m, rad] added to the prediction's for the same reason. Chosen."""
    joint_margin: float = 0.02
    """Length [m] beyond the limb's predicted near end in which the mask is still used. Chosen: the prediction may be off."""

    # ---- Finding the target again

    detect_reach: float = 1.2
    """Reach of a region of the mask, in lengths of the target: what is nearer belongs to the region. Chosen above one, because
    the region may show either end."""
    home_gate: float = ONE_IN_100
    """Squared Mahalanobis distance from the target's home above which a shape is not taken for the target."""
    detect_every_ns: dict[str, int] = field(default_factory=lambda: {"lost": 250_000_000, "doubtful": 1_000_000_000})
    """Least time [ns] between two detections, while the target is lost and while its pose is only doubtful. Chosen: a detection
    takes as long as twenty tracked frames."""
    recent_ns: int = 250_000_000
    """Time [ns] for which a target is looked for where it was tracked last, too, where the prediction does not lead to it: an
    observer that another sense has led away takes some pictures to follow. Chosen: a reaching arm stays within a fit's reach."""
    explained: float = 0.5
    """Overlap with all of a region, a bare upper arm included, from which no other region is tried. Chosen."""
    detect_fits: int = 4
    """Number of hypotheses that are fitted in a region: those that overlap best. Chosen for time."""
    start_overlap: float = 0.1
    """Least overlap with a region of a start that is fitted to it. Chosen low: its depth may be off by a quarter."""
    home_weight: float = 0.005
    """Overlap that one standard deviation from home costs a hypothesis. Chosen small: it decides between mirror images, which
    overlap equally."""

    # ---- The paper's method

    paper_sigma: tuple[float, float] = (0.02, 0.09)
    """Standard deviations [m, rad] published by `--method paper`. The position's is from the paper, which gives no covariance but
    an average error of less than 2 cm; the rotation's is chosen."""
    paper_fails: float = 0.3
    """Overlap below which an ascent of `--method paper` has lost the target and starts anew. Chosen: what the target shows beside
    an occluder overlaps more."""
