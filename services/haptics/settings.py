"""Settings of the haptic estimator."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class HapticSettings:
    """Settings of `estimator.Estimator`. Every field states its unit and the source of its value.

    "Chosen" means by hand, on simulated limbs; `penumbra bench haptics` shows the effect of a change. A misfit is a mean squared
    residual in variances: one, where the limb explains the voltages. Odds are natural logarithms.
    """

    # ---- How a pose is forgotten

    memory_s: float = 10.0
    """Time constant [s] with which the track decays to home. Derived: with a home known to 12 cm it adds 5 mm of standard
    deviation in 10 ms, twice the motion of a limb in that time. A gap in the voltages of this length resets the estimator."""
    roll_memory_s: float = 0.1
    """Time constant [s] with which the roll about the limb's axis decays to home. Chosen short, because the voltages hardly show
    the roll: a wrong estimate must not be kept for seconds."""

    # ---- What the fused pose tells

    expected_sigma: float = 0.02
    """Maximum standard deviation [m] of the fused position, along its worst direction, with which the limb is searched for
    nowhere else. Chosen: a camera's recent position to 2 cm separates places that feel alike."""
    expected_inflation: float = 2.0
    """Factor on the fused pose's standard deviations in the solve's prior. Chosen: the fused pose says where to look, and must
    not count as a measurement of the skin."""
    expected_floor: tuple[float, float] = (0.01, 0.1)
    """Standard deviations [m, rad] added to that prior, for the same reason. Chosen."""

    # ---- Whether the voltages are explained

    track_misfit: float = 2.0
    """Smoothed misfit above which the track no longer explains the voltages and the solve starts from scratch. Chosen: far from
    the pads, where few electrodes feel anything, the noise of a single window doubles the misfit without separating places."""
    misfit_share: float = 0.2
    """Weight of the newest window in a smoothed misfit: an average over about five windows. Chosen."""
    misfit_cap: float = 6.0
    """Maximum misfit that a window contributes to a smoothed one, so that one window cannot decide alone. Chosen."""
    strange_size: float = 3.5
    """Distance of the estimated size from the mean one, in standard deviations between people, above which the object is no limb.
    Chosen: one person in 450 is beyond, and so is a metal bar, which feels like a very thin arm."""
    pad_misfit: float = 4.0
    """Smoothed misfit of a pad above which the weight of its electrodes falls with the misfit's square: the pad is mounted
    turned, or has another pad's calibration. Chosen."""
    pad_share: float = 0.03
    """Weight of the newest window in a pad's smoothed misfit: an average over about thirty windows. Chosen."""
    pad_cap: float = 100.0
    """Maximum squared residual, in variances, that an electrode contributes to its pad's misfit. Chosen."""

    # ---- Whether a limb is felt

    share_memory_s: float = 0.5
    """Time constant [s] with which the unexplained share of an object's signal changes. Chosen: an object that moves at 0.3 m/s
    shows another side by then; for one at rest the noise is averaged over this time."""
    odds_memory_s: float = 30.0
    """Time constant [s] with which evidence fades while something is felt. Chosen: a limb that a camera saw stays a limb for 15 s
    more, unless its signals say otherwise."""
    odds_rate: float = 40.0
    """Maximum rate of change of the log odds [1/s], so that a burst of noise does not decide. Chosen: a limb is identified after
    0.12 s at the earliest."""
    limb_odds: float = 4.6
    """Log odds above which the object is a limb, until they fall below zero. Derived: one object in a hundred may be taken for a
    limb."""
    object_odds: float = 6.9
    """Log odds against a limb above which it is an object. Derived: one limb in a thousand may be refused."""
    most_odds: float = 10.0
    """Maximum log odds, for or against. Chosen: a change from one to the other is decided in 0.4 s."""
    seen_odds: float = 8.0
    """Log odds of a limb that is felt where a camera has just seen it. Chosen: contrary evidence over 0.1 s revokes it."""
    absent_s: float = 5.0
    """Time [s] without anything near after which the next object may be anything. Chosen: a limb that leaves the pads' range
    behind an occluder, and comes back, stays identified."""

    # ---- Where else the limb may be

    scratch_every: int = 3
    """Of this number of consecutive windows that nothing explains, one is solved from scratch. Chosen for time: such a solve
    takes some milliseconds."""
    scratch_solves: int = 3
    """Number of starts that such a window is solved from: those with the largest posterior probability. Measured in 228 windows
    of three replays: they lead to the best of all nine solutions in 99 %, in half of the time."""
    elsewhere_every: int = 5
    """Of this number of tracked windows, one is also solved from another start. Chosen: as a limb comes near, its possible place
    splits in two within a few windows."""
    elsewhere_away: float = 0.06
    """Minimum distance along the limb [m] between the track and that other start. Chosen: from nearer, the solve ends at the
    track."""
    same_place: float = 0.02
    """Standard deviation [m] added to the covariances of two places before they are compared. Chosen."""
    apart: float = 4.0
    """Squared Mahalanobis distance above which two places are distinct. Below it, one of them with its covariance stands for
    both. Chosen: two standard deviations."""
    beside_odds: float = 3.0
    """Log odds of the track over a rival that was found beside it and explains the window equally well: twenty to one. Chosen
    with replays of `arm`: the rival was searched for, some place always explains a single window, and a tracked limb is rarely
    elsewhere. With seven to one the track jumped to places up to 20 cm away, and stayed there for a quarter of a second; with
    fifty to one a limb that has jumped is found too late."""
    odds_step: float = 2.0
    """Maximum change of the log odds by one window, so that a burst of noise does not decide. Chosen."""
    odds_decided: float = 7.0
    """Log odds above which the rival is dropped: a thousand to one. Chosen. Below zero the two change places."""
    slides: tuple[float, ...] = (0.0, -0.08, 0.08, -0.16, 0.16, -0.24, 0.24)
    """Displacements along the limb [m] of the starts from scratch, from home. Chosen to cover a forearm: its thick and thin parts
    feel alike."""
    clearance: float = 0.05
    """Minimum gap [m] between pads and limb at such a start. Chosen: a solve that starts inside a pad does not come out."""

    # ---- What is published

    trusted: float = 0.7
    """Share of a window's information that is published. Chosen on replays of `arm`, in twelve of which 0.6 instead of 1.0 % of
    the fused poses of hidden limbs are beyond three sigma; they are called tracking for 65 instead of 73 % of the time, and with
    a half for 60 %."""
    error_lasts: float = 5.0
    """Number of successive windows in which field model and drift make about the same error. Its variance is multiplied by this
    number, because fusion assumes that the windows' errors are independent. Chosen by the NEES of `penumbra bench haptics`."""
    doubt_lasts: float = 50.0
    """The same number for the ambiguity between two places: a second, in which successive windows may all prefer the wrong one.
    Chosen likewise."""
    size_lasts: float = 25.0
    """The same number for the error of the limb's size, which lasts as long as the person stays. Chosen likewise."""
    links_error: float = 0.005
    """Standard deviation of the predicted effect of the robot's own links, as a share of that effect. Chosen."""
    farthest_gap: float = 1.0
    """Gap [m] that stands for itself and every larger one. Chosen far beyond the range of any pad."""
    range_share: float = 4.0 / 3.0
    """The pose is in range if the smallest gap is below this share of the pad's range: 20 cm for a range of 15 cm. Chosen."""
    worst_sigma: float = 0.03
    """The pose is in range if the standard deviation [m] of its best known direction is at most this. Chosen."""
