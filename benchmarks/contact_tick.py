"""What a tick of contact costs: body, tracking and solver, against points, modes and tools; beside MuJoCo's flex.

    python benchmarks/contact_tick.py [--ticks 3000] [--model liver.npz] [--flex]

Tools of radius 5 mm slide at once over a surface with a point every 3 mm, pressed in by 3 mm all the way; microseconds of wall time
a tick, compute alone. `rows` are the points in the system a tick, `sweeps` of the solver, `points` in contact with each tool, means
of the ticks that are timed. `--model` takes a surface model instead, and slides three tools around places in its working area.
`--flex` steps a MuJoCo flex with about as many nodes, on which a sphere presses, by 1 ms in the same run (package mujoco). Its
default solver, Newton's, factorizes the matrix of all nodes in each step with a contact; the conjugate gradients do not, and are
the faster ones for this.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported

import igl
import numpy as np
from numba import njit

from palpate.geometry.places_apart import places_apart
from palpate.model_file import SurfaceModel, ToolShape, load_model
from palpate.scene.schema import check_config
from palpate.scene_cloud import in_working_area
from palpate_server import simulation  # registers the image
from palpate_server.coupling import sphere_contact, spheres
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.realtime.clock import monotonic_ns
from palpate_server.realtime.native_image import make_image, view
from palpate_server.realtime.records import REACTION

RADIUS_M, DEPTH_M, REACH_M = 5e-3, 3e-3, 0.012


@njit
def run(image, positions, wanted, force, reactions, nanoseconds, sizes, touched):
    contact = view(image)
    for k in range(positions.shape[0]):
        start = monotonic_ns()
        sphere_contact.advance(contact, positions[k], wanted, force, reactions)
        nanoseconds[k] = monotonic_ns() - start
        sizes[k, 0] = contact.rows.n_rows[0]
        sizes[k, 1] = contact.rows.sweeps[1]
        for tool in range(wanted.size):
            touched[k, tool] = reactions[tool].n_contact_points


def synthetic(count: int, modes: int, tools: int) -> SurfaceModel:
    """A half-space, with the tools on a circle whose radius is half of the way to its edge."""
    spacing = 3e-3
    circle = spacing * (count - 1) / 4 if tools > 1 else 0.0
    angles = 2 * np.pi * np.arange(tools) / tools
    shapes = [
        ToolShape(f"tip{i}", RADIUS_M, 0.3, (circle * np.cos(angle), circle * np.sin(angle), 0.01))
        for i, angle in enumerate(angles)
    ]
    return half_space_model(shapes, count, spacing, 3e3, prony=([0.5, 0.3], [0.58, 0.004]), n_modes=modes)


def with_three_tools(model: SurfaceModel) -> SurfaceModel:
    """The model of a file with its first tool three times, in its working area and apart."""
    scene = check_config(json.loads(model.config), "the model's scene")
    working = in_working_area(scene, model.points) & ~model.held
    inside, beyond = model.points[working], model.points[~working]
    places = inside[places_apart(inside, beyond, 3)]
    tool = replace(model.tools[0], radius_m=RADIUS_M)
    tools = tuple(replace(tool, name=f"tip{i}", home_m=tuple(p)) for i, p in enumerate(places.tolist()))
    return replace(model, tools=tools)


def slides(model: SurfaceModel, ticks: int) -> np.ndarray:
    """(ticks, n_tools, 3), m: pressed in within 0.2 s, then at constant depth along Lissajous figures at some 0.1 m/s.

    The figures lie in the tangent plane of the point nearest to each home, and are projected onto the surface.
    """
    time_s = np.arange(ticks) * model.period_s
    height = RADIUS_M + 1e-3 - np.minimum(time_s * 0.02, DEPTH_M + 1e-3)
    along = REACH_M * np.sin(2 * np.pi * 1.5 * time_s)
    positions = np.empty((ticks, len(model.tools), 3))
    for i, tool in enumerate(model.tools):
        point = np.argmin(np.linalg.norm(model.points - tool.home_m, axis=1))
        normal = model.normals[point]
        first = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        across = REACH_M * np.sin(2 * np.pi * 1.1 * time_s + i)
        plane = np.stack([along, across], 1) @ np.stack([first, np.cross(normal, first)])
        feet, outward = on_surface(model, model.points[point] + plane)
        positions[:, i] = feet + height[:, None] * outward
    return positions


def on_surface(model: SurfaceModel, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of the surface nearest to places (n, 3), m, and the normals there, (n, 3)."""
    _, triangle, feet = igl.point_mesh_squared_distance(
        places, model.points, model.triangles.astype(np.int64)
    )
    corners = model.triangles[triangle]
    shares = igl.barycentric_coordinates(feet, *(model.points[corners[:, i]] for i in range(3)))
    normals = np.einsum("ni,nij->nj", shares, model.normals[corners])
    return feet, normals / np.linalg.norm(normals, axis=1)[:, None]


