"""Measure whether this machine can run a server at 1 kHz: a verdict, and what to change.

    palpate check-host [MODEL.npz] [--seconds 10] [--json]

With a model, the server runs this one, and all of its tools are pressed; without, a small sample of one patch.

Exit code 0: good or marginal. 1: not sufficient. 2: it could not be measured. 130: Ctrl-C.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import zenoh

import palpate_server.session.server  # noqa: F401, it runs in a child process; a missing package is found here, at the start
from palpate.model_file import ModelFileError, load_model, save_model
from palpate_client.arguments import failed, positive_up_to
from palpate_client.connection import open_session
from palpate_client.errors import ClientError
from palpate_client.local_server import free_endpoint, running
from palpate_client.wire import LEASE_MS, Keys
from palpate_server.coupling.models import tools_of
from palpate_server.diagnostics.round_trips import RoundTrips, ping_pong, through_a_model
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import threads

GOOD, MARGINAL, NOT_SUFFICIENT = "good", "marginal", "not sufficient"
_PING_PONG_S = 3.0
_LOAD_S = 5.0
_LONGEST_S = 3600.0
_COMMAND_BYTES, _FORCE_BYTES = 90, 220  # of messages for one tool

Value = float | str | bool | None


@dataclass(frozen=True)
class Finding:
    """One result: as text, as values with the unit in their names, its verdict, and advice for when it is not good."""

    name: str
    text: str
    values: Mapping[str, Value]
    verdict: str
    advice: str = ""


@dataclass(frozen=True)
class Bounds:
    """Values up to `good` are good, up to `marginal` marginal, and above not sufficient."""

    good: float
    marginal: float

    def judge(self, value: float) -> str:
        if value <= self.good:
            return GOOD
        return MARGINAL if value <= self.marginal else NOT_SUFFICIENT


# A hand feels delays of a few milliseconds; a tick takes one.
TIMER_LATENESS_P99_S = Bounds(100e-6, 500e-6)
ROUND_TRIP_P99_S = Bounds(1e-3, 3e-3)
UNANSWERED_SHARE = Bounds(0.01, 0.1)  # of commands: lost, or superseded before a tick used them
COMPUTE_P99_PERIODS = 0.5, 0.9  # of a tick, good and marginal; the rest of the period is for messages
LATE_SHARE = Bounds(0.001, 0.01)
SKIPPED_SHARE = Bounds(0.0, 0.001)
LOAD_PER_CPU = 0.3
SILENCE_IN_LEASES = Bounds(0.25, 0.75)  # after a silence of one lease the link is lost


def worst(verdicts: Sequence[str]) -> str:
    return max(verdicts, key=(GOOD, MARGINAL, NOT_SUFFICIENT).index)


def settings() -> list[Finding]:
    """Settings of the kernel and limits of the user. A setting is never worse than marginal."""
    cpus = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0] / cpus
    real_time = _has_real_time_kernel()
    governor = _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    refusal = _try_priority()
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    locked = soft == resource.RLIM_INFINITY or os.geteuid() == 0
    findings = [
        _setting("processors", str(cpus), cpus, cpus >= 2, "give the server two processors"),
        _setting("load per processor", f"{load:.2f}", load, load <= LOAD_PER_CPU, "stop other programs"),
        _setting(
            "real-time kernel", "yes" if real_time else "no", real_time, real_time, "a PREEMPT_RT kernel"
        ),
        _setting("real-time priority", refusal or "allowed", refusal is None, not refusal, refusal or ""),
        _setting(
            "locked memory",
            "unlimited" if locked else f"{soft} bytes",
            None if locked else soft,
            locked,
            "ulimit -l unlimited",
        ),
    ]
    if governor is not None:
        advice = "cpupower frequency-set -g performance"
        findings.append(_setting("governor", governor, governor, governor == "performance", advice))
    return findings


def _setting(name: str, text: str, value: Value, good: bool, advice: str) -> Finding:
    return Finding(name, text, {name.replace(" ", "_"): value}, GOOD if good else MARGINAL, advice)


def _read(path: str) -> str | None:
    return Path(path).read_text().strip() if Path(path).is_file() else None


def _has_real_time_kernel() -> bool:
    return _read("/sys/kernel/realtime") == "1"


def _for_late_ticks() -> str:
    """Advice, without what this machine has."""
    parts = ["stop other programs"]
    if not _has_real_time_kernel():
        parts.append("use a real-time kernel")
    if _try_priority() is not None:
        parts.insert(0, "allow real-time priority")
    return ", ".join(parts)


def _try_priority() -> str | None:
    result: list[str | None] = []
    thread = threading.Thread(target=lambda: result.append(threads.raise_priority()))
    thread.start()
    thread.join()
    return result[0]


def transport_round_trip(seconds: float = _PING_PONG_S) -> list[Finding]:
    """A bare Zenoh ping/pong with messages as large as commands and forces."""
    trips = ping_pong(_COMMAND_BYTES, _FORCE_BYTES, seconds)
    advice = "stop other programs; check what else uses the loopback device"
    return [_round_trip("Zenoh round trip", trips, advice), _unanswered("unanswered pings", trips, advice)]


def tick_run(path: Path, seconds: float) -> list[Finding]:
    """A server with a model, a client that presses all tools at 1 kHz, and a viewer of the surface. Raises ModelFileError, ClientError."""
    model = load_model(path)
    tools = [tool.name for tool in tools_of(model)]
    trips, status = through_a_model(path, tools, seconds, viewer=True)
    timer, compute = status["timer_lateness_s"], status["compute_time_s"]
    late = status["late_ticks"] / max(status["ticks"], 1)
    skipped = status["skipped_ticks"] / max(status["ticks"], 1)
    for_late_ticks = _for_late_ticks()
    return [
        _duration(
            "timer lateness",
            timer["p50"],
            timer["p99"],
            TIMER_LATENESS_P99_S,
            for_late_ticks,
        ),
        _duration(
            "tick computation",
            compute["p50"],
            compute["p99"],
            Bounds(*(share * model.period_s for share in COMPUTE_P99_PERIODS)),
            "a model with fewer points, modes or tools, or a faster processor",
        ),
        _round_trip("command to force", trips, "see timer and round trip"),
        _unanswered("unanswered commands", trips, "see timer and round trip"),
        _share("late ticks", late, LATE_SHARE, for_late_ticks),
        _share("skipped ticks", skipped, SKIPPED_SHARE, "stop other programs"),
    ]


def under_load(path: Path, seconds: float = _LOAD_S) -> Finding:
    """Whether a client keeps its link to a server beside one busy loop for each processor, each in a process session of its own.

    The longest silence is the longest time between two forces at the client. It includes the client's own wait for a processor.
    """
    arrivals = [time.monotonic()]
    lost = threading.Event()

    def on_token(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            lost.set()

    endpoint, keys = free_endpoint(), Keys("check-host")
    command = ["-m", "palpate_server", str(path), "--listen", endpoint, "--session", keys.session]
    with running([sys.executable, *command], "serving"), open_session(endpoint) as session:
        session.liveliness().declare_subscriber(keys.server, on_token, history=True)
        session.declare_subscriber(keys.force, lambda sample: arrivals.append(time.monotonic()))
        time.sleep(0.5)
        arrivals[:] = arrivals[-1:]
        with busy_loops(len(os.sched_getaffinity(0)), seconds):
            time.sleep(seconds)
        arrivals.append(time.monotonic())
    silence_s = max(later - earlier for earlier, later in pairwise(arrivals))
    lease_s = LEASE_MS * 1e-3
    return Finding(
        "link under load",
        f"{'lost' if lost.is_set() else 'kept'}, longest silence {silence_s:.3f} s of a lease of {lease_s:g} s",
        {"lost": lost.is_set(), "longest_silence_s": silence_s, "lease_s": lease_s},
        NOT_SUFFICIENT if lost.is_set() else SILENCE_IN_LEASES.judge(silence_s / lease_s),
        "stop other programs"
        if _try_priority() is None
        else "allow real-time priority, so that Zenoh's threads get it too; stop other programs",
    )


@contextlib.contextmanager
def busy_loops(number: int, longest_s: float, *, apart: bool = True) -> Iterator[None]:
    """Run `number` busy processes, each in a process session of its own (setsid) if `apart`: the kernel shares time between sessions first.

    They end after `longest_s`, even if this process is killed.
    """
    loop = f"import time\nend = time.monotonic() + {longest_s}\nwhile time.monotonic() < end: pass"
    processes = []
    try:
        for _ in range(number):
            processes.append(subprocess.Popen([sys.executable, "-c", loop], start_new_session=apart))
        yield
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


def _duration(name: str, p50_s: float, p99_s: float, bounds: Bounds, advice: str) -> Finding:
    text = f"p50 {p50_s * 1e6:.0f} us, p99 {p99_s * 1e6:.0f} us"
    return Finding(name, text, {"p50_s": p50_s, "p99_s": p99_s}, bounds.judge(p99_s), advice)


def _round_trip(name: str, trips: RoundTrips, advice: str) -> Finding:
    return _duration(name, trips.p50_s, trips.p99_s, ROUND_TRIP_P99_S, advice)


def _unanswered(name: str, trips: RoundTrips, advice: str) -> Finding:
    return _share(name, trips.unanswered, UNANSWERED_SHARE, advice)


def _share(name: str, share: float, bounds: Bounds, advice: str) -> Finding:
    return Finding(name, f"{share:.3%}", {"share": share}, bounds.judge(share), advice)


@contextlib.contextmanager
def _model(path: Path | None) -> Iterator[Path]:
    """A file that holds a model: the one at `path`, which is looked at first, or a sample. Raises ModelFileError, OSError."""
    if path is not None:
        load_model(path)
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        sample = Path(folder) / "sample.npz"
        save_model(spring_mass_model(n_modes=50), sample)
        yield sample


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate check-host", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "model",
        type=Path,
        nargs="?",
        metavar="MODEL.npz",
        help="the model that is to run here (default: a small sample)",
    )
    parser.add_argument(
        "--seconds",
        type=positive_up_to(_LONGEST_S),
        default=10.0,
        help="length of the tick run, up to an hour (%(default)s s)",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    options = parser.parse_args(arguments)
    hints = settings()
    try:
        with _model(options.model) as path:
            measured = [*transport_round_trip(), *tick_run(path, options.seconds), under_load(path)]
    except (ClientError, ModelFileError, OSError) as error:
        return failed("palpate check-host", error, 2)
    except KeyboardInterrupt:
        return 130
    verdict = worst([finding.verdict for finding in measured])
    findings = [*hints, *measured]
    if options.json:
        print(json.dumps({"verdict": verdict, "findings": [asdict(f) for f in findings]}, indent=2))
    else:
        for finding in findings:
            print(f"{finding.name:20} {finding.verdict:15} {finding.text}")
        print(f"\nverdict: {verdict}")
        for finding in findings:
            if finding.verdict != GOOD:
                print(f"  {finding.name}: {finding.advice}")
    return 1 if verdict == NOT_SUFFICIENT else 0


if __name__ == "__main__":
    sys.exit(main())
