"""`python -m palpate_server MODEL.npz`: serve a reduced model until a signal."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

# The server needs no pool of linear algebra threads. This must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import zenoh

from palpate.files import make_folder, printable
from palpate.model_file import ModelFileError, load_model
from palpate_client.arguments import failed, positive, positive_up_to
from palpate_client.wire import DEFAULT_ENDPOINT, DEFAULT_SESSION, Keys
from palpate_server.arguments import index, need
from palpate_server.coupling import models
from palpate_server.coupling.models import Model
from palpate_server.realtime.safety import Limits, least_force_rate
from palpate_server.session import log_limit, transport
from palpate_server.session.loading import accuracy_warnings
from palpate_server.session.server import (
    DEFAULT_RECORDINGS_BYTES,
    DEFAULT_SURFACE_HZ,
    MAX_SURFACE_HZ,
    ServerOptions,
    serve,
)

log = logging.getLogger("palpate_server")

EXIT_REFUSED = 2


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    log_limit.set_up()
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # silent unless RUST_LOG says otherwise
    stop = _stop_at_signals()
    try:
        keys = Keys(options.session)
        how = _server_options(options)
        model = load_model(options.model)
        for warning in accuracy_warnings(model):
            log.warning("%s", warning)
        with transport.open_session(options.listen, options.zenoh_config) as session:
            serve(model, session, keys, how, stop, lambda: _announce(model, keys, options))
    except (OSError, ModelFileError, transport.TransportError, ValueError) as error:
        return failed("palpate serve", error, EXIT_REFUSED)
    print("stopped", flush=True)
    return 0


def _stop_at_signals() -> threading.Event:
    """An event that SIGINT, SIGTERM and SIGHUP set; a hang-up that is ignored, as under nohup, stays ignored."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: stop.set())
    return stop


def _server_options(options: argparse.Namespace) -> ServerOptions:
    """The options as the server takes them. Raises ValueError for a limit that is too low and for a folder that can't be used."""
    limits = Limits(
        options.max_force_n,
        options.max_force_rate_n_per_s,
        options.max_speed_m_per_s,
        options.workspace_m,
        0.0,
    )
    least = least_force_rate(limits.max_force_n)
    if limits.max_force_rate_n_per_s < least:
        raise ValueError(
            f"--max-force-rate-n-per-s is {limits.max_force_rate_n_per_s:g}: expected at least "
            f"{least:g}, so that {limits.max_force_n:g} N can fade in time when a client is gone"
        )
    models = options.models or options.model.parent
    if not models.is_dir():
        raise ValueError(f"--models {models}: no such folder")
    if options.black_box is not None:
        _prepare_folder("--black-box", options.black_box)
    if options.recordings is not None:
        need("mcap", "recorder", "palpate serve --recordings")
        _prepare_folder("--recordings", options.recordings)
    return ServerOptions(
        limits,
        models,
        options.recordings,
        round(options.max_recordings_gb * 1e9),
        options.black_box,
        options.surface_hz,
        options.cpu,
        options.model.name if options.model.resolve().parent == models.resolve() else None,
    )


def _announce(model: Model, keys: Keys, options: argparse.Namespace) -> None:
    tools = ", ".join(tool.name for tool in models.tools_of(model))
    text = f"serving {model.name} (order {model.order}, tools: {tools}) as {keys.prefix}"
    print(printable(f"{text} on {options.zenoh_config or options.listen}; Ctrl-C stops"), flush=True)


def _prepare_folder(option: str, folder: Path) -> None:
    """Make a folder unless it exists. Raises ValueError if that fails or if the folder is not writable."""
    try:
        make_folder(folder)
    except OSError as error:
        raise ValueError(f"{option} {error}") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="palpate serve",
        description="Serve a reduced tissue model over Zenoh: positions in, forces out, 1000 times a second.",
        epilog="The messages are described in docs/wire.md. SIGINT, SIGTERM and SIGHUP stop the server cleanly.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL.npz", help="model file made by `palpate build`")
    parser.add_argument(
        "--session",
        default=DEFAULT_SESSION,
        help="name in the keys palpate/SESSION/... (default: %(default)s)",
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--listen",
        metavar="ENDPOINT",
        default=DEFAULT_ENDPOINT,
        help="Zenoh endpoint to listen on (default: %(default)s, this machine only)",
    )
    place.add_argument(
        "--zenoh-config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration (JSON5), used as it is: TLS, access control, routers",
    )
    _add_folders(parser)
    parser.add_argument(
        "--surface-hz",
        type=positive_up_to(MAX_SURFACE_HZ),
        default=DEFAULT_SURFACE_HZ,
        metavar="HZ",
        help=f"surfaces a second while somebody subscribes, up to {MAX_SURFACE_HZ:g} (default: %(default)s)",
    )
    parser.add_argument(
        "--cpu",
        type=index,
        metavar="N",
        help="keep the threads that run ticks on this processor (default: where the system puts them)",
    )
    _add_limits(parser.add_argument_group("limits", "what no client can exceed, for each tool"))
    return parser


def _add_folders(parser: argparse.ArgumentParser) -> None:
    for name, text in (
        ("--models", "folder that clients may load other models from (default: that of MODEL.npz)"),
        (
            "--black-box",
            "folder for the last two seconds of ticks after a fault, a lost or silent client, or a storm of limits",
        ),
        (
            "--recordings",
            "folder for recordings that clients ask for (extra `recorder`; default: no recordings)",
        ),
    ):
        parser.add_argument(name, type=Path, metavar="FOLDER", help=text)
    parser.add_argument(
        "--max-recordings-gb",
        type=positive,
        default=DEFAULT_RECORDINGS_BYTES / 1e9,
        metavar="GB",
        help="largest size of the folder of recordings (default: %(default)s)",
    )


def _add_limits(group: argparse._ArgumentGroup) -> None:
    for name, default, metavar, text in (
        ("--max-force-n", 10.0, "N", ""),
        ("--max-force-rate-n-per-s", 2000.0, "N/S", ""),
        ("--max-speed-m-per-s", 1.0, "M/S", "of a tip "),
        ("--workspace-m", 0.1, "M", "farthest that a tip moves from its start "),
    ):
        group.add_argument(
            name, type=positive, default=default, metavar=metavar, help=f"{text}(default: %(default)s)"
        )


if __name__ == "__main__":
    sys.exit(main())
