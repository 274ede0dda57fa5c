"""Metrics in Prometheus' format, derived from health reports (`Node.health`) alone.

Counters belong to the process that reports them and restart with it, as Prometheus expects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from penumbra.shared.contract import processes
from penumbra.shared.contract.report import Report, TopicReport
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.health import STATUSES

WHO = ("cell", "service", "instance", "host")
"""Labels of every metric."""

Reports = Callable[[], Iterable[Report]]


def serve(address: str, port: int, reports: Reports) -> WSGIServer:
    """Serves the metrics of `reports()`, called at each request, on http://address:port/metrics in a thread of its own, until
    `shutdown` and `server_close`. Raises OSError where the port is taken or the address does not belong to this host."""
    registry = CollectorRegistry()
    registry.register(_Collector(reports))
    server, _ = start_http_server(port, address, registry)
    return server


class _Collector(Collector):
    def __init__(self, reports: Reports):
        self._reports = reports

    def describe(self) -> Iterable[Metric]:
        """Nothing in advance: the metrics depend on the reports."""
        return ()

    def collect(self) -> Iterator[Metric]:
        return metrics(self._reports())


def metrics(reports: Iterable[Report]) -> Iterator[Metric]:
    """Metrics of health reports. Times are in seconds, memory in bytes, CPU in cores."""
    families = _Families()
    for report in reports:
        who = tuple(getattr(report, name) for name in WHO)
        for status in STATUSES:
            families.gauge("status", "1 for the status that the process has", who, status == report.status, status=status)
        families.gauge("uptime_seconds", "since the process began", who, report.uptime_s)
        families.gauge("cpu_cores", "cores in use", who, report.cpu)
        families.gauge("memory_bytes", "resident memory", who, 1e6 * report.memory_mb)
        families.gauge("replicas", "living replicas of the service", who, report.replicas)
        for kind, count in report.faults.items():
            families.counter("faults", "exceptions by kind and place", who, count, kind=kind)
        for key, traffic in report.topics.items():
            _traffic(families, "received", who, key, traffic)
        for key, traffic in report.published.items():
            _traffic(families, "published", who, key, traffic)
        _own(families, who, report)
    return iter(families)


def _own(families: _Families, who: tuple[str, ...], report: Report) -> None:
    """Metrics of a service's own report, as listed in its row of the table of processes."""
    process = processes.find(report.service)
    for metric in process.metrics if process else ():
        for entry, row in (report.report.get(metric.within, {}) if metric.within else report.report).items():
            label = {metric.each: entry}
            if metric.is_counter:
                families.counter(metric.name, metric.about, who, row[metric.field], **label)
            elif metric.values:
                for value in metric.values:
                    families.gauge(metric.name, metric.about, who, row[metric.field] == value, **label, **{metric.field: value})
            else:
                families.gauge(metric.name, metric.about, who, row[metric.field], **label)


def _traffic(families: _Families, way: str, who: tuple[str, ...], key: str, traffic: TopicReport) -> None:
    topic = bus.topic_of(key.partition(" #")[0])
    labels = {"topic": topic.name if topic else "", "key": key}
    families.counter(f"{way}_messages", f"good messages {way}", who, traffic.count, **labels)
    families.gauge(f"{way}_hertz", f"messages {way} a second", who, traffic.rate_hz, **labels)
    if traffic.age_s is not None:
        families.gauge(f"{way}_age_seconds", "since the newest measurement", who, traffic.age_s, **labels)
    if way == "published":
        return
    if traffic.delay_s is not None:
        families.gauge("received_delay_seconds", "from the newest measurement to its arrival", who, traffic.delay_s, **labels)
    families.gauge("stale", "1 for an input that is missing", who, traffic.stale, **labels)
    if traffic.dropped is not None:
        families.counter(
            "dropped_messages", "messages that the publisher sent and that were never received", who, traffic.dropped, **labels
        )
    for kind, count in traffic.bad.items():
        families.counter("refused_messages", "messages refused by kind", who, count, **labels, kind=kind)


class _Families:
    """Metric families by name, each with the labels of its first sample."""

    def __init__(self) -> None:
        self._found: dict[str, CounterMetricFamily | GaugeMetricFamily] = {}

    def __iter__(self) -> Iterator[Metric]:
        return iter(self._found.values())

    def counter(self, name: str, about: str, who: tuple[str, ...], value: float, **labels: str) -> None:
        self._add(CounterMetricFamily, name, about, who, value, labels)

    def gauge(self, name: str, about: str, who: tuple[str, ...], value: float, **labels: str) -> None:
        self._add(GaugeMetricFamily, name, about, who, value, labels)

    def _add(
        self,
        kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
        name: str,
        about: str,
        who: tuple[str, ...],
        value: float,
        labels: dict[str, str],
    ) -> None:
        if name not in self._found:
            self._found[name] = kind(f"penumbra_{name}", about, labels=[*WHO, *labels])
        self._found[name].add_metric([*who, *labels.values()], float(value))
