"""A viser server that answers this machine alone, says nothing on standard output, and opens no tunnel.

viser listens on all addresses by default, tries the next thousand ports without a word, answers pages of any origin,
and lets any client ask it for a public address. Here it does none of that.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
import warnings
from collections.abc import Callable
from typing import Any, TypeVar
from urllib.parse import urlsplit

from splashbench.errors import SplashbenchError

T = TypeVar("T")

DEFAULT_PORT = 8080
# Ports that are tried, from the default one, where the user names none.
_TRIED = 50
# Ports that other programs may take between the look and the use.
_RACES = 10
INSTALL = "in a checkout: pip install -c constraints.txt -e '.[view]'"


def is_loopback(host: str) -> bool:
    """Whether `host` is this machine's own address, which no other machine reaches."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def free_port(host: str, wanted: int | None, start: int | None = None) -> int:
    """`wanted`, or where that is None the first free port from `start`, by default from DEFAULT_PORT.

    Raises SplashbenchError where `wanted` is in use, none is free, or `host` is no address of this machine.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise SplashbenchError(
            f"--host {host} is no address ({error.strerror or error}); give one of this machine's"
        ) from None
    first = wanted or start or DEFAULT_PORT
    ports = range(first, 1 + (first if wanted is not None else min(first + _TRIED - 1, 65535)))
    fault: OSError | None = None
    for port in ports:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # As servers do: a port that a program left a moment ago is free.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], port))
                return port
            except OSError as error:
                fault = error
                if not _is_in_use(error):
                    break
    if fault is not None and not _is_in_use(fault):
        raise SplashbenchError(
            f"cannot listen on {host}, port {first} ({fault.strerror}); give another --host or --port"
        )
    if wanted is not None:
        raise SplashbenchError(f"port {wanted} is in use; give another --port, or none and the next free one is taken")
    raise SplashbenchError(f"ports {first} to {first + _TRIED - 1} are in use; give another by --port")


def _is_in_use(error: OSError) -> bool:
    return error.errno == errno.EADDRINUSE


class PortTaken(SplashbenchError):
    """Another program took a port that was free a moment ago."""

    def __init__(self, port: int) -> None:
        super().__init__(f"port {port} was taken by another program meanwhile; run the command again")


def on_free_port(host: str, wanted: int | None, start: int | None, listen: Callable[[int], T]) -> T:
    """What `listen` returns for a port, see `free_port`. Where another program is faster, the next one is tried."""
    for left in reversed(range(_RACES)):
        try:
            return listen(free_port(host, wanted, start))
        except PortTaken:
            if wanted is not None or not left:
                raise
    raise AssertionError("no race is left")


def is_own_page(headers: Any, loopback: bool) -> bool:
    """Whether a connection comes from a page of the server that it asks, by its `headers` (a mapping).

    Else any page in the user's browser could look at the scene and press buttons. loopback: whether the server
    listens on this machine alone; the name it is called by must then be this machine's (DNS rebinding).
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    name = urlsplit(f"//{host}").hostname or ""
    if loopback and not is_loopback(name):
        return False
    return origin is None or urlsplit(origin).netloc.lower() == host.lower()


def require_viser() -> None:
    """Raise SplashbenchError where viser is not installed."""
    try:
        import viser
    except ImportError as error:
        raise SplashbenchError(f"the viewer needs viser, which cannot be imported ({error}); {INSTALL}") from None
    del viser


def start_server(host: str, port: int, label: str) -> Any:
    """viser's server on `host` and `port`, which are free. label: the panel's heading.

    Raises SplashbenchError where viser is not installed, PortTaken where another program took the port meanwhile.
    """
    require_viser()
    import rich
    import viser

    class QuietServer(viser.ViserServer):  # type: ignore[misc]
        """Without the tunnel to a public address, which any client may ask for."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    rich.reconfigure(quiet=True)  # its banner would go to standard output, between the lines of --json
    # Of browsers that go away while something is sent to them.
    warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
    server = QuietServer(host=host, port=port, label=label, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise PortTaken(port)
    loopback = is_loopback(host)
    sockets = server._websock_server

    # Waited for before a client is sent anything. There is no public way to a connection's headers.
    async def refuse_strangers(client: Any) -> None:
        connection = sockets._live_connections[client.client_id]
        if not is_own_page(connection.request.headers, loopback):
            await connection.close(1008, "pages of other servers may not look")

    sockets.on_client_connect(refuse_strangers)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def address_of(host: str, port: int) -> str:
    """Where a browser on this machine finds the server."""
    name = "localhost" if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"
