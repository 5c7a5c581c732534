"""`palpate view` in a real browser: something is dragged on the page, force and deformation change, and closing it ends the force.

It needs Chromium, such as Debian's packages `chromium` and `fonts-dejavu-core`. Pictures are kept in out/screenshots.
"""

from __future__ import annotations

import contextlib
import io
import math
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from scipy import ndimage

from palpate.model_file import SurfaceModel, save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Flags
from palpate_view.panels import STRAIN

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
Image = pytest.importorskip("PIL.Image")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# A browser that draws in software takes a processor for itself.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]

PICTURES = Path(__file__).parents[2] / "out" / "screenshots"
PATIENCE_MS = 60_000
N_CLOSINGS = 5
# A browser without a window hides no page: the page is told what it is told by one that does.
HIDE = """
Object.defineProperty(document, "hidden", { get: () => true });
document.dispatchEvent(new Event("visibilitychange"));
"""
N_MOVES = 60
EVENT_S = 0.05  # between two events of a finger
CLOSED_S = 0.1  # from the end of the page to no force
STILL_S = 1.0  # a hand that closes a page holds still
CLOSED = "palpate-closed"
NOTE_CLOSE = f"""addEventListener("pagehide", () =>
    console.log("{CLOSED}", Math.floor(performance.timeOrigin + performance.now())))"""
N_COLORED = 300  # pixels of deformed tissue
# Pictures are drawn in software; what is around the picture is quicker without the detour over the graphics library.
SWIFTSHADER = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--disable-gpu-rasterization",
)
NO_NETWORK = (
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture
def browser() -> Iterator[Any]:
    PICTURES.mkdir(parents=True, exist_ok=True)
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*SWIFTSHADER, *NO_NETWORK])
        yield browser
        browser.close()


def opened(browser: Any, address: str, **options: Any) -> Any:
    """The page, once it shows the organ."""
    context = browser.new_context(**(options or {"viewport": {"width": 1040, "height": 600}}))
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(NOTE_CLOSE)
    page.goto(address)
    page.get_by_text("Drag on the organ").wait_for(state="attached")  # on a phone the controls are closed
    page.evaluate("document.querySelectorAll('[class*=Notification] button').forEach(b => b.click())")
    return page


def pixels(page: Any) -> np.ndarray:
    """(height, width, 3): the page as it is seen, a pixel for each CSS pixel."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(scale="css"))).convert("RGB"), int)


def place_on_the_organ(page: Any) -> tuple[float, float]:
    """The place that is farthest inside of what has the tissue's colors, once that is seen: a picture may not be drawn yet."""
    end_s = time.monotonic() + PATIENCE_MS / 1e3
    while True:
        r, g, b = np.moveaxis(pixels(page), 2, 0)
        inside = ndimage.distance_transform_edt((r > 80) & (r > 1.2 * g) & (r > 1.4 * b))
        y, x = np.unravel_index(int(inside.argmax()), inside.shape)
        if inside[y, x] > 25:
            return float(x), float(y)
        assert time.monotonic() < end_s, "no organ is seen"


def drag_until(page: Any, condition: Callable[[], object], what: str, finger: Finger | None = None) -> None:
    """Drag around on the organ, with the mouse or a finger, until something is so; it stays down.

    It begins anew after N_MOVES: a drag that begins before the camera is at its place may miss the organ, and turns the picture.
    """
    pointer = finger or page.mouse
    end_s = time.monotonic() + PATIENCE_MS / 1e3
    i = 0
    while not condition():
        assert time.monotonic() < end_s, f"waited for {what}"
        if i % N_MOVES == 0:
            pointer.up()
            x, y = place_on_the_organ(page)
            pointer.move(x, y)
            pointer.down()
        i += 1
        pointer.move(x + 25 * math.sin(i / 8), y + 12 * math.sin(i / 5))


def hold_still(page: Any, client: Any) -> None:
    """Press for STILL_S; again where a busy machine was silent for so long that the tool was let go."""
    end_s = time.monotonic() + PATIENCE_MS / 1e3
    while True:
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        time.sleep(STILL_S)
        if newtons(client.forces[-1]) > 0.15:
            return
        assert time.monotonic() < end_s, "waited for a force that stays"


