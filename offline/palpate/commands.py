"""The commands of the offline side. Each imports what it needs only when it runs."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import time
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from palpate import interrupts
from palpate.stages import stage_reporter

if TYPE_CHECKING:
    from palpate.scene.schema import Config
    from palpate.stage_cache import StageCache


def build() -> None:
    """Build a scene into a model file and say how accurate it is."""
    options = _build_options()

    with interrupts.ends_at_once():
        from palpate.files import check_output
        from palpate.model_file import save_model
        from palpate.report import accuracy_text
        from palpate.scene.schema import load_config, override_reduction

    tolerance = None if options.tolerance is None else parse_tolerance(options.tolerance)
    scene = override_reduction(load_config(options.scene), options.method, options.order, tolerance)
    if options.dry_run:
        _print_expectation(scene, options)
        return
    path = options.output or Path(f"{scene.name}.npz")
    inputs = [options.scene]
    if surface := getattr(scene.geometry, "file", None):
        inputs.append(options.scene.parent / surface)
    check_output(path, inputs)
    start = time.monotonic()
    with stage_reporter(to_stderr=options.json) as stages:
        stages("libraries")
        with interrupts.ends_at_once():
            from palpate.build import build_model
            from palpate.build_surface import build_surface_model

        build_scene = build_surface_model if scene.tool else build_model
        model = build_scene(scene, options.scene.parent, stages, chosen_cache(options))
        interrupts.check()
    save_model(model, path, inputs)
    seconds = time.monotonic() - start
    if options.json:
        print(json.dumps({"file": str(path), "seconds": seconds} | model.summary(), indent=2))
        return
    print(accuracy_text(model, options.verbose))
    print(f"\nwrote {path} ({path.stat().st_size / 2**20:.1f} MiB) in {seconds:.0f} s")


def _print_expectation(scene: Config, options: argparse.Namespace) -> None:
    with interrupts.ends_at_once():
        from palpate.expected import expectation_json, expectation_text
        from palpate.expected_surface import expected_surface_model

    folder = options.scene.parent
    if not scene.tool:
        print(
            json.dumps(expectation_json(scene, folder)) if options.json else expectation_text(scene, folder)
        )
        return
    with stage_reporter(to_stderr=options.json) as stages:
        expected = expected_surface_model(scene, folder, stages, chosen_cache(options))
    print(json.dumps(asdict(expected)) if options.json else expected.text())


def _build_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=build.__doc__)
    parser.add_argument("scene", type=Path, help="a TOML file such as configs/liver.toml")
    parser.add_argument(
        "--output", "-o", type=Path, metavar="FILE.npz", help="(default: NAME.npz of the scene)"
    )
    parser.add_argument(
        "--method",
        help="of the reduction: passive, tbr, tbr-band, hankel-optimal, modal or modal-static (default: the scene's)",
    )
    stop = parser.add_mutually_exclusive_group()
    stop.add_argument("--order", type=int, help="number of states of the reduced model")
    stop.add_argument(
        "--tolerance", help="largest relative force error in the haptic band, such as 0.02 or 2%%"
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="say how many nodes and how much memory, for a scene with contacts how much time too, and build nothing",
    )
    add_cache_options(parser)
    parser.add_argument("--verbose", action="store_true", help="all figures of the accuracy report")
    parser.add_argument(
        "--json", action="store_true", help="the report as JSON; progress goes to standard error"
    )
    return parser.parse_args()


def add_cache_options(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        help="folder for finished stages (default: palpate in $XDG_CACHE_HOME or ~/.cache; at most 8 GiB)",
    )
    where.add_argument("--no-cache", action="store_true", help="compute every stage, keep none")


def chosen_cache(options: argparse.Namespace) -> StageCache:
    """Raises OSError where the folder can't be made or written to."""
    from palpate.stage_cache import NO_CACHE, StageCache, default_folder

    return NO_CACHE if options.no_cache else StageCache.open(options.cache or default_folder())


