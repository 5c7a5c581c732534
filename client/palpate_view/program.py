"""See and touch a running server in the browser: the organ deforms live, and the mouse or a finger is a device.

The page is served on this machine alone, unless --host opens it to a network. Exit code 0: stopped by a signal or Ctrl-C. 2: it
could not start.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import ipaddress
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Sequence
from typing import Any

import viser
import zenoh
from viser._messages import RunJavascriptMessage

from palpate_client import ClientError, Connection, ServerGone
from palpate_client.arguments import add_connection_options, connection_for
from palpate_view.panels import Panels
from palpate_view.session import Session

DEFAULT_PORT = 8080
RETRY_S = 1.0
_TOLD_S = 6.0
# Ends a drag when the page is hidden or closed. The server would see the closed connection about 0.1 s later: the browser ends the
# thread that has it first. On a phone, folds the controls, which would cover the organ; viser has no message for that.
_SCRIPT = """
if (!window.palpateEndDrag) {
  window.palpateEndDrag = () => window.dispatchEvent(new Event("blur"));
  window.addEventListener("pagehide", window.palpateEndDrag);
  document.addEventListener("visibilitychange", () => { if (document.hidden) window.palpateEndDrag(); });
  const narrow = window.matchMedia("(max-width: 36em)");
  const fold = () => {
    if (!narrow.matches) return;
    const papers = [...document.querySelectorAll(".mantine-Paper-root")];
    const sheet = papers.find(e => e.style.position === "fixed" && e.style.bottom === "0px");
    const handle = sheet?.querySelector('[style*="cursor: pointer"]');
    if (handle) handle.click(); else setTimeout(fold, 100);
  };
  narrow.addEventListener("change", () => setTimeout(fold, 100));
  fold();
}
"""


class Page(viser.ViserServer):
    """viser's server, without its tunnel: a page can't have it published on the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class View:
    """The page, and the session that it shows."""

    def __init__(self, host: str, port: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # viser greets; `main` says where the page is
            self.page = Page(host, port, label="palpate", verbose=False)
        self.page.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(70, 150, 200)
        )
        self.panels = Panels(self.page.gui)
        self.session: Session | None = None
        self.page.on_client_connect(self._opened)
        self.page.on_client_disconnect(self._closed)
        self.panels.tool.on_update(self._choose)
        self.panels.load.on_click(self._load)
        self.panels.record.on_click(self._record)

    def show(self, options: argparse.Namespace, connection: Connection, stop: threading.Event) -> None:
        """Show a connection's session until it shows another model. Raises ServerGone."""

        def connect(name: str) -> Connection:
            return Connection(options.connect, options.session, zenoh_config=options.zenoh_config, name=name)

        self.session = Session(self.page, self.panels, connection, connect, self.tell)
        try:
            self.session.run(stop)
        finally:
            self.session = None
            self.panels.show_no_server()

    def tell(self, text: str, page: int | None = None) -> None:
        """Show a message on a page, or on all."""
        for client in self.page.get_clients().values():
            if page in (None, client.client_id):
                client.add_notification("palpate", text, auto_close_seconds=_TOLD_S)

    async def _opened(self, client: viser.ClientHandle) -> None:
        # viser has no public way to this message of its own.
        client._websock_connection.queue_message(RunJavascriptMessage(_SCRIPT))
        if session := self.session:
            session.frame_organ(client)

    async def _closed(self, client: viser.ClientHandle) -> None:
        if session := self.session:
            session.page_closed(client.client_id)

    def _choose(self, _: Any) -> None:
        if session := self.session:
            session.choose_tool(self.panels.tool.value)

    def _load(self, event: Any) -> None:
        if session := self.session:
            session.load(event.client_id, self.panels.model.value, self.panels.stiffness.value)

    def _record(self, event: Any) -> None:
        if session := self.session:
            session.record(event.client_id)


def main(arguments: Sequence[str] | None = None) -> int:
    options = parse_options(arguments)
    zenoh.init_log_from_env_or("off")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, lambda *_: stop.set())
    try:
        require_host(options.host)
        connection = connection_for(options)
        with connection:
            view = View(options.host, options.port)
            url = page_url(options.host, view.page.get_port())
            print(f"palpate view: {url} shows {connection.keys.prefix}; Ctrl-C stops", flush=True)
            if options.open:
                webbrowser.open(url)
            with contextlib.suppress(ServerGone):
                view.show(options, connection, stop)
    except (ClientError, OSError, ValueError) as error:
        print(f"palpate view: {error}", file=sys.stderr)
        return 2
    try:
        show_again(view, options, stop)
    finally:
        view.page.stop()
    return 0


def show_again(view: View, options: argparse.Namespace, stop: threading.Event) -> None:
    """Show the session of each server that comes, and each model that it runs, until `stop` is set."""
    told = False
    while not stop.is_set():
        try:
            with connection_for(options) as connection:
                told = False
                view.show(options, connection, stop)
        except ClientError as error:
            if not told:
                view.tell(str(error))
                print(f"palpate view: {error}; waiting for a server", file=sys.stderr)
                told = True
            stop.wait(RETRY_S)


def page_url(host: str, port: int) -> str:
    """Where a page that is served from an IP address is found on this machine."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def require_host(host: str) -> None:
    """Raises OSError where this machine can't serve at an address: viser would wait for ever."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, 0), family=family).close()
    except OSError as error:
        raise OSError(f"--host: {host} can't be served from: {error.strerror}") from error


def port(text: str) -> int:
    number = int(text)
    if not 1 <= number <= 65_535:
        raise argparse.ArgumentTypeError(f"{number}: expected a port from 1 to 65535")
    return number


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="palpate view", description=(__doc__ or "").split("\n\n")[0])
    add_connection_options(parser)
    parser.add_argument(
        "--port",
        type=port,
        default=DEFAULT_PORT,
        help="of the page, or the next free one (%(default)s)",
    )
    parser.add_argument(
        "--host",
        type=address,
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where the page is served, such as 0.0.0.0 for all networks; it has no password (%(default)s)",
    )
    parser.add_argument("--open", action="store_true", help="open it in the browser of this machine")
    options = parser.parse_args(arguments)
    if not ipaddress.ip_address(options.host).is_loopback:
        print(
            f"palpate view: warning: the page on {options.host} has no password and no encryption: whoever reaches it "
            "sees the session and can move its tools",
            file=sys.stderr,
        )
    return options


def address(text: str) -> str:
    """An IP address of this machine. Raises argparse.ArgumentTypeError."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no IP address, such as 127.0.0.1 or 0.0.0.0") from None


if __name__ == "__main__":
    sys.exit(main())
