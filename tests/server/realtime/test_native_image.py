"""Arrays as numba has them in memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numba import types
from numba.core.datamodel import default_manager

from palpate_server.realtime import native_image


class Unknown(NamedTuple):
    values: np.ndarray


def test_numba_keeps_an_array_in_memory_as_images_are_written() -> None:
    for dimensions in (1, 2, 3):
        model = default_manager[types.Array(types.float64, dimensions, "C")]
        assert model._fields == native_image.ARRAY_MEMBERS


def test_a_tuple_of_another_type_is_refused() -> None:
    with pytest.raises(TypeError, match="Unknown"):
        native_image.make_image(Unknown(np.zeros(3)))
