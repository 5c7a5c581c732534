"""`palpate view`: addresses that can't be served from end at once."""

from __future__ import annotations

import pytest

pytest.importorskip("viser", reason="palpate[view] is not installed")

from palpate_view.program import main, page_url, parse_options


@pytest.mark.parametrize("port", ["0", "-1", "99999"])
def test_a_port_is_one(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse_options(["--port", port])
    assert ended.value.code == 2
    assert "expected a port from 1 to 65535" in capsys.readouterr().err


def test_an_address_of_another_machine_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--host", "203.0.113.7"]) == 2  # reserved for documentation: no machine has it
    assert "--host: 203.0.113.7 can't be served from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:80"),
        ("0.0.0.0", "http://127.0.0.1:80"),
        ("::1", "http://[::1]:80"),
        ("::", "http://[::1]:80"),
    ],
)
def test_the_page_is_found_on_this_machine(host: str, url: str) -> None:
    assert page_url(host, 80) == url
