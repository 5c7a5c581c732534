"""A Prometheus endpoint for a running server. It is a process of its own, so that no scrape can delay the loop.

python -m palpate_server.diagnostics.metrics [--connect ENDPOINT] [--session NAME] [--port 9464]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from palpate_client import ClientError
from palpate_client.arguments import add_connection_options, connection_for
from palpate_server.arguments import need, port

if __name__ == "__main__":
    need("prometheus_client", "metrics", "palpate_server.diagnostics.metrics")

from prometheus_client import REGISTRY, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

_COUNTERS = {
    "ticks": "model steps",
    "ticks_on_arrival": "ticks that a command triggered",
    "late_ticks": "ticks that began more than a quarter of a period late",
    "caught_up_ticks": "missed ticks that were run later",
    "skipped_ticks": "missed ticks that were never run",
    "faults": "forces that were not finite",
    "lost_clients": "clients that disappeared while they held a tool",
    "accepted": "commands carried out",
}
_DURATIONS = ("timer_lateness_s", "tick_lateness_s", "compute_time_s", "input_age_s")
_RATES = {
    "success_rate": "share of the last 100 ticks with a new command in time",
    "success_rate_since_start": "share of the ticks of a tool with a command that had a new one in time",
}


class StatusCollector(Collector):
    """The newest status message as metrics."""

    def __init__(self) -> None:
        self.status: dict[str, Any] | None = None

    def collect(self) -> Iterator[Metric]:
        status = self.status
        yield GaugeMetricFamily(
            "palpate_up", "1 while the server sends its status", value=float(status is not None)
        )
        if status is None:
            return
        for name, text in _COUNTERS.items():
            yield CounterMetricFamily(f"palpate_{name}", text, value=status[name])
        for kind in ("refused", "malformed", "dropped"):
            family = CounterMetricFamily(f"palpate_{kind}", f"messages {kind}, by reason", labels=["reason"])
            for reason, count in status[kind].items():
                family.add_metric([reason], count)
            yield family
        for name in _DURATIONS:
            metric = f"palpate_{name.removesuffix('_s')}_seconds"
            gauge = GaugeMetricFamily(metric, f"{name} since the start", labels=["quantile"])
            for quantile, value in status[name].items():
                if value is not None:
                    gauge.add_metric([quantile], value)
            yield gauge
        for name, text in _RATES.items():
            rate = GaugeMetricFamily(f"palpate_{name}", text, labels=["tool"])
            for tool, state in status["tools"].items():
                if state[name] is not None:
                    rate.add_metric([tool], state[name])
            yield rate


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="palpate_server.diagnostics.metrics", description=(__doc__ or "").splitlines()[0]
    )
    add_connection_options(parser, name=False)
    parser.add_argument("--address", default="127.0.0.1", help="to listen on (%(default)s)")
    parser.add_argument("--port", type=port, default=9464, help="to listen on (%(default)s)")
    options = parser.parse_args(arguments)
    collector = StatusCollector()
    try:
        with connection_for(options) as connection:
            REGISTRY.register(collector)
            start_http_server(options.port, options.address)
            url = f"http://{options.address}:{options.port}/metrics"
            print(f"metrics of {connection.keys.prefix} on {url}", flush=True)
            while True:  # until Ctrl-C; None, and so palpate_up 0, when no status comes for a second
                collector.status = connection.next_status(1.0)
    except KeyboardInterrupt:
        return 0
    except (ClientError, OSError) as error:
        print(f"palpate_server.diagnostics.metrics: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