def bank() -> None:
    """Build several scenes, such as materials or orders of one organ; stages that they share are computed once."""
    parser = argparse.ArgumentParser(description=bank.__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument(
        "--out", type=Path, default=Path("bank"), help="folder for the models, NAME.npz each (%(default)s)"
    )
    parser.add_argument(
        "--executor",
        default="processes",
        help="threads, processes or dask://ADDRESS of a Dask scheduler (%(default)s)",
    )
    parser.add_argument("--workers", type=int, default=2, help="at once, not with Dask (%(default)s)")
    add_cache_options(parser)
    parser.add_argument("--json", action="store_true", help="a line of JSON for each model as it is finished")
    options = parser.parse_args()
    if options.workers < 1:
        parser.error(f"--workers {options.workers}: expected at least 1")
    from palpate.bank import build_bank

    cache = chosen_cache(options)
    with stage_reporter(to_stderr=options.json) as stages:
        stages(f"{len(options.scenes)} scenes")
        for built in build_bank(options.scenes, options.out, cache, options.executor, options.workers):
            interrupts.check()
            if options.json:
                print(json.dumps(asdict(built) | {"path": str(built.path)}), flush=True)
            stages(f"{built.path}")
            stages.note(f"{built.n_states} states, force error in band {100 * built.error_in_band:.2g} %")


def parse_tolerance(text: str) -> float:
    """A relative error as `0.02` or `2%`. Raises ValueError."""
    try:
        return float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0)
    except ValueError:
        raise ValueError(
            f"--tolerance {text!r}: expected a fraction such as 0.02, or a percentage such as 2%"
        ) from None


def inspect() -> None:
    """Say what a model file holds and how accurate it is."""
    parser = argparse.ArgumentParser(description=inspect.__doc__)
    parser.add_argument("model", type=Path, metavar="MODEL.npz")
    parser.add_argument("--json", action="store_true", help="all figures, machine-readable")
    parser.add_argument("--verbose", action="store_true", help="all figures of the accuracy report")
    options = parser.parse_args()

    with interrupts.ends_at_once():
        from palpate.model_file import load_model
        from palpate.report import accuracy_text

    model = load_model(options.model)
    print(json.dumps(model.summary(), indent=2) if options.json else accuracy_text(model, options.verbose))


