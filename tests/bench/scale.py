"""`penumbra bench scale`: larger and larger cells as real processes, and our bus beside Zenoh's plain bytes.

A cell of n cameras and n targets is n work places side by side, each as in the table cell, with eight pads. Ages are those of
frames: from the exposure to the first fused pose that has taken it in. Bytes are those of payloads, by the processes' own
counters.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.tests.bench.lib import buses, results
from penumbra.tests.bench.lib.accuracy import percentiles
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.bench.live import Recording, cpu_times, fused_ages_s
from penumbra.tests.support.cells import derive
from penumbra.tests.support.live import Running, free_port, penumbra_up, wait_for

SIZES, QUICK_SIZES = (1, 2, 4, 8), (1, 2)
REPLICAS, QUICK_REPLICAS = (1, 2), (1,)
SHARED = ("segmentation", "search", "haptics", "fusion")
"""The services that share the streams."""
SINGLE = ("emulator", "dashboard")
"""The others that `penumbra up` starts for such a cell, one of each."""
START_S, SETTLE_S = 180.0, 5.0
SAMPLES, LISTEN_S = 10, 3.0
"""Maximum number of messages and maximum time [s] in which the size of a topic's messages is measured."""
LATENCY_GOAL, THROUGHPUT_GOAL = 1.25, 0.8
ROUNDS, QUICK_ROUNDS = 9, 3
MESSAGES, PAUSE_S, FLOOD_S = 60, 0.004, 0.3


def row(size: int, replicas: int, seed: int, seconds: float, rate_hz: float | None) -> dict[str, Any]:
    """One cell, run and measured."""
    with tempfile.TemporaryDirectory() as folder:
        path = derive("table", size, size, Path(folder), rate_hz)
        cell = cells.load(path)
        flags = [word for service in SHARED for word in ("--replicas", f"{service}={replicas}")]
        with penumbra_up(str(path), seed, "--log-level", "error", *flags) as running:
            expected = dict.fromkeys(SINGLE, 1) | dict.fromkeys(SHARED, replicas)
            wait_for(lambda: ready(running) == expected, START_S, f"{expected} of cell {cell.name}", 0.5)
            recordings = [Recording(running.session, cell.name, target) for target in cell.targets]
            wait_for(lambda: all(recording.samples["fused"] for recording in recordings), START_S, "a pose of every target", 0.5)
            wait_for_masks(running.session, cell)
            time.sleep(SETTLE_S)
            sizes = payload_sizes(running.session, cell)
            return {"cameras": size, "targets": size, "replicas": replicas} | measure(running, recordings, sizes, seconds)


def ready(running: Running) -> dict[str, int]:
    """Number of ready instances by service, without the launcher and its router."""
    found: dict[str, int] = defaultdict(int)
    for report in reports(running):
        found[report["service"]] += bool(report["ready"]) and report["service"] not in ("launcher", "router")
    return {service: number for service, number in found.items() if number}


def reports(running: Running) -> list[dict[str, Any]]:
    """The health of every instance."""
    replies = running.session.get(topics.health(running.cell), timeout=3.0, consolidation=zenoh.ConsolidationMode.NONE,
                                  target=zenoh.QueryTarget.ALL)  # fmt: skip
    return [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]


def wait_for_masks(session: zenoh.Session, cell: cells.Cell) -> None:
    """Waits for a mask of every camera: segmentation compiles before."""
    seen: set[str] = set()
    subscriber = session.declare_subscriber(topics.MASK.at(cell=cell.name), lambda sample: seen.add(str(sample.key_expr)))
    wait_for(lambda: len(seen) == len(cell.cameras), START_S, "a mask of every camera", 0.5)
    subscriber.undeclare()


def payload_sizes(session: zenoh.Session, cell: cells.Cell) -> dict[str, float]:
    """Mean size [bytes] of the messages on each topic; 0 for a silent one."""
    sizes = {}
    for topic in topics.TOPICS:
        seen: list[int] = []
        subscriber = session.declare_subscriber(topic.at(cell=cell.name), partial(_note_size, seen))
        deadline = time.monotonic() + LISTEN_S
        while len(seen) < SAMPLES and time.monotonic() < deadline:
            time.sleep(0.01)
        subscriber.undeclare()
        sizes[topic.name] = float(np.mean(seen)) if seen else 0.0
    return sizes


