"""Drains a feed in one thread and passes the newest picture to another, so that a pause of either does not replay old pictures.

1. open the feed; if that fails, wait, slightly longer each time
2. read the next picture, and drop old ones, which waited while this process could not read
3. refuse a picture that does not have the camera's size
4. put it into the single slot, replacing one that was not taken
5. when the camera is lost, close it, and begin again
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Literal

from penumbra.services.camera.feed import STAMPS, WITHOUT_LATENCY, Feed, Shot, Stamps
from penumbra.services.camera.stamps import WINDOW_S, Backlog
from penumbra.shared.cell.description import Camera, CameraSource
from penumbra.shared.runtime.lowest import Lowest

BACKOFF_S = (0.2, 2.0)
"""Initial and maximum delay [s] before a camera is opened again."""
LOST_S = 3.0
"""Time [s] without a picture after which an open camera counts as faulty."""
LATE_S = 0.25
"""Delay [s] relative to the quickest picture above which a picture belongs to a backlog."""
BACK_S = 1.0
"""A stamp that goes back by more than this [s] is not an old picture: a clock was set."""
AHEAD_S = 0.05
"""Maximum time [s] by which stamps may be ahead of this host's clock."""
FASTER = 2.0
"""Factor on the cell file's rate above which pictures arrive too fast."""
FOLLOW = 0.05
"""Weight of the newest picture in the rate."""
REMEMBERED = 100
"""Number of refusals that are not logged again: a film or a folder that loops brings each one again."""
EMPTY_S = 0.001
"""Delay [s] after a read without a picture, which may return at once."""

State = Literal["opening", "streaming", "lost", "ended"]


