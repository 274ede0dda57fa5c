"""The numbers of the haptic estimator that somebody may want to change."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class HapticSettings:
    """Settings of `estimator.Estimator`. Every field states its unit and where its value comes from.

    "Chosen" means by hand, on simulated limbs; `penumbra bench haptics` shows what a change does. A misfit is a mean squared
    residual in variances: one, where the limb explains the voltages. Odds are natural logarithms.
    """

    # ---- How a pose is forgotten

    memory_s: float = 10.0
    """Time constant [s] with which the track decays to home. Derived: with a home known to 12 cm it adds 5 mm of standard
    deviation in 10 ms, twice what a limb moves in that time. A gap in the voltages of this length starts the estimator anew."""
    roll_memory_s: float = 0.1
    """Time constant [s] with which the roll about the limb's axis decays to home. Chosen short, because the voltages hardly show
    the roll: a wrong one that was once believed must not be kept for seconds."""

    # ---- What the fused pose tells

    expected_sigma: float = 0.02
    """The solve starts from the fused pose while its position has at most this standard deviation [m] along its worst direction.
    Chosen: what a camera saw a moment ago to 2 cm tells apart places that feel alike."""
    expected_inflation: float = 2.0
    """Factor on the fused pose's standard deviations where it becomes the solve's prior. Chosen: the fused pose says where to
    look, and must not be counted as something felt."""
    expected_floor: tuple[float, float] = (0.01, 0.1)
    """Standard deviations [m, rad] added to that prior, for the same reason. Chosen."""

    # ---- Whether the voltages are explained

    track_misfit: float = 2.0
    """Smoothed misfit above which the track no longer explains the voltages and the solve starts from scratch. Chosen: the noise
    of a single window far from the pads, where few electrodes feel anything, doubles the misfit without telling places apart."""
    misfit_share: float = 0.2
    """Weight of the newest window in a smoothed misfit: five windows are remembered. Chosen."""
    misfit_cap: float = 6.0
    """Largest misfit that a window contributes to a smoothed one, so that one window cannot decide alone. Chosen."""
    strange_size: float = 3.5
    """Distance of the estimated size from the mean one, in standard deviations between people, above which the thing that is
    felt is no limb. Chosen: one person in 450 is beyond, and so is a metal bar, which feels like a very thin arm."""
    pad_misfit: float = 4.0
    """Smoothed misfit of a pad from which its electrodes lose weight as its square: the pad is mounted turned, or has another
    pad's calibration. Chosen."""
    pad_share: float = 0.03
    """Weight of the newest window in a pad's smoothed misfit: some thirty windows are remembered. Chosen."""
    pad_cap: float = 100.0
    """Largest squared residual, in variances, that an electrode contributes to its pad's misfit. Chosen."""

    # ---- Whether a limb is felt

    share_memory_s: float = 0.5
    """Time constant [s] with which the share of the signal that a thing leaves unexplained changes. Chosen: a thing that moves
    at 0.3 m/s shows another side by then, one at rest is averaged for so long."""
    odds_memory_s: float = 30.0
    """Time constant [s] with which evidence fades while something is felt. Chosen: a limb that a camera saw is one for 15 s
    more, unless its signals say otherwise."""
    odds_rate: float = 40.0
    """Largest change of the log odds [1/s], so that a burst of noise does not decide. Chosen: a limb is known after 0.12 s at
    the earliest."""
    limb_odds: float = 4.6
    """Log odds from which the thing that is felt is a limb, until they fall below zero. Derived: of a hundred objects one may be
    taken for a limb."""
    object_odds: float = 6.9
    """Log odds from which it is an object. Derived: one limb in a thousand may be refused."""
    most_odds: float = 10.0
    """Largest log odds, for or against. Chosen: after a change from one to the other 0.4 s decide."""
    seen_odds: float = 8.0
    """Log odds of a limb that is felt where a camera has just seen it. Chosen: 0.1 s that says otherwise takes it back."""
    absent_s: float = 5.0
    """Time [s] for which nothing was near after which what comes next may be anything. Chosen: a limb that leaves the pads'
    range behind an occluder, and comes back, stays known."""

    # ---- Where else the limb may be

    scratch_every: int = 3
    """Of so many consecutive windows that nothing explains, one is solved from scratch. Chosen for time: such a solve takes some
    milliseconds."""
    elsewhere_every: int = 5
    """Of so many tracked windows, one is also solved from another start. Chosen: as a limb comes near, the place where it may be
    splits in two within a few windows."""
    elsewhere_away: float = 0.06
    """Least distance along the limb [m] between the track and that other start. Chosen: from nearer, the solve ends where the
    track is."""
    same_place: float = 0.02
    """Standard deviation [m] that is added to the covariances of two places before they are compared. Chosen."""
    apart: float = 4.0
    """Squared Mahalanobis distance above which two places are two. Below it, one of them with its covariance stands for both.
    Chosen: two standard deviations."""
    beside_odds: float = 3.0
    """Log odds of the track over a rival that was found beside it and explains the window as well: twenty to one. Chosen with
    replays of `arm`: the rival was searched for, one of many places always explains a single window, and a limb that is followed
    rarely is elsewhere. With seven to one the track jumped to places up to 20 cm away, and stayed there for a quarter of a
    second; with fifty to one a limb that has jumped is found too late."""
    odds_step: float = 2.0
    """Largest change of the log odds by one window, so that a burst of noise does not decide. Chosen."""
    odds_decided: float = 7.0
    """Log odds from which the rival is dropped: a thousand to one. Chosen. Below zero the two change places."""
    slides: tuple[float, ...] = (0.0, -0.08, 0.08, -0.16, 0.16, -0.24, 0.24)
    """Displacements along the limb [m] of the starts from scratch, from home. Chosen to cover a forearm: its thick and thin parts
    feel alike."""
    clearance: float = 0.05
    """Least gap [m] between pads and limb at such a start. Chosen: a solve that starts inside a pad does not come out."""

    # ---- What is published

    error_lasts: float = 5.0
    """Number of successive windows in which field model and drift make about the same error. Its variance is multiplied by it,
    because fusion takes the windows' errors for independent. Chosen by the NEES of `penumbra bench haptics`."""
    doubt_lasts: float = 50.0
    """The same number for the doubt about two places: a second, in which one window after the other may prefer the wrong one.
    Chosen likewise."""
    size_lasts: float = 25.0
    """The same number for the error of the limb's size, which stays for as long as the person does. Chosen likewise."""
    links_error: float = 0.005
    """Standard deviation of the predicted effect of the robot's own links, as a share of that effect. Chosen."""
    farthest_gap: float = 1.0
    """Gap [m] that stands for this one and every larger one. Chosen far beyond the range of any pad."""
    range_share: float = 4.0 / 3.0
    """The pose is in range while the smallest gap is below this share of the pad's range: 20 cm for a range of 15 cm.
    Chosen."""
    worst_sigma: float = 0.03
    """The pose is in range while its best known direction has at most this standard deviation [m]. Chosen."""
