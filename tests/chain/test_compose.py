"""The containers: `docker compose up` gives the same pose as `penumbra up`, and a dead service comes back.

Needs a Docker engine and builds the images, so it runs by `pytest -m containers`.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest

from penumbra.services.command import certs
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.tests.support.live import connect, wait_for

pytestmark = pytest.mark.containers
SERVICES = {"router", "emulator", "segmentation", "search", "haptics", "fusion", "dashboard"}


SECURE = ("-f", "compose.yaml", "-f", "docker/secure.yaml")


def docker(*arguments: str, stdin: str | None = None) -> str:
    done = subprocess.run(["docker", *arguments], input=stdin, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"docker {' '.join(arguments)}: exit status {done.returncode}: {done.stderr.strip()}")
    return done.stdout


def compose(*arguments: str) -> str:
    return docker("compose", *arguments)


def containers(service: str) -> list[dict]:
    ids = compose("ps", "-aq", service).split()
    return json.loads(docker("inspect", *ids))


@contextmanager
def up(*files: str):
    """The whole cell in containers."""
    try:
        compose(*files, "up", "--build", "--detach", "--wait", "--wait-timeout", "900")
        yield
    except BaseException:
        print(compose(*files, "logs", "--tail", "40"))
        raise
    finally:
        compose(*files, "down", "--volumes", "--timeout", "5")


@pytest.fixture(scope="module")
def running():
    with up():
        yield


@pytest.fixture
def session(running):
    with connect() as session:
        yield session


def current_pose(session) -> dict | None:
    for reply in session.get(topics.current_pose("table", "forearm") + "?format=json", timeout=1.0):
        if reply.ok:
            return json.loads(reply.ok.payload.to_string())
    return None


def is_tracking_now(session, after_ns: int = 0) -> bool:
    pose = current_pose(session)
    return pose is not None and pose["state"] == "tracking" and pose["stamp_ns"] > after_ns


def test_every_container_is_healthy_and_the_host_gets_a_tracked_pose(session):
    assert {c["Config"]["Labels"]["com.docker.compose.service"] for s in SERVICES for c in containers(s)} == SERVICES
    wait_for(lambda: is_tracking_now(session), 60, "a tracked pose from the containers")


def test_no_container_can_write_its_image_or_runs_as_root(running):
    for service in SERVICES:
        for container in containers(service):
            assert container["HostConfig"]["ReadonlyRootfs"], service
            assert container["Config"]["User"].startswith("10001"), service


def test_only_what_has_a_published_port_is_in_a_network_with_a_way_out(running):
    def has_a_way_out(network: str) -> bool:
        return not json.loads(docker("network", "inspect", network))[0]["Internal"]

    for service in SERVICES:
        for container in containers(service):
            networks = container["NetworkSettings"]["Networks"]
            assert any(map(has_a_way_out, networks)) == (service in ("router", "dashboard")), service


@pytest.mark.parametrize("service", ["fusion", "segmentation", "router"])
def test_a_service_that_is_killed_comes_back(session, service):
    wait_for(lambda: is_tracking_now(session), 60, "a tracked pose before the kill")
    before = containers(service)[0]["State"]
    os.kill(before["Pid"], signal.SIGKILL)
    killed_ns = time.time_ns()
    wait_for(lambda: containers(service)[0]["State"]["StartedAt"] != before["StartedAt"], 20, f"{service} started again")
    wait_for(lambda: is_tracking_now(session, killed_ns + 1_000_000_000), 60, "a tracked pose after the kill")


def test_a_second_segmentation_stands_by_and_takes_over(session):
    compose("up", "--detach", "--scale", "segmentation=2", "--no-recreate", "--wait", "--wait-timeout", "120")
    assert len(containers("segmentation")) == 2
    tokens = topics.alive("table", "segmentation")
    wait_for(lambda: sum(1 for reply in session.liveliness().get(tokens, timeout=1.0) if reply.ok) == 2, 30, "two tokens")
    wait_for(lambda: is_tracking_now(session), 60, "a tracked pose with two")


@pytest.fixture
def certificates(tmp_path, monkeypatch):
    """Two folders of the same certificates: this user's, and the containers'."""
    own, theirs = tmp_path / "own", tmp_path / "containers"
    certs.make(own)
    shutil.copytree(own, theirs)
    for path in (theirs, *theirs.iterdir()):
        os.chown(path, 10001, 10001)
    monkeypatch.setenv("CERTS", str(theirs))
    return own


def test_with_certificates_the_cell_is_tracked_and_nobody_without_one_sees_it(certificates):
    """Starts the containers anew, and removes them."""
    secured = bus.Connection(connect=("tls/127.0.0.1:7447",), secure=certificates)
    with up(*SECURE):
        with bus.open_session(secured, threading.Event(), lambda: None, 20.0) as session:
            wait_for(lambda: is_tracking_now(session), 120, "a tracked pose from the secured containers")
        with pytest.raises(bus.BusError, match="no router"):
            bus.open_session(bus.Connection(connect=("tcp/127.0.0.1:7447",)), threading.Event(), lambda: None, 2.0)
        for service in SERVICES:
            listed = compose(*SECURE, "exec", "-T", service, "ls", "/certs").split()
            assert set(listed) == {"ca.pem", f"{service}.pem", f"{service}-key.pem"}


STACK = "penumbra-stack"
"""Another name than the one of `docker compose`, whose networks a stack of the same name would take."""


def stack_is_gone() -> bool:
    """Asks again each time, as the engine may refuse to remove what a stopping task still holds."""
    subprocess.run(["docker", "stack", "rm", STACK], capture_output=True)
    return STACK not in docker("network", "ls") + docker("service", "ls")


@pytest.fixture
def stack():
    """The cell by `docker stack deploy`, on a swarm of this one node."""
    if docker("info", "--format", "{{.Swarm.LocalNodeState}}").strip() != "inactive":
        pytest.skip("this machine is part of a swarm already")
    docker("swarm", "init", "--advertise-addr", "127.0.0.1")
    try:
        compose("build")
        described = subprocess.run(
            [sys.executable, "docker/stack.py"], input=compose("config"), check=True, capture_output=True, text=True
        ).stdout
        docker("stack", "deploy", "--resolve-image", "never", "--detach=true", "--compose-file", "-", STACK, stdin=described)
        yield
        wait_for(stack_is_gone, 60, "the stack gone", 1.0)
    finally:
        docker("swarm", "leave", "--force")


def test_a_swarm_tracks_with_the_same_compose_file(stack):
    """Last, where no other containers take the cores."""

    def is_tracked() -> bool:
        for container in docker("ps", "-q", "--filter", f"label=com.docker.swarm.service.name={STACK}_fusion").split():
            asked = ["docker", "exec", container, "penumbra", "pose", "--json"]
            answer = subprocess.run(asked, capture_output=True, text=True, timeout=30)
            if answer.returncode == 0 and json.loads(answer.stdout)["state"] == "tracking":
                return True
        return False

    wait_for(is_tracked, 180, "a tracked pose from the stack", 1.0)
