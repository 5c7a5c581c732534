"""The two example clients when things go wrong: what they notice, what they say, and what the device is left with."""

from __future__ import annotations

import json
import math
import re
import signal
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from palpate_client_examples.contract import Contract

from palpate_server.realtime.safety import DECAY_NS, HOLD_NS, Flags

EXAMPLES = Path(__file__).parents[2] / "client_examples"
MS = 1_000_000
LIMITS = {"max_force_n": 1.0, "max_force_rate_n_per_s": 1000.0}
FADE_MS = (HOLD_NS + DECAY_NS) // MS

# The bridge as it is, with a driver whose motors write down where they are and each force that they are given.
# It may begin with the hand in the tissue, or hold the loop up at the first force until a file is there.
SPIED_BRIDGE = f"""
import os
import sys
import time
from pathlib import Path
sys.path.insert(0, {str(EXAMPLES)!r})
import device_bridge
forces = Path(__file__).with_name("rendered").open("w", buffering=1)
render = device_bridge.SimulatedDevice.render
def spied(device, force_n):
    print(device.position_m, force_n, file=forces)
    render(device, force_n)
    while force_n and "HELD_UP_UNTIL" in os.environ and not Path(os.environ["HELD_UP_UNTIL"]).exists():
        time.sleep(0.01)
device_bridge.SimulatedDevice.render = spied
begin = device_bridge.SimulatedDevice.__init__
def begin_there(device, *properties):
    begin(device, *properties)
    device.position_m = float(os.environ.get("BEGINS_AT_M", 0))
device_bridge.SimulatedDevice.__init__ = begin_there
sys.exit(device_bridge.main())
"""


# The contract, message by message. All that is said here happens in the time of the client's clock.


class Conversation:
    """A contract of a client that holds its contact, fed with commands and ticks of a server one millisecond away."""

    def __init__(self) -> None:
        description = {
            "contacts": [{"name": "tip"}],
            "flags": {flag.name: flag.value for flag in Flags},
            "limits": LIMITS,
            "period_s": 1e-3,
            "hold_s": HOLD_NS * 1e-9,
            "decay_s": DECAY_NS * 1e-9,
        }
        self.contract = Contract(description, "tip")
        self.contract.agree({"limits": LIMITS})
        self.sent_ms: dict[int, int] = {}

    def send(self, at_ms: int) -> int:
        sequence = len(self.sent_ms) + 1
        self.sent_ms[sequence] = at_ms
        self.contract.on_sent({"sequence": sequence, "client_time_ns": at_ms * MS})
        return sequence

    def tick(
        self,
        at_ms: int,
        newest: int,
        heard_ms: int | None = None,
        force_n: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> bool:
        """The tick at a time, whose newest command is `newest` (-1: none), heard at once or later; may it be rendered?"""
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
            "force_n": [list(force_n)],
        }
        return self.contract.on_force(message, (at_ms if heard_ms is None else heard_ms) * MS)

    def go_well(self, from_ms: int, to_ms: int) -> int:
        """A command each millisecond, each answered two later; the newest command."""
        first = len(self.sent_ms) + 1
        for now in range(from_ms, to_ms):
            newest = self.send(now)
            if newest > 2:
                self.tick(now, max(newest - 2, first - 1))
        return newest


@pytest.mark.parametrize("force_n", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.8, 0.8)])
def test_a_force_that_is_not_finite_or_beyond_the_limit_is_not_to_be_rendered(
    force_n: tuple[float, ...],
) -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    assert said.tick(200, newest, force_n=(0.0, 0.6, 0.6))
    assert not said.tick(201, newest, force_n=force_n)
    assert "tick 201: the force" in said.contract.broken[0]
    assert said.tick(203, newest)
    assert not said.tick(202, newest)  # from before


