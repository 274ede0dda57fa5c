"""Reader of recorded files, also of those that are damaged or whose end is missing."""

from __future__ import annotations

import io
import mmap
import re
import struct
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary

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
HEAD = struct.Struct("<BQ")
"""Beginning of a record: its opcode, and the length [bytes] of what follows."""
CHUNK = re.compile(rb"\x06.{36}\x04\0\0\0zstd", re.DOTALL)
"""Beginning of a chunk: opcode; length, times, size and checksum; name of the compression. Reading resumes there after damage."""
READ: dict[Opcode, Any] = {Opcode.METADATA: records.Metadata, Opcode.ATTACHMENT: records.Attachment, Opcode.CHUNK: records.Chunk}
"""Records that are read from a file; others are skipped."""
BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError, EOFError)
"""Exceptions that a damaged file can cause."""


@dataclass(frozen=True)
class Gap:
    """A damaged part of a file that was left out, from byte `begin` to `end`. seconds: from the last message before it to the
    first one after it."""

    begin: int
    end: int
    seconds: float


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

    about: its metadata. attachments: by name. fault: what is damaged or missing, as far as it was read; empty where nothing is.
    gaps: the damaged parts, as far as it was read. unread: number of messages that this release cannot decode, by kind.

    Raises RecordingError for any other file.
    """

    def __init__(self, path: Path):
        self.path, self.fault = path, ""
        self.gaps: list[Gap] = []
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
        return self._summary() is not None

    def cell(self) -> cells.Cell:
        """The recorded cell: from its original file where that exists unchanged, else from the attached copy. Raises CellError
        where the copy refers to other files beside the original, and RecordingError where damage has destroyed the copy."""
        if (attached := self.attachments.get(CELL)) is None:
            raise RecordingError(f"{self.path}: expected the attachment {CELL}, got none: give --cell {self.about['cell']}")
        for path in (cells.BUILT_IN / f"{self.about['cell']}.yaml", Path(self.about["cell_file"])):
            if path.is_file() and path.read_bytes() == attached:
                return cells.load(path)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / CELL
            path.write_bytes(attached)
            return cells.load(path)

    def entries(self) -> Iterator[Entry]:
        """All entries in the order in which they were written, except those in damaged parts."""
        schemas: dict[int, records.Schema] = {}
        channels: dict[int, Channel] = {}
        nameless = 0
        for record in self._records():
            match record:
                case records.Schema():
                    schemas[record.id] = record
                case records.Channel():
                    schema = schemas[record.schema_id]
                    about = tuple(record.metadata.items())
                    channels[record.id] = Channel(record.topic, record.message_encoding, schema.name, schema.data, about)
                case records.Message() if record.channel_id in channels:
                    found = channels[record.channel_id]
                    yield Entry(found, record.log_time, record.publish_time, record.data, record.sequence)
                case records.Message():
                    nameless += 1
        if nameless:
            self.fault += f"; left out: {nameless} messages whose topics only a damaged part named"

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
        """The records that matter. After damage, those of the index that name schemas and channels, as the damaged chunk may have
        named them, and then the records from the next chunk on."""
        self.fault, self.gaps = "", []
        last_ns = None
        with self.path.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(max(0, size - len(MAGIC)))
            has_end = size >= 2 * len(MAGIC) and file.read() == MAGIC
            size -= len(MAGIC) if has_end else 0
            at = sound = searched = len(MAGIC)  # sound: the end of the last chunk whose checksum is right
            damaged_at = None
            while at < size:
                try:
                    record, after = _record(file, at, size)
                    found = breakup_chunk(record, validate_crc=True) if isinstance(record, records.Chunk) else [record]
                except BROKEN:
                    damaged_at = sound  # what is skipped may have been skipped because of a wrong length
                    at = _next_chunk(file, searched, size)
                    searched = at + 1
                    continue
                if isinstance(record, records.Chunk):
                    if damaged_at is not None:
                        if (summary := self._summary()) is not None:
                            yield from (*summary.schemas.values(), *summary.channels.values())
                        self._add_gap(damaged_at, at, last_ns, record.message_start_time)
                        damaged_at = None
                    last_ns, sound, searched = record.message_end_time, after, after
                yield from found
                at = after
        if damaged_at is not None and has_end:
            self._add_gap(damaged_at, size, last_ns, None)
        self.fault = self._described(has_end, size if damaged_at is None else damaged_at)

    def _add_gap(self, begin: int, end: int, last_ns: int | None, next_ns: int | None) -> None:
        """Note a damaged part. last_ns, next_ns: time of the message before and after it; None at the beginning and at the end of
        a file, whose times the index has, if there is one."""
        summary = self._summary() if last_ns is None or next_ns is None else None
        about = summary.statistics if summary is not None else None
        last_ns = about.message_start_time if last_ns is None and about is not None else last_ns
        next_ns = about.message_end_time if next_ns is None and about is not None else next_ns
        seconds = 0.0 if last_ns is None or next_ns is None else max(0.0, (next_ns - last_ns) * 1e-9)
        self.gaps.append(Gap(begin, end, round(seconds, 3)))

    def _described(self, has_end: bool, breaks_off: int) -> str:
        """What is wrong with the file. breaks_off: byte at which a file without an end can no longer be read."""
        what = []
        if self.gaps:
            more = f" and in {len(self.gaps) - 1} other places" if len(self.gaps) > 1 else ""
            seconds = sum(gap.seconds for gap in self.gaps)
            what.append(f"is damaged after byte {self.gaps[0].begin}{more}: {seconds:.2f} s of messages are missing")
        if not has_end:
            what.append(f"has no end (it breaks off after byte {breaks_off}): its recorder was killed, or it was cut off")
        return f"{self.path} {', and '.join(what)}" if what else ""

    def _summary(self) -> Summary | None:
        """The index at the end of the file; None where there is none that can be read."""
        try:
            with self.path.open("rb") as file:
                return make_reader(file).get_summary()
        except (*BROKEN, OSError):
            return None


def _record(file: BinaryIO, at: int, size: int) -> tuple[Any, int]:
    """The record at a byte of a file of `size` bytes, None for one that does not matter, and the byte after it. Raises one of
    BROKEN."""
    file.seek(at)
    opcode, length = HEAD.unpack(file.read(HEAD.size))
    kind, after = READ.get(Opcode(opcode)), at + HEAD.size + length
    if after > size:
        raise EndOfFile
    return (kind.read(ReadDataStream(io.BytesIO(file.read(length)))) if kind else None), after


def _next_chunk(file: BinaryIO, at: int, size: int) -> int:
    """The first byte from `at` on where a chunk seems to begin; `size` where none does."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        found = CHUNK.search(data, at)
        return found.start() if found else size


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
