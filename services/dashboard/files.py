"""The page's files: read once and compressed once; no other file can be requested."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

PAGE = Path(__file__).parent / "page"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


@dataclass(frozen=True)
class File:
    """A file and its media type."""

    content: bytes
    kind: str

    @cached_property
    def compressed(self) -> bytes:
        """The content, compressed by gzip."""
        return gzip.compress(self.content, 6, mtime=0)

    @cached_property
    def tag(self) -> str:
        """ETag: a hash of the content."""
        return f'"{hashlib.sha256(self.content).hexdigest()[:20]}"'


def read(folder: Path = PAGE) -> dict[str, File]:
    """All files of the page by their paths in the address; the page itself is `/`."""
    found = {
        f"/{path.relative_to(folder).as_posix()}": File(path.read_bytes(), TYPES[path.suffix])
        for path in sorted(folder.rglob("*"))
        if path.suffix in TYPES
    }
    found["/"] = found.pop("/index.html")
    return found
