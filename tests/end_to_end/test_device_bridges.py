"""The bridges to devices whose drivers are not here, with modules that have the same functions; and the one for a desktop."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from palpate_client import Frame, ToolDescription
from palpate_client.bridge import frame_over

EXAMPLES = Path(__file__).parents[2] / "client_examples"
FAKES = Path(__file__).parent / "fake_drivers"
OUTWARD = {"force_dimension_bridge.py": 2, "openhaptics_bridge.py": 1}  # the device's axis that is up
SCRIPTS = list(OUTWARD)


@pytest.fixture
def run_bridge(
    run_example: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """A bridge with the made drivers, whose forces go to a file; run_bridge.forces() reads them."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(FAKES), *sys.path]))
    monkeypatch.setenv("FAKE_FORCES", str(tmp_path / "forces"))

    def run(script: str, endpoint: str, *options: str, **environment: str) -> Any:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        return run_example(script, endpoint, *options)

    run.forces = lambda: forces_in(tmp_path / "forces")  # type: ignore[attr-defined]
    return run


def forces_in(file: Path) -> list[tuple[float, ...]]:
    lines = file.read_text().splitlines(keepends=True) if file.exists() else []
    return [tuple(map(float, line.split())) for line in lines if line.endswith("\n")]


@pytest.fixture(scope="module")
def shared(serve_for_module: Callable[..., Any]) -> Any:
    """A server that no test harms."""
    return serve_for_module()


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_tissue_pushes_the_device_up_until_a_signal_ends_it_without_a_force(
    shared: Any, run_bridge: Any, wait_for: Callable[..., Any], script: str
) -> None:
    bridge = run_bridge(script, shared.endpoint)
    up = OUTWARD[script]
    wait_for(lambda: [f for f in run_bridge.forces() if f[up] > 0], "a force at the device", seconds=240.0)
    assert bridge.stop(signal.SIGTERM) == 130
    assert run_bridge.forces()[-1] == (0, 0, 0)
    # On the whole: a viscoelastic tissue that the tip is attached to also pulls, as the hand goes back.
    assert sum(f[up] for f in run_bridge.forces()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_device_that_is_gone_ends_the_bridge_with_code_1(shared: Any, run_bridge: Any, script: str) -> None:
    code, _, err = run_bridge(script, shared.endpoint, FAKE_GONE_AFTER_S="6").finish()
    assert code == 1, err
    assert len(err.splitlines()) == 1
    assert err.startswith("device bridge: ")


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("force_dimension_bridge.py", "no Force Dimension device can be opened: no device found"),
        ("openhaptics_bridge.py", "OpenHaptics does not call back: is a device connected and calibrated?"),
    ],
)
def test_without_a_device_the_bridge_does_not_start(
    shared: Any, run_bridge: Any, script: str, says: str
) -> None:
    code, _, err = run_bridge(script, shared.endpoint, FAKE_NONE="1").finish()
    assert (code, err) == (2, f"device bridge: {says}\n")


def test_openhaptics_own_thread_sets_zero_when_the_bridge_hangs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, wait_for: Callable[..., Any]
) -> None:
    monkeypatch.syspath_prepend(FAKES)
    monkeypatch.setenv("FAKE_FORCES", str(tmp_path / "forces"))
    device = load("openhaptics_bridge").Touch()
    try:
        device.render((0.0, 2.0, 0.0))
        wait_for(lambda: (0, 2, 0) in forces_in(tmp_path / "forces"), "the force")
        wait_for(lambda: forces_in(tmp_path / "forces")[-1] == (0, 0, 0), "no force, though none was told")
    finally:
        device.close()
        for name in [name for name in sys.modules if name.startswith(("pyOpenHaptics", "fake_hand"))]:
            del sys.modules[name]


@pytest.mark.parametrize("script", [*SCRIPTS, "haply_bridge.py", "desktop_bridge.py"])
def test_without_its_package_a_bridge_says_what_it_needs(
    start: Callable[..., Any], tmp_path: Path, script: str
) -> None:
    blocked = "forcedimension_core", "pyOpenHaptics", "websockets", "pygame"
    runner = tmp_path / "run.py"
    runner.write_text(
        f"import sys, runpy\nsys.modules |= dict.fromkeys({blocked!r})\n"
        f"runpy.run_path({str(EXAMPLES / script)!r}, run_name='__main__')\n"
    )
    code, _, err = start(runner).finish()
    assert code == 2
    assert len(err.splitlines()) == 1
    assert " needs " in err