class Reader:
    """One camera from opening until it is lost, repeatedly.

    open_feed: opens the camera; raises OSError if it is not there. is_live: whether it is a live camera; a film is not, and has
    no backlog. oldest_s: age [s] above which readers refuse a picture. log: called with errors, without repetition.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        source: CameraSource,
        open_feed: Callable[[], Feed],
        is_live: bool,
        oldest_s: float,
        stopping: threading.Event,
        log: Callable[[str], None],
    ):
        self._name, self._camera, self._source = name, camera, source
        self._open_feed, self._is_live, self._oldest_s = open_feed, is_live, oldest_s
        self._stopping, self._log = stopping, log
        self._is_filled = threading.Condition()  # guards the slot
        self._slot: Shot | None = None
        # the rest is written by the reading thread, and only read by others
        self._state: State = "opening"
        self._since_s = time.monotonic()  # start of this state, or time of the last picture
        self._why = self._refusal = ""
        self._logged: deque[str] = deque(maxlen=REMEMBERED)
        self._stamps: Stamps = ""
        self._sender_latency_s: float | None = None
        self._last_ns = 0
        self._age_s = self._period_s = 0.0
        self._delay_s, self._failures = BACKOFF_S[0], 0
        self._opened = self._received = self._late = self._refused = self._superseded = 0

    # ---- the reading thread

    def session(self) -> None:
        """Open the camera and read until it is lost; then wait. Returns to be called again."""
        self._change("opening")
        feed: Feed | None = None
        try:
            feed = self._open_feed()
            self._opened += 1
            self._drain(feed)
        except EOFError as error:
            self._change("ended", str(error))
            self._log(str(error))
        except OSError as error:
            self._lose(str(error))
        finally:
            if feed is not None:
                with suppress(OSError):
                    feed.close()
        self._stopping.wait(None if self._state == "ended" else self._delay_s)

    def _drain(self, feed: Feed) -> None:
        backlog, lowest = Backlog(1.0 / self._camera.rate_hz), Lowest(WINDOW_S)
        came_s = None
        self._last_ns = 0
        while not self._stopping.is_set():
            asked_s = time.monotonic()
            try:
                shot = feed.read()
            except ValueError as error:
                self._refuse(str(error))
                continue
            if shot is None:
                self._stopping.wait(EMPTY_S)
                continue
            now_s, now_ns = time.monotonic(), time.time_ns()
            self._received += 1
            if came_s is not None:
                usual_s = self._period_s or 1.0 / self._camera.rate_hz  # a film that was held up at the start catches up at once
                self._period_s = usual_s + FOLLOW * (now_s - came_s - usual_s)
            came_s = now_s
            self._stamps = feed.stamps
            self._sender_latency_s = getattr(feed, "sender_latency_s", None)
            if shot.stamp_ns is None:
                is_late = backlog.is_old(asked_s, now_s)
                shot = shot._replace(stamp_ns=now_ns - round(1e9 * (self._source.latency or 0.0)))
            else:
                age_s = (now_ns - shot.stamp_ns) * 1e-9
                self._age_s = lowest.add(age_s, now_s)
                is_late = self._is_live and age_s - self._age_s > LATE_S
            assert shot.stamp_ns is not None
            if is_late or 0.0 <= (self._last_ns - shot.stamp_ns) * 1e-9 < BACK_S:
                self._late += 1
            elif fault := self._fault(shot):
                self._refuse(fault)
            else:
                self._hand_on(shot)

    def _fault(self, shot: Shot) -> str:
        """The fault of a picture; empty if it has none."""
        camera, got = self._camera, shot.image
        if got.shape == (camera.height, camera.width, 3) and got.dtype == "uint8":
            return ""
        size = f"{got.shape[1]} x {got.shape[0]}" if got.ndim == 3 and got.dtype == "uint8" else f"{got.dtype} {got.shape}"
        return (
            f"expected pictures of {camera.width} x {camera.height} px in three colours, got {size}: intrinsics belong to a "
            "size; set it on the camera, or write width and height of these pictures and their fx, fy, cx, cy into the cell file"
        )

    def _hand_on(self, shot: Shot) -> None:
        assert shot.stamp_ns is not None
        self._last_ns = shot.stamp_ns
        self._refusal = ""
        self._delay_s, self._failures = BACKOFF_S[0], 0
        self._change("streaming")
        with self._is_filled:
            self._superseded += self._slot is not None
            self._slot = shot
            self._is_filled.notify()

    def _refuse(self, why: str) -> None:
        self._refused += 1
        if why not in self._logged:
            self._log(why)
            self._logged.append(why)
        self._refusal = why

    def _lose(self, why: str) -> None:
        if why != self._why or not self._failures:
            self._log(f"{why}; trying again")
        self._delay_s = min(BACKOFF_S[0] * 2.0**self._failures, BACKOFF_S[1])
        self._failures += 1
        self._change("lost", why)

    def _change(self, state: State, why: str = "") -> None:
        """Set the state; a camera that is reopened stays lost until a picture arrives."""
        if state == "opening" and self._state == "lost":
            return
        if state != self._state or state == "streaming":
            self._since_s = time.monotonic()
        self._state, self._why = state, why

    # ---- other threads

    def take(self, timeout_s: float) -> Shot | None:
        """The newest picture, with its stamp; None if none arrives within a time."""
        with self._is_filled:
            self._is_filled.wait_for(lambda: self._slot is not None, timeout_s)
            shot, self._slot = self._slot, None
            return shot

    def reasons(self) -> Sequence[str]:
        """The faults, in words."""
        return [f"camera {self._name}: {text}" for text in self._faults()]

    def _faults(self) -> list[str]:
        for_s = time.monotonic() - self._since_s
        if self._state == "ended":
            return [self._why]
        if self._refusal:
            return [self._refusal]
        if self._state == "lost":
            return [f"{self._why} (lost for {for_s:.0f} s)"]
        if for_s > LOST_S:
            return [f"no picture for {for_s:.0f} s from {self._source.shown}"]
        if self._state == "opening":
            return []
        out = []
        if self._stamps in WITHOUT_LATENCY and self._source.latency is None:
            out.append(
                f"times of exposure are not known: stamps are of {STAMPS[self._stamps].partition(',')[0]}; measure the latency "
                "and write it into the cell file (source: latency)"
            )
        if self._age_s > self._oldest_s:
            out.append(f"pictures are {self._age_s:.1f} s old when they arrive, and readers refuse them; check clock and stamps")
        elif self._age_s < -AHEAD_S:
            out.append(f"stamps are {-self._age_s:.2f} s ahead of this host's clock; synchronise the clocks")
        if self._period_s * FASTER * self._camera.rate_hz < 1.0:
            rate_hz = 1.0 / max(self._period_s, 1e-3)
            out.append(
                f"expected {self._camera.rate_hz:g} pictures a second, got {rate_hz:.0f}; write rate_hz into the cell file"
            )
        return out

    def describe(self) -> dict[str, Any]:
        """The camera's entry in the health report. late: dropped pictures of a backlog; superseded: those not taken in time;
        sender_latency_ms: from the sender's time of a picture to its arrival, correct if both clocks are synchronised."""
        latency_s = self._sender_latency_s
        return {
            "state": self._state,
            "source": self._source.shown,
            "stamps": self._stamps,
            "stamps_are": STAMPS[self._stamps],
            "rate_hz": round(1.0 / self._period_s, 1) if self._period_s else None,
            "sender_latency_ms": None if latency_s is None else round(1e3 * latency_s, 1),
            "opened": self._opened,
            "received": self._received,
            "late": self._late,
            "refused": self._refused,
            "superseded": self._superseded,
        }
