"""A surface model in the loop: the same bits as the simulation in process, fading, faults, and cross-fades between kinds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.model_file import ReducedModel, SurfaceModel
from palpate_client.wire import Flags
from palpate_server.coupling import cross_fade, models
from palpate_server.coupling.models import Model
from palpate_server.coupling.settle import Touch
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.safety import Limits
from palpate_server.simulation import Simulation

FREE = Limits(1e6, 1e12, 1e6, 1e6, 0.0)  # limits that nothing here reaches
USUAL = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
CONTACT = Flags.IN_CONTACT | Flags.SLIDING | Flags.ATTACHED


class Loop:
    """Ticks with a clock of their own; clients' frames are the model's."""

    def __init__(self, model: Model, limits: Limits = FREE) -> None:
        self.model = model
        self.start = np.array([tool.start_m for tool in models.tools_of(model)])
        self.memory = shared_memory.make_memory(
            models.make_running(model), model.period_s, [limits] * len(self.start), 1.0, self.start.tolist()
        )
        self.image = make_image(self.memory)
        self.now = 1_000_000_000

    def tick(self, positions: dict[int, np.ndarray], attach: bool = False) -> np.ndarray:
        """One tick with new commands for some tools, m; the records (n_tools,) PORT_RECORD."""
        self.now += 1_000_000
        for tool, position in positions.items():
            lease = self.memory.commands.lease[tool]
            self.memory.commands.newest[tool] = (
                *(tool, lease, self.now, 7, self.now, -1, position, np.zeros(3), attach),
            )
        scheduler.repeat_tick(self.image, self.now, self.now, False)
        ticks = int(self.memory.counters["ticks"][0])
        record: np.ndarray = self.memory.ring.ports[(ticks - 1) % RECORDS]
        return record

    def load(self, model: Model, step: float) -> cross_fade.Coupling:
        """Begin to fade over to another model."""
        touch = Touch(self.memory.wanted.copy(), self.memory.reactions.copy())
        displacement = self.memory.displacement.copy()
        following = models.make_settled(model, models.tips_of_file(model), displacement, touch)
        coupling = cross_fade.to_another(self.memory.coupling, following, step)
        self.memory = shared_memory.with_coupling(self.memory, coupling)
        scheduler.exchange(self.image, make_image(self.memory))
        return coupling

    def end_fade(self) -> None:
        self.memory = shared_memory.with_coupling(self.memory, cross_fade.after(self.memory.coupling))
        scheduler.exchange(self.image, make_image(self.memory))

    def press(self, depth_m: float, ticks: int, beside_m: float = 0.0) -> np.ndarray:
        """Bring tool 0 from 1 mm above into the tissue and hold it there: a tool that begins inside feels nothing."""
        for tick in range(ticks):
            height = np.interp(tick, [0, 210, 260], [1e-3, 1e-3, -depth_m])
            record: np.ndarray = self.tick({0: self.start[0] + (beside_m, 0.0, height)})[0]
        return record


def path_of(tool: int, tick: int, start: np.ndarray) -> np.ndarray:
    """Comes from above, is pressed 2 mm in, slides 6 mm along y, and goes."""
    height = 1e-3 * np.interp(tick, [0, 250, 300, 500, 600], [1.0, 1.0, -2.0, -2.0, 3.0])
    along = 6e-3 * np.interp(tick, [350, 480], [0.0, 1.0])
    return start + np.array([0.0, along * (1 - 2 * tool), height])


def test_the_loop_gives_what_the_simulation_in_process_gives_bit_for_bit(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    model = make_surface_model(2)
    loop, simulation = Loop(model), Simulation(model)
    flags, pulled = 0, 0.0
    for tick in range(650):
        wanted = {i: path_of(i, tick, loop.start[i]) for i in range(2)}
        records = loop.tick(wanted)
        # As the loop does it: the way from the start, and back.
        step = {f"tip{i}" if i else "tip": loop.start[i] + (p - loop.start[i]) for i, p in wanted.items()}
        for record, reaction in zip(records, simulation.step(step).values(), strict=True):
            if record["force_scale"] == 1.0:
                np.testing.assert_array_equal(record["force_n"], reaction.force_n)
            np.testing.assert_array_equal(record["normal"], reaction.normal)
            for ours, theirs in (
                ("penetration_m", reaction.penetration_m),
                ("slip_m", reaction.slip_m),
                ("n_contact_points", reaction.n_points),
                ("work_j", reaction.work_j),
                ("stored_j", reaction.stored_j),
                ("dissipated_j", reaction.dissipated_j),
            ):
                assert record[ours] == theirs, ours
            assert Flags(int(record["flags"])) & CONTACT == reaction.flags
            flags |= int(record["flags"])
            pulled = min(pulled, float(record["force_n"] @ record["normal"]))
        stored, dissipated = simulation.energy()
        assert list(loop.memory.ledger) == [stored, dissipated]
    assert flags & CONTACT == Flags.IN_CONTACT | Flags.SLIDING
    assert pulled >= -1e-12  # N
    together = records["work_j"].sum() - records["stored_j"].sum() - records["dissipated_j"].sum()
    assert together == pytest.approx(stored + dissipated, abs=1e-12)


def test_one_tool_feels_the_other_through_the_tissue(make_surface_model: Callable[..., SurfaceModel]) -> None:
    ends = []
    for lowest in (-3.0, 1.0):  # mm, of the other tool
        loop = Loop(make_surface_model(2))
        for tick in range(700):
            rests = loop.start[0] + (0.0, 0.0, np.interp(tick, [0, 210, 260], [1e-3, 1e-3, -1e-3]))
            comes = loop.start[1] + (0.0, 0.0, 1e-3 * np.interp(tick, [400, 500], [1.0, lowest]))
            records = loop.tick({0: rests, 1: comes})
        ends.append(records["force_n"][0, 2])
    with_it, alone = ends
    assert alone > 0.01
    assert abs(with_it - alone) > 0.05 * alone


def test_a_tool_that_holds_the_tissue_pulls_it_and_lets_it_go_without_a_jump(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    loop = Loop(make_surface_model())
    forces, flags = [], []
    for tick in range(900):
        height = 1e-3 * np.interp(tick, [0, 210, 260, 400, 600], [1.0, 1.0, -1.0, -1.0, 2.0])
        record = loop.tick({0: loop.start[0] + (0.0, 0.0, height)}, attach=300 <= tick < 700)[0]
        forces.append(record["force_n"].copy())
        flags.append(int(record["flags"]))
    assert not flags[299] & Flags.ATTACHED
    assert flags[310] & Flags.ATTACHED
    assert flags[690] & Flags.ATTACHED
    assert not flags[-1] & CONTACT
    assert forces[299][2] > 0.01  # pressed
    assert forces[690][2] < -0.01  # pulled
    np.testing.assert_array_equal(forces[-1], 0)
    jumps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert jumps[295:320].max() < 0.05 * np.abs(forces[690][2])
    assert jumps[700:].max() < 0.1 * np.abs(forces[690][2])  # it goes within some 20 ms


def test_a_tool_whose_client_is_gone_fades_and_touches_nothing_on_its_way_back(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    loop = Loop(make_surface_model(), USUAL)
    pressed = loop.start[0] + (0.004, 0.0, -2e-3)
    record = loop.press(2e-3, 400, beside_m=0.004)
    before = record["force_n"].copy()
    assert before[2] > 0.02
    scheduler.forget_command(loop.memory.commands, 0)
    forces = [before]
    for _ in range(60):
        record = loop.tick({})[0]
        forces.append(record["force_n"].copy())
    np.testing.assert_array_equal(record["force_n"], 0)
    assert record["flags"] & Flags.STALE
    assert not record["flags"] & CONTACT
    assert record["n_contact_points"] == 0
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert steps.max() < 0.03 * np.linalg.norm(before)  # a ramp of 50 ms
    # It comes back inside the tissue, after a jump: nothing throws it out.
    for _ in range(400):
        record = loop.tick({0: pressed})[0]
        assert np.all(np.isfinite(record["force_n"]))
        assert np.linalg.norm(record["force_n"]) <= np.linalg.norm(before) * 1.05
    assert record["work_j"] - record["withheld_j"] > -1e-9


def test_a_body_that_gives_nan_is_put_to_rest_and_goes_on(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    loop = Loop(make_surface_model())
    pressed = {0: loop.start[0] + (0.0, 0.0, -2e-3)}
    loop.press(2e-3, 300)
    loop.memory.coupling.running.contact.body.q[0] = np.nan
    record = loop.tick(pressed)[0]
    assert record["flags"] & Flags.FAULT
    np.testing.assert_array_equal(record["force_n"], 0)
    assert loop.memory.counters["faults"][0] == 1
    for tick in range(600):
        record = loop.tick(
            {0: loop.start[0] + (0.0, 0.0, 1e-3 * np.interp(tick, [0, 100, 200], [-2, 2, -2]))}
        )[0]
    assert loop.memory.counters["faults"][0] == 1
    assert record["force_n"][2] > 0.02
    assert np.all(np.isfinite([record["work_j"], record["withheld_j"], *loop.memory.ledger]))


def test_a_quiet_surface_comes_to_rest_exactly(make_surface_model: Callable[..., SurfaceModel]) -> None:
    loop = Loop(make_surface_model())
    loop.press(1e-3, 300)
    body = loop.memory.coupling.running.contact.body
    assert np.any(body.q)
    for tick in range(50_000):
        loop.tick({0: loop.start[0] + (0.0, 0.0, 5e-3)})
        if tick % 500 == 0 and not np.any(body.q):
            break
    assert not np.any(body.q)
    assert not np.any(body.y)


@pytest.mark.parametrize("order", ["surface surface", "patch surface", "surface patch"])
def test_another_model_is_faded_in_settled_whatever_its_kind(
    order: str,
    make_surface_model: Callable[..., SurfaceModel],
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    make: dict[str, list[Model]] = {
        "surface": [make_surface_model(), make_surface_model(softness=2.0)],
        "patch": [make_spring_mass_model()],
    }
    first, second = order.split()
    running, other = make[first][0], make[second][-1]
    loop = Loop(running, USUAL)
    depth = np.array([0.0, 0.0, -2e-3])
    before = loop.press(2e-3, 1500)["force_n"].copy()
    final = (
        Loop(other, USUAL).press(2e-3, 1500)["force_n"].copy()
    )  # the other model, pressed as deep for as long
    loop.load(other, 0.01)
    forces = [before]
    for _ in range(100):
        forces.append(loop.tick({0: loop.start[0] + depth})[0]["force_n"].copy())
    loop.end_fade()
    for _ in range(50):
        record = loop.tick({0: loop.start[0] + depth})[0]
        forces.append(record["force_n"].copy())
    difference = np.linalg.norm(final - before)
    assert difference > 0.2 * np.linalg.norm(before)  # the models are different enough to see it
    np.testing.assert_allclose(
        forces[-1], final, atol=0.25 * difference
    )  # of a shorter press: still relaxing
    jumps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert jumps.max() < 0.02 * difference + 1e-3 * np.linalg.norm(final)
    if second == "surface":  # nobody did the work that settled it: it is counted as withheld
        assert record["work_j"] > 0
        together = record["work_j"] - record["stored_j"] - record["dissipated_j"]
        assert together == pytest.approx(loop.memory.ledger.sum(), abs=1e-12)
    for tick in range(500):  # going away gives back no more than the model says was put in
        record = loop.tick({0: loop.start[0] + depth * (1 - tick / 200)})[0]
        if second == "surface":
            assert record["work_j"] >= -1e-9


def check_adversarial_ticks(make_surface_model: Callable[..., SurfaceModel], n: int, seed: int) -> None:
    """Commands of two tools at random, with gaps, jumps, grips, resets, other limits and other models while they press."""
    rng = np.random.default_rng(seed)
    bodies = [make_surface_model(2), make_surface_model(2, softness=4.0)]
    limits = [Limits(2.0, 60.0, 0.5, 0.1, 0.0), Limits(0.3, 20.0, 0.2, 0.1, 0.0)]
    loop, soft, fade_ends, strict = Loop(bodies[0], limits[0]), 0, -1, 0
    state, before = np.zeros((2, 3)), np.zeros((2, 3))
    silent_until, attach, swaps, resets, felt = np.zeros(2, int), False, 0, 0, 0.0
    for tick in range(n):
        state += 0.03 * (rng.normal(size=(2, 3)) * 20 - state)
        change = rng.random()
        if change < 0.002:
            silent_until[rng.integers(2)] = tick + rng.integers(5, 200)
        elif change < 0.003:
            state[rng.integers(2)] += rng.normal(size=3) * 20  # a jump, for the limit of the speed
        elif change < 0.006:
            attach = not attach
        elif change < 0.0065:
            scheduler.reset(loop.image)
            resets += 1
        elif change < 0.0085:
            strict = 1 - strict
            for i in range(2):
                scheduler.set_limits(loop.image, i, np.array(limits[strict]))
                loop.tick({})
        elif change < 0.0095 and fade_ends < 0:
            soft, fade_ends = 1 - soft, tick + 100
            loop.load(bodies[soft], 0.01)
            swaps += 1
        if tick == fade_ends:
            loop.end_fade()
            fade_ends = -1
        before = loop.memory.ports["force_n"].copy()
        rate = loop.memory.settings["max_force_rate_n_per_s"].copy()
        told = {i: loop.start[i] + 1e-3 * state[i] for i in range(2) if silent_until[i] < tick}
        records = loop.tick(told, attach)
        forces = records["force_n"]
        assert np.all(np.isfinite(forces))
        steps = np.linalg.norm(forces - before, axis=1)
        assert np.all(
            steps <= np.maximum(rate, loop.memory.settings["max_force_rate_n_per_s"]) * 1e-3 * (1 + 1e-9)
        )
        stored, dissipated = loop.memory.ledger
        energies = records["stored_j"].sum() + records["dissipated_j"].sum() + stored + dissipated
        work = float(records["work_j"].sum())
        assert work == pytest.approx(energies, abs=1e-11)
        assert min(work, stored, dissipated, records["stored_j"].min()) >= -1e-9
        felt = max(felt, float(np.linalg.norm(forces, axis=1).max()))
    assert loop.memory.counters["faults"][0] == 0
    assert swaps
    assert resets
    assert felt > 0.05


def test_no_energy_comes_out_of_the_loop_in_adversarial_ticks(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    check_adversarial_ticks(make_surface_model, 6_000, seed=3)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_energy_comes_out_of_the_loop_in_half_a_million_adversarial_ticks(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    for seed in range(10):
        check_adversarial_ticks(make_surface_model, 50_000, seed)


def test_a_tip_can_be_exchanged_while_it_touches_nothing(
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    model = make_surface_model()
    loop = Loop(model)
    start = models.start_of(model, 0, 0.003)
    scheduler.set_tip(loop.image, 0, np.array([0.003, 0.0, 200.0]), np.array(start))
    loop.tick({})
    tools = loop.memory.coupling.running.contact.tools
    assert (tools.radius[0], tools.friction[0], 1 / tools.compliance[0]) == pytest.approx((0.003, 0.0, 200.0))
    for tick in range(600):  # the port's home is that of the file's tip, the displacement counts
        down = loop.start[0] + (0.0, 0.0, -1e-5 * max(0, tick - 300))
        record = loop.tick({0: down})[0]
        if tick < 300:
            assert record["n_contact_points"] == 0 or record["force_n"][2] < 1e-9
    assert record["force_n"][2] > 0.01