@pytest.mark.parametrize(
    ("wrong", "said_of_it"),
    [
        ({"force_n": [[1.01, 0.0, 0.0]]}, "the limit 1.0 N"),
        ({"force_n": [[math.nan, 0.0, 0.0]]}, "is not finite"),
        ({"force_n": [[-0.9, 0.0, 0.0]]}, "jumped by 1.8"),
        ({"flags": [int(Flags.STALE)]}, "the input is stale"),
        ({"input_age_ns": [HOLD_NS + 2 * MS]}, "no flag says so"),
        ({"tick": 199}, "it came after tick 200"),
        ({"sequence": [90], "client_time_ns": [189 * MS]}, "the tick before answered 98"),
        ({"sequence": [1000]}, "we no longer hold the contact: it answers command 1000"),
        ({"client_time_ns": [77]}, "we no longer hold the contact: it answers command 98"),
        ({"sequence": [-1]}, "we no longer hold the contact, our commands are forgotten"),
    ],
)
def test_a_force_that_breaks_the_contract_in_any_way_is_not_to_be_rendered_but_the_next_good_one_is(
    wrong: dict[str, Any], said_of_it: str
) -> None:
    said = Conversation()
    said.go_well(100, 200)
    good = {
        "tick": 200,
        "sequence": [98],
        "client_time_ns": [said.sent_ms[98] * MS],
        "input_age_ns": [2 * MS],
        "flags": [0],
        "force_n": [[0.9, 0.0, 0.0]],
    }
    assert said.contract.on_force(good, 200 * MS)
    assert not said.contract.on_force(good | {"tick": 201} | wrong, 201 * MS)
    (broken,) = said.contract.broken
    assert said_of_it in broken
    assert said.contract.holding is ("no longer" not in broken)
    said.contract.agree({"limits": LIMITS})
    assert said.contract.on_force(good | {"tick": 202, "force_n": [[0.05, 0.0, 0.0]]}, 202 * MS)
    assert len(said.contract.broken) == 1


def test_round_trips_are_measured_anew_and_answers_counted_on() -> None:
    said = Conversation()
    said.go_well(100, 200)
    said.contract.measure_anew()
    assert said.contract.summary()["round_trip_s"]["p50"] is None
    said.go_well(200, 250)
    summary = said.contract.summary()
    assert summary["round_trip_s"]["p50"] == pytest.approx(2e-3)
    assert summary["commands_answered"] == 98 + 49


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
    observer.force_when(lambda force: force["force_scale"][0] == 1, "the force in full")
    return str(observer.next_status()["contacts"]["tip"]["holder"])


def test_a_client_whose_contact_is_released_by_another_fails_and_tells_the_servers_count(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("headless_client.py", served.endpoint, "--duration-s", "60", "--json")
        name = holder_when_poking(observer)
        assert observer.query(f"control/{name}/release")[0]
        code, out, err = client.finish()
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
        client = run_example("headless_client.py", served.endpoint, "--duration-s", "2", "--json")
        observer.force_when(lambda force: force["force_n"][0] != [0, 0, 0], "a force")
        client.process.send_signal(signal.SIGSTOP)
        time.sleep(0.5)  # after a second of silence the server would take the contact back
        client.process.send_signal(signal.SIGCONT)
        code, out, err = client.finish()
    summary = json.loads(out)
    assert code == 0, err
    assert summary["contract_broken"] == []
    assert summary["flags"]["STALE"] > 0


def test_a_summary_says_what_became_of_the_commands_and_no_more(
    serve: Callable[..., Any], run_example: Callable[..., Any]
) -> None:
    served = serve()
    # Three in a period: two of them replace each other unused.
    options = ("--duration-s", "0.5", "--rate-hz", "3000")
    code, out, err = run_example("headless_client.py", served.endpoint, *options, "--json").finish()
    assert code == 0, err
    summary = json.loads(out)
    assert set(summary["not_carried_out"]) == {"superseded"}
    code, out, err = run_example("headless_client.py", served.endpoint, *options).finish()
    assert code == 0, err
    assert re.search(r"not carried out +superseded \d+", out)


class Bridge:
    """The spied bridge: each position of the device, m, and the force that it was then given, N."""

    def __init__(self, folder: Path, run_example: Callable[..., Any], endpoint: str, *options: str) -> None:
        script = folder / "spied_bridge.py"
        script.write_text(SPIED_BRIDGE)
        self._rendered = folder / "rendered"
        self._rendered.touch()
        self.program = run_example(script, endpoint, *options)

    def rendered(self) -> list[tuple[float, float]]:
        lines = self._rendered.read_text().splitlines(keepends=True)
        pairs = [line.split() for line in lines if line.endswith("\n")]
        return [(float(position), float(force)) for position, force in pairs]

    def last_force(self) -> float | None:
        rendered = self.rendered()
        return rendered[-1][1] if rendered else None


@pytest.fixture
def run_bridge(run_example: Callable[..., Any], tmp_path: Path) -> Callable[..., Bridge]:
    return partial(Bridge, tmp_path, run_example)


@pytest.fixture
def run_bridge_until_a_force(
    run_bridge: Callable[..., Bridge], wait_for: Callable[..., Any]
) -> Callable[..., Bridge]:
    def run(*arguments: str) -> Bridge:
        bridge = run_bridge(*arguments, "--duration-s", "60")
        wait_for(bridge.last_force, "a force at the device")
        return bridge

    return run


def test_the_motors_are_left_without_a_force_at_the_end(
    serve: Callable[..., Any], run_bridge: Callable[..., Bridge]
) -> None:
    served = serve()
    for _ in range(5):  # on a busy machine the force may have been late, and let go before the end
        bridge = run_bridge(served.endpoint, "--duration-s", "0.5")  # the middle of a poke
        code, out, err = bridge.program.finish()
        assert code == 0, err
        assert float(re.search(r"round trip told +(\d+)", out)[1]) > 0  # type: ignore[index]
        (position, force), (_, last) = bridge.rendered()[-2:]
        assert last == 0
        assert position > 0
        if force != 0:
            break
    else:
        raise AssertionError("no force at the end of any of 5 pokes")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP])
