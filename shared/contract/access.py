"""Access control on a secured bus: the router's rules, from the tables of topics and processes.

A certificate's common name is the name of its holder. Sensors and methods publish what the table assigns to them, report only
their own health, and read everything. A viewer only reads and queries. An operator also controls the emulator, the launcher and
the recorder. The router drops what no rule allows, without an answer.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from penumbra.shared.contract import processes, topics
from penumbra.shared.contract.topics import TOPICS, Topic

SERVICES = tuple(process.name for process in processes.REPORTING)
"""Processes that publish, answer and report their own health."""
ROUTER, OPERATOR, VIEWER = processes.ROUTER.name, "operator", "viewer"
"""The router, which passes on what other routers have admitted, and people's commands."""
DRIVER = "driver"
"""A user's program that publishes for its own cameras, robots or skins; it reads like a viewer."""
HOLDERS = (*SERVICES, DRIVER, ROUTER, OPERATOR, VIEWER)

ANSWERS = {
    process.name: [topics.QUERYABLES[name].format(cell="*", target="*") for name in process.answers]
    for process in processes.REPORTING
}
"""Queryables beside the health query, by the process that answers them."""
EVERYTHING = ("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
              "liveliness_token", "liveliness_query", "declare_liveliness_subscriber")  # fmt: skip


def holder(service: str, is_router: bool) -> str:
    """Holder of the certificate that a process shows. A process that is not in HOLDERS is a viewer."""
    if is_router:
        return ROUTER
    return service if service in (*SERVICES, DRIVER, OPERATOR) else VIEWER


def control(table: Iterable[Topic] = TOPICS, services: Iterable[str] = SERVICES) -> dict[str, Any]:
    """Zenoh's `access_control` of a router, as JSON. A message is allowed if a rule names it and its key lies within the rule's
    keys.

    table: the topics. services: the holders that publish, answer and report their health.
    """
    table, services = tuple(table), tuple(services)
    keys = [topic.at() for topic in table]
    rules = [
        # messages are filtered on ingress, so everything may leave
        _rule("receive", EVERYTHING, ["penumbra/**"], "egress"),
        _rule("pass on", EVERYTHING, ["penumbra/**"]),
        _rule("read", ["declare_subscriber"], keys),
        _rule("see who lives", ["liveliness_query", "declare_liveliness_subscriber"], [topics.alive("*")]),
        _rule("ask", ["query"], [topics.current_pose("*", "*"), topics.description(), topics.health("*")]),
        _rule("steer", ["query"], [topics.control("*"), topics.launcher("*"), topics.recorder("*")]),
    ]
    reader = ["receive", "read", "see who lives", "ask"]
    policies = {ROUTER: ["receive", "pass on"], OPERATOR: [*reader, "steer"], VIEWER: reader}
    for holder in (*services, DRIVER):
        policies[holder] = list(reader)
        if says := [topic.at() for topic in table if holder in topic.publishers]:
            rules.append(_rule(f"{holder} publishes", ["put"], says))
            policies[holder].append(f"{holder} publishes")
    for service in services:
        own = [
            _rule(f"{service} lives", ["liveliness_token"], [topics.alive("*", service)]),
            _rule(f"{service} beats", ["put", "declare_subscriber"], [topics.beat("*", service)]),
            _rule(f"{service} answers", ["declare_queryable", "reply"],
                  [topics.health("*", service), *ANSWERS.get(service, ())]),
        ]  # fmt: skip
        rules += own
        policies[service] += [rule["id"] for rule in own]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in policies],
        "policies": [{"rules": allowed, "subjects": [name]} for name, allowed in policies.items()],
    }


def limits(table: Iterable[Topic] = TOPICS) -> list[dict[str, Any]]:
    """Zenoh's `low_pass_filter` settings of a router, as JSON. The router refuses messages larger than their topic's maximum
    size."""
    return [
        {
            "id": topic.name,
            "flows": ["ingress"],
            "messages": ["put"],
            "key_exprs": [topic.at()],
            "size_limit": topic.message.MAX_BYTES,
        }
        for topic in table
    ]


def _rule(name: str, messages: Iterable[str], keys: Iterable[str], flow: str = "ingress") -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}
