"""A fitted tissue in words, as JSON, and as the material of a scene."""

from __future__ import annotations

import math
from typing import Any

from palpate.fitting.confidence import CONFIDENCE, Interval
from palpate.fitting.records import POISSONS_RATIO, Record
from palpate.fitting.tissue import LossTangent, Tissue

DENSITY_KG_PER_M3 = 1060.0
"""Of soft tissue: no record tells it."""


def tissue_text(tissue: Tissue) -> str:
    """The table for the screen, without the material."""
    longest = max(record.window_s[1] for record in tissue.records)
    note = f"what relaxes slower than in {_digits(longest, 2)} s counts as at rest"
    rows = [("E at rest", _range(tissue.modulus_pa, "Pa"), note)]
    for number, branch in enumerate(tissue.branches, 1):
        rows.append((f"branch {number}", f"gamma {_range(branch.gamma)}", f"tau {_range(branch.tau_s, 's')}"))
    for loss in tissue.loss_tangent:
        rows.append((f"loss tangent at {loss.frequency_hz:g} Hz", *_loss_words(loss)))
    rows.append(("misfit", f"{100 * tissue.rms_residual:.2g} % (rms)", _misfit_words(tissue)))
    first, second = (max(len(row[i]) for row in rows) for i in (0, 1))
    lines = [f"{record.name}: {record.description}" for record in tissue.records]
    lines += [f"  {a:<{first}}  {b:<{second}}  {c}".rstrip() for a, b, c in rows]
    lines.append(f"  All ranges together hold with {100 * CONFIDENCE:g} % confidence. {_told(tissue)}")
    lines += [f"  - not known: {sentence}" for sentence in tissue.missing]
    lines += [f"  - {sentence}" for sentence in tissue.notes]
    return "\n".join(lines)


def material_toml(tissue: Tissue) -> str:
    """A [material] for a scene, with comments that say where it comes from and what it is good for."""
    lines = [f"# Fitted to {record.name}: {record.description}." for record in tissue.records]
    lines.append(f"# {_told(tissue)}")
    lines += [f"# Not known: {sentence}." for sentence in tissue.missing]
    lines += [f"# {sentence}." for sentence in tissue.notes]
    losses = [
        f"{_digits(loss.value.value)} at {loss.frequency_hz:g} Hz"
        for loss in tissue.loss_tangent
        if loss.value
    ]
    lines.append(f"# Loss tangent: {', '.join(losses) or 'not known in the haptic band'}.")
    return "\n".join(
        [
            *lines,
            "[material]",
            f"youngs_modulus_pa = {_digits(tissue.modulus_pa.value)}",
            f"poissons_ratio = {POISSONS_RATIO}  # assumed, not measured",
            f"density_kg_per_m3 = {DENSITY_KG_PER_M3}  # assumed, not measured",
            f"gamma = [{', '.join(_digits(b.gamma.value) for b in tissue.branches)}]",
            f"tau_s = [{', '.join(_digits(b.tau_s.value) for b in tissue.branches)}]",
        ]
    )


def tissue_json(tissue: Tissue) -> dict[str, Any]:
    """Everything but the residuals, with plain numbers, lists and names; docs/tissue.md lists the fields."""
    return {
        "records": [
            {"name": r.name, "description": r.description, "window_s": list(r.window_s)}
            for r in tissue.records
        ],
        "confidence": CONFIDENCE,
        "youngs_modulus_pa": vars(tissue.modulus_pa),
        "gamma": [vars(b.gamma) for b in tissue.branches],
        "tau_s": [vars(b.tau_s) for b in tissue.branches],
        "loss_tangent": [
            {"frequency_hz": loss.frequency_hz} | (vars(loss.value) if loss.value else {"value": None})
            for loss in tissue.loss_tangent
        ],
        "rms_residual": tissue.rms_residual,
        "missing": list(tissue.missing),
        "notes": list(tissue.notes),
        "material_toml": material_toml(tissue),
    }


def _loss_words(loss: LossTangent) -> tuple[str, str]:
    if loss.value:
        return _range(loss.value), ""
    time_s = 1 / (2 * math.pi * loss.frequency_hz)
    return "not known", (
        f"missing: complex modulus at {loss.frequency_hz:g} Hz, or a ramp of at most {_digits(time_s, 1)} s"
    )


def _misfit_words(tissue: Tissue) -> str:
    count = sum(len(residuals) for residuals in tissue.residuals)
    return f"of {count:,} values, {1 + 2 * len(tissue.branches)} parameters"


def _told(tissue: Tissue) -> str:
    windows = " and ".join(_window(record) for record in tissue.records)
    return f"Time constants outside {windows} are not determined."


def _window(record: Record) -> str:
    low, high = record.window_s
    return f"{_digits(low, 2)} to {_digits(high, 2)} s"


def _range(interval: Interval, unit: str = "") -> str:
    """The value and its ends; words instead of ends that say nothing."""
    value = f"{_digits(interval.value)} {unit}".rstrip()
    if interval.factor > 10:
        return f"{value} (uncertain)"
    return f"{value} ({_digits(interval.low)} to {_digits(interval.high)})"


def _digits(value: float, count: int = 4) -> str:
    """A number with so many digits that count, without an exponent where a person wouldn't write one."""
    rounded = float(f"{value:.{count - 1}e}")
    if 1e-4 <= rounded < 1e7:
        return f"{rounded:.10f}".rstrip("0").rstrip(".")
    return f"{rounded:g}"