# Axes


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, -0.64, 0.48)])
@pytest.mark.parametrize(
    ("right", "outward"), [((1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1)), ((1, 0, 0), (0, 1, 0))]
)
def test_a_frame_turns_the_devices_outward_into_the_normal_and_its_neutral_into_the_start(
    normal: tuple[float, float, float], right: tuple[float, ...], outward: tuple[float, ...]
) -> None:
    class Device:
        neutral_m = (0.1, 0.2, 0.3)

    device: Any = Device()
    device.right, device.outward = right, outward
    tool = ToolDescription("tip", (1.0, 2.0, 3.0), normal, 0.005)
    frame = frame_over(device, tool)
    assert isinstance(frame, Frame)
    assert frame.direction_at_client(normal) == pytest.approx(outward, abs=1e-12)
    assert frame.point_at_client(tool.start_m) == pytest.approx(device.neutral_m)
    # A rotation: rows of length 1, at right angles, right-handed.
    a, b, c = frame.rotation
    for row in frame.rotation:
        assert sum(x * x for x in row) == pytest.approx(1)
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    assert cross == pytest.approx(c)


# Mouse, keyboard and gamepad, without a screen


@pytest.fixture
def desktop(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return load("desktop_bridge")


class Gamepad:
    def __init__(self, **axes: float) -> None:
        self.axes = axes
        self.rumbled: list[tuple[float, float, int]] = []

    def get_axis(self, number: int) -> float:
        return self.axes.get({0: "x", 1: "y", 5: "trigger"}[number], -1.0 if number == 5 else 0.0)

    def rumble(self, low: float, high: float, duration_ms: int) -> None:
        self.rumbled.append((low, high, duration_ms))


def test_inputs_move_the_tip_and_stay_in_their_box(desktop: ModuleType) -> None:
    Inputs, moved, start = desktop.Inputs, desktop.moved, (0.0, 0.0, 0.0)
    assert moved(start, Inputs(), 0.001) == start
    assert moved(start, Inputs(pixels=(30, -10)), 0.001) == pytest.approx((0.003, -0.001, 0.0))
    assert moved(start, Inputs(notches=2), 0.001) == pytest.approx((0, 0, -0.001))
    assert moved(start, Inputs(held=(1, 0, 1)), 0.1) == pytest.approx((0.002, 0, -0.002))
    far = moved(start, Inputs(pixels=(10**6, -(10**6)), notches=10**6), 0.001)
    assert far == (desktop.ASIDE_M, -desktop.ASIDE_M, -desktop.DEEPEST_M)


def test_events_and_a_gamepad_become_inputs(desktop: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = desktop.pygame
    now_ms = [0]
    monkeypatch.setattr(desktop, "time", SimpleNamespace(monotonic=lambda: 1e-3 * now_ms[0]))
    device = desktop.Desktop()
    try:
        for kind, values in (
            (pygame.MOUSEMOTION, {"rel": (10, -5), "pos": (0, 0), "buttons": (0, 0, 0)}),
            (pygame.MOUSEWHEEL, {"x": 0, "y": 3}),
        ):
            pygame.event.post(pygame.event.Event(kind, **values))
        device.gamepad = Gamepad(x=0.05, y=-1.0, trigger=0.0)
        now_ms[0] += 1
        position, velocity = device.read()
        assert velocity is None
        # 10 pixels right, 5 up, and 1 ms of the stick, whose rest position is not quite 0; three notches and half the trigger.
        assert position == pytest.approx((0.001, 0.0005 + 2e-5, desktop.ABOVE_M - 0.0015 - 0.005))
        for _ in range(40):
            now_ms[0] += 1
            device.render((0.0, 0.0, 1.5))
        device.render((0.0, 0.0, 0.0))
        assert device.gamepad.rumbled[:-1] == [(0.5, 0.5, 40)] * 2
        assert device.gamepad.rumbled[-1][:2] == (0.0, 0.0)
    finally:
        device.close()


def test_a_made_mouse_presses_the_tissue_and_escape_ends_it(
    shared: Any, run_example: Callable[..., Any], tmp_path: Path, desktop: ModuleType
) -> None:
    """The bridge as it is, in a process without a screen, with events that a person's mouse would make."""
    script = tmp_path / "made_mouse.py"
    script.write_text(f"""
import sys, threading, time
sys.path.insert(0, {str(EXAMPLES)!r})
import desktop_bridge, pygame
felt = []
render = desktop_bridge.Desktop.render
def spied(device, force_n):
    felt.append(force_n)
    render(device, force_n)
    if len(felt) % 100 == 0:  # from 5 mm above to 3 mm deep, and back: what was let go on a busy machine has to leave
        pygame.event.post(pygame.event.Event(pygame.MOUSEWHEEL, x=0, y=16 if len(felt) % 200 else -16))
    if len([f for f in felt if any(f)]) == 100:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE, mod=0, unicode=""))
desktop_bridge.Desktop.render = spied
code = desktop_bridge.main()
assert felt[-1] == (0, 0, 0) and sum(f[2] for f in felt) > 0
sys.exit(code)
""")
    code, _, err = run_example(script, shared.endpoint).finish()
    assert code == 130, err
