"""Folder for files of an installation that can be made or downloaded again."""

from __future__ import annotations

import os
from pathlib import Path


def cache() -> Path:
    """The cache folder: PENUMBRA_CACHE, by default penumbra in the user's cache folder. Anything in it may be deleted."""
    return Path(os.environ.get("PENUMBRA_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "penumbra")
