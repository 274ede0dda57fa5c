"""Clones of the public repositories with training photographs, at the commits of the project's table. Only the files that are
used are checked out."""

from __future__ import annotations

import glob
import os
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

HOST = "https://github.com"
"""Where the repositories of the table are published."""


class CloneError(ValueError):
    """A repository could not be cloned. The text says which one, and git's message."""


@dataclass(frozen=True)
class Repository:
    """A row of repositories.csv: repository "owner/name"; licence and copyright are for readers."""

    repository: str
    commit: str
    licence: str
    copyright: str

    def get(self, clone: Path, host: str, paths: Iterable[str]) -> None:
        """Clone HOST/OWNER/NAME, with these files and folders of the commit. The folder `clone` is either complete or absent.
        Raises CloneError."""
        partial = clone.with_name(f"{clone.name}.part")
        if partial.exists():
            shutil.rmtree(partial)
        clone.parent.mkdir(parents=True, exist_ok=True)
        self._git("clone", "--no-checkout", "--filter=blob:none", f"{host}/{self.repository}", str(partial))
        patterns = "".join(f"/{glob.escape(path)}\n" for path in paths)  # checkout then downloads all files at once
        self._git("-C", str(partial), "sparse-checkout", "set", "--no-cone", "--stdin", said=patterns)
        self._git("-C", str(partial), "checkout", "--detach", self.commit)
        partial.rename(clone)

    def _git(self, *words: str, said: str = "") -> None:
        environment = {**os.environ, "GIT_TERMINAL_PROMPT": "0"}  # GitHub asks for a password if a repository does not exist
        done = subprocess.run(["git", *words], input=said, env=environment, capture_output=True, text=True)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            raise CloneError(f"{self.repository}: expected git to clone commit {self.commit}, got: {reason}")
