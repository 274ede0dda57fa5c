"""Effects of a fault on a running chain, as any client of the bus sees them: gaps, recovery, repeats and false tracking."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh

from penumbra.shared.contract import messages, topics
from penumbra.shared.geometry import rigid
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.reader import sender_of
from penumbra.tests.support.live import Running, wait_for

READ = (topics.FUSED, topics.VISION, topics.HAPTIC, topics.TRUTH, topics.MASK, topics.FRAME, topics.VOLTAGES)
DECODED = {topics.FUSED.name, topics.VISION.name, topics.HAPTIC.name, topics.TRUTH.name}
"""Topics whose messages are decoded. Of others only the arrival time is kept, as a frame is a megabyte."""
OUTPUTS = {
    "emulator": (topics.FRAME, topics.VOLTAGES, topics.TRUTH),
    "segmentation": (topics.MASK,),
    "search": (topics.VISION,),
    "haptics": (topics.HAPTIC,),
    "fusion": (topics.FUSED,),
}
"""The observed topics of each service; READ for all services together."""
SENSES = ((topics.VISION, "tracking"), (topics.HAPTIC, "in_range"))
"""The topics of the senses, and the state of the poses that fusion uses."""
CHI2_3_SIGMA = 20.06
"""Squared Mahalanobis distance in six dimensions within which 99.73 % of errors lie, as in one within three standard
deviations."""
SHARE, WINDOW_S = 0.75, 0.5
"""A rate is back when at least this share of it is reached in two consecutive windows of this length [s]."""
FAR_S = 0.5
"""Maximum difference [s] between the stamps of a pose and of the truth that arrived with it; beyond, one of them is wrong."""
SETTLE_S = 20.0
"""Time [s] within which a message that was sent has arrived everywhere."""


@dataclass(frozen=True)
class Seen:
    """One message: arrival time [s, steady clock], content (None where only the arrival counts), publisher, and its number among
    all messages of this publisher (None where it is not numbered)."""

    at_s: float
    message: Any = None
    publisher: str = ""
    number: int | None = None


class Outside:
    """Listens to a chain from outside, but not to messages of its own session. Everything is decoded afterwards."""

    def __init__(self, session: zenoh.Session, cell: str, target: str, pad: str):
        self._rows: dict[str, list[tuple[float, bytes, bytes, int | None]]] = {}
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        for topic in READ:
            rows = self._rows.setdefault(topic.name, [])
            key = topic.at(cell=cell, target=target, pad=pad)
            ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1024)
            subscriber = session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
            threading.Thread(target=self._read, args=(subscriber, rows, topic.name in DECODED), daemon=True).start()
            self._subscribers.append(subscriber)

    @staticmethod
    def _read(subscriber: Any, rows: list[tuple[float, bytes, bytes, int | None]], is_decoded: bool) -> None:
        for sample in subscriber:
            rows.append((time.monotonic(), sample.payload.to_bytes() if is_decoded else b"", *sender_of(sample)))

    def __enter__(self) -> Outside:
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def seen(self, topic: topics.Topic, begin_s: float = -np.inf, end_s: float = np.inf) -> list[Seen]:
        """The messages that arrived on a topic between two times of the steady clock."""
        out = []
        for at_s, payload, publisher, number in list(self._rows[topic.name]):
            if not begin_s <= at_s <= end_s:
                continue
            message = messages.decode(topic.message, payload) if topic.name in DECODED else None
            out.append(Seen(at_s, message, publisher.hex(), number))
        return out

    def newest_ns(self, topic: topics.Topic) -> int:
        """The stamp of the last message on a topic, 0 where there was none."""
        rows = self._rows[topic.name]
        return int(messages.decode(topic.message, rows[-1][1]).stamp_ns) if rows else 0

    def forget(self) -> None:
        """Drops all messages but the last one of each topic, from which the numbers of the next ones go on."""
        for rows in self._rows.values():
            del rows[:-1]


@dataclass(frozen=True)
class Numbers:
    """The effects of a fault. gap_ms: longest time without a fused pose that is not lost while a sense was alive; recovery_s:
    until all of a service's topics had their old rate, None where they never had; reused: measurements used twice;
    false_tracking: poses called tracking, of `tracking` in all, whose error was beyond three sigma of their own covariance;
    worst_cm: the largest error of their positions."""

    gap_ms: float
    recovery_s: float | None
    reused: int
    false_tracking: int
    tracking: int
    worst_cm: float


def gap_s(fused: Sequence[Seen], senses: Iterable[tuple[topics.Topic, Sequence[Seen]]], end_s: float) -> float:
    """The longest time [s] between two fused poses that are not lost, without the time in which no sense was alive: a sense is
    alive until its last usable pose is stale."""
    usable = {topic.name: state for topic, state in SENSES}
    alive = _union(
        (seen.at_s, min(seen.at_s + topic.stale_s, end_s))
        for topic, all_seen in senses
        for seen in all_seen
        if seen.message.state == usable[topic.name]
    )
    times = [seen.at_s for seen in fused if seen.message.state != "lost"]
    if not alive:
        return 0.0
    edges = [alive[0][0], *(t for t in times if t > alive[0][0]), end_s]
    starts, ends = np.array(alive).T
    overlap = lambda a, b: float(np.clip(np.minimum(ends, b) - np.maximum(starts, a), 0.0, None).sum())  # noqa: E731
    return max(overlap(a, b) for a, b in itertools.pairwise(edges))


def _union(spans: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        if out and begin <= out[-1][1]:
            out[-1] = out[-1][0], max(end, out[-1][1])
        else:
            out.append((begin, end))
    return out


def recovery_s(times: Iterable[float], rate_hz: float, fault_s: float, end_s: float) -> float | None:
    """Seconds from a fault until a stream of messages with these times of arrival has its old rate, and keeps it for two windows;
    None where it has not by the end."""
    wanted = SHARE * rate_hz * WINDOW_S
    after = np.array([t for t in times if t >= fault_s])
    for t in (fault_s, *after.tolist()):
        if t + 2 * WINDOW_S > end_s:
            return None
        first, second, last = np.searchsorted(after, [t, t + WINDOW_S, t + 2 * WINDOW_S])
        if min(second - first, last - second) >= wanted:
            return t - fault_s
    return None


def repeats(seen: Iterable[Seen]) -> int:
    """Number of messages that repeat the stamp of an earlier one."""
    stamps = [each.message.stamp_ns for each in seen]
    return len(stamps) - len(set(stamps))


def offered(seen: Sequence[Seen], usable: str) -> int:
    """Number of usable measurements, each counted once, with those that were lost on their way to us: they are gaps in the
    numbers that a publisher gives to its messages."""
    numbers: dict[str, list[int]] = {}
    for each in seen:
        if each.number is not None:
            numbers.setdefault(each.publisher, []).append(each.number)
    missed = sum(max(of) - min(of) + 1 - len(set(of)) for of in numbers.values())
    return missed + len(
        {(getattr(each.message, "camera", ""), each.message.stamp_ns) for each in seen if each.message.state == usable}
    )


def tracking_errors(fused: Iterable[Seen], truth: Sequence[Seen], epoch_ns: int) -> np.ndarray:
    """Errors (n, 2) of every pose that is called tracking while the truth is received: the squared Mahalanobis distance by the
    pose's own covariance, and the position error [m], at the pose's own stamp.

    Both are infinite for a pose whose stamp is of another time than the truth that arrived with it. A pose is left out if its
    stamp is of our time but that of the truth is not. epoch_ns: our wall clock [ns] at zero of the steady clock."""
    rows = []
    order = sorted(truth, key=lambda each: each.message.stamp_ns)
    stamps, arrivals = np.array([each.message.stamp_ns for each in order]), np.array([each.at_s for each in truth])
    for each in fused if truth else ():
        pose = each.message
        beside = int(np.argmin(np.abs(arrivals - each.at_s)))
        if pose.state != "tracking" or abs(arrivals[beside] - each.at_s) > topics.TRUTH.stale_s:
            continue
        if abs(truth[beside].message.stamp_ns - pose.stamp_ns) > FAR_S * 1e9:
            if abs(epoch_ns + each.at_s * 1e9 - pose.stamp_ns) > FAR_S * 1e9:
                rows.append((np.inf, np.inf))
            continue
        nearest = order[int(np.argmin(np.abs(stamps - pose.stamp_ns)))].message
        moved = nearest.velocity * ((pose.stamp_ns - nearest.stamp_ns) * 1e-9)
        T_true = rigid.perturb(rigid.transform(nearest.position, nearest.orientation), moved)
        error = rigid.pose_error(T_true, rigid.transform(pose.position, pose.orientation))
        rows.append((float(error @ np.linalg.solve(pose.covariance, error)), float(np.linalg.norm(error[:3]))))
    return np.array(rows).reshape(-1, 2)


def epoch_ns() -> int:
    """The wall clock [ns] at zero of the steady clock."""
    return time.time_ns() - time.monotonic_ns()


# ---- fusion's own counters


def health(running: Running, service: str = "*") -> list[dict[str, Any]]:
    """The health of every instance that answers, or of those of one service."""
    replies = running.session.get(topics.health(running.cell, service), timeout=1.0)
    return [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]


Taken = dict[tuple[str, str], int]
"""Number of measurements that each instance of fusion has accepted of each sense."""


def taken(running: Running) -> Taken:
    """The measurements that fusion has accepted until now."""
    return {
        (report["instance"], sense): target[sense]["accepted"]
        for report in health(running, "fusion")
        for target in report.get("report", {}).values()
        for sense in ("vision", "haptic")
    }


def believed_ns(running: Running) -> list[dict[str, int]]:
    """For each instance of fusion that answers, the stamp [ns] of its newest measurement of each sense."""
    selector = topics.current_pose(running.cell, "*") + "?format=json"
    poses = [json.loads(answer) for answer in bus.ask(running.session, selector)]
    return [
        {sense: pose["stamp_ns"] - round(1e9 * source["age_s"]) for sense, source in pose["sources"].items()} for pose in poses
    ]


def opened(running: Running, outside: Outside) -> Taken:
    """The measurements that fusion has accepted, after `outside` has dropped all earlier ones. It waits until none of these is on
    its way to fusion: one that is accepted later would count as a measurement that was never sent."""

    def settled() -> Taken | None:
        outside.forget()
        newest_ns = {topic.name: outside.newest_ns(topic) for topic, _ in SENSES}
        found = believed_ns(running)
        is_through = all(pose.get(sense, 0) >= stamp_ns for pose in found for sense, stamp_ns in newest_ns.items())
        return taken(running) if found and is_through else None

    return wait_for(settled, SETTLE_S, "fusion to have all that was sent")


def closed(running: Running, outside: Outside) -> Taken:
    """The measurements that fusion has accepted, after a wait until `outside` has seen all of them."""
    found = taken(running)
    believed = believed_ns(running)

    def has_seen() -> bool:
        return all(outside.newest_ns(topic) >= pose.get(topic.name, 0) for pose in believed for topic, _ in SENSES)

    wait_for(has_seen, SETTLE_S, "all that fusion has taken")
    return found


def reused(outside: Outside, before: Taken, after: Taken) -> int:
    """Number of measurements that instances of fusion have accepted in excess of those sent, by their own counters, between
    `opened` and `closed`."""
    there_were = {topic.name: offered(outside.seen(topic), usable) for topic, usable in SENSES}
    return sum(max(0, n - before.get((instance, sense), 0) - there_were[sense]) for (instance, sense), n in after.items())


def numbers(outside: Outside, service: str, old_hz: dict[str, float], fault_s: float, end_s: float, reused: int) -> Numbers:
    """The effects of a fault of a service until end_s. old_hz: rates by topic before it; reused: measurements used again."""
    begin_s = fault_s - WINDOW_S
    fused, truth = outside.seen(topics.FUSED, begin_s, end_s), outside.seen(topics.TRUTH, begin_s, end_s)
    senses = [(topic, outside.seen(topic, begin_s, end_s)) for topic in (topics.VISION, topics.HAPTIC)]
    recoveries = [
        recovery_s([seen.at_s for seen in known_poses(outside.seen(topic, fault_s, end_s))], old_hz[topic.name], fault_s, end_s)
        for topic in OUTPUTS.get(service, READ)
    ]
    known = [each for each in recoveries if each is not None]
    errors = tracking_errors(fused, truth, epoch_ns())
    return Numbers(
        round(1e3 * gap_s(fused, senses, end_s), 1),
        round(max(known), 3) if len(known) == len(recoveries) else None,
        reused + repeats(fused),
        int((errors[:, 0] > CHI2_3_SIGMA).sum()),
        len(errors),
        round(100 * float(errors[:, 1].max(initial=0.0)), 2),
    )


def rates_hz(outside: Outside, begin_s: float, end_s: float) -> dict[str, float]:
    """Messages per second by topic, over all keys that are listened to."""
    return {topic.name: len(known_poses(outside.seen(topic, begin_s, end_s))) / (end_s - begin_s) for topic in READ}


def known_poses(seen: Iterable[Seen]) -> list[Seen]:
    """The messages without fused poses that are lost, which do not count as output."""
    return [each for each in seen if not (isinstance(each.message, messages.FusedPose) and each.message.state == "lost")]
