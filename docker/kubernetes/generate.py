"""Writes the Kubernetes manifests beside it from the table of processes: `python docker/kubernetes/generate.py`.

    base/        a router per node, two routers that link them, and every service that computes; your drivers are not in it
    simulated/   base and the emulator in place of drivers
    boards/      base and the driver of a skin on nodes that have its boards
    cameras/     base and the reader of cameras on a node that reaches them
    robots/      base and the reader of robots on a node that reaches their controllers
    posecnn/     base with PoseCNN in place of segmentation and search
    ros2/        base and the participant of ROS 2
    recorded/    base and a recorder, whose files lie on a volume of its own
    secure/      base with TLS; each service has a Secret with its own certificate and no other

Each folder is a kustomization (`kubectl apply -k docker/kubernetes/simulated`). A test compares the files with the table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml

from penumbra.shared.contract import processes
from penumbra.shared.contract.processes import PROCESSES, ROUTER, Process

FOLDER = Path(__file__).parent
HUBS = 2
"""Routers that link the nodes' routers. With two of them the cell stays connected while one is away."""
PORT = 7447
SENSORS = {
    "emulator": "penumbra/sensors",
    "skin": "penumbra/boards",
    "camera": "penumbra/cameras",
    "robot": "penumbra/robots",
}
"""Label of the nodes on which a process may run because its devices are there."""
ASKED = (*SENSORS, "ros2", "record")
"""Processes that run only where a kustomization asks for them."""
VOLUMES = {"record": ("recordings", "/recordings", "100Gi", ["--out", "/recordings"])}
"""Name, place and size of the volume on which a process writes, and the arguments by which it does."""
HEADER = "# Written by docker/kubernetes/generate.py from the table of processes: change that, not this.\n"
Manifest = dict[str, Any]


def manifests() -> dict[str, str]:
    """Every file by its path below this folder."""
    services = {process.name: process for process in PROCESSES if process is not ROUTER}
    default = [each for name, each in services.items() if name not in ASKED and each.vision in (None, processes.VISION[0])]
    files = {f"base/{process.name}.yaml": [_deployment(process)] for process in default}
    files["base/router.yaml"] = _routers()
    files["base/settings.yaml"] = [_settings()]
    files["base/kustomization.yaml"] = [
        _kustomization("settings.yaml", "router.yaml", *(f"{each.name}.yaml" for each in default))
    ]
    for folder, name in (
        ("simulated", "emulator"),
        ("boards", "skin"),
        ("cameras", "camera"),
        ("robots", "robot"),
        ("posecnn", "posecnn"),
        ("ros2", "ros2"),
        ("recorded", "record"),
    ):
        files[f"{folder}/{name}.yaml"] = [_deployment(services[name]), *_claims(name)]
        files[f"{folder}/kustomization.yaml"] = [_kustomization("../base", f"{name}.yaml")]
    seeing = [_metadata_of(each.name) | {"$patch": "delete"} for each in default if each.vision]
    files["posecnn/kustomization.yaml"][0]["patches"] = [{"patch": yaml.safe_dump(each, sort_keys=False)} for each in seeing]
    patches = {f"{process.name}.yaml": _with_certificate(process.name, "Deployment", process.name) for process in default}
    patches["router.yaml"] = _with_certificate(
        "router", "DaemonSet", "router", ["--listen", f"tls/0.0.0.0:{PORT}", *_hubs("tls")]
    )
    patches["hub.yaml"] = _with_certificate("hub", "StatefulSet", "router", ["--listen", f"tls/0.0.0.0:{PORT}", *_hubs("tls")])
    patches["settings.yaml"] = _settings("tls") | {
        "data": {"PENUMBRA_CONNECT": f"tls/router:{PORT}", "PENUMBRA_SECURE": "/certs"}
    }
    files |= {f"secure/{name}": [patch] for name, patch in patches.items()}
    secure = _kustomization("../base")
    files["secure/kustomization.yaml"] = [secure | {"patches": [{"path": name} for name in sorted(patches)]}]
    return {path: HEADER + yaml.dump_all(parts, Dumper=_Plain, sort_keys=False, width=130) for path, parts in files.items()}


