"""The worked example in configs/security: who gets a connection, and what it may do."""

from __future__ import annotations

import json
import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.model_file import save_model
from palpate_client.local_server import free_endpoint
from palpate_client.wire import Keys, pack
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.recording.replay import read_recording

EXAMPLE = Path(__file__).parents[2] / "configs" / "security"
KEYS = Keys("main")

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


@pytest.fixture(scope="module")
def serve_folder(start_for_module: Callable[..., Any]) -> Callable[[Path], None]:
    def serve_folder(folder: Path) -> None:
        options = (folder / "model.npz", "--zenoh-config", folder / "server.json5")
        options += ("--recordings", folder / "recordings")
        start_for_module("-m", "palpate_server", *options, ready="serving")

    return serve_folder


@pytest.fixture(scope="module")
def server(serve_folder: Callable[[Path], None], folder: Path) -> None:
    serve_folder(folder)


@pytest.fixture
def connect_as(connect: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    """A client with somebody's certificate, under any name."""

    def connect_as(certificate: str, name: str = "", folder: Path = folder) -> Any:
        return connect(folder / f"{certificate}.json5", name=name or certificate, server="main")

    return connect_as


@pytest.fixture
def run_client(start: Callable[..., Any]) -> Callable[[Path, str], Any]:
    def run_client(folder: Path, who: str) -> Any:
        options = ("--zenoh-config", folder / f"{who}.json5", "--name", who, "--silence-s", "30")
        return start("-m", "palpate_client.poke", *options, "--duration-s", "1", "--json")

    return run_client


def assert_powerless(client: Any) -> None:
    """The server is not asked, its counters stay as they are, and the tool stays where it is."""
    before = client.status_when(
        lambda status: (
            status["tools"]["tip"]["holder"] is None and status["tools"]["tip"]["success_rate"] == 0
        ),
        "nobody at the tool",
    )
    first = len(client.forces)
    for action, request in (
        ("acquire", {"tools": ["tip"]}),
        ("release", {}),
        ("limits", {"limits": {"max_force_n": 1.0}}),
        ("reset", {}),
        ("load", {"file": "model.npz"}),
        ("record", {"file": None}),
    ):
        with pytest.raises(TimeoutError):
            client.control(action, **request)
    for _ in range(100):
        client.command({"tip": [0.0, 0.0, -0.001]})
    assert client.query("describe")[
        0
    ]  # on the same link, and behind the commands: they have come as far as they do
    after = client.next_status()
    for counter in ("accepted", "refused", "malformed"):
        assert after[counter] == before[counter]
    assert after["tools"] == before["tools"]
    assert not any(any(message["position_m"][0]) for message in client.forces[first:])


@pytest.mark.usefixtures("server")
def test_an_operator_moves_the_tool_and_feels_it(folder: Path, run_client: Callable[..., Any]) -> None:
    code, out, err = run_client(folder, "operator").finish()
    assert code == 0, err
    summary = json.loads(out)
    assert summary["commands_answered"] > 0
    assert summary["largest_force_n"] > 0


@pytest.mark.usefixtures("server")
def test_without_a_certificate_of_our_authority_nothing_is_read_and_nothing_moved(
    folder: Path, run_client: Callable[..., Any]
) -> None:
    everybody = ("nobody", "plain", "foreign", "expired", "self_signed", "servers_own")
    for client in [run_client(folder, who) for who in everybody]:
        code, out, err = client.finish()
        assert code == 2
        assert not out
        # There is not even a session in which to listen.
        assert err.startswith("palpate client: nothing answers at"), client.process.args


@pytest.mark.usefixtures("server")
@pytest.mark.parametrize(
    ("certificate", "name"),
    [
        ("observer", "observer"),
        ("observer", "operator"),
        ("recorder", "operator"),
        ("operator", "other"),
    ],
)
def test_who_is_no_operator_of_that_name_hears_forces_but_cannot_move_the_tool(
    connect_as: Callable[..., Any], certificate: str, name: str
) -> None:
    with connect_as(certificate, name) as client:
        assert_powerless(client)


@pytest.mark.usefixtures("server")
def test_a_certificate_of_ours_with_an_unknown_name_hears_nothing(connect_as: Callable[..., Any]) -> None:
    with connect_as("operator") as operator:
        stranger = connect_as("second")
        stranger.open()
        try:
            for _ in range(3):
                operator.next_status()
            assert not stranger.forces
            assert not stranger.statuses
            with pytest.raises(TimeoutError):
                stranger.acquire("tip")
        finally:
            stranger.close()


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
def test_a_clients_certificate_is_not_taken_for_the_servers(
    folder: Path,
    certificates: Path,
    serve_folder: Callable[[Path], None],
    run_client: Callable[..., Any],
) -> None:
    handshake(folder, certificates)  # the real one

    posing = certificates.with_name("posing")
    server = (EXAMPLE / "server.json5").read_text()
    write_configurations(posing, certificates, server.replace("/server.", "/observer."))
    serve_folder(posing)
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(posing, certificates)
    code, out, err = run_client(posing, "operator").finish()
    assert code == 2
    assert not out  # it heard nothing, and rendered nothing
    assert "nothing answers" in err


@pytest.mark.usefixtures("server")
def test_a_recorder_has_the_server_record_and_may_do_nothing_else(
    folder: Path,
    start: Callable[..., Any],
    run_client: Callable[..., Any],
    connect_as: Callable[..., Any],
) -> None:
    options = ("session.mcap", "--zenoh-config", folder / "recorder.json5", "--name", "recorder")
    recorder = start("-m", "palpate_server.recording.record", *options, ready="recording")
    code, _, err = run_client(folder, "operator").finish()
    assert code == 0, err
    assert recorder.stop() == 0
    assert np.any(read_recording(folder / "recordings" / "session.mcap").ports["force_n"])
    with connect_as("recorder") as client, pytest.raises(TimeoutError):
        client.acquire("tip")


@pytest.mark.usefixtures("server")
def test_nobody_hears_an_observer(connect_as: Callable[..., Any]) -> None:
    with connect_as("operator") as operator, connect_as("observer") as observer:
        gone: list[zenoh.Sample] = []
        changes = operator.session.liveliness().declare_subscriber(KEYS.server, gone.append)
        before = operator.next_status()
        for key in (KEYS.force, KEYS.status, KEYS.surface, KEYS.command("operator")):
            for _ in range(10):
                observer.session.put(key, pack({"forged": True}))
        observer.session.liveliness().declare_token(KEYS.server).undeclare()
        assert observer.query("describe")[0]  # behind all that, on the same link
        after = operator.next_status()
        assert not any("forged" in message for message in operator.forces + operator.statuses)
        assert after["malformed"] == before["malformed"]
        assert not gone
        changes.undeclare()


@pytest.mark.parametrize("number", [500, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("server")
def test_an_observer_that_declares_thousands_of_keys_costs_an_operator_nothing(
    connect_as: Callable[..., Any], assert_ticks_went_on: Callable[..., None], number: int
) -> None:
    with connect_as("operator") as operator, connect_as("observer") as observer:
        assert operator.acquire("tip")[0]
        with operator.pressing({"tip": [0.0, 0.0, -0.001]}):
            operator.force_when(lambda force: force["force_scale"][0] == 1, "the force in full")
            before = operator.next_status()
            declared = [
                observer.session.declare_subscriber(f"palpate/x{i}/force", lambda sample: None)
                for i in range(number)
            ]
            tokens = [
                observer.session.liveliness().declare_token(f"palpate/main/client/x{i}")
                for i in range(number)
            ]
            assert observer.query("describe")[0]  # behind the declarations, on the same link
            after = operator.next_status()
        assert len(declared) == len(tokens) == number
        assert after["tools"]["tip"]["holder"] == "operator"
        assert_ticks_went_on(before, after)


@pytest.mark.usefixtures("server")
def test_an_observer_cannot_keep_an_operators_lease(connect_as: Callable[..., Any]) -> None:
    def holder(status: dict[str, Any]) -> object:
        return status["tools"]["tip"]["holder"]

    with connect_as("observer", "operator") as observer:  # its token, too, is on palpate/main/client/operator
        with connect_as("operator") as operator:
            assert operator.acquire("tip")[0]
            assert holder(operator.next_status()) == "operator"
        observer.status_when(lambda status: holder(status) is None, "a free contact")


def test_two_operators_act_each_under_its_own_name(
    certificates: Path, serve_folder: Callable[[Path], None], connect_as: Callable[..., Any]
) -> None:
    folder = certificates.with_name("two")
    server = (EXAMPLE / "server.json5").read_text()
    write_configurations(folder, certificates, with_a_second_operator(server))
    serve_folder(folder)
    with (
        connect_as("operator", folder=folder) as first,
        connect_as("second", folder=folder) as second,
    ):
        with connect_as("second", "operator", folder=folder) as pretender:
            assert_powerless(pretender)
        assert first.acquire("tip")[0]
        granted, refusal = second.acquire("tip")
        assert (granted, refusal["reason"]) == (False, "held")
        assert first.control("release")[0]
        assert second.acquire("tip")[0]
        with second.pressing({"tip": [0.0, 0.0, -0.001]}):
            second.force_when(lambda force: any(force["position_m"][0]), "a movement")
