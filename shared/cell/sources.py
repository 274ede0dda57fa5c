"""Sources of pictures and joint positions in a cell file, written as KIND:PLACE."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from penumbra.shared.cell.faults import meant, refuse
from penumbra.shared.cell.fields import Model, Number


class Source(Model):
    """A source. KINDS: allowed prefixes of `url`, before its first colon; FORMS: allowed forms; ADAPTER: an example of a
    class."""

    KINDS: ClassVar[tuple[str, ...]]
    FORMS: ClassVar[str]
    ADAPTER: ClassVar[str]

    url: str

    @model_validator(mode="after")
    def _has_a_form(self) -> Source:
        if self.kind not in self.KINDS or not self.place.strip("/"):
            refuse([("url", f"expected {self.FORMS}, got {self.shown!r:.100}{meant(self.kind, self.KINDS)}")])
        module, _, name = self.place.partition(":")
        if self.kind == "adapter" and not (name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
            refuse([("url", f"expected adapter:MODULE:CLASS, as in adapter:{self.ADAPTER}, got {self.url!r:.100}")])
        return self

    @property
    def kind(self) -> str:
        """One of KINDS."""
        return self.url.partition(":")[0]

    @property
    def place(self) -> str:
        """The URL after the kind and its colon."""
        return self.url.partition(":")[2]

    @property
    def shown(self) -> str:
        """The URL without user and password."""
        head, slashes, rest = self.url.partition("://")
        return f"{head}{slashes}{rest.rpartition('@')[2]}" if slashes else self.url


class CameraSource(Source):
    """Source from which `penumbra camera` reads a camera's pictures. The emulator leaves out a camera that has a source."""

    KINDS = ("v4l2", "rtsp", "rtsps", "file", "folder", "adapter")
    FORMS = "v4l2:/dev/video0, rtsp://HOST/PATH, file:FILM, folder:PICTURES or adapter:MODULE:CLASS"
    ADAPTER = "my_camera:Camera"

    url: str = Field(
        description="v4l2:/dev/video0, rtsp://HOST/PATH, file:FILM, folder:PICTURES or adapter:MODULE:CLASS; paths and modules "
        "are looked for beside the cell file"
    )
    loop: bool = Field(default=False, description="whether a film or a folder begins again at its end")
    rate_hz: Annotated[Number, Field(gt=0, le=1000)] | None = Field(
        default=None, description="pictures per second of a film or a folder [Hz]; without it the film's own, or the camera's"
    )
    latency: Annotated[Number, Field(ge=0, le=10)] | None = Field(
        default=None, description="time from exposure to arrival [s], where nothing measures it: stamps are so much earlier"
    )
    synchronised: bool = Field(
        default=False, description="whether NTP or PTP sets the clock of an RTSP camera, whose own stamps are used then"
    )

    @model_validator(mode="after")
    def _fits_its_kind(self) -> CameraSource:
        faults = []
        for key in ("loop", "rate_hz"):
            if getattr(self, key) and not self.is_played:
                faults.append((key, f"expected it with file: or folder: only, got it with {self.kind}:; remove it"))
        if self.synchronised and not self.kind.startswith("rtsp"):
            faults.append(("synchronised", f"expected it with rtsp: only, got it with {self.kind}:; remove it"))
        refuse(faults)
        return self

    @property
    def is_played(self) -> bool:
        """Whether the pictures are played back, rather than live."""
        return self.kind in ("file", "folder")

    def path(self, folder: Path) -> Path:
        """Path of a film or a folder; folder: base of relative paths."""
        return folder / Path(self.place).expanduser()


class JointSource(Source):
    """Source from which `penumbra robot` reads a robot's joint positions."""

    KINDS = ("ur", "panda", "adapter")
    FORMS = "ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS"
    ADAPTER = "my_robot:Robot"

    url: str = Field(description="ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS, a module beside the cell file")
    prefix: str | None = Field(
        default=None, description="what the cell's joints are called before the controller's names; without it `panda_` of panda:"
    )
