"""`palpate view` in a real browser: something is dragged on the page, force and deformation change, and closing it ends the force.

It needs Chromium, such as Debian's packages `chromium` and `fonts-dejavu-core`. Pictures are kept in out/screenshots.
"""

from __future__ import annotations

import contextlib
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

from palpate.model_file import SurfaceModel, save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Flags

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
PATIENCE_MS = 180_000
N_CLOSINGS = 5
CLOSED_S = 0.1  # from the page's close to no force
NOTE_CLOSE = """addEventListener("pagehide", () =>
    localStorage.setItem("closed_ms", performance.timeOrigin + performance.now()))"""
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


@pytest.fixture(scope="module")
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


def beside_the_tool(page: Any) -> tuple[float, float]:
    """A place on the organ: it is in the middle of the picture, and so is the tool."""
    box = page.locator("canvas").first.bounding_box()
    return box["x"] + box["width"] / 2 + 55, box["y"] + box["height"] / 2 + 40


def drag_until(page: Any, condition: Callable[[], object], what: str) -> None:
    """Drag around on the organ until something is so; the button stays down."""
    x, y = beside_the_tool(page)
    page.mouse.move(x, y)
    page.mouse.down()
    end_s = time.monotonic() + PATIENCE_MS / 1e3
    i = 0
    while not condition():
        assert time.monotonic() < end_s, f"waited for {what}"
        i += 1
        page.mouse.move(x + 25 * math.sin(i / 8), y + 12 * math.sin(i / 5))


def close(page: Any) -> int:
    """Close a page; when it was closed, as the page itself noted it, ns on this machine's monotonic clock."""
    context, address = page.context, page.url
    offset_ns = time.time_ns() - time.monotonic_ns()
    page.close()
    blank = context.new_page()  # of the same origin, which has the note
    blank.route("**/note", lambda route: route.fulfill(body="<html></html>", content_type="text/html"))
    blank.goto(f"{address.rstrip('/')}/note")
    note = blank.wait_for_function("localStorage.getItem('closed_ms')")  # the browser stores it by and by
    closed_ms = float(note.json_value())
    context.close()
    return round(closed_ms * 1e6) - offset_ns


def colored_pixels(picture: Path) -> int:
    """How many pixels between the panels have the colors of tissue that is displaced by a third of the scale and more."""
    between = Image.open(picture).convert("RGB").crop((320, 0, 720, 600))
    r, g, b = np.moveaxis(np.asarray(between, int), 2, 0)
    return int(np.count_nonzero((r > 200) & (g > 120) & (g < r) & (b < 0.75 * g)))


def newtons(message: dict[str, Any]) -> float:
    return float(np.linalg.norm(message["force_n"][0]))


def let_go(client: Any, what: str) -> None:
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
        took_s = []
        for _ in range(N_CLOSINGS):
            drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
            pressed = next(m for m in reversed(client.forces) if newtons(m) > 0.15)
            assert pressed["flags"][0] & Flags.IN_CONTACT
            assert pressed["n_contact_points"][0] > 0
            closed_ns = close(page)
            let_go(client, "no force")
            first = next(m for m in client.forces if m["server_time_ns"] > closed_ns and newtons(m) == 0)
            took_s.append((first["server_time_ns"] - closed_ns) * 1e-9)
            page = opened(browser, address)
    print(f"no force {sorted(round(1e3 * t) for t in took_s)} ms after the page was closed")
    assert statistics.median(took_s) < CLOSED_S, took_s


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
        page.context.new_page().bring_to_front()
        let_go(client, "no force of a page that is hidden")
        page.context.close()
        page = opened(browser, address)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
        stopped = renderers()
        assert stopped
        try:
            for process in stopped:
                process.suspend()
            let_go(client, "no force of a page that is stopped")
        finally:
            for process in stopped:
                process.resume()
        page.context.close()


def test_a_patch_is_dragged_and_let_go_with_the_button_and_by_a_page_that_hangs(
    browser: Any, serve: Callable[..., Any], view: Callable[[str], str], connect: Callable[..., Any]
) -> None:
    served = serve()
    address = view(served.endpoint)
    with connect(served.endpoint) as client:
        page = opened(browser, address)
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.1, "a force")
        page.screenshot(path=PICTURES / "patch_pressed.png")
        page.mouse.up()
        let_go(client, "no force")
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.1, "a force again")
        page.context.new_cdp_session(page).send("Page.setWebLifecycleState", {"state": "frozen"})
        let_go(client, "no force of a page that hangs")


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
        factor = page.get_by_label("Stiffness", exact=True).first
        factor.fill("3")
        factor.press("Enter")
        page.get_by_role("button", name="Load").click()
        client.status_when(lambda status: status["model"]["stiffness_factor"] == 3.0, "a stiffer model")
        page.get_by_text("stiffness factor").first.wait_for()
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
        x, y = beside_the_tool(page)
        touch = page.context.new_cdp_session(page)
        touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
        end_s, i = time.monotonic() + PATIENCE_MS / 1e3, 0
        while newtons(client.forces[-1]) < 0.15:
            assert time.monotonic() < end_s, "waited for a force"
            i += 1
            point = {"x": x + 20 * math.sin(i / 8), "y": y}
            touch.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [point]})
        page.screenshot(path=PICTURES / "phone.png")
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
        page.close()


def test_without_a_server_it_says_so_in_one_line(start: Callable[..., Any]) -> None:
    code, out, err = start("-m", "palpate", "view", "--connect", free_endpoint()).finish()
    assert code == 2 and out == ""
    assert len(err.splitlines()) == 1 and "nothing answers" in err
