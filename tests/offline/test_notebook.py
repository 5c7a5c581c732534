"""The functions for notebooks: the code of docs/notebook.md on a small body, and that a picture shows what it says."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from notebook_figures import figures

from palpate import notebook
from palpate.build import build_full_model, build_model
from palpate.model_file import ReducedModel, SurfaceModel, save_model
from palpate.scene.schema import load_config

PAGE = (Path(__file__).parents[2] / "docs" / "notebook.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, slab_scene):
    """What the page's code finds: a scene and its model."""
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "my-organ.toml").write_text(
        slab_scene(more="[reduction]\ntolerance = 0.01\nband_hz = [0.0, 20.0]\n")
    )
    (folder / "configs").mkdir()
    model = build_model(load_config(folder / "my-organ.toml"), folder)
    save_model(model, folder / "configs" / "liver.npz")
    return folder, model


def test_the_code_of_the_page_draws_every_picture(folder, make_surface_model, monkeypatch):
    where, _ = folder
    monkeypatch.chdir(where)
    save_model(make_surface_model(), where / "liver-surface.npz")
    drawn = figures("\n".join(BLOCKS))
    plots = {name for name in vars(notebook) if name.startswith("plot_")}
    assert set(drawn) == plots
    for figure in drawn.values():
        assert figure.axes
        figure.savefig(where / "figure.png")


def test_a_held_press_relaxes_to_the_stiffness_at_rest(folder):
    _, model = folder
    pressed = notebook.press(model, depth_m=0.002, hold_s=20.0)
    normal = np.asarray(model.contacts[0].normal)
    at_rest = 0.002 * normal @ model.static_stiffness[:3, :3] @ normal
    assert pressed.force_n[-1] == pytest.approx(at_rest, rel=1e-3)
    assert np.max(pressed.force_n) > 1.2 * at_rest
    assert pressed.time_s[-1] == pytest.approx(20.1)
    with pytest.raises(ValueError, match="contact = 1"):
        notebook.press(model, depth_m=0.002, contact=1)
    with pytest.raises(ValueError, match="ramp_s = 0"):
        notebook.press(model, depth_m=0.002, ramp_s=0.0)


def test_a_tool_pressed_into_a_surface_model_is_pushed_out_the_more_the_deeper_and_the_tissue_relaxes(
    make_surface_model,
):
    model = make_surface_model()
    deep, shallow = (notebook.press(model, depth_m=depth, hold_s=2.0) for depth in (0.002, 0.001))
    for pressed in (deep, shallow):
        assert pressed.force_n[0] == 0
        assert 0 < pressed.force_n[-1] < np.max(pressed.force_n)
    assert deep.force_n[-1] > 2 * shallow.force_n[-1]
    with pytest.raises(ValueError, match="contact = 9"):
        notebook.press(model, depth_m=0.001, contact=9)


def test_the_response_that_runs_is_the_full_ones_in_the_band(folder):
    _, model = folder
    full, running = (line.get_xydata() for line in notebook.plot_response(model).axes[0].lines)
    in_band = full[:, 0] <= model.accuracy.band_hz[1]
    np.testing.assert_allclose(
        running[in_band, 1], full[in_band, 1], rtol=1.01 * model.accuracy.error_in_band
    )


def test_errors_fall_with_the_order_and_are_missing_where_there_is_no_model(folder):
    where, _ = folder
    config = load_config(where / "my-organ.toml")
    full = build_full_model(config, where)
    (errors,) = notebook.error_against_order(
        full, ["tbr-band"], [0, 10, 60], config.reduction.band_hz
    ).values()
    assert np.isnan(errors[0])
    assert errors[2] < 0.1 * errors[1]


def test_a_notebook_shows_models_and_figures(folder, make_surface_model):
    formatters = {kind: {} for kind in ("text/html", "image/png")}
    shell = SimpleNamespace(
        display_formatter=SimpleNamespace(
            formatters={
                kind: SimpleNamespace(for_type=known.__setitem__) for kind, known in formatters.items()
            }
        )
    )
    notebook.load_ipython_extension(shell)
    _, model = folder
    assert "verdict" in formatters["text/html"][ReducedModel](model)
    assert "points to touch" in formatters["text/html"][SurfaceModel](make_surface_model())
    assert formatters["image/png"][Figure](notebook.plot_response(model)).startswith(b"\x89PNG")


def test_the_response_of_a_surface_model_is_refused(make_surface_model):
    with pytest.raises(ValueError, match=r"is a surface model: plot_response expects"):
        notebook.plot_response(make_surface_model())
