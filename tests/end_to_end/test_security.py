"""The worked example in configs/security: who gets a connection, and what it may do."""

from __future__ import annotations

import json
import re
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from mcap.reader import make_reader

from palpate.model import save_model
from palpate_server import wire
from palpate_server.round_trips import free_endpoint
from palpate_server.sample_model import spring_mass_model

EXAMPLE = Path(__file__).parents[2] / "configs" / "security"
CLIENT = Path(__file__).parents[2] / "client_examples" / "headless_client.py"
KEYS = wire.Keys("main")

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good ones and bad ones."""
    certificates = tmp_path_factory.mktemp("security") / "certificates"
    make_certificates(certificates)
    make_certificates(certificates, "second")
    make_bad_certificates(certificates)
    return certificates


@pytest.fixture(scope="module")
def folder(certificates: Path) -> Path:
    """The configurations as they are shipped, and a model."""
    folder = certificates.with_name("shipped")
    write_configurations(folder, certificates, (EXAMPLE / "server.json5").read_text())
    return folder


def write_configurations(folder: Path, certificates: Path, server: str) -> None:
    """A free port and the certificates' paths in place of the shipped ones; a model to serve with them."""
    endpoint = free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")

    def rewrite(text: str) -> str:
        assert "tls/localhost:7447" in text
        return text.replace("tls/localhost:7447", endpoint).replace("certificates/", f"{certificates}/")

    folder.mkdir()
    (folder / "server.json5").write_text(rewrite(server))
    client = rewrite((EXAMPLE / "client.json5").read_text())
    for name in ("operator", "observer", "recorder", "second", "foreign", "expired", "self_signed"):
        (folder / f"{name}.json5").write_text(client.replace("operator", name))
    lines = [line for line in client.splitlines() if "connect_private_key" not in line]
    nobody = "\n".join(line for line in lines if "connect_certificate" not in line)
    (folder / "nobody.json5").write_text(nobody.replace("enable_mtls: true", "enable_mtls: false"))
    (folder / "plain.json5").write_text(client.replace("tls/", "tcp/"))
    (folder / "servers_own.json5").write_text(client.replace("operator", "server"))
    save_model(spring_mass_model(), folder / "model.npz")


def make_certificates(folder: Path, *names: str) -> None:
    subprocess.run(["sh", str(EXAMPLE / "make_certificates.sh"), str(folder), *names], check=True, timeout=60)


def make_bad_certificates(ours: Path) -> None:
    """Three that say `operator` and have a key, but that our authority has not signed, or not for today."""
    theirs = ours.with_name("theirs")
    make_certificates(theirs, "operator")
    for suffix in ("key", "pem"):
        shutil.copy(theirs / f"operator.{suffix}", ours / f"foreign.{suffix}")
    for name, steps in {
        "expired": (
            "req -new -key expired.key -subj /CN=operator -addext subjectAltName=DNS:localhost -out expired.csr",
            "x509 -req -in expired.csr -copy_extensions copyall -CA authority.pem -CAkey authority.key"
            " -days -1 -out expired.pem",
        ),
        "self_signed": ("req -x509 -key self_signed.key -subj /CN=operator -out self_signed.pem",),
    }.items():
        shutil.copy(ours / "operator.key", ours / f"{name}.key")
        for step in steps:
            command = ["openssl", *step.split()]
            subprocess.run(command, cwd=ours, check=True, capture_output=True, timeout=60)


def with_a_second_operator(text: str) -> str:
    """What the comment in server.json5 says: a copy of the operator's rule, subject and policy with the other name."""
    blocks = r'\{[^{}]*"(?:operate as )?operator"[^{}]*\},\n'
    text, count = re.subn(blocks, lambda block: block[0] + block[0].replace("operator", "second"), text)
    assert count == 3
    return text


@contextmanager
def serving(folder: Path) -> Iterator[None]:
    arguments = (str(folder / "model.npz"), "--zenoh-config", str(folder / "server.json5"))
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_server", *arguments], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("serving")
        yield
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[None]:
    with serving(folder):
        yield