def close(page: Any) -> tuple[int, int]:
    """Close a page: when that was asked for, and when it was told so (its `pagehide`), ns on this machine's monotonic clock.

    A page that draws in software is told when its picture is done, 0.1 to 0.3 s later.
    """
    offset_ns = time.time_ns() - time.monotonic_ns()
    noted: list[int] = []
    page.on("console", lambda m: noted.append(int(m.text.split()[1])) if m.text.startswith(CLOSED) else None)
    asked_ns = time.monotonic_ns()
    page.close()
    page.context.close()
    assert noted, "the browser ended the page without telling it"
    return asked_ns, 1_000_000 * noted[0] - offset_ns


class Finger:
    """A finger on a page, with the methods of its mouse."""

    def __init__(self, page: Any) -> None:
        self._session = page.context.new_cdp_session(page)
        self._place: dict[str, float] = {}
        self._is_down = False

    def move(self, x: float, y: float) -> None:
        self._place = {"x": x, "y": y}
        if self._is_down:
            self._send("touchMove", self._place)
            time.sleep(EVENT_S)

    def down(self) -> None:
        self._is_down = True
        self._send("touchStart", self._place)

    def up(self) -> None:
        if self._is_down:
            self._is_down = False
            self._send("touchEnd")

    def _send(self, kind: str, *places: dict[str, float]) -> None:
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})


def colored_pixels(picture: Path) -> int:
    """How many pixels between the panels have the colors of tissue that is displaced by a third of the scale and more."""
    between = Image.open(picture).convert("RGB").crop((320, 0, 720, 600))
    r, g, b = np.moveaxis(np.asarray(between, int), 2, 0)
    return int(np.count_nonzero((r > 200) & (g > 120) & (g < r) & (b < 0.75 * g)))


def newtons(message: dict[str, Any]) -> float:
    return float(np.linalg.norm(message["force_n"][0]))


def wait_until_free(client: Any, what: str) -> None:
    """Wait for a free tool, and for `what`: no force."""
    client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
    client.force_when(lambda message: newtons(message) == 0, what)


def newtons_shown(page: Any) -> float:
    return float(page.locator("text=/^\\d+\\.\\d\\d/").first.inner_text().split()[0])