def test_the_motors_are_left_without_a_force_by_a_signal(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge], number: int
) -> None:
    bridge = run_bridge_until_a_force(serve().endpoint)
    bridge.program.process.send_signal(number)
    assert bridge.program.stop(number) == 130  # a terminal that is closed may well say so twice
    assert bridge.last_force() == 0


def test_under_nohup_a_hang_up_does_not_end_the_bridge(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge], wait_for: Callable[..., Any]
) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # what is started inherits it
    try:
        bridge = run_bridge_until_a_force(serve().endpoint)
    finally:
        signal.signal(signal.SIGHUP, before)
    bridge.program.process.send_signal(signal.SIGHUP)
    rendered = len(bridge.rendered())
    wait_for(lambda: len(bridge.rendered()) > rendered + 100, "further steps")
    assert bridge.program.stop() == 130


def test_a_hand_that_begins_in_the_tissue_has_to_leave_it_first(
    serve: Callable[..., Any],
    run_bridge_until_a_force: Callable[..., Bridge],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("BEGINS_AT_M", "0.01")
    positions, forces = zip(*run_bridge_until_a_force(serve().endpoint).rendered(), strict=True)
    assert positions[0] == 0.01
    assert min(positions[: next(i for i, force in enumerate(forces) if force)]) <= 0


def test_the_motors_are_left_without_a_force_when_the_server_is_killed(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge]
) -> None:
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    served.process.kill()
    code, _, err = bridge.program.finish()
    assert code == 1
    assert "the server is gone" in err
    assert bridge.last_force() == 0


def test_a_bridge_lets_go_when_the_server_says_that_it_stops(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge]
) -> None:
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    assert served.stop() == 0
    code, _, err = bridge.program.finish()
    assert code == 1
    assert "the server is stopping" in err
    assert "contract broken" not in err
    assert bridge.last_force() == 0


