"""The command line: build a model, look into it, run it, touch it."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

if TYPE_CHECKING:
    from palpate.model_file import ReducedModel

app = typer.Typer(
    name="palpate",
    help="Feel soft tissue: build a reduced viscoelastic model, serve it at 1 kHz, touch it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)

# Options, --help among them, go to the program that is started.
PASS_THROUGH = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def main() -> None:
    """Entry point: mistakes of the user end in one line and exit code 2."""
    try:
        app()
    except (ValueError, OSError, MemoryError) as error:
        if os.environ.get("PALPATE_TRACEBACK"):
            raise
        errors.print("error:", style="bold red", end=" ")
        errors.print(str(error) or "out of memory", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)


def _version(asked: bool) -> None:
    if asked:
        console.print(f"palpate {version('palpate')}", highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Feel soft tissue: build a reduced viscoelastic model, serve it at 1 kHz, touch it."""


def parse_tolerance(text: str) -> float:
    """A relative error as `0.02` or `2%`. Raises ValueError."""
    try:
        value = float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0)
    except ValueError:
        raise ValueError(
            f"--tolerance {text!r}: expected a fraction such as 0.02, or a percentage such as 2%"
        ) from None
    if not 0 < value < 1:
        raise ValueError(f"--tolerance {text!r}: expected above 0 and below 1 (100%)")
    return value


@app.command()
def build(
    config: Annotated[Path, typer.Argument(help="Scene, a TOML file such as configs/liver.toml.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Model file; default: NAME.npz of the scene's name.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(help="tbr, tbr-band, hankel-optimal, modal or modal-static; default: the scene's."),
    ] = None,
    order: Annotated[int | None, typer.Option(help="Number of states of the reduced model.")] = None,
    tolerance: Annotated[
        str | None,
        typer.Option(help="Largest relative force error inside the haptic band, such as 0.02 or 2%."),
    ] = None,
) -> None:
    """Build a scene into a model file and print the report of its accuracy."""
    from palpate.files import check_output
    from palpate.model_file import save_model
    from palpate.scene.schema import load_config, override_reduction

    if order is not None and tolerance is not None:
        raise ValueError("--order and --tolerance exclude each other: expected at most one of them")
    scene = load_config(config)
    if method is not None or order is not None or tolerance is not None:
        wanted = None if tolerance is None else parse_tolerance(tolerance)
        scene = override_reduction(scene, method, order, wanted, "command line")
    path = output or Path(f"{scene.name}.npz")
    inputs = [config]
    check_output(path, inputs)
    start = time.monotonic()
    with stage_reporter() as report:
        from palpate.build import build_model

        model = build_model(scene, config.parent, report)
    save_model(model, path, inputs)
    print_accuracy(model)
    size = path.stat().st_size / 2**20
    console.print(
        f"wrote [bold]{path}[/] ({size:.1f} MiB) in {time.monotonic() - start:.0f} s", highlight=False
    )


@app.command()
def inspect(
    model: Annotated[Path, typer.Argument(help="Model file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable, on standard output.")] = False,
) -> None:
    """Say what a model file holds and how good it is."""
    from palpate.model_file import load_model

    loaded = load_model(model)
    if as_json:
        sys.stdout.write(json.dumps(loaded.summary(), indent=2) + "\n")
    else:
        print_accuracy(loaded)


@app.command(context_settings=PASS_THROUGH)
def serve(context: typer.Context) -> None:
    """Run a model file at 1 kHz over Zenoh (`palpate serve --help` for its options)."""
    _run_module("palpate_server", context.args)


@app.command(context_settings=PASS_THROUGH)
def record(context: typer.Context) -> None:
    """Record a running server's commands, forces and status to an MCAP file (`palpate record --help`)."""
    _run_module("palpate_server.recording.record", context.args)


@app.command(context_settings=PASS_THROUGH)
def replay(context: typer.Context) -> None:
    """Repeat a recording offline through a model and compare bit for bit (`palpate replay --help`)."""
    _run_module("palpate_server.recording.replay", context.args)


@app.command(name="check-host", context_settings=PASS_THROUGH)
def check_host(context: typer.Context) -> None:
    """Measure whether this machine can hold 1 kHz, and say what to change (`palpate check-host --help`)."""
    _run_module("palpate_server.diagnostics.check_host", context.args)


@app.command(context_settings=PASS_THROUGH)
def client(context: typer.Context) -> None:
    """Poke a running server and check every answer (`palpate client --help` for its options)."""
    _run_module("palpate_client.poke", context.args)


@app.command(context_settings=PASS_THROUGH)
def health(context: typer.Context) -> None:
    """Say whether a server is there and its loop runs (`palpate health --help` for its options)."""
    _run_module("palpate_client.health", context.args)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the model and the picture.")] = Path("out"),
    seconds: Annotated[float, typer.Option(help="How long to poke, s.", min=1, max=600)] = 5.0,
) -> None:
    """Build the liver unless it is built, serve it in a second process, poke it, and draw what was felt."""
    from palpate.demo import run_demo

    with stage_reporter() as report:
        summary = run_demo(Path(str(files("palpate_configs") / "liver.toml")), out, seconds, report)
    print_accuracy(summary.model)
    console.print("\n".join(summary.lines()), highlight=False, soft_wrap=True)


@app.command()
def reproduce(
    figure: Annotated[
        list[int] | None,
        typer.Option("--figure", help="Number of a figure, 2 to 16; again for more; default: all."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the page paper.md and its images.")] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Small node clouds, about a minute.")] = False,
) -> None:
    """Regenerate the figures of BaniHani & De 2009, and three beyond them, each as a plot and a table."""
    with stage_reporter() as report:
        report("libraries")
        from palpate_paper.reproduce import reproduce

        written = reproduce(figure or [], out, quick, report)
    for path in written:
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _run_module(module: str, arguments: list[str]) -> None:
    """Become a module of the server or the client: a process that shares nothing with the offline stage."""
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])


@contextmanager
def stage_reporter() -> Iterator[Stages]:
    """Progress of long work: each stage is shown while it runs, and with its time once it is done."""
    stages = Stages(console)
    try:
        yield stages
    except BaseException:
        stages.stop(failed=True)
        raise
    stages.stop()


class Stages:
    """Call it with a stage's name when the stage begins; `note` adds what came of it."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._status = console.status("")
        self._name: str | None = None
        self._note = ""
        self._start = 0.0

    def __call__(self, name: str) -> None:
        self.stop()
        self._name, self._note, self._start = name, "", time.monotonic()
        self._status.update(f"{name} ...")
        self._status.start()

    def note(self, text: str) -> None:
        self._note = text
        self._status.update(f"{self._name} ... {text}")

    def stop(self, failed: bool = False) -> None:
        self._status.stop()
        if self._name is not None:
            mark = "[red]✗[/]" if failed else "[green]✓[/]"
            elapsed = time.monotonic() - self._start
            note = f"  [dim]{self._note}[/]" if self._note else ""
            self._console.print(
                f"{mark} {elapsed:6.1f} s  {self._name}{note}", highlight=False, soft_wrap=True
            )
            self._name = None


def print_accuracy(model: ReducedModel) -> None:
    """The model and the report of its accuracy as a table."""
    from palpate.reduction.accuracy import warnings
    from palpate.report import accuracy_table

    console.print(accuracy_table(model))
    for warning in warnings(model):
        console.print(f"[yellow]{warning}[/]", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
