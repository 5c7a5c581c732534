"""Bounds of common haptic devices, and warnings when a model is too stiff for one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.model_file import ReducedModel
from palpate_server.realtime.safety import Limits

_CHAI3D = "CHAI3D 3 device specifications, github.com/chai3d/chai3d, src/devices"


_MARGIN = 0.95  # of the stiffness at which Colgate's condition holds no more


@dataclass(frozen=True)
class DeviceProfile:
    """Bounds for what a device renders; max_stiffness and max_damping are the largest recommended ones at 1 kHz."""

    name: str
    max_force_n: float
    max_stiffness_n_per_m: float
    max_damping_n_s_per_m: float
    workspace_radius_m: float
    source: str


@dataclass(frozen=True)
class Device:
    """The device that a client renders with; its round trip from command to force and its own damping, when told."""

    profile: DeviceProfile
    round_trip_s: float | None = None
    damping_n_s_per_m: float | None = None


PROFILES = {
    profile.name: profile
    for profile in (
        DeviceProfile("generic", 3.0, 700.0, 4.0, 0.1, "none: below every device here"),
        DeviceProfile("touch", 3.3, 700.0, 5.0, 0.10, f"{_CHAI3D}: PHANTOM Omni, the Touch's former name"),
        DeviceProfile("phantom-omni", 3.3, 700.0, 5.0, 0.10, _CHAI3D),
        DeviceProfile("phantom-desktop", 7.9, 1000.0, 5.0, 0.10, _CHAI3D),
        DeviceProfile("phantom-premium-1.5", 8.5, 800.0, 5.0, 0.12, _CHAI3D),
        DeviceProfile("phantom-premium-3.0", 22.0, 1000.0, 5.0, 0.25, _CHAI3D),
        DeviceProfile("omega", 12.0, 5000.0, 30.0, 0.075, f"{_CHAI3D}: omega.3, omega.6, omega.7"),
        DeviceProfile("delta", 20.0, 5000.0, 30.0, 0.15, f"{_CHAI3D}: delta.3, delta.6"),
        DeviceProfile("sigma", 12.0, 4000.0, 30.0, 0.075, f"{_CHAI3D}: sigma.7"),
        DeviceProfile("lambda", 12.0, 8000.0, 30.0, 0.1125, f"{_CHAI3D}: lambda.7"),
        DeviceProfile("falcon", 8.0, 3000.0, 20.0, 0.04, _CHAI3D),
        DeviceProfile("inverse3", 10.0, 1000.0, 6.0, 0.15, "Haply's CHAI3D device class for the Inverse3"),
    )
}


def limits_for(profile: DeviceProfile, ceiling: Limits) -> Limits:
    """The tighter of the device's and the server's bounds; the passivity controller may damp as the device can."""
    return ceiling._replace(
        max_force_n=min(ceiling.max_force_n, profile.max_force_n),
        workspace_radius_m=min(ceiling.workspace_radius_m, profile.workspace_radius_m),
        max_damping_n_s_per_m=profile.max_damping_n_s_per_m,
    )


def coupling_stiffness(device: Device | None, period_s: float) -> float:
    """The largest stiffness, N/m, at the device, of the spring between it and a sphere that touches a surface model.

    That is the largest one that the device is good for, the generic one without a device. With the device's own damping b and
    its round trip D, a sampled spring K is passive for b > K (T / 2 + D) (Colgate & Schenkel 1997). Tissue in series only
    makes it softer.
    """
    if device is None:
        return PROFILES["generic"].max_stiffness_n_per_m
    stiffness = device.profile.max_stiffness_n_per_m
    if device.damping_n_s_per_m is not None:
        delay_s = device.round_trip_s or 0.0
        stiffness = min(stiffness, _MARGIN * device.damping_n_s_per_m / (period_s / 2 + delay_s))
    return stiffness


def warnings_for(device: Device, model: ReducedModel, tool: int, scale: float) -> list[str]:
    """Why `device` may not render a tool (by index) of a patch model stably; `scale` is that of the client's frame."""
    rows = slice(3 * tool, 3 * tool + 3)
    stiffness = float(np.linalg.norm(model.continuous.d[rows, rows], 2)) * scale**2
    warnings = stiffness_warnings(
        device.profile, stiffness, model.period_s, device.round_trip_s, device.damping_n_s_per_m
    )
    passive_up_to_hz = model.accuracy.passive_up_to_hz
    if passive_up_to_hz < 0.5 / model.period_s * (1 - 1e-9):
        warnings.append(
            f"the model dissipates energy up to {passive_up_to_hz:.3g} Hz; faster than that it can give out "
            f"{model.accuracy.largest_energy_out_j * 1e3:.2g} mJ in a poke of 1 mm"
        )
    return warnings


def stiffness_warnings(
    profile: DeviceProfile,
    stiffness_n_per_m: float,
    period_s: float,
    round_trip_s: float | None,
    damping_n_s_per_m: float | None,
) -> list[str]:
    """Why a stiffness (the model's instant one, at the device) may not be rendered stably; empty when nothing is wrong.

    Colgate & Schenkel (1997): a sampled spring K is passive on a device with damping b if b > K T / 2, for a model
    without damping of its own. A delay D of the force adds to the half period: b > K (T / 2 + D).
    """
    warnings = []
    if stiffness_n_per_m > profile.max_stiffness_n_per_m:
        warnings.append(
            f"the model's instant stiffness is {stiffness_n_per_m:.3g} N/m, "
            f"{profile.name} is good for {profile.max_stiffness_n_per_m:.3g} N/m"
        )
    if damping_n_s_per_m is not None:
        delay = round_trip_s if round_trip_s is not None else 0.0
        needed = stiffness_n_per_m * (period_s / 2 + delay)
        if damping_n_s_per_m <= needed:
            warnings.append(
                f"a device damping of {damping_n_s_per_m:.3g} N s/m is not above the {needed:.3g} N s/m that "
                f"{stiffness_n_per_m:.3g} N/m need at a period of {period_s * 1e3:.3g} ms "
                f"and a round trip of {delay * 1e3:.3g} ms: it may vibrate"
            )
    return warnings