class _Plain(yaml.SafeDumper):
    """Writes what is used twice twice, in place of an anchor and an alias."""

    def ignore_aliases(self, _: object) -> bool:
        return True


def _settings(protocol: str = "tcp") -> Manifest:
    data = {
        "PENUMBRA_CELL": "table",
        "PENUMBRA_CONNECT": f"{protocol}/router:{PORT}",
        "PENUMBRA_LOG_FORMAT": "json",
        "PENUMBRA_METRICS_PORT": "0.0.0.0:9464",
    }
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "penumbra"}, "data": data}


def _deployment(process: Process) -> Manifest:
    replicas = max(process.replicas, 1)
    pod = _pod(process.name, process.name, [process.name])
    if replicas > 1:  # on different nodes where there are several, so that the pose outlives a node
        pod["spec"]["topologySpreadConstraints"] = [
            {
                "maxSkew": 1,
                "topologyKey": "kubernetes.io/hostname",
                "whenUnsatisfiable": "ScheduleAnyway",
                "labelSelector": {"matchLabels": _labels(process.name)},
            }
        ]
    if process.name in SENSORS:
        pod["spec"]["nodeSelector"] = {SENSORS[process.name]: "true"}
    if process.name in VOLUMES:
        name, place, _, arguments = VOLUMES[process.name]
        container = pod["spec"]["containers"][0]
        container["args"] += arguments
        container["volumeMounts"].append({"name": name, "mountPath": place})
        pod["spec"]["volumes"].append({"name": name, "persistentVolumeClaim": {"claimName": name}})
        pod["spec"]["securityContext"]["fsGroup"] = 10001
    if process.name == "skin":  # serial ports: a container reaches a device of its host only with all rights
        pod["spec"]["containers"][0]["securityContext"] = {"privileged": True, "readOnlyRootFilesystem": True}
    if process.name == "ros2":  # ROS nodes reach the cell's router; where they have one of their own, this names it
        pod["spec"]["containers"][0]["env"] = [{"name": "PENUMBRA_ROS_CONNECT", "value": f"tcp/router:{PORT}"}]
    # A process that may have no second one beside it ends before its successor starts.
    strategy = {"type": "RollingUpdate", "rollingUpdate": {"maxSurge": 1, "maxUnavailable": 0}}
    spec = {
        "replicas": replicas,
        "strategy": strategy if process.beside else {"type": "Recreate"},
        "selector": {"matchLabels": _labels(process.name)},
        "template": pod,
    }
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": _metadata(process.name), "spec": spec}


