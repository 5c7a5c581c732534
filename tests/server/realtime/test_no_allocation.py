"""A tick takes nothing from the heap, whatever it has to do: counted by the allocator of compiled code itself."""

# mypy: disable-error-code="no-untyped-call, attr-defined"
from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numba import njit
from numba.core.runtime import _nrt_python as nrt
from numba.core.runtime.nrt import rtsys

from palpate.model_file import ReducedModel, SurfaceModel
from palpate_client.wire import Flags
from palpate_server.coupling import cross_fade, models
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import Image, make_image
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.safety import Limits

PERIOD_NS = 1_000_000
LIMITS = Limits(
    max_force_n=0.3,
    max_force_rate_n_per_s=20.0,
    max_speed_m_per_s=0.5,
    workspace_radius_m=0.01,
    max_damping_n_s_per_m=4.0,
)

FREE = Limits(1e6, 1e12, 1e6, 1e6, 0.0)


@njit()
def silent_ticks(n: int, incoming: np.ndarray, image: Image, start_ns: int) -> None:
    for k in range(n):
        now = start_ns + k * PERIOD_NS
        scheduler.repeat_tick(image, now, now, False)


@njit()
def commanded_ticks(n: int, incoming: np.ndarray, image: Image, start_ns: int) -> None:
    """A new command before each tick: a tip that pushes beyond its workspace and comes back at once, again and again."""
    for k in range(n):
        now = start_ns + k * PERIOD_NS
        depth = 0.03 if k % 40 < 20 else 0.0
        command = incoming[0]
        command.sequence = command.arrival_ns = now
        command.position_m[2] = depth
        scheduler.hand_over(image, 1)
        scheduler.repeat_tick(image, now, now, False)


@njit()
def pressing_ticks(n: int, incoming: np.ndarray, image: Image, start_ns: int) -> None:
    """A new command before each tick: a sphere that comes from outside, slides, holds the tissue and lets it go."""
    for k in range(n):
        now = start_ns + k * PERIOD_NS
        command = incoming[0]
        command.sequence = command.arrival_ns = now
        command.position_m[0] = 1e-5 * (k % 500)
        command.position_m[2] = 1e-3 - 1e-5 * min(k % 500, 400)
        command.attach = k % 500 > 450
        scheduler.hand_over(image, 1)
        scheduler.repeat_tick(image, now, now, False)


@njit()
def arrays(n: int) -> float:
    total = 0.0
    for k in range(n):
        total += np.ones(k + 1)[k]
    return total


@pytest.fixture(autouse=True)
def statistics() -> Iterator[None]:
    nrt.memsys_enable_stats()
    yield
    nrt.memsys_disable_stats()


def allocations(function: Callable[..., object], n: int, *arguments: object) -> int:
    """What the allocator was asked for by `n` rounds; the call itself, which hands arrays over, is taken off."""
    function(0, *arguments)
    counts = []
    for rounds in (0, n):
        before = rtsys.get_allocation_stats().alloc
        function(rounds, *arguments)
        counts.append(rtsys.get_allocation_stats().alloc - before)
    return counts[1] - counts[0]


class Ticks:
    """A memory with a clock of its own; `flags` are those that were seen in the last run."""

    def __init__(self, memory: shared_memory.Memory) -> None:
        self.memory, self.image, self.now = memory, make_image(memory), 1_000_000_000
        self.flags: list[int] = []

    def allocations(self, ticks: Callable[..., None], n: int) -> int:
        first = scheduler.records_written(self.memory.shared)
        count = allocations(ticks, n, self.memory.commands.incoming, self.image, self.now)
        assert scheduler.records_written(self.memory.shared) == first + n
        self.now += n * PERIOD_NS
        rows = np.arange(first, first + n) % RECORDS
        self.flags = list(self.memory.ring.ports["flags"][rows, 0])
        return count

    def seen(self, flag: Flags) -> bool:
        return any(flags & flag for flags in self.flags)


