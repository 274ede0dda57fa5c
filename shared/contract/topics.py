"""Table of all topics, used by the bus, `penumbra topics`, the health check and the access rules."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Literal

from penumbra.shared.contract import messages

if TYPE_CHECKING:
    from penumbra.shared.cell.description import Cell
    from penumbra.shared.contract.outline import Outline


class QoS(Enum):
    """Quality of service of a topic, with its reason."""

    LATEST_WINS = "a new sample makes the old one worthless: never wait for a slow reader"
    NEVER_DROP = "every message counts: wait for the reader"


class Priority(Enum):
    """Zenoh priority of a topic. Each priority has its own queue on a link, and higher ones are sent first."""

    POSE = "INTERACTIVE_HIGH"
    SIGNAL = "DATA_HIGH"
    IMAGE = "DATA_LOW"


@dataclass(frozen=True)
class Topic:
    """A topic.

    `key`: with {names} as placeholders; `rate_hz`: nominal rate; `depth`: samples that a busy reader keeps; `stale_s`: age after
    which a reader calls the topic stale; `publishers`: processes (`shared.contract.processes`) that may publish it, and `driver`
    for a user's program with a sensor (`penumbra.client`); `slow_hz`: rate per key over a slow link, 0 for never (`penumbra
    router --slow`); `by_camera`: whether the messages of all cameras share a key, each camera at its own rate; `needs`: part of
    the cell without which nobody publishes it, where the key does not show this.
    """

    name: str
    key: str
    message: type[messages.Message]
    rate_hz: float
    depth: int
    stale_s: float
    publishers: tuple[str, ...]
    about: str
    priority: Priority
    slow_hz: float
    qos: QoS = QoS.LATEST_WINS
    by_camera: bool = False
    needs: Literal["cameras", "pads", "sim"] | None = None

    def is_expected(self, cell: Cell | Outline) -> bool:
        """Whether a cell has the parts that the publishers of this topic need: without them the topic is not missing."""
        return self.needs is None or bool(getattr(cell, self.needs))

    @property
    def oldest_s(self) -> float:
        """Age [s] after which a message is refused as part of a backlog or a replay. Clocks may differ by MAX_FUTURE_S."""
        return 5.0 * self.stale_s + messages.MAX_FUTURE_S

    def at(self, **names: str) -> str:
        """Key expression of the topic. A name that is not given becomes the wildcard `*`."""
        wanted = {"cell", "camera", "robot", "pad", "target"}
        return self.key.format(**{name: names.get(name, "*") for name in wanted})

    def names(self, key: str) -> dict[str, str]:
        """Values of the {names} in a key of this topic, without the cell."""
        pairs = zip(self.key.split("/"), key.split("/"), strict=True)
        return {part[1:-1]: value for part, value in pairs if part.startswith("{") and part != "{cell}"}


FRAME = Topic("frame", "penumbra/{cell}/camera/{camera}/frame", messages.Frame, 20, 1, 0.2,
              ("emulator", "camera", "ros2", "driver"), "one RGB image", Priority.IMAGE, 0)  # fmt: skip
JOINTS = Topic("joints", "penumbra/{cell}/robot/{robot}/joints", messages.Joints, 50, 16, 0.1,
               ("emulator", "robot", "ros2", "driver"),
               "joint angles [rad], or displacements [m]", Priority.SIGNAL, 20)  # fmt: skip
VOLTAGES = Topic("voltages", "penumbra/{cell}/skin/{pad}/voltages", messages.Voltages, 50, 32, 0.1,
                 ("emulator", "skin", "driver"), "electrode amplitudes [V], 1 kHz in batches", Priority.SIGNAL, 0)  # fmt: skip
TRUTH = Topic("truth", "penumbra/{cell}/target/{target}/truth", messages.Truth, 50, 16, 0.2, ("emulator",),
              "what the emulator knows", Priority.SIGNAL, 5, needs="sim")  # fmt: skip
MASK = Topic("mask", "penumbra/{cell}/camera/{camera}/mask", messages.Mask, 20, 1, 0.3, ("segmentation",),
             "class indices of a window of a frame", Priority.IMAGE, 0)  # fmt: skip
VISION = Topic("vision", "penumbra/{cell}/target/{target}/pose/vision", messages.VisionPose, 20, 4, 0.3, ("search", "posecnn"),
               "the camera's pose and covariance", Priority.POSE, 20, by_camera=True, needs="cameras")  # fmt: skip
HAPTIC = Topic("haptic", "penumbra/{cell}/target/{target}/pose/haptic", messages.HapticPose, 50, 16, 0.1, ("haptics",),
               "the skin's pose and information", Priority.POSE, 20, needs="pads")  # fmt: skip
FUSED = Topic("fused", "penumbra/{cell}/target/{target}/pose/fused", messages.FusedPose, 200, 4, 0.1, ("fusion",), "the one pose",
              Priority.POSE, 20)  # fmt: skip

TOPICS = (FRAME, JOINTS, VOLTAGES, TRUTH, MASK, VISION, HAPTIC, FUSED)

SMOOTHED = Topic("smoothed", "penumbra/{cell}/target/{target}/pose/smoothed", messages.SmoothedPose, 200, 4, 0.1, (),
                 "the pose afterwards, in files only", Priority.POSE, 0)  # fmt: skip
"""Topic that `penumbra replay --smooth` writes to files. It is not in TOPICS: nobody may publish it, and no replay sends it."""


QUERYABLES = {
    "current_pose": "penumbra/{cell}/target/{target}/pose",
    "description": "penumbra/{cell}/description",
    "control": "penumbra/{cell}/sim/control",
    "launcher": "penumbra/{cell}/launcher/control",
    "recorder": "penumbra/{cell}/record/control",
}
"""Keys of the queryables beside the health query, by their names in `shared.contract.processes`. The function of the same name
says what is asked and answered."""


def current_pose(cell: str, target: str) -> str:
    """The current fused pose: MessagePack of FusedPose, or JSON with `?format=json`; with `stamp_ns=NANOSECONDS` at a
    moment of the last second."""
    return QUERYABLES["current_pose"].format(cell=cell, target=target)


def description(cell: str = "*") -> str:
    """Summary of the cell, JSON of `shared.contract.outline.Outline`, for programs that do not have the cell file."""
    return QUERYABLES["description"].format(cell=cell)


def control(cell: str) -> str:
    """Request of `penumbra sim`, JSON as in `{"command": "occlude", "value": "0.8"}`; the answer is the emulator's settings,
    as of `penumbra sim state --json`."""
    return QUERYABLES["control"].format(cell=cell)


def launcher(cell: str) -> str:
    """Request of `penumbra restart` or `penumbra scale`, JSON as in `{"command": "restart", "services": ["fusion"], "id": "a1"}`
    or `{"command": "scale", "service": "segmentation", "number": 2, "id": "a2"}`; the answer is the change's report (`what`,
    `doing`, `error`, `done`), and `{"command": "state", "id": "a1"}` asks for it again."""
    return QUERYABLES["launcher"].format(cell=cell)


def recorder(cell: str) -> str:
    """Request of `penumbra record save`, JSON `{"command": "save"}`; the answer names the `file` and its `seconds`."""
    return QUERYABLES["recorder"].format(cell=cell)


def alive(cell: str, service: str = "*", instance: str = "*") -> str:
    """Liveliness token of one running instance."""
    return f"penumbra/{cell}/alive/{service}/{instance}"


def beat(cell: str, service: str = "*", instance: str = "*") -> str:
    """Key of the heartbeats between replicas of a service, without content: the sender gets processor time."""
    return f"penumbra/{cell}/beat/{service}/{instance}"


def health(cell: str, service: str = "*", instance: str = "*") -> str:
    """The health and metrics of one running instance, JSON."""
    return f"penumbra/{cell}/{service}/{instance}/health"
