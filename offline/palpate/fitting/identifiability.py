"""What the records don't tell of a material, and which data would."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from palpate.fitting.confidence import Interval
from palpate.fitting.records import Record, TimeRecord

_WIDEST = 4.0  # an interval that reaches further than this factor is no result
_WIDEST_AT_REST = 1.5


def tells(records: Sequence[Record], time_s: float) -> bool:
    """Whether a time constant lies in the window of a record."""
    return any(low <= time_s <= high for low, high in (record.window_s for record in records))


def missing_data(
    records: Sequence[Record], at_rest: Interval, strengths: Sequence[Interval], times_s: Sequence[Interval]
) -> Iterator[str]:
    """A sentence for each thing that can't be identified.

    strengths, times_s  of the fitted branches, in the order of rising times
    """
    fastest = min(records, key=lambda r: r.window_s[0])
    slowest = max(records, key=lambda r: r.window_s[1])
    outside = [t.value for t in times_s if not tells(records, t.value)]
    if too_fast := [t for t in outside if t < fastest.window_s[0]]:
        yield _too_fast(fastest, min(too_fast))
    if too_slow := [t for t in outside if t > slowest.window_s[1]]:
        yield _too_slow(slowest, max(too_slow))
    for t in outside:
        if fastest.window_s[0] <= t <= slowest.window_s[1]:
            yield (
                f"a branch has a time constant of about {t:.2g} s, in a gap between the records. "
                f"Missing: the complex modulus around {_hz(t)} Hz"
            )
    if too_slow:
        return  # what follows is relative to the stiffness at rest
    for strength, time in zip(strengths, times_s, strict=True):
        widest = max(strength.factor, time.factor)
        if widest > _WIDEST and time.value not in outside:
            yield (
                f"the branch of about {time.value:.2g} s is uncertain: its strength or time constant may be wrong by a "
                f"factor of {_about(widest)}. Missing: less noise, or more values around {time.value:.2g} s or {_hz(time.value)} Hz"
            )
    if at_rest.factor > _WIDEST_AT_REST:
        yield (
            f"the stiffness at rest is uncertain by a factor of {_about(at_rest.factor)}. Missing: a longer hold, "
            "or lower frequencies"
        )


def _too_fast(record: Record, time_s: float) -> str:
    shortest = record.window_s[0]
    if isinstance(record, TimeRecord):
        return (
            f"a ramp of {record.ramp_s:.3g} s tells no time constant below {shortest:.3g} s, and the tissue has one "
            f"(about {_about(time_s)} s or shorter). Missing: a ramp of at most {_about(time_s)} s, or the complex modulus up to "
            f"{_hz(time_s)} Hz or more"
        )
    return (
        f"frequencies up to {record.frequency_hz[-1]:.3g} Hz tell no time constant below {shortest:.2g} s, and the tissue has one "
        f"(about {_about(time_s)} s or shorter). Missing: the complex modulus up to {_hz(time_s)} Hz or more"
    )


def _too_slow(record: Record, time_s: float) -> str:
    longest = record.window_s[1]
    if isinstance(record, TimeRecord):
        return (
            f"a hold of {record.hold_s:.3g} s tells no time constant above {longest:.3g} s, half of it, and the tissue still "
            f"relaxes at its end (time constant of about {_about(time_s)} s or longer): its stiffness at rest isn't known. "
            f"Missing: a hold of at least {_about(3 * max(time_s, record.hold_s))} s"
        )
    return (
        f"frequencies down to {record.frequency_hz[0]:.3g} Hz tell no time constant above {longest:.3g} s, and the tissue has one "
        f"(about {_about(time_s)} s or longer): its stiffness at rest isn't known. Missing: the complex modulus down to "
        f"{_about(1 / (6 * math.pi * time_s))} Hz or a relaxation with a hold of at least {_about(3 * time_s)} s"
    )


def _hz(time_s: float) -> str:
    return f"{1 / (2 * math.pi * time_s):.2g}"


def _about(value: float) -> str:
    """A number with one digit that counts."""
    return f"{float(f'{value:.1g}'):g}"
