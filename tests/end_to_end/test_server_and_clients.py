"""Server and clients as a user runs them: separate processes, real sockets, real time."""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import math
import os
import random
import re
import signal
import subprocess
import threading
import time
import urllib.request
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from dense_form import dense_a
from palpate.model_file import save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import RECORDER, Flags
from palpate_server.diagnostics.sample_model import spring_mass_model

LIMITS_MET = int(
    Flags.WORKSPACE_CLAMPED | Flags.SPEED_LIMITED | Flags.SLEW_LIMITED | Flags.FORCE_CLAMPED | Flags.FAULT
)


@pytest.fixture(scope="module")
def shared_server(serve_for_module: Callable[..., Any]) -> Any:
    """For tests of answers, which leave nothing behind."""
    return serve_for_module()


def in_full(force: dict[str, Any]) -> bool:
    return bool(force["force_scale"][0] == 1)


def has_flag(flag: Flags) -> Callable[[dict[str, Any]], bool]:
    return lambda force: bool(force["flags"][0] & flag)


def test_forces_through_the_wire_are_the_tissues_answer_to_the_applied_positions(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    run_example: Callable[..., Any],
    tmp_path: Path,
    forces_in: Callable[..., Any],
) -> None:
    """Forces are best effort. So what each tick applied is told by the server's recording, in which none is missing."""
    served = serve(
        *("--max-force-n", "1000", "--max-force-rate-n-per-s", "1e9", "--max-speed-m-per-s", "100"),
        *("--recordings", str(tmp_path)),
    )
    heard = tmp_path / "ticks.csv"
    with connect(served.endpoint, name=RECORDER) as client:
        client.record("ticks.mcap")
        options = ("--duration-s", "2", "--json", "--record", str(heard))
        code, out, err = run_example("palpate_client.poke", served.endpoint, *options).finish()
        assert code == 0, err
        assert client.control("record", file=None)[1]["recording"]["error"] is None
    summary = json.loads(out)
    assert summary["contract_broken"] == []
    assert summary["commands_answered"] > 0
    assert summary["round_trip_s"]["p50"] > 0

    system, (first, *_) = served.model.discrete, (recorded := forces_in(tmp_path / "ticks.mcap"))
    applied = np.array([tick["position_m"][0] for tick in recorded])
    assert not np.any(applied[0])  # recorded from before the first displacement: the model was at rest
    assert np.abs(applied).max() == pytest.approx(0.005, rel=1e-3)
    state, a = np.zeros(system.order), dense_a(system)
    expected = np.empty_like(applied)
    for k, u in enumerate(applied):
        expected[k] = system.c @ state + system.d @ u
        state = a @ state + system.b @ u

    with heard.open(newline="") as file:
        rows = list(csv.DictReader(file))
    ticks = np.array([int(row["tick"]) for row in rows])
    # The table begins before the tool is acquired and ends after it, the count does not.
    assert np.sum(np.diff(ticks) - 1) >= summary["forces_lost"]
    rows = [row for row in rows if 0 <= int(row["tick"]) - first["tick"] < len(recorded)]
    known = np.array([int(row["tick"]) - first["tick"] for row in rows])
    flags = np.array([int(row["tip.flags"]) for row in rows])
    assert not np.any(flags & LIMITS_MET)
    scale = np.array([float(row["tip.force_scale"]) for row in rows])
    assert scale.max() == 1
    displacement = np.array([[float(row[f"tip.position_{axis}_m"]) for axis in "xyz"] for row in rows])
    np.testing.assert_array_equal(displacement, applied[known])
    force = np.array([[float(row[f"tip.force_{axis}_n"]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(
        force, -scale[:, None] * expected[known], rtol=0, atol=1e-12 * np.abs(expected).max()
    )


def test_device_bridge_holds_the_contract(serve: Callable[..., Any], run_example: Callable[..., Any]) -> None:
    code, out, err = run_example("device_bridge.py", serve().endpoint, "--duration-s", "1").finish()
    assert code == 0, err
    assert "largest force" in out


def test_force_is_zero_within_a_tenth_of_a_second_after_the_client_is_killed(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    slow = ("--duration-s", "60", "--frequency-hz", "0.1")
    with connect(served.endpoint) as observer:
        for _ in range(5):
            client = run_example("palpate_client.poke", served.endpoint, *slow)
            observer.force_when(lambda force: in_full(force) and np.any(force["force_n"]), "the force")
            killed_ns = time.monotonic_ns()
            client.process.kill()
            observer.force_when(has_flag(Flags.STALE), "the end of the force")
            # One machine, one monotonic clock: the server's tick times are comparable with the time of the kill.
            after = [m for m in list(observer.forces) if m["server_time_ns"] >= killed_ns]
            zero = next(i for i, m in enumerate(after) if not np.any(m["force_n"]))
            assert not any(np.any(m["force_n"]) for m in after[zero:])
            assert after[zero]["server_time_ns"] - killed_ns < 100e6
            observer.status_when(lambda s: s["tools"]["tip"]["holder"] is None, "a free tool")
        assert observer.acquire("tip")[0]


def test_a_client_that_pauses_for_half_a_second_is_faded_out_and_softly_in_again(
    serve: Callable[..., Any],
    run_example: Callable[..., Any],
    connect: Callable[..., Any],
    tmp_path: Path,
    forces_in: Callable[..., Any],
) -> None:
    served = serve("--recordings", str(tmp_path))
    slow = ("--duration-s", "60", "--frequency-hz", "0.5")
    with connect(served.endpoint, name=RECORDER) as observer:
        client = run_example("palpate_client.poke", served.endpoint, *slow)
        observer.force_when(in_full, "the force in full")
        assert observer.control("record", file="pause.mcap")[0]
        client.process.send_signal(signal.SIGSTOP)
        stopped_ns = time.monotonic_ns()
        time.sleep(0.5)
        resumed_ns = time.monotonic_ns()
        client.process.send_signal(signal.SIGCONT)
        observer.force_when(in_full, "the force in full again")
        state = observer.next_status()["tools"]["tip"]
        assert observer.control("record", file=None)[1]["recording"]["error"] is None
    assert state["holder"] is not None  # half a second is no reason to lose the lease
    assert 0 < state["success_rate_since_start"] < 1

    ticks = forces_in(tmp_path / "pause.mcap")  # none is missing
    during = [tick for tick in ticks if stopped_ns <= tick["server_time_ns"] < resumed_ns]
    assert any(has_flag(Flags.HELD)(tick) for tick in during)
    assert any(has_flag(Flags.DECAYING)(tick) for tick in during)
    stale = [tick for tick in during if has_flag(Flags.STALE)(tick)]
    assert stale == during[-len(stale) :]
    assert not any(np.any(tick["force_n"]) for tick in stale)
    assert any(has_flag(Flags.SOFT_START)(tick) for tick in ticks)
    assert any(in_full(tick) for tick in ticks if tick["server_time_ns"] >= resumed_ns)
    for before, after in itertools.pairwise(ticks):
        assert after["tick"] == before["tick"] + 1
        assert math.dist(before["force_n"][0], after["force_n"][0]) <= 2.0 + 1e-9  # the default 2000 N/s
        assert after["force_scale"][0] - before["force_scale"][0] <= 1e-3 / 0.2 + 1e-9


def test_a_killed_server_is_named_by_the_client_which_fails(
    serve: Callable[..., Any], run_example: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as observer:
        client = run_example("palpate_client.poke", served.endpoint, "--duration-s", "60")
        observer.force_when(in_full, "the force in full")
        served.process.kill()
        code, _, err = client.finish()
    assert code == 1
    assert "the server is" in err


def test_a_client_without_a_server_says_so(run_example: Callable[..., Any]) -> None:
    code, _, err = run_example("palpate_client.poke", free_endpoint(), "--duration-s", "1").finish()
    assert code == 2
    assert "palpate client:" in err


def malformed_payloads(count: int) -> list[bytes]:
    """Every kind of wrong, from one seed: random, truncated, wrong type, wrong shape, not finite, huge."""
    generator = random.Random(0)
    good = {"kind": "command", "sequence": 1, "client_time_ns": 1, "position_m": {"tip": [0.0, 0.0, 0.0]}}
    whole = msgpack.packb(good)
    kinds: list[Callable[[], bytes]] = [
        lambda: generator.randbytes(generator.randrange(200)),
        lambda: whole[: generator.randrange(len(whole))],
        lambda: msgpack.packb(good | {"sequence": "one"}),
        lambda: msgpack.packb(good | {"position_m": [1, 2]}),
        lambda: msgpack.packb(good | {"position_m": {"tip": [0.0] * generator.randrange(3)}}),
        lambda: msgpack.packb(good | {"position_m": {"tip": [float("nan"), 0.0, 0.0]}}),
        lambda: msgpack.packb(good | {"position_m": {"tip": [1e308, 1e308, float("inf")]}}),
        lambda: msgpack.packb(good | {"position_m": {generator.randbytes(3).hex(): [0.0, 0.0, 0.0]}}),
        lambda: bytes(5000),
        lambda: msgpack.packb(generator.randrange(10**9)),
    ]
    return [kinds[i % len(kinds)]() for i in range(count)]


def test_ten_thousand_malformed_messages_leave_the_server_ticking(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        granted, _ = client.acquire("tip")
        assert granted
        payloads = malformed_payloads(10_000)
        before = client.next_status()
        client.put(bytes(10_000_000))  # larger than anything it reads, not too large to be counted
        for payload in payloads:
            client.put(payload)

        def counted(status: dict[str, Any]) -> int:
            return sum(status["refused"].values()) + sum(status["malformed"].values())

        after = client.status_when(
            lambda status: counted(status) - counted(before) == len(payloads) + 1, "all messages"
        )
        assert after["accepted"] == before["accepted"]
        assert after["malformed"]["too_large"] == 1001
        assert after["refused"]["not_finite"] == 2000
        assert after["faults"] == 0
        assert after["ticks"] > before["ticks"]

        sequence = client.command({"tip": [0.0, 0.0, -1e-3]})
        client.force_when(lambda force: force["sequence"][0] == sequence, "its answer")


@pytest.mark.parametrize("size", [20_000, 10_000_000])
def test_a_request_that_is_too_large_is_refused_before_it_is_read(
    shared_server: Any, connect: Callable[..., Any], size: int
) -> None:
    with connect(shared_server.endpoint) as client:
        granted, refusal = client.acquire("tip", remark="x" * size)
        assert not granted
        assert refusal["reason"] == "too_large"
        assert "expected at most 16384" in refusal["message"]
        (reply,) = client.session.get("palpate/test/describe", attachment=bytes(size), timeout=60.0)
        assert msgpack.unpackb(reply.err.payload.to_bytes())["reason"] == "too_large"
        assert client.acquire("tip")[0]


def test_old_sequences_and_others_tools_are_refused(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve(n_contacts=2)
    with connect(served.endpoint) as first, connect(served.endpoint) as second:
        assert first.acquire("tip")[0]
        granted, refusal = second.acquire("tip1", "tip")
        assert not granted
        assert refusal["reason"] == "held"
        assert second.acquire("tip1")[0]
        first.command({"tip": [0.0, 0.0, 0.0]}, sequence=5)
        first.command({"tip": [0.0, 0.0, 1e-3]}, sequence=5)
        first.command({"tip": [0.0, 0.0, 1e-3]}, sequence=4)
        second.command({"tip": [0.0, 0.0, 1e-3]}, sequence=6)
        second.command({"nothing": [0.0, 0.0, 1e-3]}, sequence=7)
        status = first.status_when(
            lambda status: status["accepted"] + sum(status["refused"].values()) == 5, "all commands"
        )
        assert status["accepted"] == 1
        assert status["refused"]["unknown_tool"] == 1
        assert status["refused"]["old_sequence"] == 2
        assert status["refused"]["not_holder"] == 1
        assert first.control("release") == (True, {"kind": "answer", "tools": ["tip"]})
        assert second.acquire("tip")[0]


@pytest.mark.parametrize(
    ("key", "fields", "reason"),
    [
        ("nobody/acquire", {"tools": ["tip"]}, "not_alive"),
        ("no.body/acquire", {"tools": ["tip"]}, "unknown_action"),
        ("*/acquire", {"tools": ["tip"]}, "unknown_action"),
        ("nobody/*", {}, "unknown_action"),
        ("nobody/explode", {}, "unknown_action"),
        ("nobody/acquire", {"tools": "tip"}, "wrong_type"),
        ("nobody/acquire", {}, "missing_field"),
        ("nobody/acquire", {"tools": ["tip"], "frame": {"scale": 0}}, "out_of_range"),
        ("nobody/acquire", {"tools": ["tip"], "round_trip_s": -1}, "out_of_range"),
        ("nobody/limits", {}, "missing_field"),
        ("nobody/limits", {"limits": {"max_force_n": 1.0}}, "not_holder"),
        ("nobody/acquire", {"tools": ["tip"], "device": ["omega"]}, "unknown_device"),
        ("nobody/acquire", {"tools": ["tip"], "device": {}}, "unknown_device"),
        ("nobody/record", {"file": "a.mcap"}, "no_recordings"),
    ],
)
def test_every_refusal_carries_its_reason(
    shared_server: Any, connect: Callable[..., Any], key: str, fields: dict[str, Any], reason: str
) -> None:
    with connect(shared_server.endpoint) as client:
        request = {"kind": "request", "schema_version": 2, **fields}
        granted, refusal = client.query(f"control/{key}", request)
        assert not granted
        assert (refusal["kind"], refusal["reason"]) == ("refusal", reason)
        assert refusal["message"]


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (None, "wrong_version"),
        ({"contacts": ["tip"]}, "wrong_version"),
        ({"schema_version": 2, "tools": ["tip"]}, "wrong_kind"),
        ([1], "not_a_map"),
    ],
)
def test_a_request_of_another_version_or_kind_is_refused(
    shared_server: Any, connect: Callable[..., Any], request_: object, reason: str
) -> None:
    with connect(shared_server.endpoint) as client:
        granted, refusal = client.query("control/nobody/acquire", request_)
        assert (granted, refusal["reason"]) == (False, reason)


def test_a_delete_on_a_command_key_is_counted_as_malformed(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        client.session.delete(client.key(f"command/{client.name}"))
        client.status_when(lambda status: status["malformed"]["not_msgpack"] == 1, "the DELETE")


def test_a_query_with_any_key_is_answered_and_does_not_fill_the_log(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        for _ in range(100):
            for key in ("palpate/**", "**", "palpate/test/control/*/*", "palpate/*/describe"):
                replies = list(client.session.get(key, timeout=60.0))
                answers = [reply.ok or reply.err for reply in replies]
                assert answers
                assert all(str(answer.encoding).startswith("application/msgpack") for answer in answers)
        assert client.acquire("tip")[0]
    assert served.stop() == 0
    assert "Traceback" not in served.program.printed()
    assert len(served.program.printed().splitlines()) < 20


def test_a_device_brings_its_limits_its_frame_and_warnings(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        request: dict[str, Any] = {"tools": ["tip"], "device": "touch"}
        request |= {"round_trip_s": 2e-3, "device_damping_n_s_per_m": 0.01, "frame": {"scale": 2.0}}
        granted, terms = client.control("acquire", **request)
        assert granted
        limits = terms["tools"]["tip"]["limits"]
        assert limits["max_force_n"] == 3.3
        assert terms["frame"]["scale"] == 2.0
        assert any("damping" in warning for warning in terms["warnings"])
        status = client.next_status()["tools"]["tip"]
        assert status["holder"] == client.name
        assert status["limits"] == limits
        assert status["frame"]["scale"] == 2.0

        save_model(spring_mass_model(1, 35), tmp_path / "stiffer.npz")
        granted, answer = client.control("load", file="stiffer.npz")
        assert granted
        damping, stiffer = (next(w for w in of["warnings"] if "damping" in w) for of in (terms, answer))
        needed, needed_by_stiffer = (
            float(re.search(r"above the ([\d.e+]+)", w)[1]) for w in (damping, stiffer)
        )
        assert needed_by_stiffer > needed

        granted, refusal = client.control("acquire", **request | {"device": "hammer"})
        assert (granted, refusal["reason"]) == (False, "unknown_device")
        granted, refusal = client.control("acquire", **request | {"frame": {"scale": -1}})
        assert (granted, refusal["reason"]) == (False, "out_of_range")
        granted, refusal = client.control("limits", limits={"max_damping_n_s_per_m": None})
        assert (granted, refusal["reason"]) == (False, "wrong_type")

        granted, answer = client.control("limits", limits={"max_force_n": 1.5})
        assert granted
        assert answer["tools"] == {"tip": {"limits": limits | {"max_force_n": 1.5}}}
        beyond: list[dict[str, float]] = [  # of the server's 10 N, or of the device's 3.3 N and 5 N s/m
            {"max_force_n": 11.0},
            {"max_force_n": 3.4},
            {"max_damping_n_s_per_m": 5.1},
            {"max_force_n": 0.0},
            {"max_force_n": -1.0},
            {"max_force_n": math.inf},
        ]
        for wanted in beyond:
            granted, refusal = client.control("limits", limits=wanted)
            assert (granted, refusal["reason"]) == (False, "out_of_range")
        for too_slow in (199.0, 1e-320):  # the server's 10 N in the 50 ms of the fading are 200 N/s
            granted, refusal = client.control("limits", limits={"max_force_rate_n_per_s": too_slow})
            assert (granted, refusal["reason"]) == (False, "out_of_range")
            assert "200" in refusal["message"]
        assert client.control("limits", limits={"max_force_rate_n_per_s": 200.0})[0]
        granted, refusal = client.control("limits", limits={"max_torque": 1.0})
        assert (granted, refusal["reason"]) == (False, "unknown_limit")


def test_a_client_that_goes_on_commanding_may_acquire_its_tool_again(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve(n_contacts=2)
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        with client.pressing({"tip": [0.0, 0.0, -0.004]}):
            client.force_when(in_full, "the force in full")
            granted, answer = client.acquire("tip1", "tip")
            assert granted, answer
            client.force_when(in_full, "the force in full again")
        tools = client.next_status()["tools"]
        assert [tools[name]["holder"] for name in ("tip", "tip1")] == [client.name] * 2


def test_only_who_is_alone_may_reset_the_model(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    served = serve(n_contacts=2)
    with connect(served.endpoint) as first, connect(served.endpoint) as second:
        granted, refusal = first.control("reset")
        assert (granted, refusal["reason"]) == (False, "not_holder")
        assert first.acquire("tip")[0]
        assert first.control("reset")[0]
        assert second.acquire("tip1")[0]
        granted, refusal = first.control("reset")
        assert (granted, refusal["reason"]) == (False, "held")


def test_a_model_is_exchanged_while_a_client_presses_and_a_bad_file_leaves_the_old_one(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    tmp_path: Path,
    assert_ticks_went_on: Callable[..., None],
) -> None:
    served = serve()
    save_model(replace(spring_mass_model(1, 35), name="other"), tmp_path / "other.npz")
    save_model(spring_mass_model(2, 5), tmp_path / "two.npz")
    (tmp_path / "bad.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:2000])
    outside = tmp_path.parent / "outside.npz"
    save_model(spring_mass_model(1, 5), outside)
    (tmp_path / "link.npz").symlink_to(outside)
    (tmp_path / "circle.npz").symlink_to(tmp_path / "circle.npz")
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        with client.pressing({"tip": [0.0, 0.0, -0.004]}):
            client.force_when(in_full, "the force in full")
            for name in (
                "bad.npz",
                "two.npz",
                "missing.npz",
                "link.npz",
                "circle.npz",
                "x" * 5000,
                "zero\0.npz",
                "../outside.npz",
                str(outside),
                "",
                3,
            ):
                granted, refusal = client.control("load", file=name)
                assert (granted, refusal["reason"]) == (False, "bad_model")
            assert client.query("describe")[1]["model"]["name"] == "masses on springs"
            before = client.next_status()
            granted, answer = client.control("load", file="other.npz")
            assert granted
            assert (answer["model"]["name"], answer["model"]["order"]) == ("other", 70)
            after = client.status_when(lambda status: status["model"]["name"] == "other", "the other model")
            assert_ticks_went_on(before, after)
            client.force_when(lambda force: force["tick"] > after["ticks"], "the forces until now")
        assert client.query("describe")[1]["model"]["name"] == "other"
        messages = [force for force in client.forces if force["tick"] >= before["ticks"]]
        assert messages[-1]["tick"] - messages[0]["tick"] >= 500  # the fading over
        assert len(messages) > 100
        assert all(math.isfinite(f) for message in messages for f in message["force_n"][0])
        largest = max(
            math.dist(a["force_n"][0], b["force_n"][0]) / (b["tick"] - a["tick"])
            for a, b in itertools.pairwise(messages)
        )
        assert largest <= 2.0 + 1e-9  # the default 2000 N/s
        assert after["faults"] == 0


def test_describe_and_geometry_say_what_the_model_is(
    serve: Callable[..., Any], connect: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    served = serve("--max-force-n", "3.5", "--surface-hz", "60")
    surface = served.model.surface
    with connect(served.endpoint) as client:
        _, description = client.query("describe")
        assert description["schema_version"] == 2
        assert description["limits"]["max_force_n"] == 3.5
        assert description["surface_period_s"] == 1 / 60
        assert [tool["name"] for tool in description["tools"]] == ["tip"]
        assert description["model"]["accuracy"]["band_hz"] == [0.0, 30.0]
        _, geometry = client.query("geometry")
        vertices = np.frombuffer(geometry["vertices_m"], "<f4").reshape(-1, 3)
        np.testing.assert_array_equal(vertices, surface.vertices.astype(np.float32))
        triangles = np.frombuffer(geometry["triangles"], "<i4").reshape(-1, 3)
        np.testing.assert_array_equal(triangles, surface.triangles)

        surfaces: list[dict[str, Any]] = []
        subscriber = client.session.declare_subscriber(
            "palpate/test/surface", lambda s: surfaces.append(msgpack.unpackb(s.payload.to_bytes()))
        )

        def intervals() -> list[int]:
            return [b["tick"] - a["tick"] for a, b in itertools.pairwise(surfaces)]

        wait_for(intervals, "some surfaces, two of them in time", lambda seen: len(seen) >= 4 and 17 in seen)
        subscriber.undeclare()
        moved = np.frombuffer(surfaces[-1]["displacement_m"], "<f4")
        np.testing.assert_array_equal(
            moved, np.zeros(3 * len(surface.vertices), np.float32)
        )  # nobody pokes it
        assert min(intervals()) == 17  # of a millisecond: the nearest to 60 Hz


def test_the_threads_that_run_ticks_are_kept_on_the_processor_that_is_asked_for(
    serve: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    allowed = os.sched_getaffinity(0)
    if len(allowed) == 1:
        pytest.skip("all threads are on the one processor that there is")
    cpu = max(allowed)

    def pinned(process: subprocess.Popen[bytes]) -> int:
        count = 0
        for task in Path(f"/proc/{process.pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread may end meanwhile
                count += f"Cpus_allowed_list:\t{cpu}\n" in (task / "status").read_text()
        return count

    served = serve("--cpu", str(cpu))
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        sequence = client.command({"tip": [0.0, 0.0, 0.0]})
        client.force_when(lambda force: force["sequence"][0] == sequence, "its answer")
        assert pinned(served.process) == 2  # the deadline loop and the thread that receives commands
    assert served.stop() == 0

    served = serve("--cpu", "1000")  # a processor that is not there is no reason not to serve
    with connect(served.endpoint):
        pass
    assert served.stop() == 0
    assert "not kept on processor 1000" in served.program.printed()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_server_cleanly_within_a_second(
    serve: Callable[..., Any], connect: Callable[..., Any], wait_for: Callable[..., Any], number: int
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        gone: list[int] = []
        client.session.liveliness().declare_subscriber(
            "palpate/test/server", lambda sample: gone.append(time.monotonic_ns())
        )
        assert client.acquire("tip")[0]
        assert served.stop(number) == 0
        wait_for(lambda: gone, "the end of the server's token")
        stopping = [status for status in client.statuses if status["state"] == "stopping"]
        assert stopping
        # From when it said so, which is as soon as the signal is served, to when its token went.
        assert gone[-1] - stopping[0]["server_time_ns"] < 1e9


def test_a_hang_up_that_is_ignored_does_not_stop_the_server(
    start: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    save_model(spring_mass_model(), tmp_path / "model.npz")
    endpoint = free_endpoint()
    script = (
        "import signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN);"
        "from palpate_server.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    options = ("--listen", endpoint, "--session", "test")
    server = start("-c", script, tmp_path / "model.npz", *options, ready="serving")
    with connect(endpoint) as client:
        server.process.send_signal(signal.SIGHUP)
        client.next_status()
        assert client.next_status()["state"] == "running"
    assert server.stop() == 0


HEAVY = ("scipy", "trimesh", "pydantic", "pydantic_core", "rich")


def imported(report: str) -> set[str]:
    """The modules in what `python -X importtime` has printed."""
    return set(re.findall(r"^import time: .*\|\s*(\S+)$", report, re.MULTILINE))


def test_the_server_process_imports_nothing_that_only_a_build_needs(
    start: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    """Beyond numba itself, which looks for scipy's BLAS when it compiles and goes on where there is no scipy."""
    save_model(spring_mass_model(), tmp_path / "model.npz")
    endpoint = free_endpoint()
    numba = start("-X", "importtime", "-c", "import numba; numba.njit(lambda x: x + 1)(1)")
    options = ("--listen", endpoint, "--session", "test")
    server = start(
        "-X", "importtime", "-m", "palpate_server", tmp_path / "model.npz", *options, ready="serving"
    )
    with connect(endpoint) as client:
        assert client.acquire("tip")[0]
        assert client.control("load", file="model.npz")[0]
    assert server.stop() == 0
    more = imported(server.err.read_text()) - imported(numba.finish()[2])
    assert "palpate_server.session.server" in more
    assert not {name for name in more if name.split(".")[0] in HEAVY}


def test_a_model_that_is_wrong_by_its_own_report_is_told_of_at_the_start(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    model = spring_mass_model()
    accuracy = replace(model.accuracy, error_in_band=1.43)
    save_model(replace(model, accuracy=accuracy), tmp_path / "wrong.npz")
    server = start(
        "-m", "palpate_server", tmp_path / "wrong.npz", "--listen", free_endpoint(), ready="serving"
    )
    assert "143 %" in server.err.read_text()
    assert server.stop() == 0


def test_a_model_file_that_unpacks_to_a_gibibyte_costs_no_force_and_no_lease(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    tmp_path: Path,
    assert_ticks_went_on: Callable[..., None],
) -> None:
    served = serve()
    model = tmp_path / "model1.npz"
    with (
        zipfile.ZipFile(model) as good,
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as bomb,
    ):
        for name in good.namelist():
            if name != "metadata.npy":
                bomb.writestr(name, good.read(name))
        with bomb.open("metadata.npy", "w", force_zip64=True) as member:
            header = {"descr": "|u1", "fortran_order": False, "shape": (2**30,)}
            np.lib.format.write_array_header_1_0(member, header)
            for _ in range(2**10):
                member.write(bytes(2**20))
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        with client.pressing({"tip": [0.0, 0.0, -0.004]}):
            client.force_when(in_full, "the force in full")
            before = client.next_status()
            granted, refusal = client.control("load", file="bomb.npz")
            after = client.next_status()
        assert (granted, refusal["reason"]) == (False, "bad_model")
        assert after["tools"]["tip"]["holder"] == client.name
        assert after["lost_clients"] == before["lost_clients"]
        assert_ticks_went_on(before, after)


# One process for many starts that fail; each gives a line and its code.
TRY_EACH = """
import json, sys
from palpate_server.__main__ import main
for arguments in json.loads(sys.argv[1]):
    print("code", main(arguments), file=sys.stderr, flush=True)
"""


def test_a_server_that_cannot_start_says_why_in_one_line(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    model = next(tmp_path.glob("*.npz"))
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(model.read_bytes()[:1000])
    unreadable = tmp_path / "broken.json5"
    unreadable.write_text("{ mode: ")
    wrong: tuple[tuple[tuple[str, ...], str], ...] = (
        ((str(model), "--listen", served.endpoint), "in use"),
        ((str(model), "--listen", "carrier-pigeon/1"), "carrier-pigeon/1"),
        ((str(damaged),), "damaged"),
        ((str(tmp_path / "missing.npz"),), "no such model file"),
        ((str(model), "--zenoh-config", str(unreadable)), "broken.json5"),
        ((str(model), "--zenoh-config", str(tmp_path / "missing.json5")), "no such file"),
        ((str(model), "--session", "a/b"), "a/b"),
        ((str(model), "--max-force-rate-n-per-s", "1"), "expected at least 200"),
    )
    tried = start("-c", TRY_EACH, json.dumps([arguments for arguments, _ in wrong])).finish()
    messages, codes = tried[2].splitlines()[0::2], tried[2].splitlines()[1::2]
    assert codes == ["code 2"] * len(wrong)
    for message, (_, expected) in zip(messages, wrong, strict=True):
        assert expected in message
    code, _, err = start("-m", "palpate_server", tmp_path / "missing.npz").finish()
    assert (code, len(err.splitlines())) == (2, 1)


def test_a_zenoh_configuration_is_used_as_it_is(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint, config = free_endpoint(), tmp_path / "zenoh.json5"
    config.write_text(
        f'{{ mode: "peer", listen: {{ endpoints: ["{endpoint}"] }},'
        " scouting: { multicast: { enabled: false }, gossip: { enabled: false } } }"
    )
    served = serve("--zenoh-config", str(config), listen=False)
    with connect(endpoint) as client:
        assert client.query("describe")[0]
    assert served.stop() == 0


def test_metrics_of_a_running_server_are_served_to_prometheus(
    serve: Callable[..., Any], start: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    served = serve()
    port = free_endpoint().rpartition(":")[2]
    options = ("--connect", served.endpoint, "--session", "test", "--port", port)
    start("-m", "palpate_server.diagnostics.metrics", *options, ready="metrics of")

    def scrape() -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as reply:
            return str(reply.read().decode())

    text = wait_for(scrape, "the server", lambda text: "palpate_up 1.0" in text)
    assert 'palpate_malformed_total{reason="not_msgpack"} 0.0' in text
    assert 'palpate_success_rate{tool="tip"} 0.0' in text
    assert float(re.findall(r"^palpate_ticks_total (\S+)", text, re.MULTILINE)[0]) > 0
    served.stop()
    wait_for(scrape, "the end of the server", lambda text: "palpate_up 0.0" in text)


def test_a_client_that_never_stops_asking_does_not_keep_the_server_from_stopping(
    serve: Callable[..., Any], connect: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        done = threading.Event()
        answered: list[object] = []
        payload = msgpack.packb({"kind": "request", "schema_version": 2, "limits": {"max_force_n": 1.0}})

        def ask() -> None:
            while not done.is_set():
                for _reply in client.session.get(
                    f"palpate/test/control/{client.name}/limits", payload=payload, timeout=0.5
                ):
                    answered.append(None)

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            wait_for(lambda: len(answered) > 100, "some answers")
            assert served.stop() == 0
        finally:
            done.set()
            for thread in threads:
                thread.join()


def test_a_killed_client_leaves_a_black_box_behind(
    serve: Callable[..., Any],
    run_example: Callable[..., Any],
    connect: Callable[..., Any],
    wait_for: Callable[..., Any],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "boxes"
    served = serve("--black-box", str(folder))
    with connect(served.endpoint) as observer:
        client = run_example("palpate_client.poke", served.endpoint, "--duration-s", "60")
        observer.force_when(in_full, "the force in full")
        client.process.kill()
        (path,) = wait_for(lambda: list(folder.glob("*-lost.npz")), "a black box")
    with np.load(path, allow_pickle=False) as file:
        assert np.any(file["ports"]["force_n"])
        assert not np.any(file["ports"]["force_n"][-1])
