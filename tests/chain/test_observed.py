"""What is measured of a fault from outside, on messages whose numbers are known."""

import msgspec
import numpy as np
import pytest

from penumbra.shared.contract import messages, topics
from penumbra.tests.support import observed
from penumbra.tests.support.nodes import pose
from penumbra.tests.support.observed import Seen

SENSES = (topics.VISION, topics.HAPTIC)


def fused(at_s, state="tracking", x=0.0, stamp_ns=None):
    message = pose(round(1e9 * at_s) if stamp_ns is None else stamp_ns, x)
    return Seen(at_s, msgspec.structs.replace(message, state=state))


def haptic(at_s, state="in_range"):
    return Seen(
        at_s,
        messages.HapticPose(
            stamp_ns=round(1e9 * at_s),
            sample_stamp_ns=round(1e9 * at_s),
            target="forearm",
            frame="world",
            position=np.zeros(3),
            orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            information=np.eye(6),
            gap=0.05,
            state=state,
        ),
    )


def truth(at_s, speed=0.0):
    return Seen(
        at_s,
        messages.Truth(
            stamp_ns=round(1e9 * at_s),
            target="forearm",
            frame="world",
            position=np.array([speed * at_s, 0.0, 0.2]),
            orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            velocity=np.array([speed, 0, 0, 0, 0, 0]),
            hidden=0.0,
            gap=0.05,
        ),
    )


def test_a_gap_is_where_no_pose_was_known_while_a_sense_was_alive():
    poses = [fused(t) for t in (0.0, 0.1, 0.9, 1.0)]
    alive = [haptic(t / 100) for t in range(101)]
    assert observed.gap_s(poses, [(topics.HAPTIC, alive)], 1.0) == pytest.approx(0.8)
    lost = [*poses[:2], fused(0.5, "lost"), *poses[2:]]
    assert observed.gap_s(lost, [(topics.HAPTIC, alive)], 1.0) == pytest.approx(0.8), "to say lost is no pose"
    assert observed.gap_s(poses[:2], [(topics.HAPTIC, alive)], 1.0) == pytest.approx(0.9), "until the end"
    assert observed.gap_s(poses[2:], [(topics.HAPTIC, alive)], 1.0) == pytest.approx(0.9), "from the beginning"
    early = [haptic(0.0), haptic(0.15), haptic(0.2, "out_of_range")]
    assert observed.gap_s(poses, [(topics.HAPTIC, early)], 1.0) == pytest.approx(0.1), "nobody could know it later"
    assert observed.gap_s(poses, [(topics.HAPTIC, [])], 1.0) == 0.0


def test_a_rate_is_back_when_it_stays():
    steady = np.arange(0.0, 6.0, 0.02)
    assert observed.recovery_s(steady, 50.0, 1.0, 6.0) == 0.0
    gone = steady[(steady < 1.0) | (steady > 2.5)]
    assert observed.recovery_s(gone, 50.0, 1.0, 6.0) == pytest.approx(1.52, abs=0.03)
    burst = np.concatenate([gone[gone < 1.0], np.arange(1.2, 1.5, 0.005), gone[gone > 2.5]])
    assert observed.recovery_s(burst, 50.0, 1.0, 6.0) == pytest.approx(1.52, abs=0.03), "a burst is no rate"
    assert observed.recovery_s(steady[steady < 1.0], 50.0, 1.0, 6.0) is None
    assert observed.recovery_s(steady[::2], 50.0, 1.0, 6.0) is None


def test_a_measurement_counts_once_however_often_it_is_repeated_and_also_where_it_did_not_reach_us():
    numbered = [Seen(0.1 * n, haptic(0.1 * stamp).message, "skin", n) for n, stamp in ((5, 1), (6, 2), (9, 3), (10, 3))]
    assert observed.repeats(numbered) == 1
    assert observed.offered(numbered, "in_range") == 3 + 2
    assert observed.offered(numbered, "out_of_range") == 2
    cameras = [Seen(0.0, messages.VisionPose(**vision(camera))) for camera in ("front", "side", "front")]
    assert observed.offered(cameras, "tracking") == 2


def vision(camera):
    same = {
        name: value
        for name, value in msgspec.structs.asdict(haptic(0.0).message).items()
        if name in ("stamp_ns", "target", "frame")
    }
    turned = {"position": np.zeros(3), "orientation": np.array([0.0, 0.0, 0.0, 1.0]), "covariance": np.eye(6)}
    return same | turned | {"camera": camera, "overlap": 1.0, "hidden": 0.0, "state": "tracking"}


def test_an_error_is_taken_at_the_stamp_and_another_time_is_wrong_whatever_it_says():
    track = [truth(t / 50, speed=0.5) for t in range(100)]
    right, off, coasting = fused(1.01, x=0.505), fused(1.01, x=0.605), fused(1.01, "coasting", x=9.0)
    old = fused(1.5, x=0.4, stamp_ns=8 * 10**8)
    errors = observed.tracking_errors([right, off, coasting, old], track, 0)
    np.testing.assert_allclose(errors[:2], [[0.0, 0.0], [0.1**2 / 1e-4, 0.1]], atol=1e-9)
    assert np.isinf(errors[2]).all() and len(errors) == 3
    truth_elsewhere = [Seen(1.5, truth(3600.0).message)]
    assert len(observed.tracking_errors([fused(1.5)], truth_elsewhere, 0)) == 0, "the truth's own clock is wrong"
    assert (errors[:, 0] > observed.CHI2_3_SIGMA).sum() == 2
    assert len(observed.tracking_errors([right], [], 0)) == 0