def _claims(process: str) -> list[Manifest]:
    """The claim of the volume on which a process writes."""
    if process not in VOLUMES:
        return []
    name, _, size, _ = VOLUMES[process]
    spec = {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": size}}}
    return [{"apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": _metadata(name), "spec": spec}]


def _routers() -> list[Manifest]:
    """A router on every node, which its pods reach by the Service `router`, and the hubs that link these routers."""
    arguments = ["router", "--listen", f"tcp/0.0.0.0:{PORT}", *_hubs("tcp")]
    selector = {"matchLabels": _labels("router")}
    routers = {"selector": selector, "template": _pod("router", "router", arguments, PORT)}
    near = {"selector": _labels("router"), "ports": [{"name": "zenoh", "port": PORT}], "internalTrafficPolicy": "Local"}
    hubs = {
        "serviceName": "hub",
        "replicas": HUBS,
        "podManagementPolicy": "Parallel",
        "selector": {"matchLabels": _labels("hub")},
        "template": _pod("hub", "router", arguments, PORT),
    }
    far = {
        "selector": _labels("hub"),
        "ports": [{"name": "zenoh", "port": PORT}],
        "clusterIP": "None",
        "publishNotReadyAddresses": True,
    }
    return [
        {"apiVersion": "apps/v1", "kind": "DaemonSet", "metadata": _metadata("router"), "spec": routers},
        {"apiVersion": "v1", "kind": "Service", "metadata": _metadata("router"), "spec": near},
        {"apiVersion": "apps/v1", "kind": "StatefulSet", "metadata": _metadata("hub"), "spec": hubs},
        {"apiVersion": "v1", "kind": "Service", "metadata": _metadata("hub"), "spec": far},
    ]


def _hubs(protocol: str) -> list[str]:
    return [word for i in range(HUBS) for word in ("--connect", f"{protocol}/hub-{i}.hub:{PORT}")]


def _pod(component: str, image: str, arguments: list[str], port: int | None = None) -> Manifest:
    """A pod with one container: no rights, nothing writable but /tmp, probes from the heartbeat that the service writes."""
    check = ["python", "-S", "/usr/local/bin/heartbeat.py"]
    container: Manifest = {
        "name": component,
        "image": f"penumbra-{image}",
        "args": arguments,
        "envFrom": [{"configMapRef": {"name": "penumbra"}}],
        "ports": [{"name": "metrics", "containerPort": 9464}],
        "startupProbe": {"exec": {"command": check}, "periodSeconds": 1, "failureThreshold": 60},
        "readinessProbe": {"exec": {"command": [*check, "--ready"]}, "periodSeconds": 5, "timeoutSeconds": 3},
        "livenessProbe": {"exec": {"command": check}, "periodSeconds": 5, "timeoutSeconds": 3, "failureThreshold": 3},
        "securityContext": {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}},
        "resources": {"requests": {"cpu": "250m", "memory": "256Mi"}, "limits": {"memory": "1Gi"}},
        "volumeMounts": [
            {"name": "tmp", "mountPath": "/tmp"},
            {"name": "shm", "mountPath": "/dev/shm"},
            {"name": "cell", "mountPath": "/cell", "readOnly": True},
        ],
    }
    if port is not None:
        container["ports"].append({"name": "zenoh", "containerPort": port})
    spec = {
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": 10001,
            "runAsGroup": 10001,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [container],
        "volumes": [
            {"name": "tmp", "emptyDir": {"medium": "Memory", "sizeLimit": "16Mi"}},
            {"name": "shm", "emptyDir": {"medium": "Memory", "sizeLimit": "256Mi"}},
            {"name": "cell", "configMap": {"name": "cell", "optional": True}},
        ],
    }
    return {"metadata": {"labels": _labels(component)}, "spec": spec}


def _with_certificate(component: str, kind: str, holder: str, arguments: list[str] | None = None) -> Manifest:
    """A patch that mounts the Secret of one holder of a certificate."""
    container: Manifest = {"name": component, "volumeMounts": [{"name": "certs", "mountPath": "/certs", "readOnly": True}]}
    if arguments is not None:
        container["args"] = ["router", *arguments]
    volume = {"name": "certs", "secret": {"secretName": f"penumbra-{holder}", "defaultMode": 0o440}}
    spec = {"securityContext": {"fsGroup": 10001}, "containers": [container], "volumes": [volume]}
    return {"apiVersion": "apps/v1", "kind": kind, "metadata": {"name": component}, "spec": {"template": {"spec": spec}}}


def _metadata_of(deployment: str) -> Manifest:
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": {"name": deployment}}


def _kustomization(*resources: str) -> Manifest:
    return {"apiVersion": "kustomize.config.k8s.io/v1beta1", "kind": "Kustomization", "resources": list(resources)}


def _metadata(component: str) -> Manifest:
    return {"name": component, "labels": _labels(component)}


def _labels(component: str) -> dict[str, str]:
    return {"app.kubernetes.io/name": "penumbra", "app.kubernetes.io/component": component}


def main() -> None:
    for path, text in manifests().items():
        (FOLDER / path).parent.mkdir(exist_ok=True)
        (FOLDER / path).write_text(text)


if __name__ == "__main__":
    sys.exit(main())
