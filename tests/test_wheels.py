"""What pyproject.toml asks for can be installed without a compiler on every Python that it names."""

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
PYTHONS = ("3.11", "3.12", "3.13")
APART = {"torch"}
"""One exact version, of which the README lets everybody install the build of his choice: an index need not have this one."""


def wanted(requirements: list[str], python: str) -> set[str]:
    """What a list asks for under a Python, without the project's own extras. pip would judge markers by the Python it runs on."""
    here: dict[str, Any] = {**default_environment(), "python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    foreign = [each for each in map(Requirement, requirements) if each.name not in {PROJECT["name"], *APART}]
    return {f"{each.name}{each.specifier}" for each in foreign if not each.marker or each.marker.evaluate(here)}


def everything(python: str) -> set[str]:
    lists = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    return set().union(*(wanted(requirements, python) for requirements in lists))


@pytest.mark.network
@pytest.mark.parametrize("python", PYTHONS)
def test_every_extra_resolves_to_wheels(python, tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--only-binary=:all:"]
    pip += ["--python-version", python, "--target", str(tmp_path / "nothing"), *sorted(everything(python))]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "Would install" in done.stdout


@pytest.mark.parametrize("python", PYTHONS)
def test_every_python_is_declared_and_only_on_3_11_pybullet_is_asked_for(python):
    assert f"Programming Language :: Python :: {python}" in PROJECT["classifiers"]
    assert Requirement(f"python{PROJECT['requires-python']}").specifier.contains(python)
    asks = {extra for extra, listed in PROJECT["optional-dependencies"].items() if "pybullet" in " ".join(wanted(listed, python))}
    assert asks == ({"emulator"} if python == "3.11" else set())
