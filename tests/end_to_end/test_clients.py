"""The two example clients when things go wrong: what they notice, what they say, and what the device is left with."""

from __future__ import annotations

import json
import re
import signal
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from palpate.model_file import save_model
from palpate_client import Connection, Frame, Incompatible, Refused, ServerGone, Tool, ToolLost, steps
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Flags
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.session import transport

SESSION = "test"
RELEASE = {"kind": "request", "schema_version": 2}
EXAMPLES = Path(__file__).parents[2] / "client_examples"

# The bridge as it is, with a driver whose motors write down how deep they are, m, and each force that they are given, N, along
# the device's axis out of the tissue. It may begin with the hand in the tissue, and hold the loop up at the first force until
# a file is there, and then until the bridge has received that the server stops.
SPIED_BRIDGE = f"""
import os
import sys
import time
from pathlib import Path
sys.path.insert(0, {str(EXAMPLES)!r})
import device_bridge
from palpate_client import Connection
forces = Path(__file__).with_name("rendered").open("w", buffering=1)
go_on = Path(__file__).with_name("go_on")
render = device_bridge.SimulatedDevice.render
connections = []
join = Connection._join
def joined(connection):
    connections.append(connection)
    join(connection)
Connection._join = joined
def server_is_gone():
    return connections[0]._stopping.is_set() and connections[0]._gone.is_set()
def spied(device, force_n):
    forces.write("%r %r\\n" % (-1e-3 * device.z_mm, force_n[2]))  # at once, whenever a signal comes
    render(device, force_n)
    while force_n[2] and "HOLD_UP" in os.environ and not go_on.exists():
        time.sleep(0.005)
    while force_n[2] and os.environ.get("HOLD_UP") == "stop" and not server_is_gone():
        time.sleep(0.005)
device_bridge.SimulatedDevice.render = spied
begin = device_bridge.SimulatedDevice.__init__
def begin_there(device, *properties):
    begin(device, *properties)
    device.z_mm = -1e3 * float(os.environ.get("BEGINS_AT_M", 0))
device_bridge.SimulatedDevice.__init__ = begin_there
sys.exit(device_bridge.main())
"""


# The library, against a server of its own.


@pytest.fixture
def connection(serve: Callable[..., Any]) -> Iterator[Connection]:
    with Connection(serve().endpoint, SESSION) as connection:
        yield connection


def press_until_a_force(tool: Tool) -> tuple[float, float, float]:
    for _ in steps(60.0, 0.001):
        tool.move(tool.at_depth(0.002))
        if any(force := tool.take_force()):
            return force
    raise AssertionError("no force in 60 s")


def test_a_tool_is_held_from_entering_to_leaving_and_its_force_points_out_of_the_tissue(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer, Connection(served.endpoint, SESSION) as connection:
        with Tool(connection) as tool:
            assert tool.take_force() == (0.0, 0.0, 0.0)
            force = press_until_a_force(tool)
            assert sum(f * n for f, n in zip(force, tool.normal, strict=True)) > 0
            assert observer.next_status()["tools"]["tip"]["holder"] == connection.name
        assert observer.next_status()["tools"]["tip"]["holder"] is None
        assert tool.contract.broken == []
        assert tool.take_force() == (0.0, 0.0, 0.0)


def test_the_force_that_knows_of_a_command_is_waited_for(connection: Connection) -> None:
    with Tool(connection) as tool:
        assert not tool.wait_for_answer(0.0)  # nothing was sent
        answered = []
        for _ in range(20):
            tool.move(tool.home_m)
            assert tool.wait_for_answer(60.0)
            assert tool.newest is not None
            answered.append(tool.newest.sequence)
    assert answered == list(range(answered[0], answered[0] + 20))


def test_what_is_no_position_is_told_at_once(connection: Connection) -> None:
    with Tool(connection) as tool:
        for wrong in (
            [0.0, 0.0],
            "abc",
            [0.0, 0.0, None],
            5,
            [0.0, 0.0, np.nan],
            [np.inf, 0.0, 0.0],
            [10**400, 0, 0],
        ):
            with pytest.raises(ValueError, match=r"position_m is .*: expected three finite numbers"):
                tool.move(wrong)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=r"velocity_m_per_s is .*: expected three finite numbers"):
            tool.move(tool.home_m, [0.0, np.nan, 0.0])
        assert tool.contract.commands_sent == 0
        tool.move(np.zeros(3, np.float32))  # type: ignore[arg-type]
        assert any(press_until_a_force(tool))