class Client:
    """A session with somebody's certificate, under any name, that keeps the forces and statuses it hears."""

    def __init__(self, folder: Path, certificate: str, name: str) -> None:
        self.name = name
        self.forces: list[dict[str, Any]] = []
        self.statuses: list[dict[str, Any]] = []
        self.sequence = 0
        self.session = zenoh.open(zenoh.Config.from_file(folder / f"{certificate}.json5"))
        for key, to in ((KEYS.force, self.forces), (KEYS.status, self.statuses)):
            self.session.declare_subscriber(key, _appender(to))
        self.token = self.session.liveliness().declare_token(KEYS.client(name))

    def __enter__(self) -> Client:
        try:
            wait_for(lambda: self.forces and self.statuses)
        except BaseException:
            self.session.close()  # or the program would hang at its end
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def control(self, action: str, request: dict[str, Any]) -> str:
        """ "ok", the reason of the server's refusal, or "" when the server did not answer: it was not asked."""
        for reply in self.session.get(
            KEYS.control(self.name, action), payload=wire.pack(request), timeout=1.0
        ):
            if reply.ok is not None:
                return "ok"
            if reply.err is not None and str(reply.err.encoding).startswith("application/msgpack"):
                return str(msgpack.unpackb(reply.err.payload.to_bytes())["reason"])
        return ""

    def acquire(self) -> str:
        return self.control("acquire", {"contacts": ["tip"]})

    def command(self, depth_m: float) -> None:
        self.sequence += 1
        displacement = {"tip": [0.0, 0.0, -depth_m]}
        command = {"sequence": self.sequence, "client_time_ns": 1, "displacement_m": displacement}
        self.session.put(KEYS.command(self.name), wire.pack(command))

    def next_status(self) -> dict[str, Any]:
        """One that was made after everything that the server has heard until now."""
        count = len(self.statuses)
        wait_for(lambda: len(self.statuses) >= count + 3)
        return self.statuses[-1]