def row(name: str, model: SurfaceModel, ticks: int) -> None:
    contact = spheres.make(model)
    image, n = make_image(contact), len(model.tools)
    positions = slides(model, ticks)
    nanoseconds, sizes = np.zeros(ticks, np.int64), np.zeros((ticks, 2), np.int64)
    touched = np.zeros((ticks, n), np.int64)
    run(image, positions, np.full(n, 1), np.zeros((n, 3)), np.zeros(n, REACTION), nanoseconds, sizes, touched)
    times = nanoseconds[300:] / 1e3
    median, p99, p999 = np.percentile(times, [50, 99, 99.9])
    rows, sweeps = sizes[300:].mean(axis=0)
    points = " ".join(f"{mean:.1f}" for mean in touched[300:].mean(axis=0))
    print(
        f"{name:12s} {model.n_points:6d} {model.n_modes:6d} {n:6d} | {median:8.1f} {p99:8.1f} {p999:8.1f} | "
        f"{rows:6.1f} {sweeps:6.1f} {points}",
        flush=True,
    )


def flex(nodes_a_side: int, solver: str, steps: int) -> None:
    """A block of soft tissue on the floor, without gravity and collisions with itself, as ours is."""
    import mujoco

    spacing, last = 0.06 / (nodes_a_side - 1), nodes_a_side - 1
    xml = f"""<mujoco><option timestep="0.001" integrator="discrete" solver="{solver}" gravity="0 0 0"/><worldbody>
      <flexcomp name="block" type="grid" count="{nodes_a_side} {nodes_a_side} {nodes_a_side}" spacing="{spacing} {spacing} {spacing}"
        dim="3" mass="0.23" radius="0.0005" pos="0 0 0.03"><contact selfcollide="none"/>
        <elasticity young="5.2e3" poisson="0.45" damping="0.01"/><pin gridrange="0 0 0 {last} {last} 0"/></flexcomp>
      <body name="tip" mocap="true" pos="0 0 0.066"><geom type="sphere" size="{RADIUS_M}"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data, times, contacts = mujoco.MjData(model), [], []
    for k in range(steps):
        data.mocap_pos[0] = (0.0, 0.0, 0.0655 - min(k * 2e-4, DEPTH_M))
        start = time.perf_counter()
        mujoco.mj_step(model, data)
        times.append((time.perf_counter() - start) * 1e6)
        contacts.append(data.ncon)
    pressed = slice(steps // 4, None)
    median, p99 = np.percentile(times[pressed], [50, 99])
    print(
        f"MuJoCo {mujoco.__version__} flex, {nodes_a_side**3} nodes, one sphere, {np.median(contacts[pressed]):.0f} contacts, "
        f"{solver}: median {median:.0f}, p99 {p99:.0f} us a step"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ticks", type=int, default=3000)
    parser.add_argument("--model", help="a surface model's file")
    parser.add_argument("--flex", action="store_true", help="beside MuJoCo's flex")
    options = parser.parse_args()
    assert simulation is not None
    print("model        points  modes  tools |   median      p99    p99.9 |   rows sweeps points")
    if options.model:
        model = load_model(Path(options.model))
        assert isinstance(model, SurfaceModel), "expected a surface model"
        row("file", with_three_tools(model), options.ticks)
    else:
        for count, modes, tools in ((31, 300, 1), (31, 300, 3), (31, 1000, 3), (21, 300, 3), (44, 1000, 3)):
            row("half-space", synthetic(count, modes, tools), options.ticks)
    if options.flex:
        for nodes_a_side, steps in ((10, 200), (12, 100)):
            for solver in ("CG", "Newton"):
                flex(nodes_a_side, solver, steps)


if __name__ == "__main__":
    main()
