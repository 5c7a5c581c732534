"""The bridge in C++: its contract beside the one in Python, and the whole of it, built and run as a user does.

The contract and the queue need a C++ compiler. The bridge needs cmake, msgpack's C++ headers, zenoh-c and
zenoh-cpp; where they are not in the system, CMAKE_PREFIX_PATH tells where. What is not there is skipped.
"""

from __future__ import annotations

import math
import os
import random
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from palpate_client import Contract, Force, OneSidedContact
from palpate_client.messages import read_description
from palpate_client.wire import Flags

SOURCE = Path(__file__).parents[2] / "client_examples" / "cpp"
RELEASE = {"kind": "request", "schema_version": 2}
MS = 1_000_000
HOLD_NS, DECAY_NS = 20 * MS, 50 * MS
PATIENCE_S = 60.0  # what is waited for comes much sooner
PROMISE = {
    "tools": [{"name": "tip", "start_m": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "radius_m": 0.01}],
    "limits": {"max_force_n": 1.0, "max_force_rate_n_per_s": 1000.0},
    "period_s": 1e-3,
    "hold_s": HOLD_NS * 1e-9,
    "decay_s": DECAY_NS * 1e-9,
    "model": {"config_sha256": "0"},
}

# Reads what is done to a contract or a queue, or where a hand is, and prints what they say of it.
LISTENER = f"""
#include <iostream>
#include <thread>
#include "contract.hpp"
#include "realtime.hpp"

void check_contract() {{
    palpate::Promise promise;
    promise.period_s = {PROMISE["period_s"]};
    promise.hold_s = {PROMISE["hold_s"]};
    promise.decay_s = {PROMISE["decay_s"]};
    promise.max_force_n = 1.0;
    promise.max_force_rate_n_per_s = 1000.0;
    promise.decaying = {int(Flags.DECAYING)};
    promise.stale = {int(Flags.STALE)};
    palpate::Contract contract(promise);
    std::string may_be_rendered;
    for (std::string word; std::cin >> word;) {{
        if (word == "agree") contract.agree(1.0);
        if (word == "release") contract.release();
        if (word == "sent") {{
            std::int64_t sequence, at;
            std::cin >> sequence >> at;
            contract.on_sending(sequence, at);
        }}
        if (word == "force") {{
            palpate::Force f;
            std::string x;
            std::cin >> f.tick >> f.sequence >> f.client_time_ns >> f.input_age_ns >> f.flags >> x >> f.arrival_ns;
            f.force_n[0] = std::stod(x);
            may_be_rendered += contract.on_force(f) ? '1' : '0';
        }}
    }}
    const auto& trips = contract.round_trips();
    std::cout.precision(17);
    std::cout << contract.holding() << ' ' << contract.commands() << ' ' << contract.forces() << ' '
              << contract.lost_ticks() << ' ' << contract.answered() << ' ' << contract.largest_force_n() << ' '
              << trips.at(0.5).value_or(-1) << ' ' << trips.at(0.99).value_or(-1) << ' '
              << trips.longest().value_or(-1) << '\\n'
              << may_be_rendered << '\\n';
    for (const auto& line : contract.broken()) std::cout << line << '\\n';
}}

void check_contact() {{
    std::int64_t silence_ns;
    bool touches_anywhere;
    std::cin >> silence_ns >> touches_anywhere;
    palpate::OneSidedContact contact(silence_ns, {{0.0, 0.6, -0.8}}, touches_anywhere);
    std::cout.precision(17);
    for (palpate::Vec3 hand; std::cin >> silence_ns >> hand[0] >> hand[1] >> hand[2];) {{
        const auto tip = contact.tip(hand, silence_ns);
        const palpate::Vec3 at = tip.value_or(palpate::Vec3{{}});
        std::cout << tip.has_value() << ' ' << at[0] << ' ' << at[1] << ' ' << at[2] << '\\n';
    }}
}}

void check_queue(long count) {{
    static palpate::Queue<std::array<long, 8>, 64> queue;  // longer than what a processor writes at once
    std::thread writer([&] {{
        for (long i = 0; i < count; ++i) {{
            while (!queue.push({{i, i, i, i, i, i, i, i}})) std::this_thread::yield();
        }}
    }});
    long wrong = 0;
    std::array<long, 8> got{{}};
    for (long i = 0; i < count; ++i) {{
        while (!queue.pop(got)) std::this_thread::yield();
        for (long part : got) wrong += part != i;
    }}
    writer.join();
    std::cout << wrong << ' ' << queue.pop(got) << '\\n';
}}

int main(int, char** argv) {{
    const std::string what = argv[1];
    if (what == "contract") check_contract();
    if (what == "contact") check_contact();
    if (what == "queue") check_queue(300'000);
}}
"""