def test_a_bridge_that_was_held_up_when_the_server_stopped_says_that_it_stops(
    serve: Callable[..., Any],
    run_bridge_until_a_force: Callable[..., Bridge],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Its loop learns at once that the server stops and that it is gone."""
    monkeypatch.setenv("HELD_UP_UNTIL", str(go_on := tmp_path / "go_on"))
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    assert served.stop() == 0
    time.sleep(0.5)  # until the bridge has heard it
    go_on.touch()
    code, _, err = bridge.program.finish()
    assert code == 1
    assert "the server is stopping" in err
    assert "contract broken" not in err
    assert bridge.last_force() == 0


def test_the_motors_are_left_without_a_force_when_the_contact_is_lost(
    serve: Callable[..., Any],
    run_bridge_until_a_force: Callable[..., Bridge],
    connect: Callable[..., Any],
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        bridge = run_bridge_until_a_force(served.endpoint, "--name", "bridge")
        assert observer.query("control/bridge/release")[0]
        code, _, err = bridge.program.finish()
    assert code == 1
    assert "we no longer hold the contact" in err
    assert bridge.last_force() == 0


def test_while_no_force_comes_none_is_rendered_until_the_tip_has_left_the_tissue(
    serve: Callable[..., Any],
    run_bridge_until_a_force: Callable[..., Bridge],
    wait_for: Callable[..., Any],
) -> None:
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    served.process.send_signal(signal.SIGSTOP)
    try:
        # Its token is there for another second, when the bridge would end: it is the silence that is noticed.
        time.sleep(0.05)
        silent = len(bridge.rendered())

        def let_go(rendered: list[tuple[float, float]]) -> bool:
            return any(position > 0 and force == 0 for position, force in rendered[silent:])

        wait_for(bridge.rendered, "no force in the tissue", let_go)
    finally:
        served.process.send_signal(signal.SIGCONT)
    wait_for(lambda: any(force for _, force in bridge.rendered()[silent:]), "a force again")
    assert bridge.program.process.poll() is None
    positions, forces = zip(*bridge.rendered()[silent:], strict=True)
    assert min(positions[: next(i for i, force in enumerate(forces) if force)]) <= 0


def test_the_servers_warning_of_vibration_counts_the_round_trip_that_the_bridge_measured(
    serve: Callable[..., Any], run_bridge: Callable[..., Bridge]
) -> None:
    options = ("--duration-s", "0.1", "--damping-n-s-per-m", "0.001")
    code, out, err = run_bridge(serve().endpoint, *options).program.finish()
    assert code == 0, err
    told_us = float(re.search(r"round trip told +(\d+)", out)[1])  # type: ignore[index]
    warned_ms = float(re.search(r"a round trip of ([\d.]+) ms", err)[1])  # type: ignore[index]
    assert warned_ms == pytest.approx(told_us / 1e3, rel=0.01)


def test_a_recording_that_cannot_be_written_does_not_cost_the_summary(
    serve: Callable[..., Any], run_example: Callable[..., Any]
) -> None:
    options = ("--duration-s", "0.5", "--json", "--record", "/dev/full")
    code, out, err = run_example("headless_client.py", serve().endpoint, *options).finish()
    assert code == 3
    assert json.loads(out)["contract_broken"] == []
    assert err.strip() == "palpate client: /dev/full: No space left on device"


def test_what_cannot_be_connected_with_is_told_from_a_server_that_is_not_there(
    run_example: Callable[..., Any], tmp_path: Path
) -> None:
    missing = tmp_path / "missing.json5"
    for endpoint, options, said in (
        ("nonsense", (), "'nonsense' is no endpoint, such as tcp/127.0.0.1:7447"),
        ("tcp/127.0.0.1:1", ("--zenoh-config", str(missing)), f"{missing}: No such file"),
        ("tcp/127.0.0.1:1", (), "nothing answers at tcp/127.0.0.1:1"),
    ):
        code, _, err = run_example("device_bridge.py", endpoint, *options).finish()
        assert code == 2
        assert err.startswith(f"device bridge: {said}")


@pytest.mark.parametrize("script", ["headless_client.py", "device_bridge.py"])
def test_a_name_that_no_key_can_have_is_refused_at_once(run_example: Callable[..., Any], script: str) -> None:
    names = ["a*", "a/b", "", "x" * 65]
    for client in [run_example(script, "tcp/127.0.0.1:1", "--name", name) for name in names]:
        code, _, err = client.finish()
        assert code == 2
        assert "argument --name" in err


def test_a_client_is_interrupted_while_it_connects(run_example: Callable[..., Any]) -> None:
    """To an endpoint where somebody takes the connection and says nothing."""
    clients, connections = [], []
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        silent.settimeout(60)
        for script in ("headless_client.py", "device_bridge.py"):
            clients.append(run_example(script, f"tcp/127.0.0.1:{silent.getsockname()[1]}"))
            connections.append(silent.accept()[0])
            clients[-1].process.send_signal(signal.SIGINT)
        assert [client.finish() for client in clients] == [(130, "", "")] * 2
        for connection in connections:
            connection.close()
