"""A cell for tests of programs that display one, on a real bus, at a fraction of the chain's cost: pictures, masks, truth and
voltages of the emulated world, made beforehand and sent in a loop, and poses as senses and fusion would publish them.

The nodes, the router, the messages and the emulator's answers are the real ones; the estimates are the truth plus an error.
"""

from __future__ import annotations

import itertools
import json
import time
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from penumbra.services.emulator.control import control
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.labels import TARGET_LABELS
from penumbra.shared.geometry import rigid
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.sim.world.world import Sensors, World

STEPS, STEP_TICKS = 12, 6
PERIOD_S = 0.1
SCALE, MARGIN = 4, 24
TOO_HIDDEN = 0.7
"""Hidden share of the target from which on vision reports that it is occluded."""
SERVICES = ("emulator", "segmentation", "search", "haptics", "fusion")


@dataclass(frozen=True)
class Step:
    """One moment of the clip: the emulator's messages, and the mask of its first camera."""

    frame: messages.Frame
    mask: messages.Mask
    truth: messages.Truth
    others: list[tuple[topics.Topic, dict[str, str], Any]]


def clip(world: World) -> list[Step]:
    """A clip of about a second of the emulated world."""
    sensors, camera = Sensors(world, 0), next(iter(world.cell.cameras))
    out = []
    for k in range(1, STEPS * STEP_TICKS, STEP_TICKS):
        found = sensors.tick(k)
        view = world.view(camera, k * 0.02)
        rows, columns = np.nonzero(np.isin(view.labels, TARGET_LABELS))
        y0, x0 = max(0, int(rows.min()) - MARGIN), max(0, int(columns.min()) - MARGIN)
        labels = view.labels[y0 : int(rows.max()) + MARGIN, x0 : int(columns.max()) + MARGIN][::SCALE, ::SCALE]
        mask = messages.Mask(stamp_ns=0, labels=np.ascontiguousarray(labels, np.uint8), x0=x0, y0=y0, scale=SCALE)
        (truth,) = (message for _, _, message in found if isinstance(message, messages.Truth))
        others = [each for each in found if each[0] is not topics.TRUTH]
        out.append(Step(messages.Frame(stamp_ns=0, image=view.image), mask, truth, others))
    return out


class Shown:
    """The cell on a router at `endpoint`, within a `with` block. hidden: the share that vision reports as hidden; feels: whether
    the skin is in range; both may be set at any time."""

    def __init__(self, cell: cells.Cell, endpoint: str, seed: int = 3):
        self.cell, self.hidden, self.feels = cell, 0.1, True
        self.world = World(cell, seed)
        self._camera, self._target = next(iter(cell.cameras)), next(iter(cell.targets))
        steps = clip(self.world)
        self._steps = itertools.cycle([*steps, *reversed(steps)])
        self._rng = np.random.default_rng(seed)
        self._began = time.monotonic()
        router = Node("router", cell, bus.Connection(mode="router", listen=(endpoint,)))
        self.nodes = {name: Node(name, cell, bus.Connection(connect=(endpoint,))) for name in SERVICES}
        self._stack, self._all = ExitStack(), [router, *self.nodes.values()]
        emulator = self.nodes["emulator"]
        emulator.answer(topics.control(cell.name), self._answer)
        emulator.every(PERIOD_S, self._publish)
        self.nodes["fusion"].add_report(self._target, lambda: {"state": self.state})

    @property
    def state(self) -> messages.FusedState:
        """The state of the fused pose."""
        return "tracking" if self.hidden < TOO_HIDDEN or self.feels else "lost"

    def __enter__(self) -> Shown:
        for node in self._all:
            self._stack.enter_context(node)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    def _answer(self, parameters: dict[str, str], payload: bytes) -> tuple[bytes, str]:
        asked = json.loads(payload)
        said = control(self.world, payload, time.monotonic() - self._began)
        if asked["command"] == "occlude" and asked["value"] != "auto":
            self.hidden = float(asked["value"])
        return json.dumps(said).encode(), "application/json"

    def _publish(self) -> None:
        step, now_ns, nodes = next(self._steps), time.time_ns(), self.nodes
        for topic, names, message in step.others:
            nodes["emulator"].publish(topic, _stamped(message, now_ns), **names)
        nodes["emulator"].publish(topics.FRAME, _stamped(step.frame, now_ns), camera=self._camera)
        nodes["segmentation"].publish(topics.MASK, _stamped(step.mask, now_ns), camera=self._camera)
        truth = _stamped(step.truth, now_ns, hidden=self.hidden)
        nodes["emulator"].publish(topics.TRUTH, truth, target=self._target)
        sees = self.hidden < TOO_HIDDEN
        pose: dict[str, Any] = {"stamp_ns": now_ns, "target": self._target, "frame": self.cell.frame}
        vision = messages.VisionPose(
            **pose,
            **self._near(truth, 0.006, 0.03),
            camera=self._camera,
            covariance=np.diag([4e-5] * 3 + [1e-3] * 3),
            overlap=0.9,
            hidden=self.hidden,
            state="tracking" if sees else "occluded",
        )
        nodes["search"].publish(topics.VISION, vision, target=self._target)
        haptic = messages.HapticPose(
            **pose,
            **self._near(truth, 0.008, 0.05),
            information=np.diag([1e4] * 3 + [400.0] * 3),
            sample_stamp_ns=now_ns,
            gap=0.08 if self.feels else 0.4,
            state="in_range" if self.feels else "out_of_range",
        )
        nodes["haptics"].publish(topics.HAPTIC, haptic, target=self._target)
        weight = 0.7 if sees and self.feels else float(sees)
        sources = {
            "vision": messages.Source(age_s=0.06, weight=weight),
            "haptic": messages.Source(age_s=0.02, weight=1.0 - weight if self.feels else 0.0),
        }
        shape = np.diag([1.0, 4.0, 2.0])
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = (9e-6 if sees else 4e-5) * shape
        covariance[3:, 3:] = 4e-4 * np.eye(3)
        fused = messages.FusedPose(
            **pose,
            **self._near(truth, 0.003, 0.01),
            velocity=truth.velocity,
            covariance=covariance,
            state=self.state,
            sources=sources,
        )
        nodes["fusion"].publish(topics.FUSED, fused, target=self._target)

    def _near(self, truth: messages.Truth, metres: float, radians: float) -> dict[str, Any]:
        """The true pose with an error of these standard deviations [m, rad]."""
        error = self._rng.normal(size=6) * np.repeat([metres, radians], 3)
        T = rigid.perturb(rigid.transform(truth.position, truth.orientation), error)
        position, orientation = rigid.position_orientation(T)
        return {"position": np.array(position), "orientation": np.array(orientation)}


def _stamped(message: Any, stamp_ns: int, **changes: Any) -> Any:
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    return type(message)(**(fields | {"stamp_ns": stamp_ns} | changes))
