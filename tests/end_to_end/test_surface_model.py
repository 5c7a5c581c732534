"""A surface model served by a second process: forces, two clients, grip, cross-fades, recordings, devices."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.model_file import ReducedModel, SurfaceModel, save_model
from palpate_client import Connection, Tool, steps
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Flags
from palpate_server.coupling.models import tools_of
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.recording import replay
from palpate_server.session.devices import PROFILES
from palpate_server.simulation import Simulation

CONTACT = Flags.IN_CONTACT | Flags.SLIDING | Flags.ATTACHED


def assert_all_is_repeated(path: Path, *models: Any) -> replay.Recorded:
    recorded = replay.read_recording(path)
    result = replay.compare(recorded, models)
    assert result.difference is None
    assert result.ticks == result.of == len(recorded.ticks)
    assert result.with_force > 50
    return recorded


def test_pokes_and_a_slide_through_the_wire_are_those_of_the_simulation_bit_for_bit(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
) -> None:
    model = make_surface_model()
    served = serve("--recordings", str(tmp_path), model=model)
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        home = client.next_status()["tools"]["tip"]["home_m"]
        assert home == list(tools_of(model)[0].start_m)
        client.record("a.mcap")
        times = [0, 300, 400, 450, 550, 650, 800, 900]
        for i in range(1000):
            height = 1e-3 * np.interp(i, times, [1.0, 1.0, -2.0, 1.0, -2.0, -2.0, -1.0, 2.0])
            along = 1e-3 * np.interp(i, [600, 850], [0.0, 8.0])
            client.command({"tip": [home[0] + along, home[1], home[2] + height]})
            time.sleep(1e-3)
        assert client.control("record", file=None)[0]
        received = {message["tick"]: message for message in client.forces}
    recorded = assert_all_is_repeated(tmp_path / "a.mcap", model)

    simulation = Simulation(model, PROFILES["generic"].max_stiffness_n_per_m)
    simulation._contact.tick[0] = recorded.ticks["tick"][0]  # points a bit away are looked at in turns
    flags, compared = 0, 0
    for tick, (record,) in zip(recorded.ticks, recorded.ports, strict=True):
        where = home + (record["position_m"] - home)
        named = {"tip": where} if record["force_scale"] > 0 else {}
        reaction = simulation.step(named).get("tip")
        message = received.get(int(tick["tick"]))
        if message is None or reaction is None or record["force_scale"] < 1:
            continue
        compared += 1
        flags |= message["flags"][0]
        assert message["force_n"][0] == reaction.force_n.tolist()
        assert message["normal"][0] == reaction.normal.tolist()
        assert message["n_contact_points"][0] == reaction.n_points
        assert message["work_j"][0] == reaction.work_j
        assert np.dot(message["force_n"][0], message["normal"][0]) >= 0  # it never pulls
    assert compared > 300
    assert flags & CONTACT == Flags.IN_CONTACT | Flags.SLIDING


def test_two_clients_with_one_tool_each_feel_each_other(
    serve: Callable[..., Any], connect: Callable[..., Any], make_surface_model: Callable[..., SurfaceModel]
) -> None:
    model = make_surface_model(2)
    served = serve(model=model)
    one, other = ([*tool.start_m] for tool in tools_of(model))

    def below(start: list[float], depth_m: float) -> list[float]:
        return [start[0], start[1], start[2] - depth_m]

    with connect(served.endpoint) as first, connect(served.endpoint) as second:
        for client, tool in ((first, "tip"), (second, "tip1")):
            granted, answer = client.acquire(tool)
            assert granted, answer

        def felt(other_touches: bool) -> float:
            """What the first one feels, by the mean of 50 ticks.

            On a busy machine commands stay away until a force fades and the tool is lifted, so only whole forces count.
            """
            whole: list[float] = []

            def is_enough(force: dict[str, Any]) -> bool:
                is_whole = force["force_scale"] == [1.0, 1.0] and force["n_contact_points"][0] > 2
                if is_whole and (force["n_contact_points"][1] > 2) == other_touches:
                    whole.append(force["force_n"][0][2])
                return len(whole) == 50

            first.force_when(is_enough, "50 ticks with whole forces")
            return float(np.mean(whole))

        with first.pressing({"tip": below(one, 2e-3)}):
            with second.pressing({"tip1": below(other, -2e-3)}):
                alone = felt(other_touches=False)
            with second.pressing({"tip1": below(other, 4e-3)}):
                beside = felt(other_touches=True)
    assert alone > 0.02
    assert abs(beside - alone) > 0.05 * alone


def test_the_python_client_holds_the_tissue_pulls_it_and_lets_it_go(
    serve: Callable[..., Any], make_surface_model: Callable[..., SurfaceModel]
) -> None:
    served = serve(model=make_surface_model())
    forces = []
    with Connection(served.endpoint, "test") as connection, Tool(connection) as tool:
        connection.on_tool_force(tool.name, forces.append)
        for i in steps(1.6, 1e-3):
            tool.move(tool.at_depth(1e-3 * np.interp(i, [250, 350, 700, 1000], [-1.0, 2.0, 2.0, -1.0])))
            if i == 500:
                tool.attach()
            if i == 1300:
                tool.let_go()
    attached = [force for force in forces if force.flags & Flags.ATTACHED]
    assert min(force.force_n[2] for force in attached) < -0.01
    assert not forces[-1].flags & CONTACT
    assert tuple(forces[-1].force_n) == (0.0, 0.0, 0.0)
    assert all(force.force_n[2] > -1e-9 for force in forces[: forces.index(attached[0])])
    assert tool.contract.broken == []


def test_what_a_device_can_render_decides_how_stiff_the_coupling_is(
    serve: Callable[..., Any], connect: Callable[..., Any], make_surface_model: Callable[..., SurfaceModel]
) -> None:
    served = serve(model=make_surface_model())
    with connect(served.endpoint) as client:

        def tip(**fields: Any) -> dict[str, Any]:
            granted, answer = client.acquire("tip", **fields)
            assert granted, answer
            assert answer["warnings"] == []
            told = {
                name: answer["tools"]["tip"][name] for name in ("radius_m", "friction", "stiffness_n_per_m")
            }
            status = client.status_when(
                lambda status: status["tools"]["tip"]["stiffness_n_per_m"] == told["stiffness_n_per_m"], "it"
            )
            assert told == {name: status["tools"]["tip"][name] for name in told}
            return told | {"home_m": answer["tools"]["tip"]["home_m"]}

        assert tip()["stiffness_n_per_m"] == 700.0
        assert tip(device="omega")["stiffness_n_per_m"] == 5000.0
        damped = {"device": "touch", "device_damping_n_s_per_m": 0.3, "round_trip_s": 0.0025}
        # K (T / 2 + D) < b, Colgate & Schenkel
        stiffness = tip(**damped)["stiffness_n_per_m"]
        assert 0.9 * 0.3 / 0.003 < stiffness < 0.3 / 0.003
        assert tip(**damped, stiffness_n_per_m=50.0)["stiffness_n_per_m"] == 50.0
        assert tip(frame={"scale": 2.0})["stiffness_n_per_m"] == pytest.approx(700.0)
        smaller = tip(radius_m=0.0045, friction=0.0)
        assert (smaller["radius_m"], smaller["friction"]) == (0.0045, 0.0)
        assert smaller["home_m"] == pytest.approx([0.0, 0.0, 0.0045])
        granted, answer = client.acquire("tip", radius_m=0.002)
        assert granted
        (warning,) = answer["warnings"]
        assert "tool 'tip': radius_m = 0.002 touches about 0.7 points 0.003 m apart" in warning
        assert "a radius_m of 0.0041" in warning
        for fields in (
            {"radius_m": 0.006},
            {"radius_m": 0},
            {"friction": 3.0},
            {"stiffness_n_per_m": 701.0},
            {"device": "touch", "device_damping_n_s_per_m": 0.0},
        ):
            granted, answer = client.acquire("tip", **fields)
            assert (granted, answer["reason"]) == (False, "out_of_range"), fields
            assert any(name in answer["message"] for name in fields)


def test_the_headless_client_and_the_bridge_run_unchanged(
    serve: Callable[..., Any],
    run_example: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    served = serve(model=make_surface_model())
    code, out, err = run_example("palpate_client.poke", served.endpoint, "--duration-s", "1").finish()
    assert code == 0, err
    assert "contract           held" in out
    code, out, err = run_example("device_bridge.py", served.endpoint, "--duration-s", "2").finish()
    assert (code, err) == (0, ""), err  # no warning either


def test_the_headless_client_shows_the_servers_warnings(
    serve: Callable[..., Any],
    run_example: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    model = make_surface_model()
    small = replace(model, tools=(replace(model.tools[0], radius_m=0.002),))
    served = serve(model=small)
    code, _, err = run_example("palpate_client.poke", served.endpoint, "--duration-s", "1").finish()
    assert code == 0, err
    (warning,) = err.splitlines()
    assert warning.startswith("warning: tool 'tip': radius_m = 0.002 touches about")


def test_three_tools_of_two_clients_are_repeated_bit_for_bit_and_are_in_the_black_box(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    wait_for: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
) -> None:
    """One slides in circles, one presses, one with a smaller tip holds the tissue and pulls it."""
    model = make_surface_model(3)
    homes = ((-0.01, -0.008, 0.02), (0.01, -0.008, 0.02), (0.0, 0.01, 0.02))
    tools = tuple(replace(tool, home_m=home) for tool, home in zip(model.tools, homes, strict=True))
    model = replace(model, tools=tools)
    folders = ("--recordings", str(tmp_path), "--black-box", str(tmp_path / "box"))
    served = serve(*folders, model=model)
    with connect(served.endpoint) as first, connect(served.endpoint) as second:
        homes = first.acquire("tip", "tip1")[1]["tools"]
        (x, y, z), presses = homes["tip"]["home_m"], homes["tip1"]["home_m"]
        pulled = second.acquire("tip2", radius_m=0.0045)[1]["tools"]["tip2"]["home_m"]
        first.record("a.mcap")
        looked_at, touched, attached = 0, 0, 0
        give_up = time.monotonic() + 60
        for i in itertools.count():
            depth = 1e-3 * np.interp(i, [250, 350], [-1.0, 2.0])
            circle = 3e-3 * np.array([np.cos(0.02 * i), np.sin(0.02 * i)])
            first.command(
                {
                    "tip": [x + circle[0], y + circle[1], z - depth],
                    "tip1": [presses[0], presses[1], presses[2] - depth],
                }
            )
            height = 1e-3 * np.interp(i, [250, 350, 500, 700], [1.0, -2.0, -2.0, 1.0])
            second.command({"tip2": [pulled[0], pulled[1], pulled[2] + height]}, attach={"tip2": i > 400})
            messages = first.forces[looked_at:]
            looked_at += len(messages)
            touched += sum(min(message["n_contact_points"]) > 0 for message in messages)
            attached += sum(bool(message["flags"][2] & Flags.ATTACHED) for message in messages)
            if i > 900 and min(touched, attached) > 100:
                break
            assert time.monotonic() < give_up, (touched, attached)
            time.sleep(1e-3)
        assert first.control("record", file=None)[0]
        written = wait_for(lambda: list((tmp_path / "box").glob("*-stale.npz")), "a file of the silence")
    recorded = assert_all_is_repeated(tmp_path / "a.mcap", model)
    assert np.count_nonzero(np.all(recorded.ports["n_contact_points"] > 0, axis=1)) > 100
    with np.load(written[0], allow_pickle=False) as box:
        assert box["tools"].tolist() == ["tip", "tip1", "tip2"]
        in_both = np.isin(box["ticks"]["tick"], recorded.ticks["tick"])
        same = np.isin(recorded.ticks["tick"], box["ticks"]["tick"])
        assert np.count_nonzero(same) > 100
        assert box["ports"][in_both].tobytes() == recorded.ports[same].tobytes()


def test_a_model_whose_points_are_too_close_for_its_tool_is_refused_and_the_server_goes_on(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    start: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
) -> None:
    model = make_surface_model()
    close = half_space_model(model.tools, 21, 3e-4, n_modes=6)
    nowhere_wrong = replace(model.accuracy, error_map=np.zeros(close.n_points, np.float32))
    close = replace(
        close, n_nodes=close.n_points, accuracy=nowhere_wrong, config_sha256="6f" * 32, built_with="the tests"
    )
    save_model(close, tmp_path / "close.npz")
    served = serve(model=model)
    words = "radius_m = 0.005 is near 441 points"
    with connect(served.endpoint) as client:
        x, y, z = client.acquire("tip")[1]["tools"]["tip"]["home_m"]
        with client.pressing({"tip": [x, y, z - 2e-3]}):
            client.force_when(lambda force: force["force_scale"] == [1.0], "the end of the soft start")
            granted, refusal = client.control("load", file="close.npz")
            assert (granted, refusal["reason"]) == (False, "bad_model")
            assert words in refusal["message"]
            assert "expected at most 400" in refusal["message"]
            assert "\n" not in refusal["message"]
            after = client.force_when(lambda force: force["force_scale"] == [1.0], "a whole force")
            assert after["force_n"][0][2] > 0.01
            assert client.next_status()["model"]["config_sha256"] == model.config_sha256
            assert client.control("load", file="model1.npz")[0]
    code, out, err = start(
        "-m", "palpate_server", tmp_path / "close.npz", "--listen", free_endpoint()
    ).finish()
    assert (code, out) == (2, "")
    (line,) = err.strip().splitlines()
    assert words in line


@pytest.mark.slow
def test_models_of_both_kinds_are_loaded_in_turns_while_the_tool_presses_and_all_is_repeated(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    make_spring_mass_model: Callable[..., ReducedModel],
    tmp_path: Path,
) -> None:
    surface, softer = make_surface_model(), make_surface_model(softness=2.0)
    softer = replace(softer, name="softer", config_sha256="6f" * 32)
    patch = make_spring_mass_model(1, 20)
    # Its patch is where the sphere touches.
    patch = replace(patch, contacts=(replace(patch.contacts[0], radius_m=0.01),))
    for name, model in (("softer", softer), ("patch", patch), ("surface", surface)):
        save_model(model, tmp_path / f"{name}.npz")
    served = serve("--recordings", str(tmp_path), model=surface)
    with connect(served.endpoint) as client:
        granted, answer = client.acquire("tip")
        x, y, z = answer["tools"]["tip"]["home_m"]
        with client.pressing({"tip": [x, y, z + 1e-3]}):
            client.force_when(lambda force: force["force_scale"] == [1.0], "the end of the soft start")
        client.record("a.mcap")
        with client.pressing({"tip": [x, y, z - 2e-3]}):
            client.force_when(lambda force: force["flags"][0] & Flags.IN_CONTACT, "contact")
            kinds = []
            for name in ("softer", "patch", "surface"):
                granted, answer = client.control("load", file=f"{name}.npz")
                assert granted, answer
                kinds.append(answer["model"]["kind"])
                geometry = client.query("geometry")[1]
                surfaces: list[Any] = []
                key = client.key("surface")
                subscriber = client.session.declare_subscriber(key, surfaces.append)
                deadline = time.monotonic() + 60
                while not surfaces and time.monotonic() < deadline:
                    time.sleep(0.01)
                subscriber.undeclare()
                assert len(geometry["vertices_m"]) == 12 * geometry["n_vertices"]
                assert surfaces, "a surface"
            assert kinds == ["surface", "patch", "surface"]
            client.force_when(
                lambda force: (
                    force["force_scale"] == [1.0]
                    and force["flags"][0] & Flags.IN_CONTACT
                    and force["force_n"][0][2] > 0.01
                ),
                "a whole force",
            )
        assert client.control("record", file=None)[0]
    recorded = assert_all_is_repeated(tmp_path / "a.mcap", surface, softer, patch)
    limit = 2000.0 * 1e-3  # N, --max-force-rate-n-per-s
    assert np.linalg.norm(np.diff(recorded.ports["force_n"][:, 0], axis=0), axis=1).max() < 0.02 * limit


def test_a_model_is_loaded_anew_three_times_as_stiff_and_all_is_repeated(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
) -> None:
    model = make_surface_model()
    served = serve("--recordings", str(tmp_path), model=model)

    def settled_n(client: Any, tip_n_per_m: float) -> float:
        """The force 3 mm deep, by a spring of this stiffness, when the tissue has relaxed."""
        x, y, z = client.acquire("tip", stiffness_n_per_m=tip_n_per_m)[1]["tools"]["tip"]["home_m"]

        def is_still(force: dict[str, Any]) -> bool:
            if force["tick"] % 100:
                return False
            last = [each["force_n"][0][2] for each in client.forces[-1000:]]  # two periods of the lowest mode
            return bool(max(last) - min(last) < 5e-3 * min(last))

        with client.pressing({"tip": [x, y, z + 1e-3]}):
            client.force_when(lambda force: force["force_scale"] == [1.0], "the end of the soft start")
        with client.pressing({"tip": [x, y, z - 3e-3]}):
            client.force_when(lambda force: force["force_n"][0][2] > 0.05, "a force")
            return float(client.force_when(is_still, "relaxed tissue")["force_n"][0][2])

    with connect(served.endpoint) as client:
        described = client.query("describe")[1]
        assert described["model_file"] in described["model_files"]
        soft_n = settled_n(client, 200.0)
        client.record("a.mcap")
        granted, answer = client.control("load", file=described["model_file"], stiffness_factor=3)
        assert granted and answer["model"]["stiffness_factor"] == 3.0, answer
        client.status_when(lambda status: status["model"]["stiffness_factor"] == 3.0, "the factor")
        stiff_n = settled_n(client, 600.0)
        assert client.control("record", file=None)[0]
        assert client.query("describe")[1]["model"]["band_hz"][1] == pytest.approx(model.band_hz[1] * 3**0.5)
        for wrong in ("3", 0.01, -1, float("nan")):
            assert not client.control("load", file=described["model_file"], stiffness_factor=wrong)[0]
    # Tissue and spring are both three times as stiff. The rest of the relaxation is some tenths of a percent.
    assert stiff_n / soft_n == pytest.approx(3.0, rel=0.02)
    assert_all_is_repeated(tmp_path / "a.mcap", model)


@pytest.mark.slow
def test_what_a_stiffer_model_gives_a_hand_that_pressed_a_soft_one_is_counted_apart(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
) -> None:
    """Pressed in soft, let go stiff: the hand gets out more than it put in. Each model by itself gives out nothing.

    On a busy machine commands may stay away until the tool is lifted. The energies balance then too, but the hand has put in
    more: so it tries again.
    """
    soft, stiff = make_surface_model(softness=6.0), make_surface_model()
    stiff = replace(stiff, name="stiff", config_sha256="6f" * 32)
    save_model(soft, tmp_path / "soft.npz")
    save_model(stiff, tmp_path / "stiff.npz")
    served = serve("--recordings", str(tmp_path), model=soft)
    with connect(served.endpoint) as client:
        x, y, z = client.acquire("tip")[1]["tools"]["tip"]["home_m"]

        def move(*heights_m: float) -> None:
            for height in np.linspace(*heights_m, 300):
                client.command({"tip": [x, y, z + height]})
                time.sleep(1e-3)

        def load(name: str) -> None:
            granted, answer = client.control("load", file=name)
            assert granted, answer

        for attempt in range(10):
            with client.pressing({"tip": [x, y, z + 1e-3]}):
                load("soft.npz")
                assert client.control("reset")[0]
                client.force_when(lambda force: force["force_scale"] == [1.0], "the end of the soft start")
                client.record(f"{attempt}.mcap")
            move(1e-3, -3e-3)
            with client.pressing({"tip": [x, y, z - 3e-3]}):
                load("stiff.npz")
            move(-3e-3, 1e-3)
            with client.pressing({"tip": [x, y, z + 1e-3]}):
                client.force_when(lambda force: force["n_contact_points"] == [0], "the end of contact")
                assert client.control("record", file=None)[0]
            recorded = assert_all_is_repeated(tmp_path / f"{attempt}.mcap", soft, stiff)
            felt, tip = what_a_hand_felt(recorded), recorded.ports[:, 0]
            if np.min(tip["force_scale"]) > 0:
                break
        else:
            raise AssertionError("10 times the tool was lifted in the middle")
    largest = np.max(tip["work_j"])
    assert felt[-1] < -0.2 * largest  # the hand has gained
    assert tip["withheld_j"][-1] > 0.2 * largest


def what_a_hand_felt(recorded: replay.Recorded) -> NDArray[np.float64]:
    """(n_ticks,), J: the work that it did on the device, after a look at the ledger."""
    ticks, tip = recorded.ticks, recorded.ports[:, 0]
    largest = np.max(tip["work_j"])
    kept = tip["stored_j"] + tip["dissipated_j"] + ticks["tissue_stored_j"] + ticks["tissue_dissipated_j"]
    np.testing.assert_allclose(tip["work_j"], kept, rtol=0, atol=1e-9 * largest)
    assert np.min(tip["work_j"]) >= -1e-9
    steps_m = np.diff(tip["position_m"], axis=0, prepend=tip["position_m"][:1])
    felt: NDArray[np.float64] = -np.cumsum(np.einsum("ti,ti->t", tip["force_n"], steps_m))
    np.testing.assert_allclose(tip["work_j"] - tip["withheld_j"], felt, rtol=0, atol=1e-6 * largest)
    return felt


def test_a_tool_that_is_lost_while_it_presses_fades_and_is_lifted_off(
    serve: Callable[..., Any], connect: Callable[..., Any], make_surface_model: Callable[..., SurfaceModel]
) -> None:
    served = serve(model=make_surface_model())
    with connect(served.endpoint) as watcher:
        with connect(served.endpoint) as client:
            x, y, z = client.acquire("tip")[1]["tools"]["tip"]["home_m"]
            with client.pressing({"tip": [x, y, z + 1e-3]}):
                client.force_when(lambda force: force["force_scale"] == [1.0], "the end of the soft start")
            with client.pressing({"tip": [x + 3e-3, y, z - 3e-3]}):
                client.force_when(lambda force: force["flags"][0] & Flags.IN_CONTACT, "contact")
        stale = watcher.force_when(lambda force: force["flags"][0] & Flags.STALE, "silence")
        assert stale["force_n"] == [[0.0, 0.0, 0.0]]
        lifted = watcher.force_when(lambda force: not force["flags"][0] & CONTACT, "nothing touched")
        assert lifted["n_contact_points"] == [0]
        assert lifted["tissue_stored_j"] >= 0
        forces = [np.array(message["force_n"][0]) for message in watcher.forces]
    assert max(np.linalg.norm(b - a) for a, b in itertools.pairwise(forces)) < 0.5