def wait_for(condition: Callable[[], object]) -> None:
    give_up = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def _appender(to: list[dict[str, Any]]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: to.append(msgpack.unpackb(sample.payload.to_bytes()))


def assert_powerless(client: Client) -> None:
    """The server is not asked, its counters stay as they are, and the tool stays where it is."""
    before = client.next_status()
    first = len(client.forces)
    for action, request in (
        ("acquire", {"contacts": ["tip"]}),
        ("release", {}),
        ("limits", {"limits": {"max_force_n": 1.0}}),
        ("reset", {}),
        ("load", {"model": "model.npz"}),
        ("record", {}),
    ):
        assert client.control(action, request) == ""
    for _ in range(100):
        client.command(0.001)
    after = client.next_status()
    for counter in ("accepted", "refused", "malformed"):
        assert after[counter] == before[counter]
    assert after["contacts"] == before["contacts"]
    assert not any(any(message["displacement_m"][0]) for message in client.forces[first:])


def run_client(folder: Path, who: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(CLIENT), "--zenoh-config", str(folder / f"{who}.json5"), "--name", who]
    return subprocess.run(
        [*command, "--duration-s", "1", "--json"], capture_output=True, text=True, timeout=60
    )


@pytest.mark.usefixtures("server")
def test_an_operator_moves_the_tool_and_feels_it(folder: Path) -> None:
    done = run_client(folder, "operator")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["commands_answered"] > 0
    assert summary["largest_force_n"] > 0


@pytest.mark.usefixtures("server")
@pytest.mark.parametrize("who", ["nobody", "plain", "foreign", "expired", "self_signed", "servers_own"])
def test_without_a_certificate_of_our_authority_nothing_is_read_and_nothing_moved(
    folder: Path, who: str
) -> None:
    done = run_client(folder, who)
    assert done.returncode == 2
    assert "palpate client:" in done.stderr

    with pytest.raises(zenoh.ZError):  # there is not even a session in which to listen
        zenoh.open(zenoh.Config.from_file(folder / f"{who}.json5")).close()


@pytest.mark.usefixtures("server")
@pytest.mark.parametrize(
    ("certificate", "name"),
    [
        ("observer", "observer"),
        ("observer", "operator"),
        ("recorder", "recorder"),
        ("recorder", "operator"),
        ("operator", "other"),
    ],
)
def test_who_is_no_operator_of_that_name_hears_forces_but_cannot_move_the_tool(
    folder: Path, certificate: str, name: str
) -> None:
    with Client(folder, certificate, name) as client:
        assert_powerless(client)


@pytest.mark.usefixtures("server")
def test_a_certificate_of_ours_with_an_unknown_name_hears_nothing(folder: Path) -> None:
    with Client(folder, "operator", "operator") as operator:
        stranger = Client(folder, "second", "second")
        try:
            operator.next_status()
            operator.next_status()
            assert not stranger.forces
            assert not stranger.statuses
            assert stranger.acquire() == ""
        finally:
            stranger.session.close()


def handshake(folder: Path, certificates: Path) -> None:
    """With the server of a folder, by Python's own TLS. Raises ssl.SSLError."""
    (endpoint,) = re.findall(r"tls/localhost:(\d+)", (folder / "server.json5").read_text())
    context = ssl.create_default_context(cafile=certificates / "authority.pem")
    context.load_cert_chain(certificates / "operator.pem", certificates / "operator.key")
    with (
        socket.create_connection(("localhost", int(endpoint)), timeout=10) as plain,
        context.wrap_socket(plain, server_hostname="localhost"),
    ):
        pass


@pytest.mark.usefixtures("server")
def test_a_clients_certificate_is_not_taken_for_the_servers(folder: Path, certificates: Path) -> None:
    handshake(folder, certificates)  # the real one

    posing = certificates.with_name("posing")
    server = (EXAMPLE / "server.json5").read_text()
    write_configurations(posing, certificates, server.replace("/server.", "/observer."))
    with serving(posing):
        with pytest.raises(ssl.SSLCertVerificationError):
            handshake(posing, certificates)
        done = run_client(posing, "operator")
    assert done.returncode == 2
    assert not done.stdout  # it heard nothing, and rendered nothing
    assert "nothing answers" in done.stderr


@pytest.mark.usefixtures("server")
def test_a_recorder_records_the_commands_of_an_operator(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "session.mcap"
    options = (str(out), "--zenoh-config", str(folder / "recorder.json5"))
    recorder = subprocess.Popen(
        [sys.executable, "-m", "palpate_server.record", *options], stdout=subprocess.PIPE, text=True
    )
    try:
        assert recorder.stdout is not None
        assert recorder.stdout.readline().startswith("recording")
        time.sleep(0.5)  # until the server knows that it listens
        done = run_client(folder, "operator")
        assert done.returncode == 0, done.stderr
        recorder.terminate()
        assert recorder.wait(20) == 0
    finally:
        recorder.kill()
        recorder.communicate()
    with out.open("rb") as stream:
        topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    answered = json.loads(done.stdout)["commands_answered"]
    assert answered > 0
    assert topics.count(KEYS.command("operator")) >= answered // 2  # best effort, on a busy machine


@pytest.mark.usefixtures("server")
def test_nobody_hears_an_observer(folder: Path) -> None:
    with (
        Client(folder, "operator", "operator") as operator,
        Client(folder, "observer", "observer") as observer,
    ):
        gone: list[zenoh.Sample] = []
        changes = operator.session.liveliness().declare_subscriber(KEYS.server, gone.append)
        for key in (KEYS.force, KEYS.status, KEYS.surface, KEYS.command("operator")):
            for _ in range(10):
                observer.session.put(key, wire.pack({"forged": True}))
        observer.session.liveliness().declare_token(KEYS.server).undeclare()
        before = operator.next_status()
        after = operator.next_status()
        assert not any("forged" in message for message in operator.forces + operator.statuses)
        assert after["malformed"] == before["malformed"]
        assert not gone
        changes.undeclare()


@pytest.mark.usefixtures("server")
def test_an_observer_cannot_keep_an_operators_lease(folder: Path) -> None:
    with Client(
        folder, "observer", "operator"
    ) as observer:  # its token, too, is on palpate/main/client/operator
        with Client(folder, "operator", "operator") as operator:
            assert operator.acquire() == "ok"
            assert operator.next_status()["contacts"]["tip"]["holder"] == "operator"
        wait_for(lambda: observer.statuses[-1]["contacts"]["tip"]["holder"] is None)


def test_two_operators_act_each_under_its_own_name(certificates: Path) -> None:
    folder = certificates.with_name("two")
    server = (EXAMPLE / "server.json5").read_text()
    write_configurations(folder, certificates, with_a_second_operator(server))
    with (
        serving(folder),
        Client(folder, "operator", "operator") as first,
        Client(folder, "second", "second") as second,
    ):
        with Client(folder, "second", "operator") as pretender:
            assert_powerless(pretender)
        assert first.acquire() == "ok"
        assert second.acquire() == "held"
        assert first.control("release", {}) == "ok"
        assert second.acquire() == "ok"
        second.command(0.001)
        wait_for(lambda: any(second.forces[-1]["displacement_m"][0]))
