"""Reader of recorded files, also of those whose end is missing."""

from __future__ import annotations

import io
import struct
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap import records
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import BadMessage, Frame, Message, decode
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording import foxglove
from penumbra.shared.recording.entries import KEY, PUBLISHER, Channel, Entry
from penumbra.shared.recording.faults import RecordingError
from penumbra.shared.recording.file import MAGIC, File
from penumbra.shared.runtime.bus import topic_of

ABOUT, CELL = "penumbra", "cell.yaml"
"""Names of the metadata and of the attached cell file."""
LARGEST = 1 << 30
"""Maximum size of a record [bytes]. A larger length indicates damage."""
BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError, EOFError)
"""Exceptions that a damaged file can cause."""


@dataclass(frozen=True)
class Played:
    """A message of a file: the time of its reception, its key with the names in it, and its publisher."""

    received_ns: int
    topic: Topic
    key: str
    names: dict[str, str]
    publisher: str
    message: Message


class Recording:
    """A file of `penumbra record`.

    about: its metadata. attachments: by name. fault: what is wrong with its end, as far as it was read; empty where nothing is.
    unread: number of messages that this release cannot decode, by kind.

    Raises RecordingError for any other file.
    """

    def __init__(self, path: Path):
        self.path, self.fault = path, ""
        self.about: Mapping[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.unread: dict[str, int] = {}
        self._reason = ""
        try:
            with path.open("rb") as file:
                if file.read(len(MAGIC)) != MAGIC:
                    raise RecordingError(f"{path}: expected an MCAP file of `penumbra record`, got something else")
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
        for record in self._records():
            match record:
                case records.Metadata() if record.name == ABOUT:
                    self.about = record.metadata
                case records.Attachment():
                    self.attachments[record.name] = record.data
                case records.Schema() | records.Channel() | records.Message():  # these come before all messages
                    break
        if not self.about:
            raise RecordingError(f"{path}: expected metadata {ABOUT!r}, got none: it is no file of `penumbra record`")

    @property
    def is_indexed(self) -> bool:
        """Whether the file ends with an index, as a file that was closed does."""
        try:
            with self.path.open("rb") as file:
                return make_reader(file).get_summary() is not None
        except (*BROKEN, OSError):
            return False

    def cell(self) -> cells.Cell:
        """The recorded cell: from its original file where that exists unchanged, else from the attached copy. Raises CellError
        where the copy refers to other files beside the original."""
        attached = self.attachments[CELL]
        for path in (cells.BUILT_IN / f"{self.about['cell']}.yaml", Path(self.about["cell_file"])):
            if path.is_file() and path.read_bytes() == attached:
                return cells.load(path)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / CELL
            path.write_bytes(attached)
            return cells.load(path)

    def entries(self) -> Iterator[Entry]:
        """All entries in the order in which they were written, up to the first damage."""
        schemas: dict[int, records.Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records():
            match record:
                case records.Schema():
                    schemas[record.id] = record
                case records.Channel():
                    schema = schemas[record.schema_id]
                    about = tuple(record.metadata.items())
                    channels[record.id] = Channel(record.topic, record.message_encoding, schema.name, schema.data, about)
                case records.Message():
                    found = channels[record.channel_id]
                    yield Entry(found, record.log_time, record.publish_time, record.data, record.sequence)

    def messages(self, wanted: Collection[Topic] = topics.TOPICS) -> Iterator[Played]:
        """Messages of the wanted topics as they were on the bus, in order of arrival. Messages that this release cannot decode
        are counted in `unread`. Raises RecordingError where it can decode none of them."""
        count, known = 0, dict[Channel, _Source | None]()
        for entry in self.entries():
            if entry.channel not in known:
                known[entry.channel] = _source(entry.channel, wanted)
            if (source := known[entry.channel]) is None:
                continue
            try:
                message = _message(source.topic, entry)
            except BadMessage as error:
                self.unread[error.kind] = self.unread.get(error.kind, 0) + 1
                self._reason = self._reason or str(error)
                continue
            count += 1
            yield Played(entry.log_ns, source.topic, source.key, source.names, source.publisher, message)
        if self.unread and not count:
            raise RecordingError(f"{self.path}: none of its {sum(self.unread.values())} messages can be read: {self._reason}")

    def _records(self) -> Iterator[Any]:
        self.fault = ""
        with self.path.open("rb") as file:
            try:
                yield from StreamReader(file, validate_crcs=True, record_size_limit=LARGEST).records
            except BROKEN as error:
                size = file.seek(0, io.SEEK_END)
                why = f"{type(error).__name__}: {error}".removesuffix(": ")
                self.fault = f"{self.path} has no end ({why} before byte {size}): its recorder was killed, or it is damaged"


class _Source(NamedTuple):
    topic: Topic
    key: str
    names: dict[str, str]
    publisher: str


def _source(channel: Channel, wanted: Collection[Topic]) -> _Source | None:
    """Topic, key and publisher on the bus of a channel's messages; None where they are for viewers only, or not wanted."""
    about = dict(channel.about)
    topic = topic_of(about[KEY], wanted) if KEY in about else None
    return _Source(topic, about[KEY], topic.names(about[KEY]), about.get(PUBLISHER, "")) if topic else None


def _message(topic: Topic, entry: Entry) -> Message:
    if entry.channel.encoding == "msgpack":
        return decode(topic.message, entry.data)
    stamp_ns, image = foxglove.unpacked(entry.data)
    return Frame(stamp_ns=stamp_ns, image=image)


@dataclass(frozen=True)
class Mended:
    """Result of `mend`: number of messages, time from the first to the last [s], and the fault of the original file."""

    messages: int
    seconds: float
    fault: str


def mend(source: Path, out: Path) -> Mended:
    """Copies everything that can be read from a file to a new file with an index, and verifies the copy. Raises
    RecordingError."""
    recording = Recording(source)
    file = File(out, {ABOUT: recording.about}, recording.attachments, 0)
    first_ns = last_ns = None
    for entry in recording.entries():
        file.write(entry)
        first_ns, last_ns = first_ns or entry.log_ns, entry.log_ns
    file.close()
    again = Recording(out)
    count = sum(1 for _ in again.entries())
    if again.fault or count != file.messages:
        raise RecordingError(f"{out}: expected {file.messages} messages to be readable, got {count}: is the disk sound?")
    return Mended(count, ((last_ns or 0) - (first_ns or 0)) * 1e-9, recording.fault)
