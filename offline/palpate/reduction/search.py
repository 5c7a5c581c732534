"""The smallest order that will do, where the error does not fall monotonously with the order."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Result = TypeVar("Result")


def smallest_order(
    orders: NDArray[np.intp], attempt: Callable[[int], Result | None]
) -> tuple[int, Result] | None:
    """The first of the ascending orders whose attempt succeeds: up a ladder of orders, then all on its last rung.

    attempt  gives what an order makes, or None where that is not good enough

    Rungs are 25 % apart. An order below the last failing rung may succeed by accident; it is not looked for.
    """
    below, rung = -1, 0
    while len(orders):
        if attempt(int(orders[rung])) is not None:
            for i in range(below + 1, rung + 1):
                result = attempt(int(orders[i]))
                if result is not None:
                    return int(orders[i]), result
        if rung == len(orders) - 1:
            break
        below, rung = rung, min(max(rung + 1, math.ceil(1.25 * rung)), len(orders) - 1)
    return None
