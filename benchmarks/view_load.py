"""What the page of `palpate view` costs the loop: tick lateness and compute time with the page open and dragging, and without.

    python benchmarks/view_load.py [MODEL.npz] [--runs 3] [--seconds 20]

Both drag the same tool around the same place at the same rate of commands: without the page a program does, by the same code as
the page's. The browser (Debian: chromium) draws in software and at a low priority, because it stands for one with a graphics
processor of its own. Without the page, busy loops take the browser's place at the lowest priority: a processor of a virtual machine
that sleeps wakes up to 2 ms late, and the page would seem to make the loop better. Every measurement has a server of its own; they
alternate. Prints p50 and p99 of the server's last status, in microseconds, and the ratio.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from palpate.model_file import SurfaceAccuracy, ToolShape, save_model
from palpate_client import Connection
from palpate_client.local_server import free_endpoint, running
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_view.hand import Grip, Hand
from palpate_view.motion import press_patch, press_surface, slid
from palpate_view.session import surface_at_rest
from palpate_view.surface import Hit, vertex_normals

FIGURES = ("tick_lateness_s", "compute_time_s")
DEPTH_M = 0.005  # the page's own
EVENT_S = 0.05  # between two events of a pointer
OPENING_S = 6.5  # a page opens so long: as many ticks without a command are in both figures
FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing", "--disable-gpu-rasterization", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a half-space of 441 points)")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, chromium(Path(folder)) as open_page:
        model = options.model or sample(Path(folder))
        found: dict[str, list[dict[str, Any]]] = {"without": [], "with": []}
        for run in range(options.runs):
            for name, drag in (("without", drag_without), ("with", lambda *a: drag_on_page(open_page, *a))):
                status = measure(model, drag, options.seconds)
                found[name].append(status)
                print(f"run {run}, {name} the page: {readable(status)}", flush=True)
    for figure in FIGURES:
        for share in ("p50", "p99"):
            bare, page = (statistics.median(1e6 * s[figure][share] for s in found[name]) for name in found)
            print(f"{figure} {share}: with {page:.1f} us, without {bare:.1f} us, ratio {page / bare:.2f}")


def sample(folder: Path) -> Path:
    path = folder / "sample.npz"
    model = half_space_model([ToolShape("tip", 0.005, 0.3, (0.0, 0.0, 0.02))], n_modes=6)
    zeros = dict.fromkeys((field.name for field in fields(SurfaceAccuracy)), 0.0)
    accuracy = SurfaceAccuracy(**zeros | {"error_map": np.zeros(model.n_points, np.float32)})
    model = replace(model, n_nodes=model.n_points, accuracy=accuracy, built_with="a benchmark")
    save_model(model, path)
    return path


def measure(model: Path, drag: Callable[[str, float], None], seconds: float) -> dict[str, Any]:
    """The last status of a server while something is dragged for some seconds."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate", "serve", str(model), "--listen", endpoint]
    with running(command, "serving"), Connection(endpoint) as connection:
        drag(endpoint, seconds)
        status = connection.next_status(2.0)
        assert status is not None
        return status


def drag_without(endpoint: str, seconds: float) -> None:
    """A circle around the place before the tool's home, by the hand of the page."""
    with awake(), Connection(endpoint) as connection:
        tool = connection.description.message["tools"][0]
        normal = np.asarray(tool["normal"], float)
        vertices, triangles = surface_at_rest(connection.geometry())
        normals = vertex_normals(vertices, triangles)
        hand = Hand(connection, print)
        if connection.description.message["model"].get("kind") != "surface":
            hand.take(
                Grip(0, tool["name"]),
                press_patch(np.asarray(tool["start_m"], float), np.zeros(3), normal, DEPTH_M),
            )
        middle = np.asarray(tool["start_m"], float)
        radius_m: float = tool["radius_m"]
        time.sleep(OPENING_S)
        end_s, i, taken = time.monotonic() + seconds, 0, hand.grip is not None
        while time.monotonic() < end_s:
            i += 1
            around = middle + 0.004 * np.array([math.sin(i / 8), math.sin(i / 5), 0.0])
            nearest = int(np.linalg.norm(vertices - around, axis=1).argmin())
            hit = Hit(vertices[nearest], normals[nearest])
            if not taken:
                taken = hand.take(Grip(0, tool["name"]), press_surface(hit, around, radius_m, DEPTH_M))
            hand.aim(0, lambda g, hit=hit: slid(g, hit, radius_m, DEPTH_M) if g.presses else g)  # type: ignore[misc]
            time.sleep(EVENT_S)
        assert hand.grip is not None, "the tool was lost"
        hand.end()


def drag_on_page(open_page: Callable[[], Page], endpoint: str, seconds: float) -> None:
    port = free_endpoint().rpartition(":")[2]
    command = [sys.executable, "-m", "palpate", "view", "--connect", endpoint, "--port", port]
    with running(command, "palpate view:"):
        page = open_page()
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_text("Drag on the organ").wait_for(timeout=60_000)
        box = page.locator("canvas").first.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2 + 55, box["y"] + box["height"] / 2 + 40  # beside the tool
        page.mouse.move(x, y)
        page.mouse.down()
        end_s, i = time.monotonic() + seconds, 0
        while time.monotonic() < end_s:
            i += 1
            page.mouse.move(x + 25 * math.sin(i / 8), y + 15 * math.sin(i / 5))
            time.sleep(EVENT_S)
        assert float(page.locator("text=/^\\d+\\.\\d\\d/").first.inner_text().split()[0]) > 0, (
            "no force on the page"
        )
        page.close()


@contextmanager
def awake() -> Iterator[None]:
    """Keeps all processors awake."""
    command = ["nice", "-n", "19", sys.executable, "-c", "while True: pass"]
    loops = [subprocess.Popen(command) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def chromium(folder: Path) -> Iterator[Callable[[], Page]]:
    """Makes pages of a browser that runs at a low priority."""
    program = shutil.which("chromium")
    if program is None:
        raise SystemExit("chromium is not installed (Debian: apt install chromium)")
    nice = folder / "chromium"
    nice.write_text(f'#!/bin/sh\nexec nice -n 19 {program} "$@"\n')
    nice.chmod(0o755)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=nice, args=list(FLAGS))
        yield lambda: browser.new_page(viewport={"width": 1040, "height": 600})
        browser.close()


def readable(status: dict[str, Any]) -> str:
    parts = [f"{f} p50 {1e6 * status[f]['p50']:.1f} p99 {1e6 * status[f]['p99']:.1f} us" for f in FIGURES]
    return ", ".join((*parts, f"{status['ticks']} ticks, {status['skipped_ticks']} skipped"))


if __name__ == "__main__":
    main()
