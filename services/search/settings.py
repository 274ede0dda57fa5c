"""Settings of the search for a target."""

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

    "Chosen" means by hand; `penumbra bench search` shows what a change does. An overlap is the intersection over union of mask
    and silhouette among scored pixels, in [0, 1]; a misfit is a mean squared offset of the contour, 1 to 3 for right poses.
    """

    # ---- Whether a pose is right

    fits: float = 0.8
    """Minimum overlap of a right pose. Measured: the network's masks reach 0.93 to 0.97 at the right pose."""
    fits_well: float = 0.9
    """Overlap from which no other explanation is searched for. Chosen between `fits` and the overlap of right poses."""
    fits_expected: float = 0.6
    """Minimum overlap of a pose that the image confirms and a sure prediction expects. Chosen: a mask that labels an occluder as
    the wall behind it is no reason to give up."""
    fits_shaped: float = 0.75
    """Minimum overlap of a limb that is not quite the mesh. Chosen: a surface 8 mm off that of a forearm of 4 cm radius costs a
    tenth; with 0.7, poses of wrong limbs were tracked in a film."""
    wrong_misfit: float = 6.0
    """Misfit from which a pose is wrong whatever its overlap. Chosen: twice what one right pose in a hundred exceeds."""
    other_shape: tuple[float, float] = (0.001, 0.012)
    """Standard deviation [m] of a limb's surface from the mesh's: the minimum that is no error of a mask, and the maximum of a
    right pose. Chosen: bodies differ by a tenth of a forearm's radius of 4 cm, and a sleeve adds a few millimetres."""
    shape_known: tuple[int, int] = (5, 20)
    """Number of pictures that showed the mesh, from which the limb has no other shape, and the maximum that is counted: a
    person's shape stays, and a mask that is wrong for a moment is no shape. Pictures in which the limb is lost count back.
    Chosen."""
    least_confidence: float = 0.2
    """Minimum probability that a pose is right (`Findings.confidence`) with which a limb that is the mesh is tracked. Chosen on
    2300 frames of the kinds of `penumbra bench search`: 12 of 82 wrong poses that nothing else refutes are below, and 3 of 483
    right ones."""
    gate: float = ONE_IN_10_000
    """Squared Mahalanobis distance between the prediction and another pose, above which the other pose is rejected."""

    # ---- Whether enough of the target shows

    hidden: float = 0.95
    """Maximum hidden share of a pose that a sure prediction expects. Chosen."""
    turning: tuple[float, float] = (0.05, 0.1)
    """Hidden share above which a roll is less certain than its covariance says, and the standard deviation [rad] that is added:
    the roll is searched for near the prediction. Measured in 30 replays of limbs that are hidden by a third to two thirds: rolls
    called sure to 12 degrees are off by more than three standard deviations in 2 to 4 % of the pictures, in which limbs turn by
    30 to 50 degrees a second. Chosen: twice as much makes covariances too cautious for limbs that rest."""
    least_points: float = 3.0
    """Minimum number of independent contour points of such a pose. Chosen: where two thirds of a limb are hidden 6 m away, 3.4 to
    3.6 are left in a picture 1280 pixels wide."""
    recognised: float = 0.5
    """Maximum hidden share of a shape that no sure prediction expects. Chosen: a smaller piece may be anything."""
    recognised_points: float = 8.0
    """Minimum number of independent contour points of such a shape. Chosen: two more than a pose has unknowns."""
    covers: float = 0.5
    """Share of the silhouette that is covered or outside the picture, above which a target that shows too little is occluded, not
    lost. Chosen."""

    # ---- What the prediction says

    sure: tuple[float, float] = (0.1, 0.1)
    """Maximum standard deviation of the position of a sure prediction: across the line of sight [m], and along it as a share of
    the distance if that is more, because a camera hardly measures the distance. Chosen."""
    expected: float = ONE_IN_10
    """Squared Mahalanobis distance from the prediction below which a pose counts as expected."""
    prior_inflation: float = 2.0
    """Factor on the prediction's standard deviations before it regularises the fit. Chosen: the prediction is only meant to keep
    the fit from diverging."""
    prior_floor: tuple[float, float] = (0.02, 0.09)
    """Standard deviations [m, rad] added to the prediction's for the same reason. Chosen."""
    beside: tuple[float, float] = (0.05, 0.3)
    """Standard deviations [m, rad] about a rival of the pose, with which it is fitted to the mask where the image does not
    confirm it as it is: a turned limb of which only a piece shows lies elsewhere. Chosen: half of the turns' spacing."""
    joint_margin: float = 0.02
    """Length [m] beyond the limb's predicted near end in which the mask is still used. Chosen: the prediction may be off."""

    # ---- Finding the target again

    detect_reach: float = 1.2
    """Reach of a region of the mask, in lengths of the target: nearer pixels belong to the region. Chosen above one, because the
    region may show either end."""
    home_gate: float = ONE_IN_100
    """Squared Mahalanobis distance from the target's home above which a shape is not accepted as the target."""
    detect_every_ns: dict[str, int] = field(default_factory=lambda: {"lost": 250_000_000, "doubtful": 1_000_000_000})
    """Minimum time [ns] between two detections, while the target is lost and while its pose is only doubtful. Chosen: a detection
    takes as long as twenty tracked frames."""
    recent_ns: int = 250_000_000
    """Time [ns] for which a target is also searched for where it was last tracked, if the prediction does not lead to it: an
    observer that another sense has led away needs some pictures to follow. Chosen: a reaching arm stays within a fit's reach."""
    explained: float = 0.5
    """Overlap with the whole region, a bare upper arm included, from which no other region is tried. Chosen."""
    detect_fits: int = 4
    """Number of hypotheses that are fitted per region: those with the largest overlap. Chosen for time."""
    start_overlap: float = 0.1
    """Minimum overlap of a start with the region to which it is fitted. Chosen low: its depth may be off by a quarter."""
    home_weight: float = 0.005
    """Overlap that one standard deviation from home costs a hypothesis. Chosen small: it decides between mirror images, which
    overlap equally."""

    # ---- The paper's method

    paper_sigma: tuple[float, float] = (0.02, 0.09)
    """Standard deviations [m, rad] published by `--method paper`. The position's is from the paper, which gives no covariance but
    an average error of less than 2 cm; the rotation's is chosen."""
    paper_fails: float = 0.3
    """Overlap below which an ascent of `--method paper` has lost the target and is restarted. Chosen: the visible part of a
    target beside an occluder overlaps more."""
