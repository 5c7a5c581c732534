"""Colors and their levels."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_view.colors import N_BANDS, TISSUE, band_colors, band_levels, color_at, nice_ceiling


@pytest.mark.parametrize(
    ("value", "ceiling"), [(1.0, 1.0), (1.01, 2.0), (0.0049, 0.005), (5e-4, 5e-4), (0.06, 0.1), (9.9, 10.0)]
)
def test_the_scale_ends_at_a_round_number(value: float, ceiling: float) -> None:
    assert nice_ceiling(value) == pytest.approx(ceiling)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_of_nothing_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        nice_ceiling(value)


def test_colors_begin_with_the_tissue_and_get_lighter() -> None:
    assert color_at(0.0) == TISSUE
    luminance = [np.dot(color_at(share), [0.2126, 0.7152, 0.0722]) for share in np.linspace(0, 1, 21)]
    assert (np.diff(luminance) > 0).all()


def test_every_band_has_a_color_and_a_level() -> None:
    levels = band_levels(0.01)
    assert len(band_colors()) == len(levels) == N_BANDS
    assert (np.diff(levels) > 0).all() and levels[0] > 0 and levels[-1] < 0.01
