"""The secured bus: a real router with access control, and a session for each certificate. Whoever may not say something is not
heard by the router's own reader, which hears everything that comes in."""

import itertools
import json
import stat
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import zenoh

from penumbra.services.command import certs, cli
from penumbra.services.launcher import launch
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, messages, topics
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import PATIENCE_S, free_port, wait_for
from penumbra.tests.support.nodes import pose

CELL = cells.load("table")
STRANGER = "stranger"
"""Whose certificate is of the same authority, but whose name stands in no rule."""
WHO = (*access.SERVICES, access.DRIVER, access.OPERATOR, access.VIEWER)
NAMES = {"cell": "table", "camera": "front", "robot": "panda", "pad": "p0", "target": "forearm"}


class Bus:
    """A secured router, what it hears, and clients by whose certificate they show."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        self.router = Node("router", CELL, bus.Connection("router", listen=(self.endpoint,), secure=folder)).open()
        assert self.router.session is not None
        self.heard = self.router.session.declare_subscriber("penumbra/**", zenoh.handlers.FifoChannel(4096))
        self.clients: dict[str, zenoh.Session] = {}

    def client(self, who: str) -> zenoh.Session:
        if who not in self.clients:
            self.clients[who] = connect(self.endpoint, who, self.folder)
        return self.clients[who]

    def settle(self, who: str) -> None:
        """Returns once the router has dealt with all that the client has sent: an answer comes after it."""
        selector = topics.health("table", "router", self.router.instance)
        assert [reply for reply in self.client(who).get(selector, timeout=10.0) if reply.ok]

    def puts(self) -> list[zenoh.Sample]:
        return list(iter(self.heard.try_recv, None))

    def close(self) -> None:
        for client in self.clients.values():
            client.close()
        self.router.close()


def connect(endpoint: str, who: str, folder: Path, ca: Path | None = None, patience_s: float = 30.0) -> zenoh.Session:
    """A client with the certificate of `who` in `folder`, whatever the services make of such a name; it trusts `ca`."""
    config = bus.configuration(bus.Connection(connect=(endpoint,), secure=folder))
    tls = {f"connect_{what}": str(folder / f"{who}{end}.pem") for what, end in (("certificate", ""), ("private_key", "-key"))}
    for key, value in (tls | {"root_ca_certificate": str(ca or folder / "ca.pem")}).items():
        config.insert_json5(f"transport/link/tls/{key}", json.dumps(value))
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise


def put(session: zenoh.Session, key: str, payload: bytes) -> None:
    """A message that a busy machine does not drop."""
    session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("certs")
    certs.make(out, names=(*access.HOLDERS, STRANGER))
    return out


@pytest.fixture(scope="module")
def secured(folder):
    found = Bus(folder)
    yield found
    found.close()


# ---- who may say what


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
@pytest.mark.parametrize("who", WHO)
def test_only_the_publisher_of_a_topic_is_received_on_it(secured, who, topic):
    secured.puts()
    session, key = secured.client(who), topic.at(**NAMES)
    put(session, key, b"put")
    session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
    secured.settle(who)
    came = [(str(sample.key_expr), sample.kind) for sample in secured.puts()]
    assert came == ([(key, zenoh.SampleKind.PUT)] if who in topic.publishers else [])


@pytest.mark.parametrize("who", WHO)
def test_a_message_to_all_keys_at_once_is_refused(secured, who):
    secured.puts()
    for key in ("penumbra/**", "**", "penumbra/table/target/*/pose/*", "elsewhere"):
        put(secured.client(who), key, b"put")
    secured.settle(who)
    assert not secured.puts()


@pytest.mark.parametrize(("who", "whose"), list(itertools.product(WHO, WHO)))
def test_health_and_liveliness_are_published_only_by_oneself(secured, who, whose):
    session, instance = secured.client(who), f"of-{who}"
    token = session.liveliness().declare_token(topics.alive("table", whose, instance))
    queryable = session.declare_queryable(topics.health("table", whose, instance), zenoh.handlers.FifoChannel(8))
    secured.settle(who)
    living = secured.router.session.liveliness().get(topics.alive("table", whose, instance), timeout=10.0)
    is_alive = any(reply.ok for reply in living)
    is_asked = reaches(secured.router.session, topics.health("table", whose, instance), queryable)
    token.undeclare(), queryable.undeclare()
    assert (is_alive, is_asked) == (who == whose and who in access.SERVICES,) * 2


@pytest.mark.parametrize("who", WHO)
def test_a_service_beats_for_itself_alone(secured, who):
    secured.puts()
    put(secured.client(who), topics.beat("table", "fusion", "one"), b"")
    secured.settle(who)
    assert bool(secured.puts()) == (who == "fusion")


def reaches(asker: zenoh.Session, key: str, queryable: zenoh.Queryable) -> bool:
    """Whether a query gets to the queryable; where it does not, the asker is told at once that nobody answers."""
    replies = asker.get(key, timeout=10.0)
    while True:
        if (query := queryable.try_recv()) is not None:
            query.drop()
            return True
        try:
            if replies.try_recv() is None:
                continue
        except zenoh.ZError:  # all that there is has answered
            return queryable.try_recv() is not None


@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize(("service", "key"), [(service, key) for service, keys in access.ANSWERS.items() for key in keys])
def test_a_question_is_answered_only_by_whose_it_is(secured, who, service, key):
    key = key.replace("/*/", "/table/", 1).replace("*", "forearm")
    queryable = secured.client(who).declare_queryable(key, zenoh.handlers.FifoChannel(8))
    secured.settle(who)
    is_asked = reaches(secured.router.session, key, queryable)
    queryable.undeclare()
    assert is_asked == (who == service)


@pytest.mark.parametrize("who", WHO)
def test_only_an_operator_steers_and_everybody_may_ask_for_the_pose_and_the_cell(secured, who):
    asked = {}
    for key in (topics.control("table"), topics.current_pose("table", "forearm"), topics.description("table")):
        queryable = secured.router.session.declare_queryable(key, zenoh.handlers.FifoChannel(8))
        replies = secured.client(who).get(key, timeout=10.0)
        secured.settle(who)
        asked[key.rpartition("/")[2]] = queryable.try_recv() is not None
        queryable.undeclare()
        del replies
    assert asked == {"control": who == access.OPERATOR, "pose": True, "description": True}


@pytest.mark.parametrize("who", WHO)
def test_everybody_reads_every_topic_and_nobody_anything_else(secured, who):
    session = secured.client(who)
    readers = [session.declare_subscriber(topic.at(cell="table"), zenoh.handlers.FifoChannel(64)) for topic in topics.TOPICS]
    others = [session.declare_subscriber(key, zenoh.handlers.FifoChannel(64)) for key in ("**", "penumbra/table/alive/*/*")]
    secured.settle(who)
    for topic in topics.TOPICS:
        put(secured.router.session, topic.at(**NAMES), b"put")
    put(secured.router.session, "elsewhere", b"put")
    secured.settle(who)
    heard = [sum(1 for _ in iter(reader.try_recv, None)) for reader in (*readers, *others)]
    for reader in (*readers, *others):
        reader.undeclare()
    # what comes for one subscription is handed to all of a session's that match it: not the key, the wildcard was refused
    assert heard[: len(readers)] == [1] * len(readers)
    assert heard[len(readers) :] == [len(readers), 0]


def test_everybody_sees_which_services_live(secured):
    token = secured.client("fusion").liveliness().declare_token(topics.alive("table", "fusion", "seen"))
    secured.settle("fusion")
    for who in WHO:
        replies = secured.client(who).liveliness().get(topics.alive("table"), timeout=10.0)
        assert topics.alive("table", "fusion", "seen") in {str(reply.ok.key_expr) for reply in replies if reply.ok}, who
    token.undeclare()


def test_a_certificate_whose_name_stands_in_no_rule_sends_and_receives_nothing(secured):
    secured.puts()
    session = secured.client(STRANGER)
    for topic in topics.TOPICS:
        put(session, topic.at(**NAMES), b"put")
    reader = session.declare_subscriber("penumbra/**", zenoh.handlers.FifoChannel(64))
    assert not [reply for reply in session.get(topics.health("table"), timeout=1.0) if reply.ok]
    put(secured.client("fusion"), topics.FUSED.at(**NAMES), b"put")
    secured.settle("fusion")
    assert len(secured.puts()) == 1
    assert reader.try_recv() is None


def test_a_message_larger_than_its_topic_allows_stays_at_the_router(secured):
    secured.puts()
    session, key = secured.client("fusion"), topics.FUSED.at(**NAMES)
    put(session, key, bytes(messages.FusedPose.MAX_BYTES + 1))
    put(session, key, bytes(messages.FusedPose.MAX_BYTES))
    secured.settle("fusion")
    assert [len(sample.payload) for sample in secured.puts()] == [messages.FusedPose.MAX_BYTES]


def test_a_router_passes_on_what_the_router_of_another_host_has_let_through(secured, folder):
    far = f"tls/127.0.0.1:{free_port()}"
    with Node("router", CELL, bus.Connection("router", (secured.endpoint,), (far,), secure=folder)):
        writer = connect(far, "fusion", folder)
        try:
            secured.puts()
            own = topics.FUSED.at(**NAMES)
            wait_for(secured.puts, 30, "a message of the far host", act=lambda: put(writer, own, b"put"))
            for topic in topics.TOPICS:
                put(writer, topic.at(**NAMES), b"put")
            came: list[zenoh.Sample] = []

            def is_through() -> bool:
                put(writer, own, b"last")
                came.extend(secured.puts())
                return b"last" in [sample.payload.to_bytes() for sample in came]

            wait_for(is_through, 30, "the last one")
            beats = zenoh.KeyExpr(topics.beat("table", access.ROUTER))  # of two routers beside one another
            assert {str(sample.key_expr) for sample in came if not beats.intersects(sample.key_expr)} == {own}
        finally:
            writer.close()


def test_services_work_on_a_secured_bus_as_on_another(secured, folder):
    got = []
    connection = bus.Connection(connect=(secured.endpoint,), secure=folder)
    reader, writer, emulator = (Node(name, CELL, connection) for name in ("search", "fusion", "emulator"))
    reader.subscribe(topics.FUSED, lambda message, names: got.append(message))
    writer.answer(topics.current_pose("table", "forearm"), lambda parameters, payload: b"here")

    def refuse(parameters, payload):
        raise ValueError("no such command")

    emulator.answer(topics.control("table"), refuse)
    with reader, writer, emulator:
        wait_for(lambda: got, 10, "a pose", act=lambda: writer.publish(topics.FUSED, pose(), target="forearm"))
        assert reader.query(topics.current_pose("table", "forearm")) == [b"here"]
        services = {json.loads(answer)["service"] for answer in reader.query(topics.health("table"), timeout_s=10.0)}
        assert services == {"router", "search", "fusion", "emulator"}
        operator = secured.client(access.OPERATOR)
        with pytest.raises(bus.Refused, match="no such command"):
            bus.ask(operator, topics.control("table"), timeout_s=10.0)


def test_processes_and_commands_take_the_switch(folder, capsys):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    flags = ["--secure", str(folder), "--connect", endpoint]
    commands = [
        ["penumbra.services.command.cli", "router", "--secure", str(folder), "--listen", endpoint],
        ["penumbra.tests.support.nodes", "fusion", *flags],
    ]
    processes = [subprocess.Popen([sys.executable, "-m", *command], stderr=subprocess.DEVNULL) for command in commands]
    try:
        wait_for(lambda: cli.main(["pose", "--json", *flags]) == 0, 60, "a pose")
        assert json.loads(capsys.readouterr().out)["target"] == "forearm"
        assert cli.main(["pose", "--connect", endpoint.replace("tls", "tcp")]) == 2
        assert "no router" in capsys.readouterr().err
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(PATIENCE_S)


# ---- who gets in


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> Path:
    """Certificates of another authority."""
    out = tmp_path_factory.mktemp("other")
    certs.make(out)
    return out


def test_a_certificate_of_another_authority_does_not_get_in(secured, folder, other):
    connect(secured.endpoint, "fusion", folder).close()
    with pytest.raises(zenoh.ZError):
        connect(secured.endpoint, "fusion", other, ca=folder / "ca.pem", patience_s=0.0)


def test_a_client_does_not_trust_a_router_of_another_authority(secured, folder, other):
    with pytest.raises(zenoh.ZError):
        connect(secured.endpoint, "fusion", folder, ca=other / "ca.pem", patience_s=0.0)


def test_without_a_certificate_nobody_gets_in(secured, folder):
    config = bus.configuration(bus.Connection(connect=(secured.endpoint,)))
    config.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(str(folder / "ca.pem")))
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)


def test_without_encryption_nobody_gets_in(secured):
    with pytest.raises(bus.BusError, match="no router at tcp/"):
        Node("fusion", CELL, bus.Connection(connect=(secured.endpoint.replace("tls", "tcp"),))).open(patience_s=0.0)


def test_a_service_that_listens_does_not_pass_for_a_router(folder):
    endpoint = f"tls/127.0.0.1:{free_port()}"
    config = bus.configuration(bus.Connection("router", listen=(endpoint,), secure=folder))
    for what, end in (("certificate", ""), ("private_key", "-key")):
        config.insert_json5(f"transport/link/tls/listen_{what}", json.dumps(str(folder / f"fusion{end}.pem")))
    with zenoh.open(config), pytest.raises(zenoh.ZError):
        connect(endpoint, "search", folder, patience_s=0.0)


def test_a_router_at_an_address_that_its_certificate_does_not_name_is_not_trusted(folder):
    port = free_port()
    router = Node("router", CELL, bus.Connection("router", listen=(f"tls/127.0.0.2:{port}",), secure=folder))
    with router, pytest.raises(zenoh.ZError):
        connect(f"tls/127.0.0.2:{port}", "fusion", folder, patience_s=0.0)


def test_the_waiting_for_a_router_says_which_certificates_are_expected(folder):
    connection = bus.Connection(connect=(f"tls/127.0.0.1:{free_port()}",), secure=folder)
    with pytest.raises(bus.BusError, match="nothing listens there"):
        Node("fusion", CELL, connection).open(patience_s=0.0)
    assert connection.whereabouts.endswith(f"with a certificate of the same CA as in {folder}")


# ---- the switch


@pytest.mark.parametrize(
    ("connection", "reason"),
    [
        (
            bus.Connection(connect=("tcp/127.0.0.1:7447",)),
            "endpoint: .* got 'tcp/127.0.0.1:7447'; protocols with certificates: tls$",
        ),
        (bus.Connection("peer"), "--mode: expected client or router with --secure"),
        (
            bus.Connection(service="fusion", secure=Path("nowhere")),
            "expected ca.pem, fusion.pem, fusion-key.pem, got no readable ca.pem",
        ),
    ],
)
def test_what_would_not_be_secure_is_refused(folder, connection, reason):
    with pytest.raises(bus.BusError, match=reason):
        bus.configuration(replace(connection, secure=connection.secure or folder))


def test_the_switch_is_a_flag_or_the_environment_and_off_without(folder, monkeypatch):
    from penumbra.services import flags

    def secure(*argv):
        return bus.connection(flags.parse(flags.COMMON, argv)).secure

    monkeypatch.delenv("PENUMBRA_SECURE", raising=False)
    assert secure() is None
    assert secure("--secure", "here") == Path("here")
    monkeypatch.setenv("PENUMBRA_SECURE", str(folder))
    assert secure() == folder


def test_the_launcher_stays_on_loopback_unless_secured_and_hands_the_switch_on(folder):
    def options(**changed):
        plain = {"connect": [], "port": 7, "secure": None, "replicas": [], "vision": "procnet", "cell": "table"}
        flags = dict.fromkeys(flag.name for process in PROCESSES for flag in process.flags)
        flags |= dict.fromkeys(process.starter.name for process in PROCESSES if process.starter)
        flags |= {"log_level": "info", "log_format": "text"}
        return SimpleNamespace(**{**plain, **flags, **changed})

    assert (launch.listening(options()), launch.meeting_points(options())) == ("tcp/127.0.0.1:7", ("tcp/127.0.0.1:7",))
    secured = options(secure=folder)
    assert (launch.listening(secured), launch.meeting_points(secured)) == ("tls/0.0.0.0:7", ("tls/127.0.0.1:7",))
    for process in launch.fleet(CELL, secured).processes:
        at = process.command.index("--secure")
        assert process.command[at + 1] == str(folder)
    assert not any("--secure" in process.command for process in launch.fleet(CELL, options()).processes)


def test_every_process_of_the_launcher_and_every_publisher_has_a_certificate():
    publishers = {name for topic in topics.TOPICS for name in topic.publishers}
    assert publishers <= {*access.SERVICES, access.DRIVER}
    assert {process.name for process in PROCESSES} <= set(access.HOLDERS)


# ---- penumbra certs


def test_certs_are_readable_only_by_their_user_and_not_replaced_by_chance(tmp_path, capsys):
    out = tmp_path / "certs"
    assert cli.main(["certs", "--out", str(out), "--hosts", "robot.local", "10.0.0.7"]) == 0
    assert f"penumbra up --secure {out}" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {f"{n}{end}.pem" for n in ("ca", *access.HOLDERS) for end in ("", "-key")}
    assert {stat.S_IMODE(path.stat().st_mode) for path in out.iterdir()} == {0o600}
    before = (out / "ca.pem").read_bytes()
    assert cli.main(["certs", "--out", str(out)]) == 2
    assert "--force to replace" in capsys.readouterr().err
    assert (out / "ca.pem").read_bytes() == before
    assert cli.main(["certs", "--out", str(out), "--force"]) == 0
    assert (out / "ca.pem").read_bytes() != before


def test_only_the_routers_certificate_has_hosts_and_is_good_for_a_server(tmp_path):
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID

    certs.make(tmp_path, ["robot.local", "10.0.0.7"])
    for name in access.HOLDERS:
        certificate = x509.load_pem_x509_certificate((tmp_path / f"{name}.pem").read_bytes())
        assert certificate.subject.rfc4514_string() == f"CN={name}"
        purposes = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert (ExtendedKeyUsageOID.SERVER_AUTH in purposes) == (name == access.ROUTER)
        assert ExtendedKeyUsageOID.CLIENT_AUTH in purposes
    router = x509.load_pem_x509_certificate((tmp_path / "router.pem").read_bytes())
    named = router.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert set(named.get_values_for_type(x509.DNSName)) == {"localhost", "router", "robot.local"}
    assert {str(address) for address in named.get_values_for_type(x509.IPAddress)} == {"127.0.0.1", "::1", "10.0.0.7"}


@pytest.mark.parametrize("host", ["tls/robot:7447", "", "two words", "10.0.0.1:7447"])
def test_a_host_with_more_than_its_name_is_refused(tmp_path, host):
    with pytest.raises(bus.BusError, match="without protocol and port"):
        certs.make(tmp_path, [host])
    assert not list(tmp_path.iterdir())
