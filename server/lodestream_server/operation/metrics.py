"""Metrics for Prometheus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)

from .disks import disk_of

__all__ = ["Metrics"]

_SECONDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
_BUILD_SECONDS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)


class Metrics:
    """The metrics of one server, in a registry of its own."""

    media_type = CONTENT_TYPE_LATEST

    def __init__(self) -> None:
        # A series for each that says when it began would double their number.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._requests = self._counter("requests", "HTTP requests answered", "method", "route", "status")
        self._request_seconds = self._histogram(
            "request_seconds", "time from a request to the end of its answer", _SECONDS
        )
        self._errors = self._counter("errors", "refused or failed requests and streams, by kind", "kind")
        self._streams_open = Gauge("lodestream_streams_open", "streams open now", registry=self._registry)
        self._streams = self._counter("streams", "ended streams, by result", "result")
        self._first_surface = self._histogram(
            "first_surface_seconds",
            "time from the open of a stream until the first drawable surface was sent",
            _SECONDS,
        )
        self._sent = self._counter("stream_bytes", "bytes of containers sent in streams")
        self._saved = self._counter(
            "stream_saved_bytes",
            "bytes that were not sent because the target was met or the client stopped, without those it held",
        )
        self._uploaded = self._counter("upload_bytes", "bytes of uploads received")
        self._build_seconds = self._histogram(
            "build_seconds", "duration of builds, by resulting state", _BUILD_SECONDS, "state"
        )

    def watch(self, folder: Path, surfaces: Callable[[], int], builds: Callable[[], int]) -> None:
        """Set the sources of gauges: the disk of a folder, the number of surfaces, the number of builds."""
        self._gauge("surfaces", "surfaces of the server", surfaces)
        self._gauge("builds_pending", "builds that wait or run", builds)
        self._gauge(
            "disk_free_bytes",
            "free space on the disk of the data folder, or of the scratch folder of a bucket",
            lambda: disk_of(folder).free,
        )

    def watch_bucket(self, writes: Callable[[], bool], unseen: Callable[[], float]) -> None:
        """Set the sources of gauges of servers that share a bucket: whether this one writes, and `Following.unseen`."""
        self._gauge("writer", "whether the server writes to its data: 1 if it does", writes)
        self._gauge(
            "bucket_unseen_seconds", "seconds since the bucket last answered what is asked again and again", unseen
        )

    def answered(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an HTTP request that was answered."""
        self._requests.labels(method, route, status).inc()
        self._request_seconds.observe(seconds)

    def failed(self, kind: str) -> None:
        """Count a refusal or failure; the kind is the ``code`` of a problem document or an ``error``."""
        self._errors.labels(kind).inc()

    def stream_opened(self) -> None:
        """Count a stream that has begun."""
        self._streams_open.inc()

    def first_surface(self, seconds: float) -> None:
        """Record the time until the first layer or level of a stream was sent."""
        self._first_surface.observe(seconds)

    def stream_ended(self, result: str, sent: int, saved: int) -> None:
        """Count a stream that has ended."""
        self._streams_open.dec()
        self._streams.labels(result).inc()
        self._sent.inc(sent)
        self._saved.inc(saved)

    def uploaded(self, size: int) -> None:
        """Count the bytes of an upload."""
        self._uploaded.inc(size)

    def built(self, state: str, seconds: float) -> None:
        """Record the duration of a build."""
        self._build_seconds.labels(state).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return generate_latest(self._registry)

    def _counter(self, name: str, meaning: str, *labels: str) -> Counter:
        return Counter(f"lodestream_{name}", meaning, labels, registry=self._registry)

    def _histogram(self, name: str, meaning: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(f"lodestream_{name}", meaning, labels, buckets=buckets, registry=self._registry)

    def _gauge(self, name: str, meaning: str, look: Callable[[], float]) -> None:
        Gauge(f"lodestream_{name}", meaning, registry=self._registry).set_function(look)
