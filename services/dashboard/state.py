"""Numbers and words of the page: plain functions from messages and health reports to JSON objects.

A pose is [x, y, z, qx, qy, qz, qw] in metres. Times are seconds; `null` stands for an unknown value.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.processes import LAUNCHER, find
from penumbra.shared.contract.report import Report
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.accuracy import accuracy
from penumbra.shared.runtime.rates import topic_rows

DIGITS = 5
"""Decimals of a number: a hundredth of a millimetre."""
SILENT = 2.0
"""Age of a sense's last message, in stale times of its topic, above which the sense counts as silent."""
FAR_M = 1.0
"""Gap [m] from which on it is not shown: the skin feels nothing there."""


@dataclass
class Seen:
    """The newest messages of one target: the fused pose, the truth of an emulated cell, and of each sense, vision by camera."""

    fused: messages.FusedPose | None = None
    truth: messages.Truth | None = None
    vision: dict[str, messages.VisionPose] = field(default_factory=dict)
    haptic: messages.HapticPose | None = None


def target(seen: Seen, now_ns: int, known: Mapping[str, Any]) -> dict[str, Any]:
    """One target at a moment: its moving parts in the scene, and its numbers; only `state: none` if there is no fresh pose.
    known: the last result of `numbers`."""
    pose = seen.fused
    if pose is None or shown_state(seen, now_ns) == "none":
        return {"state": "none"}
    truth = _fresh_truth(seen, now_ns)
    return {
        **known,
        "state": pose.state,
        "stamp": pose.stamp_ns * 1e-9,
        "age": _age_s(pose, now_ns),
        "pose": _pose(pose),
        "truth": None if truth is None else {"pose": _pose(truth), "hidden": truth.hidden, "gap": truth.gap},
        "senses": senses(seen, now_ns),
    }


def numbers(seen: Seen, now_ns: int) -> dict[str, Any]:
    """Values that change slowly on the page: angles, speeds, deviations, error and weights; empty if there is no fresh pose."""
    pose = seen.fused
    if pose is None or shown_state(seen, now_ns) == "none":
        return {}
    truth = _fresh_truth(seen, now_ns)
    found = accuracy(pose, [truth] if truth else [])
    ball = ellipsoid(pose.covariance[:3, :3])
    return {
        "rpy": _numbers(rigid.rpy(pose.orientation)),
        "velocity": _numbers(pose.velocity),
        "sigma": _numbers(np.sqrt(np.maximum(pose.covariance.diagonal(), 0.0))),
        "ellipsoid": ball,
        "spread": max(ball["radii"]),
        "error": None if truth is None else {"position": found.position, "axis": found.axis},
        "sources": {name: {"age": source.age_s, "weight": source.weight} for name, source in sorted(pose.sources.items())},
    }


def _fresh_truth(seen: Seen, now_ns: int) -> messages.Truth | None:
    return seen.truth if seen.truth and _age_s(seen.truth, now_ns) < topics.TRUTH.oldest_s else None


def shown_state(seen: Seen, now_ns: int) -> str:
    """The state of a target's pose, `none` if there is no fresh pose."""
    pose = seen.fused
    return "none" if pose is None or _age_s(pose, now_ns) > topics.FUSED.oldest_s else pose.state


def senses(seen: Seen, now_ns: int) -> dict[str, dict[str, Any]]:
    """The poses of the single senses, by sense, and for vision by camera."""
    out = {
        f"vision {camera}": {
            "sense": "vision",
            "state": said.state,
            "age": _age_s(said, now_ns),
            "pose": _pose(said) if said.state == "tracking" else None,
            "hidden": said.hidden,
        }
        for camera, said in sorted(seen.vision.items())
        if _age_s(said, now_ns) < topics.VISION.oldest_s
    }
    said = seen.haptic
    if said is not None and _age_s(said, now_ns) < topics.HAPTIC.oldest_s:
        out["haptic"] = {
            "sense": "haptic",
            "state": said.state,
            "age": _age_s(said, now_ns),
            "pose": _pose(said) if said.state == "in_range" else None,
            "gap": said.gap if said.gap < FAR_M else None,
            "contact": _contact(said),
        }
    return out


