"""Real-time scheduling: where it is permitted all threads have it, where not nothing changes and nothing fails."""

import os
import subprocess
import sys

import pytest

from penumbra.services.command import doctor
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import scheduling
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for

NO_RIGHT = """
import os, resource
from penumbra.shared.runtime import scheduling
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.getuid() == 0:
    os.setuid(65534)  # nobody
"""
ASKS = """
import os, threading
from penumbra.shared.runtime import scheduling
ended = threading.Event()
threads = [threading.Thread(target=ended.wait) for _ in range(3)]
for thread in threads[:2]:
    thread.start()
print(scheduling.go_first())
threads[2].start()
print(*(os.sched_getscheduler(thread) for thread in (0, *(thread.native_id for thread in threads))))
ended.set()
"""
"""Program that prints whether it may go first, and the policies of its first thread, of two that were there before, and of one
that it starts afterwards."""

permitted = pytest.mark.skipif(not scheduling.may_go_first(), reason="this user has no right to real-time priority")


def asked(program):
    """The lines of a program."""
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S)
    assert out.returncode == 0, out.stderr
    return out.stdout.splitlines()


def test_without_the_right_nothing_changes():
    said, policies = asked(NO_RIGHT + ASKS)
    assert said == "False"
    assert policies.split() == [str(os.SCHED_OTHER)] * 4


@permitted
def test_all_threads_go_first_those_that_were_there_before_and_those_that_come():
    said, policies = asked(ASKS)
    assert said == "True"
    assert policies.split() == [str(os.SCHED_RR)] * 4


@permitted
def test_what_it_starts_may_stay_behind():
    said, policies = asked(ASKS.replace("go_first()", "go_first(with_children=False)"))
    assert said == "True"
    before = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    assert [int(policy) for policy in policies.split()] == [before, before, before, os.SCHED_OTHER]


def test_asking_changes_nothing():
    scheduling.may_go_first()
    assert not scheduling.goes_first(os.getpid())


def test_what_must_not_wait_goes_first_once_it_is_ready_and_the_doctor_says_so():
    router = subprocess.Popen(penumbra_command("router", "--listen", f"tcp/127.0.0.1:{free_port()}"))
    try:
        if scheduling.may_go_first():
            wait_for(lambda: scheduling.goes_first(router.pid), 10, "real-time priority of the router")
    finally:
        router.terminate()
        router.wait(PATIENCE_S)
    finding = doctor._priority()
    assert finding.status == "ok" and finding.text.startswith("no ") != scheduling.may_go_first()
    assert [process.name for process in PROCESSES if process.goes_first] == ["router", "haptics", "fusion"]
