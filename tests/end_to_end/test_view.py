"""`palpate view` in a real browser: something is dragged on the page, force and deformation change, and closing it ends the force.

It needs Chromium, such as Debian's packages `chromium` and `fonts-dejavu-core`. Pictures are kept in out/screenshots.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import SurfaceModel, save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Flags

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# A browser that draws in software takes a processor for itself.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]

PICTURES = Path(__file__).parents[2] / "out" / "screenshots"
PATIENCE_MS = 180_000
CLOSED_S = 0.1  # from the page's close to no force
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
    page = browser.new_page(**(options or {"viewport": {"width": 1040, "height": 600}}))
    page.set_default_timeout(PATIENCE_MS)
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


def newtons(message: dict[str, Any]) -> float:
    return float(np.linalg.norm(message["force_n"][0]))


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
        took_s = []
        for _ in range(3):  # a busy machine may close a page late
            page = opened(browser, address)
            at_rest = page.screenshot(path=PICTURES / "surface_at_rest.png")
            drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force")
            drag_until(page, lambda page=page: newtons_shown(page) > 0.1, "the force on the page")
            assert page.screenshot(path=PICTURES / "surface_pressed.png") != at_rest
            page.mouse.up()  # the picture may have taken so long that the tool was let go
            drag_until(page, lambda: newtons(client.forces[-1]) > 0.15, "a force again")
            pressed = next(m for m in reversed(client.forces) if newtons(m) > 0.15)
            assert pressed["flags"][0] & Flags.IN_CONTACT
            assert pressed["n_contact_points"][0] > 0
            closed_ns = time.monotonic_ns()
            page.close()
            gone = client.force_when(lambda message: newtons(message) == 0, "no force")
            first = next(m for m in client.forces if m["server_time_ns"] > closed_ns and newtons(m) == 0)
            assert gone["tick"] >= first["tick"]
            took_s.append((first["server_time_ns"] - closed_ns) * 1e-9)
            client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
            if took_s[-1] < CLOSED_S:
                return
    raise AssertionError(f"the force was gone {took_s} s after the page was closed, expected {CLOSED_S}")


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
        client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
        client.force_when(lambda message: newtons(message) == 0, "no force")
        drag_until(page, lambda: newtons(client.forces[-1]) > 0.1, "a force again")
        page.context.new_cdp_session(page).send("Page.setWebLifecycleState", {"state": "frozen"})
        client.status_when(lambda status: status["tools"]["tip"]["holder"] is None, "a free tool")
        client.force_when(lambda message: newtons(message) == 0, "no force of a page that hangs")


def test_buttons_record_and_load_another_model(
    browser: Any,
    serve: Callable[..., Any],
    view: Callable[[str], str],
    connect: Callable[..., Any],
    make_surface_model: Callable[..., SurfaceModel],
    make_spring_mass_model: Callable[..., Any],
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
        assert (recordings / recording["file"]).stat().st_size > 0
        page.get_by_label("Model file").fill("other.npz")
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