# The example's device, whose motors write down where they are and each force that they are given, which fails if that is
# wanted, or holds the loop up at the first force until a file is there; and its driver, which is linked.
SPIED_DEVICE = f"""
#define Device SimulatedDevice
#include "{SOURCE / "simulated_device.hpp"}"
#undef Device
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <driver.h>
#include <unistd.h>

namespace palpate {{

class Device : public SimulatedDevice {{
   public:
    explicit Device(const Vec3& inwards) : SimulatedDevice(inwards), along_(inwards) {{}}
    ~Device() {{
        std::fclose(file_);
        std::fclose(driver_open((rendered_ + ".closed").c_str()));
    }}
    void render(const Vec3& force_n) noexcept {{
        const double force = dot(force_n, along_);
        std::fprintf(file_, "%.17g %.17g\\n", dot(SimulatedDevice::position_m(), along_), force);
        std::fflush(file_);
        SimulatedDevice::render(force_n);
        pushes_ = force != 0;
        const char* hold_up = std::getenv("HELD_UP_UNTIL");
        while (pushes_ && hold_up && access(hold_up, F_OK)) usleep(10'000);
    }}
    Vec3 position_m() const {{
        if (pushes_ && fails_ == "logic_error") throw std::logic_error("the encoder is upside down");
        if (pushes_ && fails_ == "int") throw 42;
        return SimulatedDevice::position_m();
    }}

   private:
    Vec3 along_;
    bool pushes_ = false;
    std::string rendered_ = std::getenv("RENDERED"), fails_ = std::getenv("FAILS") ? std::getenv("FAILS") : "";
    std::FILE* file_ = driver_open(rendered_.c_str());
}};

}}  // namespace palpate
"""


DRIVER_HEADER = """
#include <cstdio>
std::FILE* driver_open(const char* path);
"""

DRIVER = """
#include "driver.h"
std::FILE* driver_open(const char* path) { return std::fopen(path, "w"); }
"""


