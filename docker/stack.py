"""Makes of the output of `docker compose config` what `docker stack deploy` reads.

    docker compose config | python docker/stack.py | docker stack deploy --compose-file - penumbra

A swarm reads an older form of the file: without a name and build instructions, with whole numbers as ports, with file systems in
memory as mounts, and without an order of the start, for which every process waits by itself. It restarts by its own rules, and
its networks span its hosts. Names lead to the containers themselves, because the virtual addresses of a swarm forget connections
that are silent for a quarter of an hour. A port of loopback is left out, because a swarm would open it on every host: with
docker/secure.yaml the router has one.
"""

import sys
from typing import Any

import yaml

from penumbra.shared.contract import processes

DROPPED = ("build", "depends_on", "restart", "profiles", "security_opt")
"""Parts of a service that a swarm refuses or ignores. It starts no container with more rights in place of them."""


def stack(compose: dict[str, Any]) -> dict[str, Any]:
    """The file for a swarm."""
    services = {}
    for name, service in compose["services"].items():
        kept = {key: value for key, value in service.items() if key not in DROPPED}
        kept.setdefault("image", f"{compose['name']}-{name}")
        ports = [port for port in kept.pop("ports", []) if "host_ip" not in port]
        if ports:
            kept["ports"] = [port | {"published": int(port["published"]), "mode": "host"} for port in ports]
        if targets := kept.pop("tmpfs", []):
            kept["volumes"] = [*kept.get("volumes", []), *({"type": "tmpfs", "target": target} for target in targets)]
        process = processes.find(name)
        order = "start-first" if process is not None and process.beside else "stop-first"
        kept["deploy"] = {
            "endpoint_mode": "dnsrr",
            "restart_policy": {"condition": "any", "delay": "1s"},
            "update_config": {"order": order},
            **kept.get("deploy", {}),
        }
        services[name] = kept
    networks = {
        name: {"driver": "overlay", "internal": network.get("internal", False)} for name, network in compose["networks"].items()
    }
    return {"version": "3.8", "services": services, "networks": networks}


if __name__ == "__main__":
    yaml.safe_dump(stack(yaml.safe_load(sys.stdin)), sys.stdout, sort_keys=False)
