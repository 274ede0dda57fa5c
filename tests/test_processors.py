"""What is promised holds on other processors than this one: the numerical tests again, with fewer instructions."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from penumbra.tests.support.processors import PROCESSORS

ROOT = Path(__file__).parents[1]
TESTS = {
    "x86-64-v2": (
        "tests/shared/geometry",
        "tests/shared/native",
        "tests/shared/skin/test_layout.py",
        "tests/services/fusion/test_observer.py",
        "tests/services/haptics/test_estimator.py",
        "tests/services/search/test_tracker.py",
        "tests/sim/test_field.py",
        "tests/sim/test_renderer.py",
    ),
    "x86-64-v3": (
        "tests/services/posecnn/test_posecnn.py",
        "tests/services/segmentation/test_inference.py",
        "tests/services/segmentation/test_prednet.py",
        "tests/chain/test_replay.py",
    ),
}
"""Newer processors load the kernels of x86-64-v3 too, so that row is for the libraries of others. OpenVINO is not in the
other row: held to SSE4.1 on a processor with AVX-512, its version 2026.4 compiles no network ("bad combination")."""
FORBIDDEN = {"x86-64-v2": "avx", "x86-64-v3": "avx512f"}
"""Instructions that a row does without: on a processor that has none, the tests of the default run were the row's."""


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="these are switches of x86-64 code")
@pytest.mark.parametrize("name", PROCESSORS)
def test_the_numerical_tests_pass_with_the_instructions_of_an_older_processor(name):
    if FORBIDDEN[name] not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip(f"this processor has no {FORBIDDEN[name]}: nothing would be different")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *TESTS[name]]
    result = subprocess.run(command, cwd=ROOT, env={**os.environ, **PROCESSORS[name]}, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-8000:] + result.stderr[-2000:]