def _note_size(sizes: list[int], sample: zenoh.Sample) -> None:
    sizes.append(len(sample.payload))


def measure(running: Running, recordings: list[Recording], sizes: dict[str, float], seconds: float) -> dict[str, Any]:
    """Rates, ages, CPU and bytes over `seconds`."""
    processes = running.processes()
    for recording in recordings:
        for rows in recording.samples.values():
            rows.clear()
    before, cpu_before, began = counts(running), cpu_times(processes), time.monotonic()
    time.sleep(seconds)
    heard = [{topic: tuple(rows) for topic, rows in recording.samples.items()} for recording in recordings]
    cpu_after, elapsed, after = cpu_times(processes), time.monotonic() - began, counts(running)
    ages: list[float] = []
    for said in heard:
        vision = [messages.decode(messages.VisionPose, payload) for _, payload in said[topics.VISION.name]]
        fused = [messages.decode(messages.FusedPose, payload) for _, payload in said[topics.FUSED.name]]
        ages += fused_ages_s(vision, fused).tolist()
    rates = {key: (count - before.get(key, 0)) / elapsed for key, count in after.items()}
    published = per_topic(rates, "published")
    cpu: dict[str, float] = defaultdict(float)
    for name, spent in cpu_after.items():
        cpu[name.partition("-")[0]] += (spent - cpu_before.get(name, spent)) / elapsed
    links: dict[str, float] = defaultdict(float)
    for (service, _, _, topic), rate in rates.items():
        links[service] += rate * sizes[topic]
    fused_hz = sum(len(rows["fused"]) for rows in heard) / elapsed
    return {
        "offered_per_s": round(published["frame"], 1),
        "masks_per_s": round(published["mask"], 1),
        "frames_per_s": round(published["vision"], 1),
        "haptic_per_s": round(published["haptic"], 1),
        "fused_per_s": round(fused_hz, 1),
        "age_p95_ms": percentiles(np.array(ages), 1e3)["p95"],
        "cpu": round(sum(cpu.values()), 3),
        "cpu_of": {name: round(cores, 3) for name, cores in cpu.items()},
        "published_bytes_per_s": {name: round(rate * sizes[name]) for name, rate in published.items()},
        "link_bytes_per_s": {name: round(bytes_per_s) for name, bytes_per_s in links.items()},
        "message_bytes": {name: round(size) for name, size in sizes.items()},
    }


def counts(running: Running) -> dict[tuple[str, str, str, str], int]:
    """Messages so far by service, instance, whether `published` or received, and topic; the keys of a topic are summed."""
    found: dict[tuple[str, str, str, str], int] = defaultdict(int)
    for report in reports(running):
        for side in ("published", "topics"):
            for key, traffic in report[side].items():
                topic = bus.topic_of(key.partition(" #")[0])
                if topic is not None and report["service"] != "launcher":
                    found[report["service"], report["instance"], side, topic.name] += traffic["count"]
    return found


def per_topic(rates: dict[tuple[str, str, str, str], float], side: str) -> dict[str, float]:
    out = dict.fromkeys((topic.name for topic in topics.TOPICS), 0.0)
    for (_, _, which, topic), rate in rates.items():
        if which == side:
            out[topic] += rate
    return out


