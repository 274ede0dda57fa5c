"""What pyproject.toml asks for can be installed without a compiler on every Python that it names, and requirements.lock has a
version of all of it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text()
PYTHONS = ("3.11", "3.12", "3.13")
APART = {"torch"}
"""One exact version, of which the README lets everybody install the build of his choice: an index need not have this one."""


def applying(requirements: list[str], python: str) -> list[Requirement]:
    """What a list asks for under a Python, without the project's own extras. pip would judge markers by the Python it runs on."""
    here: dict[str, Any] = {**default_environment(), "python_version": python, "python_full_version": f"{python}.9", "extra": ""}
    foreign = [each for each in map(Requirement, requirements) if each.name != PROJECT["name"]]
    return [each for each in foreign if not each.marker or each.marker.evaluate(here)]


def wanted(requirements: list[str], python: str) -> set[str]:
    return {f"{each.name}{each.specifier}" for each in applying(requirements, python) if each.name not in APART}


def listed() -> list[str]:
    """All that the project asks for, with every extra."""
    return [each for extra in PROJECT["optional-dependencies"].values() for each in extra] + PROJECT["dependencies"]


def locked(text: str, python: str) -> dict[str, str]:
    """The version of each package that a lock has for a Python. Raises ValueError for a package with several."""
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    found: dict[str, str] = {}
    for each in applying(lines, python):
        (version,) = each.specifier
        if version.operator != "==" or canonicalize_name(each.name) in found:
            raise ValueError(f"expected one version of {each.name}, got {each}")
        found[canonicalize_name(each.name)] = version.version
    return found


def missing(text: str, python: str) -> list[str]:
    """What pyproject.toml asks for and a lock does not have, or has in a version beyond the range."""
    found = locked(text, python)
    asked = applying(listed(), python)
    return [str(each) for each in asked if not each.specifier.contains(found.get(canonicalize_name(each.name), "0"))]


@pytest.mark.network
@pytest.mark.parametrize("python", PYTHONS)
def test_every_extra_resolves_to_wheels(python, tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--only-binary=:all:"]
    pip += ["--python-version", python, "--target", str(tmp_path / "nothing"), *sorted(wanted(listed(), python))]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "Would install" in done.stdout


@pytest.mark.parametrize("python", PYTHONS)
def test_every_python_is_declared_and_only_on_3_11_pybullet_is_asked_for(python):
    assert f"Programming Language :: Python :: {python}" in PROJECT["classifiers"]
    assert Requirement(f"python{PROJECT['requires-python']}").specifier.contains(python)
    asks = {extra for extra, listed in PROJECT["optional-dependencies"].items() if "pybullet" in " ".join(wanted(listed, python))}
    assert asks == ({"emulator"} if python == "3.11" else set())


@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_has_every_dependency_in_the_project_s_range(python):
    assert not missing(LOCK, python), "run `just lock`"
    assert locked(LOCK, python)["torch"] == "2.13.0"
    assert missing(re.sub(r"(?m)^click==.*$", "click==99", LOCK), python) == ["click<9,>=8.5"]
    assert missing(re.sub(r"(?m)^click==.*$", "", LOCK), python) == ["click<9,>=8.5"]


def test_the_lock_names_no_place_that_only_one_machine_has():
    assert not re.findall(r"(?m)^.*(?:://|\s/|^-|@|\\).*$", LOCK)