@pytest.fixture
def ticks(make_spring_mass_model: Callable[..., ReducedModel]) -> Ticks:
    model = make_spring_mass_model(2)
    return Ticks(
        shared_memory.make_memory(models.make_running(model), model.period_s, [LIMITS, LIMITS], 1 / 30)
    )


def test_the_count_sees_every_array_that_compiled_code_makes() -> None:
    assert allocations(arrays, 100) == 100


def test_no_tick_allocates_from_the_first_command_to_silence(ticks: Ticks) -> None:
    assert ticks.allocations(silent_ticks, 10) == 0
    assert set(ticks.flags) == {Flags.STALE}
    assert ticks.allocations(commanded_ticks, 500) == 0
    for flag in (
        Flags.SOFT_START,
        Flags.WORKSPACE_CLAMPED,
        Flags.SPEED_LIMITED,
        Flags.SLEW_LIMITED,
        Flags.FORCE_CLAMPED,
    ):
        assert ticks.seen(flag), flag
    assert ticks.allocations(silent_ticks, 20) == 0
    assert all(flags & Flags.HELD for flags in ticks.flags)
    assert ticks.allocations(silent_ticks, 80) == 0
    assert ticks.seen(Flags.DECAYING)
    assert ticks.flags[-1] == Flags.STALE


def test_no_tick_allocates_while_passivity_is_kept(ticks: Ticks) -> None:
    assert ticks.allocations(commanded_ticks, 300) == 0
    ticks.memory.ports["energy_j"] = -1.0  # the port has given out energy
    assert ticks.allocations(commanded_ticks, 40) == 0
    assert ticks.seen(Flags.PASSIVITY_LIMITED)


def test_no_tick_allocates_while_one_model_fades_into_another(
    ticks: Ticks, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    assert ticks.allocations(commanded_ticks, 300) == 0
    other = models.make_running(make_spring_mass_model(2, 7))
    coupling = cross_fade.to_another(ticks.memory.coupling, other, 0.01)
    fading = shared_memory.with_coupling(ticks.memory, coupling)
    scheduler.exchange(ticks.image, make_image(fading))
    assert ticks.allocations(commanded_ticks, 50) == 0
    assert scheduler.is_changed(ticks.image)
    assert coupling.fade[0] == pytest.approx(0.5)
    assert np.any(coupling.following.patch.body.state)


def test_no_tick_of_a_surface_model_allocates(make_surface_model: Callable[..., SurfaceModel]) -> None:
    model = make_surface_model(2)
    ticks = Ticks(shared_memory.make_memory(models.make_running(model), model.period_s, [FREE, FREE], 1 / 30))
    assert ticks.allocations(pressing_ticks, 1500) == 0
    for flag in (Flags.IN_CONTACT, Flags.SLIDING, Flags.ATTACHED):
        assert ticks.seen(flag), flag
    assert ticks.allocations(silent_ticks, 200) == 0
    assert ticks.flags[-1] == Flags.STALE


def test_a_tick_with_a_fault_does_not_allocate(ticks: Ticks) -> None:
    assert ticks.allocations(commanded_ticks, 300) == 0
    ticks.memory.coupling.running.patch.body.state[0] = np.nan
    assert ticks.allocations(commanded_ticks, 10) == 0
    assert ticks.seen(Flags.FAULT)
    assert ticks.memory.counters["faults"][0] == 1


def test_a_tick_that_takes_up_a_change_does_not_allocate(ticks: Ticks) -> None:
    assert ticks.allocations(commanded_ticks, 300) == 0
    scheduler.set_limits(ticks.image, 0, np.array(LIMITS._replace(max_force_n=0.2)))
    assert ticks.allocations(commanded_ticks, 10) == 0
    assert ticks.memory.settings["max_force_n"][0] == 0.2
    scheduler.reset(ticks.image)
    assert ticks.allocations(commanded_ticks, 10) == 0
    assert ticks.seen(Flags.SOFT_START)
