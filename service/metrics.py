"""What Prometheus reads at `GET /metrics`. One registry an application, so two of them in a process do not mix."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
BATCHES = (1, 2, 4, 8, 16, 32)
POINTS = (1e3, 3e3, 1e4, 3e4, 1e5, 3e5, 1e6)


class Metrics:
    """Counters and histograms of one application."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        for collector in (ProcessCollector, PlatformCollector, GCCollector):
            collector(registry=self._registry)
        self._requests = Counter(
            "grasp_requests",
            "Requests by method, route and status.",
            ("method", "route", "status"),
            registry=self._registry,
        )
        self._duration = Histogram(
            "grasp_request_seconds",
            "From the request's head to the answer.",
            ("route",),
            buckets=SECONDS,
            registry=self._registry,
        )
        self._stages = Histogram(
            "grasp_stage_seconds",
            "Time of each stage of a request for grasps.",
            ("stage",),
            buckets=SECONDS,
            registry=self._registry,
        )
        self._predictions = Counter(
            "grasp_predictions", "Requests answered by each network.", ("model",), registry=self._registry
        )
        self._points = Histogram("grasp_points", "Points in a request.", buckets=POINTS, registry=self._registry)
        self._batches = Histogram(
            "grasp_batch_size", "Clouds predicted together.", buckets=BATCHES, registry=self._registry
        )

    def watch(
        self,
        queue_depth: Callable[[], int],
        active: Callable[[], int],
        is_ready: Callable[[], bool],
        held_bytes: Callable[[], int],
    ) -> None:
        """Read these whenever Prometheus asks."""
        Gauge("grasp_queue_depth", "Requests that wait for the predictor.", registry=self._registry).set_function(
            queue_depth
        )
        Gauge(
            "grasp_active_requests",
            "Requests for grasps that are being read, wait or are predicted.",
            registry=self._registry,
        ).set_function(active)
        Gauge(
            "grasp_held_bytes",
            "Bytes of bodies, clouds that wait and answers on their way.",
            registry=self._registry,
        ).set_function(held_bytes)
        Gauge("grasp_ready", "1 when requests are taken.", registry=self._registry).set_function(is_ready)

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answered request."""
        self._requests.labels(method, route, str(status)).inc()
        self._duration.labels(route).observe(seconds)

    def prediction(self, model: str, points: int, timings_ms: Mapping[str, float]) -> None:
        """Record a prediction's network, size and stages (milliseconds)."""
        self._predictions.labels(model).inc()
        self._points.observe(points)
        for stage, milliseconds in timings_ms.items():
            self._stages.labels(stage).observe(milliseconds / 1e3)

    def batch(self, size: int) -> None:
        """Record how many clouds were predicted together."""
        self._batches.observe(size)

    def text(self) -> bytes:
        """Everything, in Prometheus' text format."""
        return generate_latest(self._registry)
