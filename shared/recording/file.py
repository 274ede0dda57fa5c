"""Writer of an MCAP file.

Every `flush` hands whole chunks to the kernel, so a killed process loses only what came since. When the disk is full, the file
ends with its last whole chunk and remains a valid MCAP file.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from penumbra.shared.recording.entries import Channel, Entry

CHUNK_BYTES = 1 << 20
MAGIC = b"\x89MCAP0\r\n"
END = struct.pack("<BQI", Opcode.DATA_END, 4, 0) + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MAGIC
"""Shortest end of a file, without an index: end of the data, and an empty summary. (MCAP specification, version 0.)"""


class File:
    """A new file. about: its metadata, by name; attachments: by file name; now_ns: current time.

    Raises FileExistsError where the file exists already, and OSError where it cannot be written.
    """

    def __init__(self, path: Path, about: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes], now_ns: int):
        self.path = path
        self._stream = _Stream(path)
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._wholes = [0]  # the last two offsets at which the file may end
        self.messages = 0
        try:
            self._writer.start("", "penumbra")
            for name, data in about.items():
                self._writer.add_metadata(name, dict(data))
            for name, content in attachments.items():
                self._writer.add_attachment(now_ns, now_ns, name, "application/octet-stream", content)
        except OSError:
            self._stream.close()
            path.unlink(missing_ok=True)
            raise
        self._is_whole()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._stream.tell()

    def write(self, entry: Entry) -> None:
        """Adds a message. Raises OSError where the disk is full: only `cut` may follow."""
        channel = self._channels.get(entry.channel)
        if channel is None:
            channel = self._channels[entry.channel] = self._register(entry.channel)
        self._writer.add_message(channel, entry.log_ns, entry.data, entry.stamp_ns, entry.number)
        self.messages += 1

    def flush(self) -> None:
        """Hands all data to the kernel. Raises OSError as `write`."""
        self._writer.flush()
        self._is_whole()

    def sync(self) -> None:
        """Makes the kernel write all data to the disk, so that it survives a loss of power. Any thread may call it."""
        self._stream.sync()

    def close(self) -> None:
        """Ends the file with its index, on the disk. Raises OSError as `write`."""
        self._writer.finish()
        self._stream.sync()
        self._stream.close()

    def cut(self) -> None:
        """Ends the file after its last whole chunk when the disk is full, without an index, for which there is no space. Where
        even that fails, the file remains as if its writer had been killed."""
        for at in reversed(self._wholes):  # the end itself needs some bytes, so a chunk may have to be dropped
            try:
                self._stream.truncate(at)
                self._stream.write(END)
                break
            except OSError:
                continue
        else:
            self._stream.truncate(self._wholes[-1])
        self._stream.close()

    def _is_whole(self) -> None:
        if (at := self._stream.tell()) != self._wholes[-1]:
            self._wholes = [self._wholes[-1], at]

    def _register(self, channel: Channel) -> int:
        kind = channel.schema, channel.definition
        if kind not in self._schemas:
            encoding = channel.encoding if channel.definition else ""  # MessagePack describes itself
            self._schemas[kind] = self._writer.register_schema(channel.schema, encoding, channel.definition)
        return self._writer.register_channel(channel.topic, channel.encoding, self._schemas[kind], dict(channel.about))


class _Stream:
    """A new file without a buffer: data that cannot be written is not kept for a later write."""

    def __init__(self, path: Path):
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._at = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            self._at += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        """Does nothing: there is no buffer."""

    def truncate(self, at: int) -> None:
        os.ftruncate(self._descriptor, at)
        os.lseek(self._descriptor, at, os.SEEK_SET)
        self._at = at

    def sync(self) -> None:
        os.fsync(self._descriptor)

    def close(self) -> None:
        os.close(self._descriptor)
