"""Reads the bus for the pages: only while a page is open, and no more than it can show.

Small messages of the poses are always received, for the timeline. Frames, masks, joints and voltages are subscribed to while a
page looks at them, so that a cell without a page has no cost. Everything belongs to the thread of `look`, except the data that
`judge` receives from the thread that queries reports: `reports` is replaced as a whole, and timeline and slow values have a lock.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec
import numpy as np
import zenoh

from penumbra.services.dashboard import hub, state
from penumbra.services.dashboard.hub import Offer, Wanted
from penumbra.services.dashboard.timeline import Timeline
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.messages import BadMessage, Message
from penumbra.shared.contract.report import Report
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin.layout import Skin

if TYPE_CHECKING:
    from penumbra.services.dashboard.picture import Painter

LOOK_S = 1.0 / 30.0
"""Period [s] of the moments that a page shows."""
IDLE_TURNS = 6
"""Without a page only every IDLE_TURNS turns look: five times a second."""
READ_NS = 90_000_000
"""Period [ns] of numbers and voltages: every third turn, ten times a second, which is as fast as anybody reads."""
FRAMES_KEPT = 8
"""Number of frames that wait for their mask: 0.4 s at 20 Hz."""
MASKLESS_NS = 500_000_000
"""Time [ns] without a mask after which pictures are shown without one."""
NEAR_NS = 100_000_000
"""Maximum time [ns] between a picture and the pose whose outline is drawn in it."""
POSES_KEPT = 256
RING = 64

M = TypeVar("M", bound=Message)


class Ring(Generic[M]):
    """The newest samples of one key. Unreadable ones are skipped: the readers that use them count and report them."""

    def __init__(self, session: zenoh.Session, topic: Topic, depth: int, **names: str):
        self._topic = topic
        self._subscriber = session.declare_subscriber(topic.at(**names), zenoh.handlers.RingChannel(depth))

    def payloads(self) -> list[bytes]:
        """The payloads since the last call, oldest first. They are copied at once: a frame lies in memory that its publisher
        needs."""
        out = []
        while (sample := self._subscriber.handler.try_recv()) is not None:
            if len(sample.payload) <= self._topic.message.MAX_BYTES:
                out.append(sample.payload.to_bytes())
        return out

    def newest(self, now_ns: int) -> M | None:
        """The newest message since the last call, None if there is no readable one."""
        found = self.payloads()
        return self.read(found[-1], now_ns) if found else None

    def read(self, payload: bytes, now_ns: int) -> M | None:
        """The message in a payload, None if it is bad or too old."""
        try:
            return messages.decode(self._topic.message, payload, now_ns, self._topic.oldest_s)  # type: ignore[return-value]
        except BadMessage:
            return None

    def close(self) -> None:
        self._subscriber.undeclare()


class View:
    """One camera that pages look at: its newest frames and mask."""

    def __init__(self, session: zenoh.Session, node: Node, camera: str):
        from penumbra.services.dashboard.picture import Painter  # imports OpenCV, which nothing else here needs

        names = {"cell": node.cell.name, "camera": camera}
        self._frames: Ring[messages.Frame] = Ring(session, topics.FRAME, 1, **names)
        self._masks: Ring[messages.Mask] = Ring(session, topics.MASK, 4, **names)
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._mask: messages.Mask | None = None
        self._shown_ns = 0
        self.painter: Painter = Painter(node.cell, camera)

    def take(self, now_ns: int) -> None:
        """Receive the new samples."""
        for payload in self._frames.payloads():
            try:
                self._kept[messages.head(messages.Frame, payload).stamp_ns] = payload
            except BadMessage:
                continue
        while len(self._kept) > FRAMES_KEPT:
            self._kept.popitem(last=False)
        self._mask = self._masks.newest(now_ns) or self._mask

    def next(self, now_ns: int) -> tuple[messages.Frame, messages.Mask | None] | None:
        """The newest frame that has its mask, or the newest frame if no masks arrive; None if it was already shown."""
        mask = self._mask
        if mask is not None and now_ns - mask.stamp_ns > MASKLESS_NS:
            mask = None
        stamp_ns = mask.stamp_ns if mask is not None and mask.stamp_ns in self._kept else 0
        if mask is None and self._kept:
            stamp_ns = next(reversed(self._kept))
        if stamp_ns <= self._shown_ns:
            return None
        self._shown_ns = stamp_ns
        frame = self._frames.read(self._kept[stamp_ns], now_ns)
        if frame is None or frame.image.shape[:2] != (self.painter.camera.height, self.painter.camera.width):
            return None
        return frame, mask

    def close(self) -> None:
        self._frames.close()
        self._masks.close()


class Watch:
    """All received data, and the pages' messages made from it.

    wanted: what the pages can receive. offer: receives all messages of a turn at once.
    """

    def __init__(self, node: Node, wanted: Callable[[], Wanted], offer: Callable[..., None]):
        self._node, self._cell, self._wanted, self._offer = node, node.cell, wanted, offer
        self._names = {"cell": node.cell.name}
        self._senses = [sense for sense, part in (("vision", node.cell.cameras), ("haptic", node.cell.pads)) if part]
        self._rings: dict[tuple[str, str], Ring[Any]] = {}
        self._near: dict[str, Ring[Any]] = {}
        self._views: dict[str, View] = {}
        self._skin = Skin(node.cell) if node.cell.pads else None
        self.turns = 0
        self._read_due_ns = 0
        self._numbers: dict[str, dict[str, Any]] = {}
        self._joints: dict[str, list[float]] = {}
        self._levels: dict[str, list[float]] = {}
        self._poses: dict[str, deque[tuple[int, bytes]]] = {name: deque(maxlen=POSES_KEPT) for name in node.cell.targets}
        self.seen = {name: state.Seen() for name in node.cell.targets}
        self.reports: Sequence[Report] = ()
        self._lock = threading.Lock()
        self._timeline = Timeline()
        self._slow: dict[str, Any] = {}

    # ---- fast: poses, scene, pictures

    def look(self) -> None:
        """Run one turn."""
        session, wanted = self._node.session, self._wanted()
        self.turns += 1
        if session is None or (not wanted.pages and self.turns % IDLE_TURNS):
            return
        self._subscribe(session, wanted)
        now_ns = self._node.now_ns()
        self._take_poses(now_ns, bool(wanted.cameras))
        self._note_states(now_ns)
        if not wanted.pages:
            return
        offers = [Offer(hub.MOMENT, self._moment(now_ns))] if wanted.moment else []
        for camera, view in self._views.items():
            view.take(now_ns)
            if camera in wanted.ready and (found := view.next(now_ns)) is not None:
                frame, mask = found
                picture = view.painter.message(frame, mask, self._poses_at(frame.stamp_ns), self._node.now_ns())
                offers.append(Offer(hub.PICTURE, picture, camera))
        if offers:
            self._offer(*offers)

    def _moment(self, now_ns: int) -> bytes:
        """Poses, robots and pads in the form that a page receives."""
        self._take_robots(now_ns)
        if now_ns >= self._read_due_ns:
            self._read_due_ns = now_ns + READ_NS
            self._take_pads(now_ns)
            self._numbers = {}
        for name, seen in self.seen.items():
            if not self._numbers.get(name):  # due, or the pose has just arrived
                self._numbers[name] = state.numbers(seen, now_ns)
        return _text(
            {
                "stream": hub.MOMENT,
                "now": now_ns * 1e-9,
                "targets": {name: state.target(seen, now_ns, self._numbers[name]) for name, seen in self.seen.items()},
                "joints": self._joints,
                "pads": self._levels,
            }
        )

    def _subscribe(self, session: zenoh.Session, wanted: Wanted) -> None:
        """Open and close subscriptions according to the current needs."""
        if not self._rings:
            per_target = {
                topics.FUSED: RING,
                topics.TRUTH: 1,
                topics.VISION: 4 * max(1, len(self._cell.cameras)),
                topics.HAPTIC: 1,
            }
            for topic, depth in per_target.items():
                for target in self._cell.targets:
                    self._rings[topic.name, target] = Ring(session, topic, depth, target=target, **self._names)
        if wanted.pages and not self._near:
            self._near |= {
                f"robot {name}": Ring(session, topics.JOINTS, 1, robot=name, **self._names) for name in self._cell.robots
            }
            self._near |= {f"pad {name}": Ring(session, topics.VOLTAGES, 1, pad=name, **self._names) for name in self._cell.pads}
        elif not wanted.pages and self._near:
            for ring in self._near.values():
                ring.close()
            self._near = {}
        for camera in self._views.keys() - wanted.cameras:
            self._views.pop(camera).close()
        for camera in wanted.cameras - self._views.keys():
            self._views[camera] = View(session, self._node, camera)

    def _take_poses(self, now_ns: int, keeps: bool) -> None:
        for name, seen in self.seen.items():
            ring = self._rings[topics.FUSED.name, name]
            if found := ring.payloads():
                seen.fused = ring.read(found[-1], now_ns) or seen.fused
                for payload in found if keeps else ():
                    try:
                        self._poses[name].append((messages.head(messages.FusedPose, payload).stamp_ns, payload))
                    except BadMessage:
                        continue
            seen.truth = self._rings[topics.TRUTH.name, name].newest(now_ns) or seen.truth
            seen.haptic = self._rings[topics.HAPTIC.name, name].newest(now_ns) or seen.haptic
            vision = self._rings[topics.VISION.name, name]
            for payload in vision.payloads():
                said = vision.read(payload, now_ns)
                if said is not None and said.camera in self._cell.cameras:
                    seen.vision[said.camera] = said

    def _take_robots(self, now_ns: int) -> None:
        for robot in self._cell.robots:
            said = self._near[f"robot {robot}"].newest(now_ns)
            if said is not None and len(said.position) == len(self._cell.robots[robot].joints):
                self._joints[robot] = state.joints(said.position)

    def _take_pads(self, now_ns: int) -> None:
        if self._skin is None:
            return
        volts: dict[str, np.ndarray] = {}
        for pad in self._cell.pads:
            said = self._near[f"pad {pad}"].newest(now_ns)
            own = self._skin.of(self._skin.pads.index(pad))
            if said is not None and said.volts.shape[1] == own.stop - own.start:
                volts[pad] = said.volts
        self._levels = self._levels | state.levels(volts, self._skin)

    def _poses_at(self, stamp_ns: int) -> dict[str, messages.FusedPose]:
        """The pose of each target when a picture was taken, or the last one before."""
        out = {}
        for name, kept in self._poses.items():
            before = next(
                (each for each in reversed(kept) if each[0] <= stamp_ns), None
            )  # they arrive in the order of their stamps
            nearest = before or (kept[0] if kept else None)
            if nearest is not None and abs(nearest[0] - stamp_ns) < NEAR_NS:
                try:
                    out[name] = messages.decode(messages.FusedPose, nearest[1])
                except BadMessage:
                    continue
        return out

    def _note_states(self, now_ns: int) -> None:
        changed = False
        for name, seen in self.seen.items():
            now = state.shown_state(seen, now_ns)
            why = state.reasons(seen, self._senses, self.reports, now_ns) if now != "tracking" else ()
            with self._lock:
                changed |= self._timeline.state(name, now, now_ns * 1e-9, why)
        if changed:
            self._send_slow()

    # ---- slow: processes, rates, timeline

    def judge(self, reports: Iterable[Report], emulator: dict[str, Any] | None) -> None:
        """Receive the health reports of all processes and the state of the emulator, and send them to the pages."""
        self.reports = tuple(reports)
        found = state.processes(self.reports)
        names = (topic.name for topic in topics.TOPICS if self._node.keys(topic, {}))
        slow = {"processes": found, "rates": state.rates(self.reports, names), "emulator": emulator}
        with self._lock:
            self._timeline.processes(found["rows"], self._node.now_ns() * 1e-9)
            self._slow = slow
        self._send_slow()

    def _send_slow(self) -> None:
        if self._wanted().pages:
            self._offer(Offer(hub.SLOW, self.slow()))

    def slow(self) -> bytes:
        """Processes, rates and the timeline in the form that a page receives."""
        with self._lock:
            return _text(self._slow | {"stream": hub.SLOW, "timeline": list(self._timeline.entries)})


def _text(value: Any) -> bytes:
    return msgspec.json.encode(value)