def surface() -> None:
    """Take the surface of one label of an image (NIfTI, NRRD, Inrimage): smooth, closed, with the label's volume, in m.
    x points to the patient's left, y to the back, z to the head; in an Inrimage along its own axes."""
    parser = argparse.ArgumentParser(description=surface.__doc__)
    parser.add_argument("image", type=Path, metavar="IMAGE", help=".nii, .nii.gz, .nrrd, .inr or .inr.gz")
    parser.add_argument("--label", type=int, required=True, metavar="N")
    parser.add_argument("--output", "-o", type=Path, metavar="OUT.ply", required=True)
    parser.add_argument(
        "--triangles", type=int, default=20_000, metavar="N", help="at most about so many (%(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="file and what was done as JSON")
    options = parser.parse_args()
    if not 100 <= options.triangles <= 1_000_000:
        parser.error(f"--triangles {options.triangles}: expected 100 to 1000000")
    _make_ply(
        "palpate.geometry.label_surface",
        "surface_file",
        options.image,
        options,
        options.label,
        options.triangles,
    )


def repair() -> None:
    """Mend a surface file until it bounds one body, and say what was changed: merged vertices, crumbs, holes, triangles
    that are double, flat, turned or intersecting. The unit stays the file's."""
    parser = argparse.ArgumentParser(description=repair.__doc__)
    parser.add_argument("surface", type=Path, metavar="IN", help="STL, OBJ, PLY, OFF, VTK or VTP")
    parser.add_argument("--output", "-o", type=Path, metavar="OUT.ply", required=True)
    parser.add_argument("--json", action="store_true", help="file and what was changed as JSON")
    options = parser.parse_args()
    _make_ply("palpate.geometry.repair", "repair_surface", options.surface, options)


def _make_ply(
    module: str, function: str, source: Path, options: argparse.Namespace, *arguments: object
) -> None:
    """Write the PLY file that module.function(source, *arguments) makes, and print the lines that it returns with it."""
    output: Path = options.output
    with stage_reporter(to_stderr=options.json) as stages:
        stages("libraries")
        with interrupts.ends_at_once():
            from palpate.files import check_output, write_atomically

            make = getattr(importlib.import_module(module), function)
        if output.suffix.lower() != ".ply":
            raise ValueError(f"{output}: expected a name that ends in .ply")
        check_output(output, [source])
        stages("surface")
        data, lines = make(source, *arguments)
    write_atomically(output, data, [source])
    if options.json:
        print(json.dumps({"file": str(output), "notes": lines}, indent=2))
    else:
        print(*lines, f"wrote {output}", sep="\n")


def fit() -> None:
    """Fit the material of a scene to measured records of a tissue, and say what they don't determine."""
    parser = argparse.ArgumentParser(
        description=fit.__doc__,
        epilog="Columns: time_s, strain, stress_pa; or time_s, displacement_m, force_n; or frequency_hz, storage_pa, loss_pa.",
    )
    parser.add_argument("records", type=Path, nargs="+", metavar="RECORD.csv", help="records of one tissue")
    parser.add_argument(
        "--length-m", type=positive, metavar="L", help="of a specimen pulled or pressed along it"
    )
    parser.add_argument("--area-m2", type=positive, metavar="A", help="of its cross section")
    parser.add_argument(
        "--tip-radius-m", type=positive, metavar="R", help="of a sphere pressed into a thick body"
    )
    parser.add_argument(
        "--partial",
        action="store_true",
        help="give what can be told also where a part of the material can't be",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="OUT.png", help="draw records, fit, residuals, loss tangent"
    )
    parser.add_argument("--json", action="store_true", help="all figures, machine-readable")
    options = parser.parse_args()
    with interrupts.ends_at_once():
        from palpate.files import check_output
        from palpate.fitting.picture import draw_tissue
        from palpate.fitting.records import Specimen, read_record
        from palpate.fitting.summary import material_toml, tissue_json, tissue_text
        from palpate.fitting.tissue import NotIdentifiable, fit_tissue
        from palpate.plots import require_matplotlib

    if options.picture:
        require_matplotlib()
        check_output(options.picture, options.records)
    specimen = Specimen(options.length_m, options.area_m2, options.tip_radius_m)
    try:
        tissue = fit_tissue([read_record(path, specimen) for path in options.records], options.partial)
    except NotIdentifiable as error:
        raise NotIdentifiable(f"{error}\n--partial gives what the records determine") from error
    if options.picture:
        draw_tissue(tissue, options.picture)
    if options.json:
        print(json.dumps(tissue_json(tissue), indent=2))
    else:
        print(tissue_text(tissue), "", material_toml(tissue), sep="\n")


def tissues() -> None:
    """List the tissues that a scene's `preset` may name, with what was measured of each and how much it varies."""
    parser = argparse.ArgumentParser(description=tissues.__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="all that is known of these (default: a table)"
    )
    parser.add_argument("--json", action="store_true", help="a list with all figures")
    options = parser.parse_args()
    from palpate.scene.tissues import TISSUES, tissue_json, tissue_text, tissues_text

    for name in options.names:
        if name not in TISSUES:
            raise ValueError(f"there is no tissue '{name}': expected one of {', '.join(TISSUES)}")
    if options.json:
        print(json.dumps([tissue_json(name) for name in options.names or TISSUES], indent=2))
    elif options.names:
        print(*(tissue_text(name) for name in options.names), sep="\n\n")
    else:
        print(tissues_text())


def positive(text: str) -> float:
    """A finite number above zero. Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number above zero")
    return value


def demo() -> None:
    """Build the liver unless it is built, serve it in a second process, touch it, and draw what was felt."""
    parser = argparse.ArgumentParser(description=demo.__doc__)
    parser.add_argument(
        "scene",
        type=Path,
        nargs="?",
        help="another scene, such as configs/liver.toml (default: a liver that a tool presses, slides over and leaves)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out"), help="folder for the model and the picture (%(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="how long to touch, 1 to 600 s (%(default)g)"
    )
    parser.add_argument("--view", action="store_true", help="then open it in the browser, until Ctrl-C")
    add_cache_options(parser)
    parser.add_argument("--verbose", action="store_true", help="all figures of the accuracy report")
    options = parser.parse_args()
    if not 1 <= options.seconds <= 600:
        parser.error(f"--seconds {options.seconds:g}: expected 1 to 600")
    with stage_reporter() as stages:
        stages("libraries")
        with interrupts.ends_at_once():
            from palpate.demo import run_demo, show
            from palpate.report import accuracy_text

            if options.view:
                importlib.import_module("viser")  # better to miss it now than after the build

        scene = options.scene or Path(str(files("palpate_configs") / "liver-demo.toml"))
        summary = run_demo(scene, options.out, options.seconds, stages, chosen_cache(options))
    print(accuracy_text(summary.model, options.verbose), *summary.lines(), sep="\n", flush=True)
    if options.view:
        show(summary.model_path)


def reproduce() -> None:
    """Regenerate the figures of BaniHani & De 2009, and three beyond them, each as a plot and a table."""
    parser = argparse.ArgumentParser(description=reproduce.__doc__)
    parser.add_argument(
        "--figure",
        type=int,
        action="append",
        default=[],
        metavar="N",
        help="2 to 16; again for more (default: all)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        help="folder for the page paper.md and its images (%(default)s)",
    )
    parser.add_argument("--quick", action="store_true", help="small node clouds, about a minute")
    options = parser.parse_args()
    with stage_reporter() as stages:
        stages("libraries")
        with interrupts.ends_at_once():
            from palpate_paper.reproduce import reproduce as regenerate

        written = regenerate(options.figure, options.out, options.quick, stages)
    for path in written:
        print(f"wrote {path}")
