"""The server answers this machine's own pages alone, on a port that is free, and opens no tunnel."""

from __future__ import annotations

import builtins
import http.client
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from splashbench.errors import SplashbenchError
from splashbench.viewer.server import (
    DEFAULT_PORT,
    PortTaken,
    address_of,
    free_port,
    is_loopback,
    is_own_page,
    on_free_port,
    require_viser,
    start_server,
)
from splashbench.viewer.window import WindowServer


@pytest.fixture
def busy() -> Iterator[int]:
    """A port that another program listens on."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


def test_a_port_in_use_is_one_line(busy: int) -> None:
    with pytest.raises(SplashbenchError, match=f"port {busy} is in use; give another --port, or none"):
        free_port("127.0.0.1", busy)


def test_without_a_port_the_next_free_one_is_taken(busy: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.viewer.server.DEFAULT_PORT", busy)
    assert free_port("127.0.0.1", None) > busy
    assert free_port("127.0.0.1", None, start=busy + 3) >= busy + 3


def test_no_port_is_free(busy: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.viewer.server.DEFAULT_PORT", busy)
    monkeypatch.setattr("splashbench.viewer.server._TRIED", 1)
    with pytest.raises(SplashbenchError, match="are in use; give another by --port"):
        free_port("127.0.0.1", None)


def test_a_port_that_another_program_takes_in_between_is_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def listen(port: int) -> int:
        tried.append(port)
        if len(tried) < 3:
            raise PortTaken(port)
        return port

    assert on_free_port("127.0.0.1", None, None, listen) == tried[2]
    tried.clear()
    wanted = free_port("127.0.0.1", None)
    with pytest.raises(PortTaken, match=f"port {wanted} was taken by another program meanwhile"):
        on_free_port("127.0.0.1", wanted, None, listen)


@pytest.mark.parametrize("host", ["no such host", "192.0.2.1"])
def test_an_address_of_no_machine_or_another_is_one_line(host: str) -> None:
    with pytest.raises(SplashbenchError, match=r"give (one of this machine's|another --host)"):
        free_port(host, None)


@pytest.mark.parametrize(
    ("host", "own"),
    [
        *(("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.9.9.9", True)),
        *(("0.0.0.0", False), ("10.0.0.7", False), ("localhost.evil.example", False), ("", False)),
    ],
)
def test_which_addresses_are_this_machines_alone(host: str, own: bool) -> None:
    assert is_loopback(host) == own


@pytest.mark.parametrize(
    ("host", "origin", "loopback", "own"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True, True),
        ("localhost:9000", "http://localhost:9000", True, True),  # through ssh -L 9000:localhost:8080
        ("localhost:8080", None, True, True),  # no browser
        ("127.0.0.1:8080", "http://evil.example", True, False),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", True, False),  # another program's page
        ("127.0.0.1:8080", "null", True, False),  # a file, a sandbox
        ("evil.example:8080", "http://evil.example:8080", True, False),  # a name made to lead here
        ("", "http://127.0.0.1:8080", True, False),
        ("server.example:8080", "http://server.example:8080", False, True),
        ("server.example:8080", "http://evil.example", False, False),
    ],
)
def test_whose_pages_may_look(host: str, origin: str | None, loopback: bool, own: bool) -> None:
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    assert is_own_page(headers, loopback) == own


def test_addresses_for_a_browser() -> None:
    assert address_of("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert address_of("0.0.0.0", 8080) == "http://localhost:8080"
    assert address_of("::1", 8080) == "http://[::1]:8080"


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without(name: str, *words: Any) -> Any:
        if name == "viser":
            raise ImportError("No module named 'viser'")
        return original(name, *words)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SplashbenchError, match=r"needs viser.*pip install -c constraints.txt -e '\.\[view\]'"):
        require_viser()


@pytest.fixture
def server(capfd: pytest.CaptureFixture[str]) -> Iterator[Any]:
    """viser's, listening."""
    pytest.importorskip("viser", reason="comes with the extra [view]")
    running = start_server("127.0.0.1", free_port("127.0.0.1", None), "test")
    yield running
    running.stop()
    assert capfd.readouterr().out == ""  # standard output is for --json


def first_message(server: Any, **headers: str) -> Any:
    """What the server sends first to a page with these headers; None where it hangs up."""
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    origin = headers.pop("Origin", None)
    with connect(
        f"ws://127.0.0.1:{server.get_port()}",
        subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
        origin=origin,  # type: ignore[arg-type]
        additional_headers=headers,
    ) as client:
        try:
            return client.recv(timeout=10)
        except ConnectionClosed:
            return None


def test_a_strangers_page_is_sent_nothing(server: Any) -> None:
    own = f"http://127.0.0.1:{server.get_port()}"
    assert first_message(server, Origin=own)
    assert first_message(server)
    assert first_message(server, Origin="http://evil.example") is None
    assert first_message(server, Origin="http://127.0.0.1:1") is None


def test_it_listens_on_this_machine_alone(server: Any) -> None:
    assert server.get_host() == "127.0.0.1"
    others = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    strangers = [address for address in others if not is_loopback(str(address))]
    if not strangers:
        pytest.skip("this machine has no other address")
    for address in strangers:
        with pytest.raises(OSError):
            socket.create_connection((str(address), server.get_port()), timeout=2).close()


def test_no_client_can_have_a_tunnel_opened(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(*_: Any) -> None:
        raise AssertionError("a tunnel was opened")

    monkeypatch.setattr("viser._viser.ViserTunnel", opened)
    assert server.request_share_url() is None


def test_the_window_is_one_page_with_two_frames() -> None:
    port = free_port("127.0.0.1", None)
    window = WindowServer("127.0.0.1", port, [8123, 8124], ["<b>one", "two"])
    try:
        for path, status in (("/", 200), ("/?a=b", 200), ("/etc/passwd", 404), ("/../x", 404)):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            connection.request("GET", path)
            answer = connection.getresponse()
            text = answer.read().decode()
            assert answer.status == status, path
            if status == 200:
                assert text.count("<iframe data-port=") == 2
                assert 'data-port="8123" title="&lt;b&gt;one"' in text
                assert "<b>" not in text
                assert "http://" not in text.replace("http://www.w3.org/2000/svg", "").replace("http://${", "")
            else:
                assert text == ""
            connection.close()
    finally:
        window.stop()
    assert free_port("127.0.0.1", port) == port


def test_a_name_is_no_part_of_the_page() -> None:
    port = free_port("127.0.0.1", None)
    window = WindowServer("127.0.0.1", port, [8123, 8124], ["FRAMES", "PANEL HEADINGS"])
    try:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/")
        text = connection.getresponse().read().decode()
        connection.close()
    finally:
        window.stop()
    assert text.count("<iframe data-port=") == 2
    assert "<h1>FRAMES</h1>\n<h1>PANEL HEADINGS</h1>" in text


def test_the_default_port_is_one_that_needs_no_rights() -> None:
    assert DEFAULT_PORT > 1023
