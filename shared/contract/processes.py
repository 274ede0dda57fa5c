"""Table of all processes. Launcher, command line, access rules, doctor and metrics are derived from it; import contracts,
Dockerfile and compose file are tested against it.

To add a service, add a row here and a folder `services/NAME` whose `service.py` has NAME, FLAGS and `start`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from penumbra.shared.cell.description import Cell


@dataclass(frozen=True)
class Tool:
    """A command of a service, such as `penumbra segmentation train`. `about`: its line in the service's help; `function`:
    `MODULE:NAME` of its `services.flags.Command`; `extra`: the extras that it needs, as in `pip install -e '.[EXTRA]'`."""

    name: str
    about: str
    function: str
    extra: str


@dataclass(frozen=True)
class Flag:
    """A flag of a service that `penumbra up` also accepts and passes on. `choices`: its allowed values, empty for any."""

    name: str
    about: str
    choices: tuple[str, ...] = ()
    type: type[int] | type[str] = str


@dataclass(frozen=True)
class Starter:
    """A flag of `penumbra up` that starts an optional process. `passes`: the process's own flag that receives the value;
    `without`: the value where none is given; `value`: its placeholder in the help text."""

    name: str
    about: str
    passes: str
    without: str
    value: str


@dataclass(frozen=True)
class Metric:
    """A metric taken from a service's own section of the health report, one sample per entry.

    `name`: of the metric; `each`: label that names the entry; `field`: key of the number; `within`: part of the report that holds
    the entries, empty for the whole; `values`: possible texts of the field, each exported as a gauge of 0 or 1; `is_counter`:
    whether the number only grows.
    """

    name: str
    about: str
    each: str
    field: str
    within: str = ""
    values: tuple[str, ...] = ()
    is_counter: bool = False


@dataclass(frozen=True)
class Process:
    """One row of the table.

    `about`: line of `penumbra --help`; `extra`: the extras that it needs, as in `pip install -e '.[EXTRA]'`; `needs`: part of the
    cell without which it has nothing to do; `vision`: vision method that it belongs to, None for all; `replicas`: number that
    `penumbra up` starts; `restart`: whether it is restarted after a crash; `flags`: passed on by `penumbra up`; `starter`: flag
    of `penumbra up` that starts one, where it is not started by default; `beside`: whether a second instance may run and share
    the streams with the first; `joins`: whether it joins a cell that runs already, and without --cell takes the only one at the
    router; `is_required`: whether the cell is disconnected without it; `goes_first`: whether its work is short and must not wait
    for that of other processes, so that it is scheduled in real time where the system permits it; `tools`: commands of the
    service; `trained_by`: tool that trains its weights; `answers`: names of the queryables that it answers beside its health
    (`shared.contract.topics.QUERYABLES`); `metrics`: metrics from its report; `in_compose`: whether `docker compose` runs it;
    `imports_sim`: whether its image contains the simulated world.
    """

    name: str
    about: str
    extra: str
    needs: Literal["cameras", "pads", "sim", "sources", "joint_sources"] | None = None
    vision: str | None = None
    replicas: int = 1
    restart: Literal["always", "never"] = "always"
    flags: tuple[Flag, ...] = ()
    starter: Starter | None = None
    beside: bool = True
    joins: bool = False
    is_required: bool = False
    goes_first: bool = False
    tools: tuple[Tool, ...] = ()
    trained_by: str | None = None
    answers: tuple[str, ...] = ()
    metrics: tuple[Metric, ...] = ()
    in_compose: bool = True
    imports_sim: bool = False

    @property
    def module(self) -> str:
        """The module that connects it to the bus."""
        return f"penumbra.services.{self.name}.service"

    def is_needed(self, cell: Cell) -> bool:
        """Whether the cell has the parts that this process works on."""
        return self.needs is None or bool(getattr(cell, self.needs))


PROCESSES = (
    Process(
        "router",
        "the meeting point of all processes",
        extra="router",
        beside=False,
        is_required=True,
        goes_first=True,
    ),
    Process(
        "emulator",
        "a simulated cell: frames, joints, skin and truth",
        extra="emulator",
        needs="sim",
        flags=(Flag("seed", "of the emulator", type=int),),
        beside=False,
        answers=("control",),
        imports_sim=True,
    ),
    Process(
        "camera",
        "pictures of real cameras, films and folders to frames",
        extra="camera",
        needs="sources",  # belongs to a machine with cameras, which the cell file or --source names
        beside=False,
        metrics=(
            Metric(
                "camera_state",
                "1 for the state of the camera",
                each="camera",
                field="state",
                values=("opening", "streaming", "lost", "ended"),
            ),
            Metric("camera_opened", "times that the camera was opened", each="camera", field="opened", is_counter=True),
            Metric("camera_late", "pictures of a backlog, left out", each="camera", field="late", is_counter=True),
        ),
        in_compose=False,
    ),
    Process(
        "segmentation",
        "frames to masks",
        extra="segmentation",
        needs="cameras",
        vision="procnet",
        tools=(
            Tool(
                "train",
                "train the network",
                "penumbra.services.segmentation.training.train:main",
                extra="segmentation,train",
            ),
            Tool("infer", "masks of pictures and films", "penumbra.services.segmentation.files:main", extra="segmentation"),
            Tool(
                "label",
                "frames and masks for the training from films of yours",
                "penumbra.services.segmentation.training.label:main",
                extra="segmentation",
            ),
            Tool(
                "models",
                "fetch the landmark models that label films and photographs",
                "penumbra.services.segmentation.training.models:main",
                extra="segmentation",
            ),
            Tool(
                "photographs",
                "frames and masks for the training from labelled photographs",
                "penumbra.services.segmentation.training.photographs:main",
                extra="segmentation",
            ),
        ),
        trained_by="train",
    ),
    Process(
        "search",
        "masks to the camera's pose",
        extra="search",
        needs="cameras",
        vision="procnet",
        flags=(Flag("method", "of the search", choices=("default", "paper")),),
        tools=(
            Tool(
                "refine",
                "one pose of any rigid mesh on a mask file",
                "penumbra.services.search.objects.tools:refine",
                extra="search",
            ),
            Tool(
                "track",
                "any rigid mesh through a sequence of mask files",
                "penumbra.services.search.objects.tools:track",
                extra="search",
            ),
        ),
    ),
    Process(
        "posecnn",
        "frames to the camera's pose, in place of segmentation and search",
        extra="posecnn",
        needs="cameras",
        vision="posecnn",
        tools=(Tool("train", "train the network", "penumbra.services.posecnn.training.train:main", extra="posecnn,train"),),
        trained_by="train",
    ),
    Process(
        "skin",
        "sensing boards on serial ports to voltages",
        extra="skin",
        needs="pads",
        replicas=0,  # belongs to a machine with boards, which name their ports
        beside=False,
        tools=(
            Tool("decode", "one reply of a board, in hex, as JSON", "penumbra.services.skin.decode:main", extra="skin"),
            Tool(
                "calibrate",
                "the response of every electrode, from a recording or by hand",
                "penumbra.services.skin.calibration.calibrate:main",
                extra="skin",
            ),
            Tool(
                "characterise",
                "noise, reach and response of a pad: tables and pictures",
                "penumbra.services.skin.calibration.characterise:main",
                extra="skin,emulator",
            ),
            Tool("place", "where pads should sit, and how many", "penumbra.services.skin.placing.place:main", extra="skin"),
            Tool("model", "fit the field model of a cell's pads", "penumbra.services.skin.model:main", extra="train"),
        ),
        in_compose=False,
    ),
    Process(
        "robot",
        "joints of real robots from their controllers",
        extra="robot",
        needs="joint_sources",  # belongs to a machine that reaches the controllers, which the cell file or --source names
        beside=False,
        in_compose=False,
    ),
    Process(
        "haptics",
        "voltages to the skin's pose",
        extra="haptics",
        needs="pads",
        goes_first=True,
        tools=(
            Tool("train", "train the network", "penumbra.services.haptics.train:main", extra="haptics,train"),
            Tool("shapes", "what unknown shapes do to pads", "penumbra.services.haptics.shapes:main", extra="haptics,train"),
        ),
        trained_by="train",
        metrics=(
            Metric(
                "skin_contact",
                "1 for what touches the pads",
                each="target",
                field="state",
                within="contact",
                values=("none", "touch", "grip"),
            ),
        ),
    ),
    Process(
        "fusion",
        "both poses to the one pose",
        extra="fusion",
        replicas=2,  # the pose must not pause when one of them dies
        goes_first=True,
        flags=(Flag("observer", "of the fusion", choices=("default", "paper")),),
        answers=("current_pose", "description"),
        metrics=(
            Metric(
                "fused_state",
                "1 for the state of the target's pose",
                each="target",
                field="state",
                values=("tracking", "coasting", "lost"),
            ),
        ),
    ),
    Process(
        "ros2",
        "poses, frames and diagnostics to ROS 2 on Zenoh; joints and pictures from it",
        extra="ros2",
        replicas=0,  # belongs to where ROS runs, whose router it needs
        starter=Starter(
            "ros2",
            "take part in ROS 2 too, at the Zenoh router of its nodes",
            passes="--ros-connect",
            without="tcp/127.0.0.1:7447",
            value="[ENDPOINT]",
        ),
        beside=False,
        joins=True,
        in_compose=False,
    ),
    Process(
        "record",
        "every topic to MCAP files, for Foxglove, Rerun and `penumbra replay`",
        extra="record",
        replicas=0,  # fills a disk: only where it is asked for
        starter=Starter("record", "record too, into a file or folder", passes="--out", without=".", value="[FILE.mcap|FOLDER]"),
        beside=False,
        joins=True,
        tools=(
            Tool("save", "have `record --last` write what it keeps", "penumbra.services.record.tools:save", extra="record"),
            Tool("info", "what a file holds, and whether it is whole", "penumbra.services.record.tools:info", extra="record"),
            Tool(
                "mend",
                "a whole file of one that is damaged or whose recorder was killed",
                "penumbra.services.record.tools:mend",
                extra="record",
            ),
        ),
        answers=("recorder",),
        metrics=(
            Metric("recorded_bytes", "bytes written to files", "recorder", "bytes", is_counter=True),
            Metric("recorded_messages", "messages written to files", "recorder", "messages", is_counter=True),
            Metric("recorder_lost", "messages that were not recorded", "recorder", "lost", is_counter=True),
        ),
    ),
    Process(
        "dashboard",
        "a web page that shows the cell and steers it",
        extra="dashboard",
        joins=True,
        flags=(Flag("page", "where the web page is served: [ADDRESS:]PORT"),),
        tools=(
            Tool(
                "link",
                "print the links that open the page of a secured cell",
                "penumbra.services.dashboard.link:main",
                extra="dashboard",
            ),
        ),
    ),
)

LAUNCHER = Process(
    "launcher",
    "`penumbra up`",
    extra="all",
    beside=False,
    answers=("launcher",),
    metrics=(
        Metric("restarts", "times that a process was started again", "process", "restarts", within="processes", is_counter=True),
        Metric("running", "1 for a process that answers", "process", "is_running", within="processes"),
    ),
    in_compose=False,
)
"""The launcher is a process on the bus like those that it starts, but is not in PROCESSES."""

ROUTER = PROCESSES[0]
REPORTING = (*(process for process in PROCESSES if process is not ROUTER), LAUNCHER)
"""Processes with a certificate and access rights of their own; the router's certificate lets it pass on everything."""
VISION = tuple(dict.fromkeys(process.vision for process in PROCESSES if process.vision))
"""Vision methods, the default first: segmentation with search on its masks, or the paper's competing method in place of both."""


def find(name: str) -> Process | None:
    """The process of this name, the launcher included; None where there is none."""
    return next((process for process in (*PROCESSES, LAUNCHER) if process.name == name), None)


def tool(service: str, name: str) -> Tool | None:
    """The tool of a service by name; None where there is none."""
    process = find(service)
    return next((tool for tool in process.tools if tool.name == name), None) if process else None
