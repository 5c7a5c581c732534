"""what the records don't determine of a material, and which data would."""

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
    records: Sequence[Record],
    at_rest: Interval,
    branches: Sequence[tuple[Interval, Interval]],
    relaxes_beyond: tuple[bool, bool],
) -> Iterator[str]:
    """A sentence for each thing that can't be identified.

    branches        (strength, time constant, s) of each that was fitted
    relaxes_beyond  whether the records show relaxation faster than the fastest of them tells, and slower, without a branch
    """
    fastest = min(records, key=lambda r: r.window_s[0])
    slowest = max(records, key=lambda r: r.window_s[1])
    shortest, longest = fastest.window_s[0], slowest.window_s[1]
    fast = [t for _, t in branches if t.value < shortest and (t.high < shortest or t.factor > _WIDEST)]
    slow = [t for _, t in branches if t.value > longest or t.high > 2 * longest]
    if fast or relaxes_beyond[0]:
        yield _too_fast(fastest, fast[0] if fast else None)
    if slow or relaxes_beyond[1]:
        yield _too_slow(slowest, slow[-1] if slow else None)
        return  # what follows is relative to the stiffness at rest
    for strength, time in branches:
        between = shortest < time.value < longest and not tells(records, time.value)
        widest = max(strength.factor, time.factor)
        if between:
            yield (
                f"a branch has a time constant of about {time.value:.2g} s, in a gap between the records. "
                f"Missing: the complex modulus around {_hz(time.value)} Hz"
            )
        elif widest > _WIDEST and time not in fast:
            yield (
                f"the branch of about {time.value:.2g} s is uncertain: its strength or time constant may be wrong by a "
                f"factor of {_about(widest)}. Missing: less noise, or more values around {time.value:.2g} s or {_hz(time.value)} Hz"
            )
    if at_rest.factor > _WIDEST_AT_REST:
        yield (
            f"the stiffness at rest is uncertain by a factor of {_about(at_rest.factor)}. Missing: a longer hold, "
            "or lower frequencies"
        )


def _too_fast(record: Record, time: Interval | None) -> str:
    shortest = record.window_s[0]
    is_told = time is not None and time.factor <= _WIDEST
    constant = (
        f"a time constant of about {_about(time.value)} s" if time and is_told else "how fast, can't be told"
    )
    needed = time.value if time and is_told else 0.1 * shortest
    if isinstance(record, TimeRecord):
        return (
            f"a ramp of {record.ramp_s:.3g} s does not determine a time constant below {shortest:.3g} s, and the tissue relaxes faster "
            f"than that, too ({constant}). Missing: a ramp of at most {_about(needed)} s, or the complex modulus up to "
            f"{_hz(needed)} Hz"
        )
    return (
        f"frequencies up to {record.frequency_hz[-1]:.3g} Hz tell no time constant below {shortest:.2g} s, and the tissue relaxes "
        f"faster than that, too ({constant}). Missing: the complex modulus up to {_hz(needed)} Hz"
    )


def _too_slow(record: Record, time: Interval | None) -> str:
    longest = record.window_s[1]
    is_told = time is not None and time.factor <= _WIDEST
    constant = (
        f"a time constant of about {_about(time.value)} s"
        if time and is_told
        else "how slowly, can't be told"
    )
    # Three time constants relax all but 5 % of the branch.
    needed = 3 * time.value if time and is_told else 20 * longest
    if isinstance(record, TimeRecord):
        return (
            f"a hold of {record.hold_s:.3g} s does not determine a time constant above {longest:.3g} s, half of it, and the tissue still "
            f"relaxes at its end ({constant}): its stiffness at rest isn't known. Missing: a hold of at least {_about(needed)} s"
        )
    return (
        f"frequencies down to {record.frequency_hz[0]:.3g} Hz tell no time constant above {longest:.3g} s, and the tissue relaxes "
        f"slower than that, too ({constant}): its stiffness at rest isn't known. Missing: the complex modulus down to "
        f"{_about(1 / (2 * math.pi * needed))} Hz, or a relaxation with a hold of at least {_about(needed)} s"
    )


def _hz(time_s: float) -> str:
    return f"{1 / (2 * math.pi * time_s):.2g}"


def _about(value: float) -> str:
    """A number with one digit that counts."""
    return f"{float(f'{value:.1g}'):g}"