def bus_rows(rounds: int) -> list[dict[str, Any]]:
    """Our messages beside plain bytes, in turns, so that other load on the machine affects both. Medians over the rounds."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = bus.open_session(bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, START_S)
    out = []
    with router, buses.linked(endpoint) as link:
        for size in buses.PAYLOADS:
            latency: dict[str, list[float]] = defaultdict(list)
            throughput: dict[str, list[float]] = defaultdict(list)
            for number in range(rounds):
                for kind in buses.KINDS if number % 2 else reversed(buses.KINDS):
                    latency[kind].append(float(np.median(link.latencies_s(size, kind, MESSAGES, PAUSE_S))))
                    throughput[kind].append(link.per_s(size, kind, FLOOD_S))
            out.append({
                "bytes": link.senders[size].bytes,
                "latency_us": {kind: round(1e6 * float(np.median(found)), 1) for kind, found in latency.items()},
                "latency_ratio": ratio(latency),
                "per_s": {kind: round(float(np.median(found))) for kind, found in throughput.items()},
                "throughput_ratio": ratio(throughput),
            })  # fmt: skip
    return out


def ratio(found: dict[str, list[float]]) -> float:
    """Median over the rounds of the ratio of ours to raw."""
    return round(float(np.median(np.divide(found["ours"], found["raw"]))), 3)


def tables(result: Result) -> list[Part]:
    """The cells, and the bus beside its goals."""
    places = Table("size", "replicas", "frames", "masks", "vision", "haptic", "fused", "age p95", "CPU", "MB/s", "links MB/s",
                   title=f"Cells of 1 to {max(result['sizes'])} work places, seed {result['seed']}, on {result['cores']} cores",
                   caption="size: cameras and targets; messages a second of each topic; age: from the exposure to the "
                   "first fused pose that has taken the frame in, in ms; CPU: in cores; MB/s: published payloads; links: all "
                   "that processes exchange with the router")  # fmt: skip
    for each in result["rows"]:
        rates = (each[name] for name in ("offered_per_s", "masks_per_s", "frames_per_s", "haptic_per_s", "fused_per_s"))
        megabytes = (sum(each[name].values()) / 1e6 for name in ("published_bytes_per_s", "link_bytes_per_s"))
        places.add_row(
            str(each["cameras"]), str(each["replicas"]), *(f"{rate:.1f}" for rate in rates),
            "-" if each["age_p95_ms"] is None else f"{each['age_p95_ms']:.0f}", f"{each['cpu']:.2f}",
            *(f"{rate:.1f}" for rate in megabytes),
        )  # fmt: skip
    alone = Table("bytes", "p50 µs", "plain", "ratio", "goal", "1/s", "plain", "ratio", "goal",
                  title="The bus alone, beside Zenoh's plain bytes",
                  caption="between two processes through a router; p50: from before a message is made until it is read; 1/s: "
                  "messages without a loss, as many under way as a reader keeps")  # fmt: skip
    for each in result["bus"]:
        latency, throughput = each["latency_us"], each["per_s"]
        slower = marked(f"{each['latency_ratio']:.2f}", each["latency_ratio"] <= LATENCY_GOAL)
        fewer = marked(f"{each['throughput_ratio']:.2f}", each["throughput_ratio"] >= THROUGHPUT_GOAL)
        alone.add_row(
            str(each["bytes"]), f"{latency['ours']:.0f}", f"{latency['raw']:.0f}", slower, f"<= {LATENCY_GOAL}",
            str(throughput["ours"]), str(throughput["raw"]), fewer, f">= {THROUGHPUT_GOAL}",
        )  # fmt: skip
    return [places, alone]


@results.benchmark(
    "scale",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--seconds", type=flags.above_zero, default=10.0, help="length of each cell's measurement"),
    flags.Option("--rate", type=flags.above_zero, metavar="HZ", help="of the cameras (default: as in the table cell)"),
    flags.Option("--quick", is_flag=True, help="small cells, one replica, few rounds: shows that it works"),
    example="penumbra bench scale --quick --json scale.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    sizes, replicas = (QUICK_SIZES, QUICK_REPLICAS) if options.quick else (SIZES, REPLICAS)
    bus_alone = bus_rows(QUICK_ROUNDS if options.quick else ROUNDS)
    report.save({
        "seed": options.seed,
        "seconds": options.seconds,
        "sizes": sizes,
        "cores": len(os.sched_getaffinity(0)),
        "bus": bus_alone,
        "rows": [row(size, number, options.seed, options.seconds, options.rate) for size in sizes for number in replicas],
    })  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
