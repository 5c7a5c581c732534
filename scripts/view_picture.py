"""Makes the picture of `palpate view` for the documentation: the page in Chromium while the tool presses a model.

    python scripts/view_picture.py MODEL.npz

It needs playwright and Chromium (Debian: chromium, fonts-dejavu-core), which draws in software.
"""

from __future__ import annotations

import math
import re
import shutil
import sys
import time
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from palpate_client.local_server import free_endpoint, running

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "view.png"
SIZE = {"width": 1360, "height": 800}
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
)
FROM, TO = (40, -30), (-20, 10)  # pixels from the middle of the picture
SLIDE_S = 12.0


def main() -> None:
    endpoint = free_endpoint()
    port = free_endpoint().rpartition(":")[2]
    program = shutil.which("chromium")
    if program is None:
        raise SystemExit("chromium is not installed (Debian: apt install chromium)")
    palpate = [sys.executable, "-m", "palpate"]
    with (
        running([*palpate, "serve", sys.argv[1], "--listen", endpoint], "serving"),
        running([*palpate, "view", "--connect", endpoint, "--port", port], "palpate view:"),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(180_000)
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_text("Drag on the organ").wait_for(state="attached")
        page.evaluate("document.querySelectorAll('[class*=Notification] button').forEach(b => b.click())")
        slide(page)
        if not page.get_by_text(re.compile("touches|slides")).first.is_visible():
            raise SystemExit("the page lost the tool: this machine draws too slowly now, try again")
        page.screenshot(path=PICTURE)
        browser.close()
    print(PICTURE)


def slide(page: Page) -> None:
    """Press, slide to and fro, and hold still; the button stays down."""
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x + FROM[0], y + FROM[1])
    page.mouse.down()
    begin_s = time.monotonic()
    while (elapsed_s := time.monotonic() - begin_s) < SLIDE_S:
        share = 0.5 - 0.5 * math.cos(3 * math.pi * elapsed_s / SLIDE_S)
        page.mouse.move(*(a + f + share * (t - f) for a, f, t in zip((x, y), FROM, TO, strict=True)))


if __name__ == "__main__":
    main()
