"""The worked example in configs/security: who gets a connection, and what it may do."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from palpate.model import save_model
from palpate_server import wire
from palpate_server.round_trips import free_endpoint
from palpate_server.sample_model import spring_mass_model

EXAMPLE = Path(__file__).parents[2] / "configs" / "security"
CLIENT = Path(__file__).parents[2] / "client_examples" / "headless_client.py"
KEYS = wire.Keys("main")

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates, the configurations with their paths and a free port, and a model."""
    folder = tmp_path_factory.mktemp("security")
    certificates = folder / "certificates"
    subprocess.run(["sh", str(EXAMPLE / "make_certificates.sh"), str(certificates)], check=True, timeout=60)
    endpoint = free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")

    def rewrite(text: str) -> str:
        assert "tls/localhost:7447" in text
        return text.replace("tls/localhost:7447", endpoint).replace("certificates/", f"{certificates}/")

    (folder / "server.json5").write_text(rewrite((EXAMPLE / "server.json5").read_text()))
    client = rewrite((EXAMPLE / "client.json5").read_text())
    for name in ("operator", "observer"):
        (folder / f"{name}.json5").write_text(client.replace("operator", name))
    lines = [line for line in client.splitlines() if "connect_private_key" not in line]
    nobody = "\n".join(line for line in lines if "connect_certificate" not in line)
    (folder / "nobody.json5").write_text(nobody.replace("enable_mtls: true", "enable_mtls: false"))
    (folder / "plain.json5").write_text(client.replace("tls/", "tcp/"))
    save_model(spring_mass_model(), folder / "model.npz")
    return folder


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[None]:
    arguments = (str(folder / "model.npz"), "--zenoh-config", str(folder / "server.json5"))
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_server", *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("serving")
        yield
    finally:
        process.kill()
        process.communicate()


def run_client(folder: Path, who: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(CLIENT), "--zenoh-config", str(folder / f"{who}.json5")]
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
@pytest.mark.parametrize("who", ["nobody", "plain"])
def test_without_a_certificate_nothing_is_read_and_nothing_moved(folder: Path, who: str) -> None:
    done = run_client(folder, who)
    assert done.returncode == 2
    assert "palpate client:" in done.stderr

    with pytest.raises(zenoh.ZError):  # there is not even a session in which to listen
        zenoh.open(zenoh.Config.from_file(folder / f"{who}.json5"))


@pytest.mark.usefixtures("server")
def test_an_observer_hears_forces_but_cannot_move_the_tool(folder: Path) -> None:
    forces: list[dict[str, object]] = []
    statuses: list[dict[str, object]] = []
    with zenoh.open(zenoh.Config.from_file(folder / "observer.json5")) as session:
        for key, to in ((KEYS.force, forces), (KEYS.status, statuses)):
            session.declare_subscriber(key, _appender(to))
        give_up = time.monotonic() + 20
        while not (forces and statuses):
            assert time.monotonic() < give_up
            time.sleep(0.01)
        session.liveliness().declare_token(KEYS.client("intruder"))
        request = wire.pack({"contacts": ["tip"]})
        replies = list(session.get(KEYS.control("intruder", "acquire"), payload=request, timeout=1.0))
        assert not any(reply.ok for reply in replies)
        before = statuses[-1]
        command = {"sequence": 1, "client_time_ns": 1, "displacement_m": {"tip": [0.0, 0.0, 0.001]}}
        for _ in range(100):
            session.put(KEYS.command("intruder"), wire.pack(command))
        count = len(statuses)
        while len(statuses) < count + 3:
            assert time.monotonic() < give_up
            time.sleep(0.01)
        after = statuses[-1]
        for counter in ("accepted", "refused", "malformed"):  # the commands did not even arrive
            assert after[counter] == before[counter]


def _appender(to: list[dict[str, object]]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: to.append(msgpack.unpackb(sample.payload.to_bytes()))
