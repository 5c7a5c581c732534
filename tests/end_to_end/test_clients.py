"""The two example clients when things go wrong: what they notice, what they say, and what the device is left with."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from palpate_client_examples.contract import Contract

from palpate_server.safety import DECAY_NS, HOLD_NS, Flags

EXAMPLES = Path(__file__).parents[2] / "client_examples"
MS = 1_000_000
FADE_MS = (HOLD_NS + DECAY_NS) // MS

# The bridge as it is, with a driver whose motors write down where they are and each force that they are given.
SPIED_BRIDGE = f"""
import sys
sys.path.insert(0, {str(EXAMPLES)!r})
import device_bridge
forces = open(sys.argv.pop(1), "w", buffering=1)
render = device_bridge.SimulatedDevice.render
def spied(device, force_n):
    print(device.position_m, force_n, file=forces)
    render(device, force_n)
device_bridge.SimulatedDevice.render = spied
sys.exit(device_bridge.main())
"""


def finish(process: subprocess.Popen[str], seconds: float = 60.0) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=seconds)
    assert "Traceback" not in err
    return process.returncode, out, err


def wait_until(condition: Callable[[], Any], seconds: float = 20.0) -> None:
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.005)


# The contract, message by message. All that is said here happens in the time of the client's clock.


class Conversation:
    """A contract of a client that holds its contact, fed with commands and ticks of a server one millisecond away."""

    def __init__(self) -> None:
        limits = {"max_force_n": 1.0, "max_force_rate_n_per_s": 1000.0}
        description = {
            "contacts": [{"name": "tip"}],
            "flags": {flag.name: flag.value for flag in Flags},
            "limits": limits,
            "period_s": 1e-3,
            "hold_s": HOLD_NS * 1e-9,
            "decay_s": DECAY_NS * 1e-9,
        }
        self.contract = Contract(description, "tip")
        self.contract.agree({"limits": limits})
        self.sent_ms: dict[int, int] = {}

    def send(self, at_ms: int) -> int:
        sequence = len(self.sent_ms) + 1
        self.sent_ms[sequence] = at_ms
        self.contract.on_sent({"sequence": sequence, "client_time_ns": at_ms * MS})
        return sequence

    def tick(self, at_ms: int, newest: int, heard_ms: int | None = None) -> None:
        """The tick at a time, whose newest command is `newest` (-1: none), heard at once or later."""
        age_ms = at_ms - self.sent_ms[newest] - 1 if newest >= 0 else -1
        flags = 0
        if not 0 <= age_ms * MS <= HOLD_NS:
            flags = int(Flags.STALE if newest < 0 or age_ms > FADE_MS else Flags.DECAYING)
        message = {
            "tick": at_ms,
            "sequence": [newest],
            "client_time_ns": [self.sent_ms[newest] * MS if newest >= 0 else -1],
            "input_age_ns": [age_ms * MS],
            "flags": [flags],
            "force_n": [[0.0, 0.0, 0.0]],
        }
        self.contract.on_force(message, (at_ms if heard_ms is None else heard_ms) * MS)

    def go_well(self, from_ms: int, to_ms: int) -> int:
        """A command each millisecond, each answered two later; the newest command."""
        first = len(self.sent_ms) + 1
        for now in range(from_ms, to_ms):
            newest = self.send(now)
            if newest > 2:
                self.tick(now, max(newest - 2, first - 1))
        return newest


def test_a_client_whose_commands_are_forgotten_has_lost_its_contact() -> None:
    said = Conversation()
    said.go_well(100, 200)
    assert said.contract.holding
    assert not said.contract.broken
    said.tick(200, -1)
    said.tick(201, -1)
    assert not said.contract.holding
    (broken,) = said.contract.broken
    assert "tick 200: we no longer hold the contact" in broken


def test_before_the_first_answer_and_after_a_release_no_command_of_ours_is_known_rightly() -> None:
    said = Conversation()
    said.send(100)
    said.tick(100, -1)
    said.go_well(101, 200)
    said.contract.release()
    said.tick(200, -1)
    assert not said.contract.broken


def test_a_client_that_goes_on_sending_for_a_second_while_its_force_has_faded_is_not_heard() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 1300):
        if now % 60 > 40:  # with pauses that let no force fade
            said.send(now)
        said.tick(now, newest)
    assert said.contract.holding  # perhaps: nobody has said otherwise
    (broken,) = said.contract.broken
    assert "went on sending" in broken


def test_commands_that_are_held_up_for_longer_than_a_force_takes_to_fade_break_no_promise() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 400):
        said.send(now)
        said.tick(now, newest)
    said.go_well(400, 500)
    assert Flags.STALE.name in said.contract.summary()["flags"]
    assert not said.contract.broken


def test_a_client_that_was_silent_itself_finds_nothing_wrong_with_a_faded_force() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 2000):  # it sends nothing, but hears
        said.tick(now, newest)
    said.go_well(2000, 2100)
    assert not said.contract.broken


@pytest.mark.parametrize("sent_first", [1, 2000])
def test_a_client_that_was_paused_finds_nothing_wrong_with_what_it_missed(sent_first: int) -> None:
    """What came while it could not listen it hears afterwards, when it has sent commands again."""
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(2000, 2000 + sent_first):
        said.send(now)
    for now in range(200, 2001):
        said.tick(now, newest, heard_ms=2000 + sent_first)
    assert not said.contract.broken


# The clients as a user runs them.


def holder_when_poking(observer: Any) -> str:
    """The name of the client at the tip, once it feels its force in full."""
    wait_until(lambda: observer.forces[-1]["force_scale"][0] == 1)
    wait_until(lambda: observer.statuses[-1]["contacts"]["tip"]["holder"])
    return str(observer.statuses[-1]["contacts"]["tip"]["holder"])


def test_a_client_whose_contact_is_released_by_another_fails_and_tells_the_servers_count(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("headless_client.py", served.endpoint, "--duration-s", "60", "--json")
        name = holder_when_poking(observer)
        assert observer.query(f"control/{name}/release")[0]
        code, out, err = finish(client, 20)
    assert code == 1
    assert "we no longer hold the contact" in err
    summary = json.loads(out)
    assert len(summary["contract_broken"]) == 1
    assert summary["server_lost"] is None
    assert summary["commands_unanswered"] > 0
    assert summary["not_carried_out"].get("refused not_holder", 0) > 0


def test_a_client_that_pauses_for_half_a_second_goes_on_and_the_contract_holds(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("headless_client.py", served.endpoint, "--duration-s", "4", "--json")
        holder_when_poking(observer)
        client.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        assert observer.forces[-1]["flags"][0] & Flags.STALE
        client.send_signal(signal.SIGCONT)
        code, out, err = finish(client, 20)
    summary = json.loads(out)
    assert code == 0, err
    assert summary["contract_broken"] == []
    assert summary["flags"]["STALE"] > 0


def test_a_summary_says_what_became_of_the_commands_and_no_more(
    serve: Callable[..., Any], run_example: Callable[..., Any]
) -> None:
    served = serve()
    # Three in a period: two of them replace each other unused.
    options = ("--duration-s", "1", "--rate-hz", "3000")
    code, out, err = finish(run_example("headless_client.py", served.endpoint, *options, "--json"))
    assert code == 0, err
    summary = json.loads(out)
    assert set(summary["not_carried_out"]) == {"superseded"}
    code, out, err = finish(run_example("headless_client.py", served.endpoint, *options))
    assert code == 0, err
    assert re.search(r"not carried out +superseded \d+", out)


@pytest.fixture
def run_bridge(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []

    def run(endpoint: str, *options: str) -> subprocess.Popen[str]:
        place = ("--connect", endpoint, "--session", "test", "--silence-s", "5")
        process = subprocess.Popen(
            [sys.executable, "-c", SPIED_BRIDGE, str(tmp_path / "rendered"), *place, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def rendered(tmp_path: Path) -> list[float]:
    return [force for _, force in positions_and_forces(tmp_path)]


def positions_and_forces(tmp_path: Path) -> list[tuple[float, float]]:
    lines = (tmp_path / "rendered").read_text().splitlines(keepends=True)
    pairs = [line.split() for line in lines if line.endswith("\n")]
    return [(float(position), float(force)) for position, force in pairs]


def wait_for_a_force(tmp_path: Path) -> None:
    wait_until(lambda: (tmp_path / "rendered").exists() and rendered(tmp_path)[-1:] not in ([], [0.0]))


def test_the_motors_are_left_without_a_force_at_the_end(
    serve: Callable[..., Any], run_bridge: Callable[..., Any], tmp_path: Path
) -> None:
    # It ends in the middle of a poke, with the tip in the tissue.
    code, out, err = finish(run_bridge(serve().endpoint, "--duration-s", "0.5"))
    assert code == 0, err
    forces = rendered(tmp_path)
    assert forces[-2] != 0
    assert forces[-1] == 0
    assert float(re.search(r"round trip told +(\d+)", out)[1]) > 0  # type: ignore[index]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_motors_are_left_without_a_force_by_a_signal(
    serve: Callable[..., Any], run_bridge: Callable[..., Any], tmp_path: Path, number: int
) -> None:
    bridge = run_bridge(serve().endpoint, "--duration-s", "60")
    wait_for_a_force(tmp_path)
    bridge.send_signal(number)
    code, _, _ = finish(bridge, 20)
    assert code == 130
    assert rendered(tmp_path)[-1] == 0


def test_the_motors_are_left_without_a_force_when_the_server_goes_and_comes_again(
    serve: Callable[..., Any], run_bridge: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    bridge = run_bridge(served.endpoint, "--duration-s", "60")
    wait_for_a_force(tmp_path)
    served.process.kill()
    code, _, err = finish(bridge, 20)
    assert code == 1
    assert "the server is gone" in err
    assert rendered(tmp_path)[-1] == 0


def test_the_motors_are_left_without_a_force_when_the_contact_is_lost(
    serve: Callable[..., Any], run_bridge: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        bridge = run_bridge(served.endpoint, "--duration-s", "60", "--name", "bridge")
        wait_for_a_force(tmp_path)
        assert observer.query("control/bridge/release")[0]
        code, _, err = finish(bridge, 20)
    assert code == 1
    assert "we no longer hold the contact" in err
    assert rendered(tmp_path)[-1] == 0


def test_while_no_force_comes_none_is_rendered_until_the_tip_has_left_the_tissue(
    serve: Callable[..., Any], run_bridge: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    bridge = run_bridge(served.endpoint, "--duration-s", "60")
    wait_for_a_force(tmp_path)
    served.process.send_signal(signal.SIGSTOP)
    try:
        # Its token is there for another second: it is the silence that is noticed, after 20 ms.
        wait_until(lambda: rendered(tmp_path)[-1] == 0, 0.5)
        let_go = len(rendered(tmp_path)) - 1
    finally:
        served.process.send_signal(signal.SIGCONT)
    wait_until(lambda: any(rendered(tmp_path)[let_go:]))
    assert bridge.poll() is None
    positions, forces = zip(*positions_and_forces(tmp_path)[let_go:], strict=True)
    assert positions[0] > 0
    assert min(positions[: next(i for i, force in enumerate(forces) if force)]) <= 0


def test_the_servers_warning_of_vibration_counts_the_round_trip_that_the_bridge_measured(
    serve: Callable[..., Any], run_bridge: Callable[..., Any]
) -> None:
    options = ("--duration-s", "0.1", "--damping-n-s-per-m", "0.001")
    code, out, err = finish(run_bridge(serve().endpoint, *options))
    assert code == 0, err
    told_us = float(re.search(r"round trip told +(\d+)", out)[1])  # type: ignore[index]
    warned_ms = float(re.search(r"a round trip of ([\d.]+) ms", err)[1])  # type: ignore[index]
    assert warned_ms == pytest.approx(told_us / 1e3, rel=0.01)


def test_a_recording_that_cannot_be_written_does_not_cost_the_summary(
    serve: Callable[..., Any], run_example: Callable[..., Any]
) -> None:
    options = ("--duration-s", "0.5", "--json", "--record", "/dev/full")
    code, out, err = finish(run_example("headless_client.py", serve().endpoint, *options))
    assert code == 3
    assert json.loads(out)["contract_broken"] == []
    assert err.strip() == "palpate client: /dev/full: No space left on device"


@pytest.mark.parametrize("script", ["headless_client.py", "device_bridge.py"])
@pytest.mark.parametrize("name", ["a*", "a/b", "", "x" * 65])
def test_a_name_that_no_key_can_have_is_refused_at_once(
    run_example: Callable[..., Any], script: str, name: str
) -> None:
    code, _, err = finish(run_example(script, "tcp/127.0.0.1:1", "--name", name))
    assert code == 2
    assert "argument --name" in err


@pytest.mark.parametrize("script", ["headless_client.py", "device_bridge.py"])
def test_a_client_is_interrupted_while_it_connects(run_example: Callable[..., Any], script: str) -> None:
    """To an endpoint where somebody takes the connection and says nothing."""
    connected = threading.Event()
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()

        def accept() -> None:
            connection, _ = silent.accept()
            with connection:
                connected.set()
                done.wait(30)

        done = threading.Event()
        thread = threading.Thread(target=accept)
        thread.start()
        try:
            client = run_example(script, f"tcp/127.0.0.1:{silent.getsockname()[1]}")
            assert connected.wait(20)
            client.send_signal(signal.SIGINT)
            code, _, err = finish(client, 20)
        finally:
            done.set()
            thread.join()
    assert code == 130
    assert not err