def ellipsoid(covariance: np.ndarray) -> dict[str, list[float]]:
    """Half axes [m] of one standard deviation and orientation (x, y, z, w) of the ellipsoid of a position's covariance (3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    if np.linalg.det(vectors) < 0.0:  # a mirrored frame has no quaternion
        vectors[:, 0] = -vectors[:, 0]
    T = np.eye(4)
    T[:3, :3] = vectors
    return {"radii": _numbers(np.sqrt(np.maximum(values, 0.0))), "orientation": _numbers(rigid.position_orientation(T)[1])}


# ---- why a pose is not tracked


def reasons(seen: Seen, expected: Iterable[str], reports: Iterable[Report], now_ns: int) -> list[str]:
    """Reasons why no sense supports the pose, one per sense: its message, or that it is silent, and then the state of its
    process.

    expected: the senses of the cell, `vision` and `haptic`. reports: the newest health reports.
    """
    out = []
    reports = list(reports)
    for sense in expected:
        said = list(seen.vision.values()) if sense == "vision" else [seen.haptic] if seen.haptic else []
        topic = topics.VISION if sense == "vision" else topics.HAPTIC
        ages = [_age_s(message, now_ns) for message in said]
        if not ages or min(ages) > SILENT * topic.stale_s:
            silent = f"{sense} is silent for {min(ages):.1f} s" if ages else f"{sense} has sent nothing"
            out.append(silent + _because(topic, reports))
        elif sense == "vision":
            out += [_of_vision(message) for message in said if isinstance(message, messages.VisionPose)]
        elif isinstance(said[0], messages.HapticPose):
            out.append(_of_haptic(said[0]))
    return out


def _of_vision(said: messages.VisionPose) -> str:
    where = f"vision of {said.camera}"
    if said.state == "occluded":
        return f"{where}: too little to see, {said.hidden:.0%} hidden"
    if said.state == "lost":
        return f"{where}: the target is not found, {said.hidden:.0%} hidden"
    confidence = "" if said.confidence is None else f", confidence {said.confidence:.0%}"
    return f"{where}: tracks, {said.hidden:.0%} hidden, overlap {said.overlap:.0%}{confidence}"


def _of_haptic(said: messages.HapticPose) -> str:
    touched = _contact(said)
    if touched:
        return f"haptic: {touched}"
    if said.state == "in_range":
        return f"haptic: in range, gap {100 * said.gap:.0f} cm"
    if said.state != "out_of_range":
        what = "no limb" if said.state == "object" else "not yet known whether it is a limb"
        return f"haptic: something is near, {what}, gap {100 * said.gap:.0f} cm"
    return "haptic: nothing in range" + (f", gap {100 * said.gap:.0f} cm" if said.gap < FAR_M else "")


def _contact(said: messages.HapticPose) -> str:
    """The contact in words, empty if there is none."""
    if said.contact == "none":
        return ""
    what = {"in_range": "the limb", "object": "an object"}.get(said.state, "something")
    return f"{what} {'holds' if said.contact == 'grip' else 'touches'} {', '.join(said.touched)}"


def _because(topic: topics.Topic, reports: list[Report]) -> str:
    """State of the processes that publish a topic."""
    publishing = [report for report in reports if report.service in topic.publishers]
    if not reports:
        return ""
    if not publishing:
        return f": {' or '.join(topic.publishers)} does not run"
    bad = [f"{report.service} is {report.status} ({'; '.join(report.reasons)})" for report in publishing if report.status != "ok"]
    return f": {', '.join(bad)}" if bad else ""


# ---- processes and traffic


def processes(reports: Iterable[Report]) -> dict[str, Any]:
    """The processes of the cell, those of the launcher by its names for them, others by their service.

    rows: one per process; can_restart: whether a launcher runs, which can restart them.
    """
    reports = sorted(reports, key=lambda report: (report.service, report.host, report.pid))
    launchers = [report for report in reports if report.service == LAUNCHER.name]
    by_pid = {(report.host, report.pid): report for report in reports}
    rows, known = [], set()
    for launcher in launchers:
        for name, process in launcher.report.get("processes", {}).items():
            report = by_pid.get((launcher.host, process.get("pid")))
            known.add((launcher.host, process.get("pid")))
            service = report.service if report else name.partition(" ")[0]
            rows.append(_row(name, service, report, process["state"], process["note"], process["restarts"], True))
    for report in reports:
        if (report.host, report.pid) not in known:
            rows.append(_row(report.service, report.service, report, "running", "", 0, False))
    order = {name: place for place, name in enumerate(dict.fromkeys(row["service"] for row in rows))}
    return {"rows": sorted(rows, key=lambda row: order[row["service"]]), "can_restart": bool(launchers)}


def _row(name: str, service: str, report: Report | None, state: str, note: str, restarts: int, is_ours: bool) -> dict[str, Any]:
    status, why = state, note
    if report is not None and state == "running":
        status, why = report.status, "; ".join(report.reasons)
    process = find(service)
    return {
        # a restarted process keeps its row on the page
        "id": name if is_ours else report.instance if report else name,
        "name": name,
        "service": service,
        "about": process.about if process else "",
        "status": status,
        "why": why,
        "host": report.host if report else "",
        "pid": report.pid if report else None,
        "cpu": report.cpu if report else None,
        "memory": report.memory_mb if report else None,
        "restarts": restarts,
        "can_restart": is_ours and service != "router",
    }


def rates(reports: Iterable[Report], names: Iterable[str]) -> list[dict[str, Any]]:
    """The traffic by topic: the mean rate per key beside the nominal one, the longest delay to a reader, losses."""
    nominal = {topic.name: topic for topic in topics.TOPICS}
    return [
        {
            "topic": row.name,
            "about": nominal[row.name].about,
            "rate": row.rate_hz if row.rates else None,
            "nominal": nominal[row.name].rate_hz,
            "delay": max(row.delays_s) if row.delays_s else None,
            "dropped": row.dropped,
            "refused": row.bad,
        }
        for row in topic_rows(reports, names)
    ]


def levels(volts: Mapping[str, np.ndarray], skin: Any) -> dict[str, list[float]]:
    """The signal of each electrode [V] by pad, relative to the amplitude with nothing near. volts: (samples, electrodes) by pad;
    skin: the cell's `Skin`."""
    out = {}
    for pad, samples in volts.items():
        own = skin.of(skin.pads.index(pad))
        out[pad] = _numbers(skin.polarity[own] * (samples.mean(axis=0) - skin.a3[own]))
    return out


def _age_s(message: messages.Message, now_ns: int) -> float:
    return (now_ns - message.stamp_ns) * 1e-9


def _pose(message: Any) -> list[float]:
    return _numbers(message.position) + _numbers(message.orientation)


def joints(q: np.ndarray) -> list[float]:
    """Joint angles [rad] or displacements [m] (n,)."""
    return _numbers(q)


def _numbers(values: np.ndarray, digits: int = DIGITS) -> list[float]:
    return [round(value, digits) for value in values.tolist()]  # for few numbers numpy's own rounding takes four times as long


def pose_of(T: np.ndarray, digits: int = DIGITS) -> list[float]:
    """A transform (4, 4) as a pose with `digits` decimals."""
    position, orientation = rigid.position_orientation(T)
    return _numbers(position, digits) + _numbers(orientation, digits)
