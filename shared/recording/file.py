"""An MCAP file that is being written.

What is written reaches the kernel with every `flush`, in whole chunks, so that a process that is killed loses what came since.
Where the disk takes no more, the file ends with its last whole chunk, and is still a file that every reader of MCAP reads.
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
"""The shortest end of a file, without an index: the data end here, the summary has no bytes. (MCAP specification, version 0.)"""


class File:
    """A new file. about: its metadata, by name; attachments: by file name; now_ns: the time.

    Raises FileExistsError where there is one already, and OSError where none can be written.
    """

    def __init__(self, path: Path, about: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes], now_ns: int):
        self.path = path
        self._stream = _Stream(path)
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._wholes = [0]  # where the file may end, the last two places
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
        """Bytes so far."""
        return self._stream.tell()

    def write(self, entry: Entry) -> None:
        """Adds a message. Raises OSError where the disk takes no more: only `cut` may follow."""
        channel = self._channels.get(entry.channel)
        if channel is None:
            channel = self._channels[entry.channel] = self._register(entry.channel)
        self._writer.add_message(channel, entry.log_ns, entry.data, entry.stamp_ns, entry.number)
        self.messages += 1

    def flush(self) -> None:
        """Hands all to the kernel. Raises OSError as `write`."""
        self._writer.flush()
        self._is_whole()

    def sync(self) -> None:
        """Has the kernel write all to the disk: what survives the loss of power. Any thread may call it."""
        self._stream.sync()

    def close(self) -> None:
        """Ends the file with its index, on the disk. Raises OSError as `write`."""
        self._writer.finish()
        self._stream.sync()
        self._stream.close()

    def cut(self) -> None:
        """Ends the file after its last whole chunk, where the disk has taken no more; without an index, for which there is no
        room. Where even that is refused, it stays as if its writer were killed."""
        for at in reversed(self._wholes):  # the end itself takes some bytes, for which a chunk may have to go
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
    """A new file without a buffer: what cannot be written is not kept to be written later."""

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
        """Nothing is kept back."""

    def truncate(self, at: int) -> None:
        os.ftruncate(self._descriptor, at)
        os.lseek(self._descriptor, at, os.SEEK_SET)
        self._at = at

    def sync(self) -> None:
        os.fsync(self._descriptor)

    def close(self) -> None:
        os.close(self._descriptor)
