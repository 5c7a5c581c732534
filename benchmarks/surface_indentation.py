"""The force of a sphere on a half-space: against Hertz and Sneddon, and how much it ripples while it slides from point to point.

    python benchmarks/surface_indentation.py [--spacing-mm 3]

A frictionless tip of 5 mm, pressed in slowly; points every 0.6 mm for the first table, every `--spacing-mm` for the second. There
it slides 40 mm at constant depth along a row of points, between two rows, across them, and askew. Ripple is the r.m.s. of the
normal force about its mean, over the mean; side force the r.m.s. of what is across the normal. None should be there.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.optimize import brentq

from palpate.model_file import SurfaceModel, ToolShape
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Simulation

RADIUS_M, YOUNG_PA, STIFFNESS_N_PER_M = 5e-3, 1e4, 1e6
PLANE_STRAIN_PA = YOUNG_PA / 0.75  # E / (1 - nu²)
SPACING_M, COUNT = 0.625e-3, 17
WAY_M = 0.04
LINES = {
    "row": (1.0, 0.0, 0.0),
    "between": (1.0, 0.0, 0.5),
    "across": (1.0, 1.0, 0.0),
    "askew": (2.0, 1.0, 0.2),
}
"""Direction x, y, and how many spacings the line is beside a point."""


def hertz(depth_m: float) -> tuple[float, float]:
    """Force, N, and radius of the contact, m, of the paraboloid that osculates the sphere (Hertz 1882)."""
    return 4 / 3 * PLANE_STRAIN_PA * np.sqrt(RADIUS_M) * depth_m**1.5, np.sqrt(RADIUS_M * depth_m)


def sneddon(depth_m: float) -> tuple[float, float]:
    """The same of the sphere itself, at any depth (Sneddon 1965): d = a artanh(a / R)."""
    a = brentq(lambda a: a * np.arctanh(a) - depth_m / RADIUS_M, 1e-9, 1 - 1e-15)
    return PLANE_STRAIN_PA * RADIUS_M**2 * ((1 + a**2) * np.arctanh(a) - a), a * RADIUS_M


def surface(count: int, spacing_m: float) -> SurfaceModel:
    tip = ToolShape("tip", RADIUS_M, 0.0, (0.0, 0.0, 2 * RADIUS_M))
    return half_space_model([tip], count, spacing_m, YOUNG_PA)


def forces(simulation: Simulation, start: np.ndarray, end: np.ndarray, n: int) -> np.ndarray:
    """(n, 3), N"""
    return np.array([simulation.step({"tip": p})["tip"].force_n for p in np.linspace(start, end, n + 1)[1:]])


def around(way_m: float, spacing_m: float) -> SurfaceModel:
    """A surface that is large enough for `slid`."""
    return surface(int(np.ceil((way_m + 0.022) / spacing_m)) | 1, spacing_m)


def ripple(force: np.ndarray) -> float:
    """R.m.s. of the normal force (n, 3) about its mean, over the mean."""
    return float(force[:, 2].std() / force[:, 2].mean())


def pressed(depths_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal forces, N, and radii of the contact, m, at increasing depths."""
    simulation, found, radii = Simulation(surface(COUNT, SPACING_M), STIFFNESS_N_PER_M), [], []
    height = RADIUS_M
    for depth in depths_m:
        forces(simulation, np.array([0.0, 0.0, height]), np.array([0.0, 0.0, RADIUS_M - depth]), 40)
        height = RADIUS_M - depth
        reaction = simulation.step({"tip": (0.0, 0.0, height)})["tip"]
        found.append(reaction.force_n[2])
        radii.append(np.sqrt(reaction.n_points / np.pi) * SPACING_M)
    return np.array(found), np.array(radii)


def slid(model: SurfaceModel, spacing_m: float, depth_m: float, line: str, way_m: float) -> np.ndarray:
    """(n, 3), N, along and across the line and normal to the surface, while the tip slides."""
    x, y, beside = LINES[line]
    along = np.array([x, y, 0.0]) / np.hypot(x, y)
    across = np.array([-along[1], along[0], 0.0])
    middle = across * beside * spacing_m + np.array([0.0, 0.0, RADIUS_M])
    down, half = np.array([0.0, 0.0, depth_m]), along * way_m / 2
    simulation = Simulation(model, STIFFNESS_N_PER_M)
    forces(simulation, middle - half, middle - half - down, 60)
    force = forces(simulation, middle - half - down, middle + half - down, round(way_m / 1e-4))[10:]
    return force @ np.stack([along, across, [0.0, 0.0, 1.0]], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spacing-mm", type=float, default=3.0)
    spacing = 1e-3 * parser.parse_args().spacing_mm
    depths = 1e-3 * np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0])
    found, radii = pressed(depths)
    print("depth mm | force N, over Hertz, over Sneddon | radius mm, Hertz, Sneddon")
    for depth, force, radius in zip(depths, found, radii, strict=True):
        (f_hertz, a_hertz), (f_sneddon, a_sneddon) = hertz(depth), sneddon(depth)
        print(
            f"{1e3 * depth:8.1f} | {force:.4f} {force / f_hertz:.3f} {force / f_sneddon:.3f} | "
            f"{1e3 * radius:.2f} {1e3 * a_hertz:.2f} {1e3 * a_sneddon:.2f}"
        )
    shallow = depths <= 3e-3
    exponent = np.polyfit(np.log(depths[shallow]), np.log(found[shallow]), 1)[0]
    print(f"exponent up to 3 mm: {exponent:.3f}")
    model = around(WAY_M, spacing)
    print(f"points every {1e3 * spacing:g} mm: ripple % / side force %")
    print("depth mm | " + " | ".join(f"{line:>11s}" for line in LINES))
    for depth in 1e-3 * np.array([1.0, 2.0, 3.0, 4.0]):
        row = []
        for line in LINES:
            force = slid(model, spacing, depth, line, WAY_M)
            side = np.sqrt(np.mean(np.sum(force[:, :2] ** 2, axis=1))) / force[:, 2].mean()
            row.append(f"{100 * ripple(force):5.1f} {100 * side:5.1f}")
        print(f"{1e3 * depth:8.1f} | " + " | ".join(row), flush=True)


if __name__ == "__main__":
    main()