def test_connection_and_tool_are_entered_once_at_a_time(connection: Connection) -> None:
    with pytest.raises(RuntimeError, match="the connection is open already"), connection:
        pass
    tool = Tool(connection)
    with pytest.raises(ToolLost, match="it is held in its `with` statement"):
        tool.move(tool.home_m)
    for _ in range(2):
        with tool:
            with pytest.raises(RuntimeError, match="the connection uses the tool 'tip'"), tool:
                pass
            with pytest.raises(RuntimeError, match="the connection uses the tool 'tip'"), Tool(connection):
                pass
            assert any(press_until_a_force(tool))
    assert tool.contract.broken == []


def test_an_error_inside_a_tool_is_not_replaced_by_one_of_its_release(connection: Connection) -> None:
    with pytest.raises(ZeroDivisionError), Tool(connection):
        connection.close()
        raise ZeroDivisionError


def test_a_frame_turns_positions_and_forces(connection: Connection) -> None:
    """The client's z axis is the outward normal; 1 mm at the client is 2 mm in the model; its origin is the tool's start."""
    described = connection.description.tools[0]
    z = described.normal
    x = (z[1], z[2], z[0])  # at right angles for a normal along an axis, as the sample's
    y = tuple(z[i - 2] * x[i - 1] - z[i - 1] * x[i - 2] for i in range(3))
    rotation = tuple(zip(x, y, z, strict=True))
    frame = Frame(rotation, scale=2.0, client_origin_m=(0.1, 0.0, 0.0), model_origin_m=described.start_m)  # type: ignore[arg-type]
    with Tool(connection, frame=frame) as tool:
        assert tool.home_m == pytest.approx((0.1, 0.0, 0.0))
        assert tool.normal == pytest.approx((0.0, 0.0, 1.0))
        force = np.array(press_until_a_force(tool))
    # At first the body answers like the springs of its feedthrough, which are not aligned with the normal.
    expected = np.array(rotation).T @ spring_mass_model(1, 20).discrete.d @ np.array(z)
    assert force @ expected > 0.99 * np.linalg.norm(force) * np.linalg.norm(expected)
    assert force[2] > 0


def test_refusals_are_the_servers_words(connection: Connection, serve: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="no tool is called 'tap': there are tip"):
        Tool(connection, "tap")
    with Tool(connection), Connection(connection.place, SESSION) as other:
        with pytest.raises(Refused, match="is held by client") as caught, Tool(other):
            pass
        assert caught.value.reason == "held"


