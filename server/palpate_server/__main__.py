"""`python -m palpate_server MODEL.npz`: serve a reduced model until SIGINT or SIGTERM."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

# The loop's process has no use for a pool of linear algebra threads; to be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import zenoh

from palpate.model_file import ModelFileError, load_model
from palpate_server import wire
from palpate_server.arguments import index, need, positive
from palpate_server.realtime.safety import Limits, least_force_rate
from palpate_server.session import transport
from palpate_server.session.server import FASTEST_SURFACE_HZ, USUAL_SURFACE_HZ, serve

EXIT_REFUSED = 2


def main(arguments: Sequence[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # silent unless RUST_LOG says otherwise
    limits = Limits(
        options.max_force_n,
        options.max_force_rate_n_per_s,
        options.max_speed_m_per_s,
        options.workspace_m,
        0.0,
    )
    least = least_force_rate(limits.max_force_n)
    if limits.max_force_rate_n_per_s < least:
        print(
            f"palpate serve: --max-force-rate-n-per-s is {limits.max_force_rate_n_per_s:g}: expected at least "
            f"{least:g}, so that {limits.max_force_n:g} N can fade in time when a client is gone",
            file=sys.stderr,
        )
        return EXIT_REFUSED
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        keys = wire.Keys(options.session)
        model = load_model(options.model)
        models = options.models or options.model.parent
        if not models.is_dir():
            raise ValueError(f"--models {models}: no such folder")
        if options.black_box is not None:
            _prepare_folder("--black-box", options.black_box)
        if options.recordings is not None:
            need("mcap", "recorder", "palpate serve --recordings")
            _prepare_folder("--recordings", options.recordings)
        with transport.open_session(options.listen, options.zenoh_config) as session:
            where = options.zenoh_config or options.listen
            contacts = ", ".join(contact.name for contact in model.contacts)

            def announce() -> None:
                print(
                    f"serving {model.name} (order {model.order}, contacts: {contacts}) "
                    f"as {keys.prefix} on {where}; Ctrl-C stops",
                    flush=True,
                )

            serve(
                model,
                limits,
                session,
                keys,
                stop,
                announce,
                models,
                options.black_box,
                options.surface_hz,
                options.cpu,
                options.recordings,
            )
    except (OSError, ModelFileError, transport.TransportError, ValueError) as error:
        print(f"palpate serve: {error}", file=sys.stderr)
        return EXIT_REFUSED
    print("stopped", flush=True)
    return 0


def _prepare_folder(option: str, folder: Path) -> None:
    """Make a folder unless it is there. Raises ValueError when that can't be, or nothing may be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{option} {folder}: can't be made: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{option} {folder}: may not be written to")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="palpate serve",
        description="Serve a reduced tissue model over Zenoh: displacements in, forces out, 1000 times a second.",
        epilog="The messages are described in docs/wire.md. SIGINT and SIGTERM stop the server cleanly.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL.npz", help="model file made by `palpate build`")
    parser.add_argument(
        "--session",
        default="main",
        help="name in the key expressions palpate/SESSION/... (default: %(default)s)",
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--listen",
        metavar="ENDPOINT",
        default=transport.DEFAULT_ENDPOINT,
        help="Zenoh endpoint to listen on (default: %(default)s, this machine only)",
    )
    place.add_argument(
        "--zenoh-config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration (JSON5), used as it is: TLS, access control, routers",
    )
    parser.add_argument(
        "--models",
        type=Path,
        metavar="FOLDER",
        help="where clients may load other models from while the server runs (default: the folder of MODEL.npz)",
    )
    parser.add_argument(
        "--black-box",
        type=Path,
        metavar="FOLDER",
        help="write the last two seconds there after a fault, a stale input or a storm of limits",
    )
    parser.add_argument(
        "--recordings",
        type=Path,
        metavar="FOLDER",
        help="where clients may have the session recorded to (extra `recorder`; default: they may not)",
    )
    parser.add_argument(
        "--surface-hz",
        type=_surface_rate,
        default=USUAL_SURFACE_HZ,
        metavar="HZ",
        help="how often the surface is sent while somebody listens, up to 60 (default: %(default)s)",
    )
    parser.add_argument(
        "--cpu",
        type=index,
        metavar="N",
        help="keep the threads that run ticks on this processor (default: where the system puts them)",
    )
    limits = parser.add_argument_group("limits", "what no client can exceed, for each contact")
    limits.add_argument(
        "--max-force-n", type=positive, default=10.0, metavar="N", help="(default: %(default)s)"
    )
    limits.add_argument(
        "--max-force-rate-n-per-s",
        type=positive,
        default=2000.0,
        metavar="N/S",
        help="(default: %(default)s)",
    )
    limits.add_argument(
        "--max-speed-m-per-s",
        type=positive,
        default=1.0,
        metavar="M/S",
        help="of a tip (default: %(default)s)",
    )
    limits.add_argument(
        "--workspace-m",
        type=positive,
        default=0.1,
        metavar="M",
        help="longest displacement of a tip (default: %(default)s)",
    )
    return parser


def _surface_rate(text: str) -> float:
    value = positive(text)
    if value > FASTEST_SURFACE_HZ:
        raise argparse.ArgumentTypeError(f"{text} is above {FASTEST_SURFACE_HZ:g}")
    return value


if __name__ == "__main__":
    sys.exit(main())