def test_a_drag_on_the_organ_presses_and_the_closed_page_lets_go(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    served = serve(model=make_surface_model())
    address = view(served.endpoint)
    with connect(served.endpoint) as client:
        page = opened(browser, address)
        page.screenshot(path=PICTURES / "surface_at_rest.png")
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        drag_until(page, lambda: newtons_shown(page) > 0.1, "the force on the page")
        page.screenshot(path=PICTURES / "surface_pressed.png")
        assert colored_pixels(PICTURES / "surface_at_rest.png") < N_COLORED
        assert colored_pixels(PICTURES / "surface_pressed.png") > N_COLORED
        page.mouse.up()  # the picture may have taken so long that the tool was let go
        took_s, asked_s = [], []
        for _ in range(N_CLOSINGS):
            hold_still(page, client)
            pressed = client.forces[-1]
            assert pressed["flags"][0] & Flags.IN_CONTACT
            assert pressed["n_contact_points"][0] > 0
            asked_ns, closed_ns = close(page)
            wait_until_free(client, "no force")
            first = next(m for m in client.forces if m["server_time_ns"] > closed_ns and newtons(m) == 0)
            took_s.append((first["server_time_ns"] - closed_ns) * 1e-9)
            asked_s.append((first["server_time_ns"] - asked_ns) * 1e-9)
            page = opened(browser, address)
    for what, times in (("was told that it ends", took_s), ("was to be closed", asked_s)):
        print(f"no force {sorted(round(1e3 * t) for t in times)} ms after the page {what}")
    assert statistics.median(took_s) < CLOSED_S, took_s


def test_the_colors_can_show_the_strain(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    served = serve(model=make_surface_model())
    address = view(served.endpoint)
    with connect(served.endpoint) as client:
        page = opened(browser, address)
        page.get_by_role("combobox", name="Show").click()
        page.get_by_role("option", name=STRAIN).click()
        page.get_by_text("2 % and more", exact=True).wait_for()  # the smallest scale
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        drag_until(page, lambda: newtons_shown(page) > 0.1, "the force on the page")
        page.screenshot(path=PICTURES / "surface_strained.png")
        assert colored_pixels(PICTURES / "surface_strained.png") > N_COLORED


def renderers() -> list[psutil.Process]:
    """Of the processes that this one has started, those of Chromium that run its pages."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            if "--type=renderer" in " ".join(process.cmdline()):
                found.append(process)
    return found


def test_a_page_that_is_hidden_or_stopped_lets_go(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    served = serve(model=make_surface_model())
    address = view(served.endpoint)
    with connect(served.endpoint) as client:
        page = opened(browser, address)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        page.evaluate(HIDE)
        wait_until_free(client, "no force of a page that is hidden")
        page.context.close()
        page = opened(browser, address)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        stopped = renderers()
        assert stopped
        try:
            for process in stopped:
                process.suspend()
            wait_until_free(client, "no force of a page that is stopped")
        finally:
            for process in stopped:
                process.resume()
        page.context.close()


def test_a_patch_is_dragged_and_let_go_with_the_button(
    browser: Any, serve: Callable[..., Any], view: Callable[[str], str], connect: Callable[..., Any]
) -> None:
    served = serve()
    address = view(served.endpoint)
    with connect(served.endpoint) as client:
        page = opened(browser, address)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.1, "a force")
        page.get_by_text("moves its patch").first.wait_for()
        page.screenshot(path=PICTURES / "patch_pressed.png")
        page.mouse.up()
        wait_until_free(client, "no force")


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option).click()


def test_buttons_record_and_load_another_model(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    make_spring_mass_model: Callable[..., Any],
    wait_for: Callable[..., Any],
    tmp_path: Path,
) -> None:
    recordings = tmp_path / "recordings"
    served = serve("--recordings", str(recordings), model=make_surface_model())
    save_model(make_spring_mass_model(), tmp_path / "other.npz")
    with connect(served.endpoint) as client:
        page = opened(browser, view(served.endpoint))
        page.get_by_role("button", name="Record").click()
        recording = client.status_when(lambda status: status["recording"] is not None, "a recording")[
            "recording"
        ]
        page.get_by_role("button", name="Stop recording").click()
        client.status_when(lambda status: status["recording"] is None, "the end of the recording")
        wait_for(lambda: (recordings / recording["file"]).stat().st_size, "the recording's end")
        choose(page, "Model", "model1.npz")  # the one that runs
        row = page.locator("label", has_text="Stiffness").locator("xpath=ancestor::*[.//input][1]")
        factor = row.locator("input:not([type=hidden])")
        factor.fill("3")
        factor.press("Enter")
        page.get_by_role("button", name="Load").click()
        client.status_when(lambda status: status["model"]["stiffness_factor"] == 3.0, "a stiffer model")
        page.get_by_text("stiffness factor").first.wait_for()
        page.get_by_text("3 times as stiff").first.wait_for()
        page.screenshot(path=PICTURES / "stiffer.png")
        choose(page, "Model", "other.npz")
        page.get_by_role("button", name="Load").click()
        client.status_when(lambda status: status["model"]["kind"] == "patch", "the other model")
        page.get_by_text("masses on springs").first.wait_for()
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.1, "a force of the other model")
        page.close()


def test_the_page_fits_a_phone_and_a_finger_presses(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    served = serve(model=make_surface_model())
    with connect(served.endpoint) as client:
        phone = {
            "viewport": {"width": 412, "height": 839},
            "has_touch": True,
            "is_mobile": True,
            "device_scale_factor": 2,
        }
        page = opened(browser, view(served.endpoint), **phone)
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide <= 0  # nothing to scroll sideways
        page.get_by_text("Press, mm").wait_for(state="hidden")  # the controls are folded
        finger = Finger(page)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force", finger)
        page.screenshot(path=PICTURES / "phone.png")
        finger.up()
        client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
        page.close()


def test_without_a_server_it_says_so_in_one_line(start: Callable[..., Any]) -> None:
    code, out, err = start("-m", "palpate", "view", "--connect", free_endpoint()).finish()
    assert code == 2 and out == ""
    assert len(err.splitlines()) == 1 and "nothing answers" in err