def test_a_tool_that_somebody_releases_is_lost(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with (
        connect(served.endpoint) as observer,
        Connection(served.endpoint, SESSION) as connection,
        pytest.raises(ToolLost, match="our commands are forgotten"),
        Tool(connection) as tool,
    ):
        press_until_a_force(tool)
        assert observer.query(f"control/{connection.name}/release", RELEASE)[0]
        for _ in steps(60.0, 0.001):
            tool.move(tool.at_depth(0.002))


def test_after_a_server_that_came_back_a_tool_is_acquired_again_but_not_with_another_model(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    other = tmp_path / "other.npz"
    save_model(replace(served.model, config_sha256="f" * 64), other)
    server = served.program
    with Connection(served.endpoint, SESSION) as connection:
        for model in (tmp_path / "model1.npz", other):
            with pytest.raises(ServerGone), Tool(connection) as tool:
                press_until_a_force(tool)
                server.process.kill()
                server.process.wait()
                for _ in steps(60.0, 0.001):
                    tool.move(tool.at_depth(0.002))
            assert tool.take_force() == (0.0, 0.0, 0.0)
            place = ("--listen", served.endpoint, "--session", SESSION)
            server = start("-m", "palpate_server", model, *place, ready="serving")
            if model == other:
                with pytest.raises(Incompatible, match="another model"):
                    connection.reconnect(60.0)
            else:
                connection.reconnect(60.0)


def test_a_message_of_another_kind_than_its_keys_or_without_its_fields_is_ignored(
    serve: Callable[..., Any], connect: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    served = serve()
    with (
        connect(served.endpoint) as observer,
        Connection(served.endpoint, SESSION) as connection,
        Tool(connection) as tool,
    ):
        press_until_a_force(tool)
        force, status = observer.forces[-1], observer.statuses[-1]
        wrong = [
            ("force", status),
            ("force", {"kind": "force"}),
            ("force", force | {"sequence": []}),
            ("force", force | {"force_n": [["a", 0.0, 0.0]]}),
            ("force", force | {"tick": None}),
            ("status", {"kind": "status"}),
            ("status", status | {"recording": 7}),
            ("status", status | {"ticks": "a"}),
        ]
        for key, payload in [("force", b"\xc1"), *((key, msgpack.packb(message)) for key, message in wrong)]:
            observer.session.put(observer.key(key), payload)
        wait_for(lambda: connection.ignored, "ignored messages", lambda ignored: ignored == len(wrong) + 1)
        assert any(press_until_a_force(tool))


def test_a_server_of_version_1_is_told_from_one_that_does_not_answer() -> None:
    endpoint = free_endpoint()
    with transport.open_session(endpoint, None) as server:
        old = msgpack.packb({"schema_version": 1})
        server.declare_queryable("palpate/test/describe", lambda query: query.reply(query.key_expr, old))
        token = server.liveliness().declare_token("palpate/test/server")
        with (
            pytest.raises(Incompatible, match="schema version 1, this client 2"),
            Connection(endpoint, SESSION),
        ):
            pass
        token.undeclare()
        with pytest.raises(ServerGone, match="no server for palpate/test"), Connection(endpoint, SESSION):
            pass


def test_the_first_program_prints_a_force_that_pushes_out(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    text = (EXAMPLES / "first_program.py").read_text()
    assert len(text.splitlines()) <= 25
    served = serve("--session", "main")
    script = tmp_path / "first_program.py"
    script.write_text(text.replace("tcp/127.0.0.1:7447", served.endpoint))
    code, out, err = start(script).finish()
    assert (code, err) == (0, "")
    last = [float(number) for number in re.findall(r"[+-][\d.]+", out.splitlines()[-1])]
    normal = served.model.contacts[0].normal
    assert sum(f * n for f, n in zip(last, normal, strict=True)) > 0


def test_a_program_that_fails_inside_a_connection_ends(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    """Python would wait for Zenoh's threads if the session was not closed."""
    script = tmp_path / "fails.py"
    script.write_text(
        "import sys\nfrom palpate_client import Connection, Tool\n"
        f"with Connection({serve().endpoint!r}, 'test') as connection, Tool(connection):\n    sys.exit(3)\n"
    )
    assert start(script).finish()[0] == 3


# The clients as a user runs them.


def holder_when_poking(observer: Any) -> str:
    """The name of the client at the tip, once it feels its force in full."""
    observer.force_when(lambda force: force["force_scale"][0] == 1, "the force in full")
    return str(observer.next_status()["tools"]["tip"]["holder"])


def test_a_client_whose_contact_is_released_by_another_fails_and_tells_the_servers_count(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("palpate_client.poke", served.endpoint, "--duration-s", "60", "--json")
        name = holder_when_poking(observer)
        assert observer.query(f"control/{name}/release", RELEASE)[0]
        code, out, err = client.finish()
        counted = observer.next_status()
    assert code == 1
    assert "we no longer hold the tool" in err
    summary = json.loads(out)
    assert len(summary["contract_broken"]) == 1
    assert summary["server_lost"] is None
    # None may be refused: a client that hears of its loss before the next command is due sends no more.
    refused = summary["not_carried_out"].get("refused not_holder", 0)
    assert refused <= counted["refused"]["not_holder"] <= summary["commands_unanswered"]


def test_a_client_that_pauses_until_its_force_has_faded_goes_on_and_the_contract_holds(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("palpate_client.poke", served.endpoint, "--duration-s", "2", "--json")
        observer.force_when(lambda force: force["force_n"][0] != [0, 0, 0], "a force")
        client.process.send_signal(signal.SIGSTOP)
        # When the force has faded, well before the server would take the tool back.
        observer.force_when(lambda force: force["flags"][0] & Flags.STALE, "a faded force")
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
    code, out, err = run_example("palpate_client.poke", served.endpoint, *options, "--json").finish()
    assert code == 0, err
    summary = json.loads(out)
    assert set(summary["not_carried_out"]) == {"superseded"}
    code, out, err = run_example("palpate_client.poke", served.endpoint, *options).finish()
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

    def go_on(self) -> None:
        """Let a bridge go on that is held up."""
        self._rendered.with_name("go_on").touch()

    def last_force(self) -> float | None:
        rendered = self.rendered()
        return rendered[-1][1] if rendered else None


@pytest.fixture
def run_bridge(run_example: Callable[..., Any], tmp_path: Path) -> Callable[..., Bridge]:
    return partial(Bridge, tmp_path, run_example)


@pytest.fixture
def run_bridge_until_a_force(
    run_bridge: Callable[..., Bridge], wait_for: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Bridge]:
    """The bridge is held up at the first force, so that the force is there when something happens: then let it go on.

    On a busy machine the forces come with gaps, in which a hand is let go until it leaves the tissue: few are rendered.
    """

    def run(*arguments: str, hold_up: str = "here") -> Bridge:
        monkeypatch.setenv("HOLD_UP", hold_up)
        bridge = run_bridge(*arguments, "--duration-s", "240")
        wait_for(bridge.last_force, "a force at the device", seconds=240.0)
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


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        signal.SIGTERM,
        *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGQUIT, signal.SIGHUP)),
    ],
)
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
    bridge.go_on()
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
    bridge.go_on()
    code, _, err = bridge.program.finish()
    assert code == 1
    assert "the server is gone" in err
    assert bridge.last_force() == 0


def test_a_bridge_lets_go_when_the_server_says_that_it_stops(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge]
) -> None:
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    served.process.send_signal(signal.SIGTERM)
    bridge.go_on()
    assert served.program.finish()[0] == 0
    code, _, err = bridge.program.finish()
    assert code == 1
    assert "the server is stopping" in err
    assert "contract broken" not in err
    assert bridge.last_force() == 0


def test_a_bridge_that_was_held_up_when_the_server_stopped_says_that_it_stops(
    serve: Callable[..., Any], run_bridge_until_a_force: Callable[..., Bridge]
) -> None:
    """Its loop learns at once that the server stops and that it is gone."""
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint, hold_up="stop")
    assert served.stop() == 0
    bridge.go_on()
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
        assert observer.query("control/bridge/release", RELEASE)[0]
        bridge.go_on()
        code, _, err = bridge.program.finish()
    assert code == 1
    assert "we no longer hold the tool" in err
    assert bridge.last_force() == 0


def test_while_no_force_comes_none_is_rendered_until_the_tip_has_left_the_tissue(
    serve: Callable[..., Any],
    run_bridge_until_a_force: Callable[..., Bridge],
    wait_for: Callable[..., Any],
) -> None:
    served = serve()
    bridge = run_bridge_until_a_force(served.endpoint)
    served.process.send_signal(signal.SIGSTOP)
    bridge.go_on()
    try:
        # Its token is there for some seconds more, when the bridge would end: it is the silence that is noticed.
        stopped = len(bridge.rendered())

        def let_go() -> int | None:
            rendered = bridge.rendered()
            return next(
                (i for i in range(stopped, len(rendered)) if rendered[i][0] > 0 == rendered[i][1]), None
            )

        since = wait_for(let_go, "no force in the tissue")
    finally:
        served.process.send_signal(signal.SIGCONT)
    wait_for(lambda: any(force for _, force in bridge.rendered()[since:]), "a force again")
    assert bridge.program.process.poll() is None
    positions, forces = zip(*bridge.rendered()[since:], strict=True)
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


def test_a_table_that_can_not_be_written_is_refused_before_the_poke(
    serve: Callable[..., Any], run_example: Callable[..., Any]
) -> None:
    options = ("--duration-s", "0.5", "--json", "--record", "/dev/full")
    code, out, err = run_example("palpate_client.poke", serve().endpoint, *options).finish()
    assert code == 2  # at once: a device is never written over
    assert not out
    assert "/dev/full" in err


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


@pytest.mark.parametrize("script", ["palpate_client.poke", "device_bridge.py"])
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
        for script in ("palpate_client.poke", "device_bridge.py"):
            clients.append(run_example(script, f"tcp/127.0.0.1:{silent.getsockname()[1]}"))
            connections.append(silent.accept()[0])
            clients[-1].process.send_signal(signal.SIGINT)
        assert [client.finish() for client in clients] == [(130, "", "")] * 2
        for connection in connections:
            connection.close()