@pytest.fixture(scope="module")
def listen(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """listen(what, told) -> what it said"""
    compiler = os.environ.get("CXX") or shutil.which("c++")
    if not compiler:
        pytest.skip("there is no C++ compiler")
    folder = tmp_path_factory.mktemp("listener")
    (folder / "listener.cpp").write_text(LISTENER)
    strict = ("-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-pthread")
    subprocess.run(
        [compiler, *strict, "-I", SOURCE, "listener.cpp", "-o", "listener"],
        cwd=folder,
        check=True,
        timeout=120,
    )

    def run(what: str, told: str = "") -> str:
        command = [str(folder / "listener"), what]
        return subprocess.run(
            command, input=told, capture_output=True, text=True, check=True, timeout=60
        ).stdout

    return run


def troubled_conversation(seed: int) -> list[tuple[Any, ...]]:
    """Six seconds of commands and ticks, in which now and then something is not as it should be."""
    dice = random.Random(seed)
    said: list[tuple[Any, ...]] = [("agree",)]
    sent: dict[int, int] = {}
    tick, force = 1000, 0.0
    reached = silent_until = 0
    for now in range(1, 6000):
        if seed % 4 and now >= silent_until and dice.random() < 0.002:
            silent_until = now + dice.choice((10, 60, 200, 4500))
        if now >= silent_until:
            sent[len(sent) + 1] = now * MS
            said.append(("sent", len(sent), now * MS))
        # Two milliseconds later its answer comes; in every fourth conversation, without pauses, only the first ones are heard.
        while reached < len(sent) and sent[reached + 1] <= (now - 2) * MS:
            reached += 1
        newest = min(reached, 10_000 if seed % 4 else 300) or -1
        age = now * MS - sent[newest] - MS if newest > 0 else -1
        flags = 0
        if not 0 <= age <= HOLD_NS:
            flags = int(Flags.STALE if newest < 0 or age > HOLD_NS + DECAY_NS else Flags.DECAYING)
        force = 0.0 if flags & Flags.STALE else max(-1.0, min(1.0, force + dice.uniform(-0.5, 0.5)))
        tick += 1
        told: dict[str, Any] = {
            "tick": tick,
            "sequence": newest,
            "client_time_ns": sent.get(newest, -1),
            "input_age_ns": age,
            "flags": flags,
            "force_n": force,
            "arrival_ns": now * MS + dice.randrange(2 * MS),
        }
        if dice.random() < 0.006:  # a fault
            what, wrong = dice.choice(
                [
                    ("force_n", dice.choice((math.nan, -math.inf, 1.5, -1.1, force + 3.0))),
                    ("flags", dice.choice((0, int(Flags.STALE)))),
                    ("tick", tick - dice.choice((1, 3))),
                    ("tick", tick + 4),
                    ("sequence", dice.choice((-1, newest + 5, max(newest - 3, 1)))),
                    ("client_time_ns", 77),
                ]
            )
            told[what] = wrong
            tick = max(tick, told["tick"])
        said.append(("force", *told.values()))
        if dice.random() < 0.002:
            said += [("release",), ("agree",)]
    return said


def in_python(said: list[tuple[Any, ...]]) -> tuple[list[float], str, list[str]]:
    contract = Contract(read_description(PROMISE))
    may_be_rendered = ""
    for word, *values in said:
        if word == "agree":
            contract.acquired(1.0)
        elif word == "release":
            contract.released()
        elif word == "sent":
            contract.on_sending(*values)
        else:
            tick, sequence, client_time_ns, input_age_ns, flags, x, arrival_ns = values
            message = Force(
                tick,
                0,
                sequence,
                client_time_ns,
                input_age_ns,
                flags,
                (),
                (x, 0.0, 0.0),
                1.0,
                0.0,
                arrival_ns,
            )
            may_be_rendered += "1" if contract.on_force(message) else "0"
    summary = contract.summary()
    trips = summary["round_trip_s"]
    counts = [
        contract.holding,
        summary["commands_sent"],
        summary["forces_received"],
        summary["forces_lost"],
        summary["commands_answered"],
        summary["largest_force_n"],
    ]
    return [*counts, trips["p50"], trips["p99"], trips["max"]], may_be_rendered, summary["contract_broken"]


def without_numbers(lines: list[str]) -> list[str]:
    """But that of the tick, with which each begins."""
    return [re.sub(r"(?<=[ \[])-?(\d[\d.e+-]*|nan|inf)", "#", line[5:]) for line in lines]


SEEDS = range(16)


def test_the_contract_says_the_same_in_both_languages(listen: Callable[..., str]) -> None:
    heard = set()
    for seed in SEEDS:
        said = troubled_conversation(seed)
        numbers, may_be_rendered, broken = in_python(said)
        first, rendered, *lines = listen(
            "contract", "\n".join(" ".join(map(str, line)) for line in said)
        ).splitlines()
        *counts, p50, p99, longest = map(float, first.split())
        assert counts == [float(n) for n in numbers[:6]], seed
        assert rendered == may_be_rendered, seed
        assert without_numbers(lines) == without_numbers(broken), seed
        assert longest == pytest.approx(numbers[8], abs=1e-12)
        for ours, exact in ((p50, numbers[6]), (p99, numbers[7])):
            assert exact <= ours + 1e-12
            assert (
                ours <= exact + 1e-6 + 1e-12 if exact < 0.1 else ours == longest
            )  # counted by the microsecond
        heard |= {line.partition(": ")[2] for line in without_numbers(broken)}
    assert len(heard) == 10, heard  # each way to break it came up


def test_a_force_that_breaks_the_contract_is_not_rendered(listen: Callable[..., str]) -> None:
    forces = [
        (10, "0.9", 1),
        (11, "nan", 0),
        (12, "-inf", 0),
        (13, "1.1", 0),  # N; the limit is 1
        (12, "0.5", 0),  # late
        (14, "0.5", 1),
    ]
    told = "\n".join(f"force {tick} -1 -1 -1 {int(Flags.DECAYING)} {force} 0" for tick, force, _ in forces)
    assert listen("contract", told).splitlines()[1] == "".join(str(may) for _, _, may in forces)


@pytest.mark.parametrize("touches_anywhere", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_tip_is_where_the_one_in_python_is(
    listen: Callable[..., str], seed: int, touches_anywhere: bool
) -> None:
    """In and out of the tissue, with gaps in which the hand is let go until it leaves: tests/client/test_tool.py says why."""
    rng = random.Random(seed)
    tool: Any = SimpleNamespace(
        home_m=(0.0,) * 3, normal=(0.0, -0.6, 0.8), silent_s=0.0, touches_anywhere=touches_anywhere
    )
    contact = OneSidedContact(tool, HOLD_NS * 1e-9)
    told, expected = [f"{HOLD_NS} {int(touches_anywhere)}"], []
    for i in range(200):
        height_m = 2e-3 * math.cos(i / 5)
        hand = [height_m * n + rng.uniform(-1e-3, 1e-3) for n in tool.normal]
        silence_ns = rng.choice([0, 0, 0, 0, HOLD_NS - 1, HOLD_NS + 1])
        tool.silent_s = silence_ns * 1e-9
        tip, touches = contact.tip(hand)
        expected.append([int(touches), *tip])
        told.append(" ".join(map(repr, (silence_ns, *hand))))
    said = [
        [float(word) for word in line.split()] for line in listen("contact", "\n".join(told)).splitlines()
    ]
    assert said == [pytest.approx(row, abs=1e-15) for row in expected]
    if not touches_anywhere:
        assert {row[0] for row in expected} == {0, 1}


def test_what_one_thread_queues_another_finds_whole_and_in_order(listen: Callable[..., str]) -> None:
    assert listen("queue").split() == ["0", "0"]  # wrong ones, and one too many


# The bridge as a user builds and runs it.


@pytest.fixture(scope="module")
def bridge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bridge")
    if not shutil.which("cmake"):
        pytest.skip("there is no cmake")
    (folder / "spied_device.hpp").write_text(SPIED_DEVICE)
    (folder / "driver").mkdir()
    (folder / "driver" / "driver.h").write_text(DRIVER_HEADER)
    (folder / "driver" / "driver.cpp").write_text(DRIVER)
    compiler = os.environ.get("CXX") or shutil.which("c++")
    if not compiler:
        pytest.skip("there is no C++ compiler")
    library = folder / "driver" / "libdriver.so"
    command = [compiler, "-shared", "-fPIC", "driver.cpp", "-o", library]
    subprocess.run(command, cwd=library.parent, check=True, timeout=120)
    configured = subprocess.run(
        [
            *("cmake", "-S", SOURCE, "-B", folder / "build", "-DCMAKE_CXX_FLAGS=-Werror"),
            f"-DDEVICE_HEADER={folder / 'spied_device.hpp'}",
            f"-DDEVICE_INCLUDE_DIRS={library.parent}",
            f"-DDEVICE_LIBRARIES={library}",
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    if configured.returncode:
        missing = re.search(
            r'configuration\s+file\s+provided\s+by\s+"(\w+)"|Could not find (MSGPACK\w+)|(CMAKE_CXX_COMPILER)',
            configured.stderr,
        )
        assert missing, configured.stderr
        pytest.skip(
            f"cmake does not find {missing[missing.lastindex or 0]}: CMAKE_PREFIX_PATH may tell where it is"
        )
    subprocess.run(["cmake", "--build", folder / "build"], check=True, timeout=280)
    return folder / "build" / "device_bridge"


class Run:
    """The bridge in a process of its own."""

    def __init__(self, program: Path, folder: Path, endpoint: str, *options: str) -> None:
        self.rendered = folder / "rendered"
        # A busy test machine is no reason to let go.
        place = ("--connect", endpoint, "--session", "test", "--silence-s", "5")
        self.process = subprocess.Popen(
            [program, *place, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"RENDERED": str(self.rendered)},
        )

    def finish(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err

    def positions_and_forces(self) -> list[tuple[float, float]]:
        lines = self.rendered.read_text().splitlines(keepends=True) if self.rendered.exists() else []
        pairs = [line.split() for line in lines if line.endswith("\n")]
        return [(float(position), float(force)) for position, force in pairs]

    def is_connected(self) -> bool:
        connections = psutil.Process(self.process.pid).net_connections("tcp")
        return any(connection.status == psutil.CONN_ESTABLISHED for connection in connections)

    def device_was_closed(self) -> bool:
        return self.rendered.with_name("rendered.closed").exists()

    def forces(self) -> list[float]:
        return [force for _, force in self.positions_and_forces()]

    def wait_for(self, condition: Callable[[], object], what: str) -> None:
        give_up = time.monotonic() + PATIENCE_S
        while not condition():
            late = time.monotonic() > give_up
            if late or self.process.poll() is not None:
                self.process.kill()
                raise AssertionError(f"no {what}; last {self.positions_and_forces()[-1:]}, {self.finish()}")
            time.sleep(0.005)

    def wait_for_a_force(self, after: int = 0) -> None:
        self.wait_for(lambda: self.forces()[after:][-1:] not in ([], [0.0]), "force")

    def wait_for_none(self) -> None:
        self.wait_for(lambda: self.forces()[-1] == 0, "end of the force")


@pytest.fixture
def run_bridge(bridge: Path, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    runs: list[Run] = []

    def run(endpoint: str, *options: str) -> Run:
        runs.append(Run(bridge, tmp_path, endpoint, *options))
        return runs[-1]

    yield run
    for started in runs:
        started.process.kill()
        started.process.communicate()


def test_the_bridge_renders_forces_keeps_the_contract_and_leaves_the_motors_without_a_force(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    served = serve()
    for _ in range(5):  # on a busy machine the force may have been late, and let go before the end
        # It ends in the middle of a poke, with the tip in the tissue.
        run = run_bridge(served.endpoint, "--duration-s", "1.5")
        code, out, err = run.finish()
        assert code == 0, err
        assert re.search(r"contract +held", out)
        answered, sent = map(int, re.search(r"commands answered +(\d+) of (\d+)", out).groups())  # type: ignore[union-attr]
        assert 0 < answered <= sent
        assert float(re.search(r"round trip told +(\d+)", out)[1]) > 0  # type: ignore[index]
        positions, forces = zip(*run.positions_and_forces(), strict=True)
        assert forces[-1] == 0
        assert run.device_was_closed()
        if forces[-2] != 0:
            break
    else:
        raise AssertionError("no force at the end of any of 5 pokes")
    # The hand feels a push outwards, and nothing outside of the tissue.
    assert min(forces) < 0
    assert all(force == 0 for position, force in zip(positions, forces, strict=True) if position <= 0)


SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_leaves_the_motors_without_a_force_and_the_contact_free(
    serve: Callable[..., Any], run_bridge: Callable[..., Run], connect: Callable[..., Any], number: int
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        run = run_bridge(served.endpoint, "--duration-s", "60")
        run.wait_for_a_force()
        run.process.send_signal(number)
        code, out, err = run.finish()
        assert observer.next_status()["tools"]["tip"]["holder"] is None
    assert code == 130, err
    assert re.search(r"contract +held", out)
    assert run.forces()[-1] == 0


def test_a_signal_before_the_first_force_closes_the_device_too(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    run = run_bridge(serve().endpoint, "--duration-s", "60")
    run.wait_for(run.forces, "open device")  # then for 1.5 s round trips are measured
    run.process.send_signal(signal.SIGTERM)
    code, _, err = run.finish()
    assert code == 130, err
    assert set(run.forces()) == {0.0}
    assert run.device_was_closed()


def test_a_signal_while_the_bridge_waits_for_a_server_to_come_again_closes_the_device_too(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60", "--wait-s", "60")
    run.wait_for_a_force()
    served.process.kill()
    run.wait_for_none()
    run.wait_for(lambda: not run.is_connected(), "end of the connection")
    run.process.send_signal(signal.SIGTERM)
    code, _, err = run.finish()
    assert code == 130, err
    assert run.device_was_closed()


@pytest.mark.parametrize(
    ("thrown", "said"), [("logic_error", "the encoder is upside down"), ("int", "the device failed")]
)
def test_a_device_that_fails_is_left_without_a_force_whatever_it_throws(
    serve: Callable[..., Any],
    run_bridge: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    thrown: str,
    said: str,
) -> None:
    monkeypatch.setenv("FAILS", thrown)
    run = run_bridge(serve().endpoint, "--duration-s", "60")
    code, _, err = run.finish()
    assert code == 1
    assert f"device bridge: {said}" in err
    assert run.forces()[-2] != 0
    assert run.forces()[-1] == 0
    assert run.device_was_closed()


def test_a_killed_server_is_told_of_and_leaves_the_motors_without_a_force(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60")
    run.wait_for_a_force()
    served.process.kill()
    code, _, err = run.finish()
    assert code == 1
    assert "the server is gone" in err
    assert run.forces()[-1] == 0


def test_a_server_that_stops_is_told_of_and_leaves_the_motors_without_a_force(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60")
    run.wait_for_a_force()
    served.process.send_signal(signal.SIGTERM)
    code, _, err = run.finish()
    assert code == 1
    assert "the server is stopping" in err  # it says so first, and its forces fade by silence
    assert "contract broken" not in err
    assert run.forces()[-1] == 0


def test_a_bridge_that_was_held_up_when_the_server_stopped_says_that_it_stops(
    serve: Callable[..., Any],
    run_bridge: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Its loop learns at once that the server stops and that it is gone."""
    monkeypatch.setenv("HELD_UP_UNTIL", str(go_on := tmp_path / "go_on"))
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60")
    run.wait_for_a_force()
    assert served.stop() == 0
    run.wait_for(lambda: not run.is_connected(), "end of the connection")  # then the stop was received
    go_on.touch()
    code, _, err = run.finish()
    assert code == 1
    assert "the server is stopping" in err
    assert "contract broken" not in err
    assert run.forces()[-1] == 0


def test_a_lost_contact_leaves_the_motors_without_a_force(
    serve: Callable[..., Any], run_bridge: Callable[..., Run], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        run = run_bridge(served.endpoint, "--duration-s", "60", "--name", "bridge")
        run.wait_for_a_force()
        assert observer.query("control/bridge/release", RELEASE)[0]
        code, _, err = run.finish()
    assert code == 1
    assert "we no longer hold the tool" in err
    assert run.forces()[-1] == 0


def test_while_the_server_is_silent_nothing_is_rendered_until_the_hand_has_left_the_tissue(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60", "--wait-s", "60")
    run.wait_for_a_force()
    served.process.send_signal(signal.SIGSTOP)
    try:
        # Its token is there for another second: it is the silence that is noticed, after 20 ms.
        run.wait_for_none()
        let_go = len(run.forces()) - 1
    finally:
        served.process.send_signal(signal.SIGCONT)
    run.wait_for_a_force(let_go)
    assert run.process.poll() is None
    positions, forces = zip(*run.positions_and_forces()[let_go:], strict=True)
    assert min(positions[: next(i for i, force in enumerate(forces) if force)]) <= 0


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_with_a_server_that_comes_again_all_is_agreed_anew(
    serve: Callable[..., Any], run_bridge: Callable[..., Run], number: int
) -> None:
    served = serve()
    run = run_bridge(served.endpoint, "--duration-s", "60", "--wait-s", "60")
    run.wait_for_a_force()
    served.process.send_signal(number)
    served.process.wait()
    run.wait_for_none()
    let_go = len(run.forces())
    serve("--listen", served.endpoint, listen=False)
    run.wait_for_a_force(let_go)
    run.process.send_signal(signal.SIGTERM)
    code, out, err = run.finish()
    assert code == 130, err
    assert len(re.findall("round trip told", out)) == 2  # one for each agreement
    assert run.forces()[-1] == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--name", "a*"), "argument --name"),
        (("--name", ""), "argument --name"),
        (("--duration-s", "0"), "argument --duration-s"),
        (("--duration-s", "nan"), "argument --duration-s"),
        (("--duration-s", "1e10"), "argument --duration-s: '1e10' is not a number above 0, up to 1e9"),
        (("--wait-s", "1e10"), "argument --wait-s: '1e10' is not a number from 0 to 1e9"),
        (("--wait-s", "-1"), "argument --wait-s"),
        (("--wait-s", "0"), "nothing answers at tcp/127.0.0.1:1"),
        # Waiting would not help.
        (("--wait-s", "60", "--connect", "nonsense"), "'nonsense' is no endpoint"),
        (("--wait-s", "60", "--zenoh-config", "missing.json5"), "missing.json5"),
        (("--force", "1"), "usage"),
        (("--device",), "usage"),
        ((), "nothing answers at tcp/127.0.0.1:1"),
    ],
)
def test_what_can_not_be_is_said_at_once(
    run_bridge: Callable[..., Run], options: tuple[str, ...], said: str
) -> None:
    code, _, err = run_bridge("tcp/127.0.0.1:1", *options).finish()
    assert code == 2
    assert said in err


def test_a_contact_that_is_not_there_is_refused_with_those_that_are(
    serve: Callable[..., Any], run_bridge: Callable[..., Run]
) -> None:
    code, _, err = run_bridge(serve().endpoint, "--tool", "tap").finish()
    assert code == 2
    assert "no tool is called 'tap': there are tip" in err
