"""The web server of a viewer: on this machine alone unless asked otherwise, for its own page only."""

import contextlib
import errno
import importlib
import io
import ipaddress
import logging
import socket
from collections.abc import Generator
from typing import Any
from urllib.parse import urlsplit

from twofold.errors import TwofoldError, install_command

FIRST_PORT, TRIED = 8080, 50
"""Where a free port is looked for, and how many are tried."""
LOOPBACK = "127.0.0.1"


def require_viser() -> Any:
    """The package viser.

    Raises:
        TwofoldError: it is not installed.
    """
    try:
        return importlib.import_module("viser")
    except ImportError as error:
        raise TwofoldError(f"The viewer needs the package viser; run {install_command('viewer')}.") from error


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine alone.

    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0")
    (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def choose_port(host: str, port: int | None) -> int:
    """The port that was asked for, or else the first free one from `FIRST_PORT` on.

    Raises:
        TwofoldError: the port is taken or not allowed, none is free, or the address is not this machine's.
    """
    if port is not None and not 0 <= port <= 65535:
        raise TwofoldError(f"--port should be 1 to 65535, or 0 for any free one; it is {port}.")
    wanted = [port] if port is not None else list(range(FIRST_PORT, FIRST_PORT + TRIED))
    for number in wanted:
        reason = _refusal(host, number)
        if reason is None:
            return number
        if reason == errno.EACCES:
            raise TwofoldError(f"Port {number} is reserved for the system; choose one above 1023 with --port.")
        if reason != errno.EADDRINUSE:
            raise TwofoldError(f"{host} is not an address of this machine; leave --host out, or give 0.0.0.0 for all.")
    if port is not None:
        raise TwofoldError(f"Port {port} of {host} is taken by another program; choose another --port, or none.")
    raise TwofoldError(f"Ports {wanted[0]} to {wanted[-1]} of {host} are all taken; name a free one with --port.")


def _refusal(host: str, port: int) -> int | None:
    """Why a port cannot be listened on, as an error number; None where it can."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((host, port))
    except OSError as error:
        return error.errno if isinstance(error.errno, int) else errno.EADDRNOTAVAIL
    return None


@contextlib.contextmanager
def quiet() -> Generator[None, None, None]:
    """Keeps what viser prints about itself away from standard output."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def open_server(host: str, port: int, title: str) -> Any:
    """A viser server that listens on an address; it never opens a public tunnel, and serves its own page only.

    Args:
        host: address.
        port: from `choose_port`.
        title: of its panel.

    Raises:
        TwofoldError: the package viser is missing.
    """
    viser = require_viser()

    class Server(viser.ViserServer):
        """Refuses to be shared through an address on the internet: avatars show real people."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Any page that is connected may ask for it; nothing happens."""

    # Browsers open connections ahead and close them unused, each of which it reports as a failed handshake.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with quiet():
        server = Server(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the person, not over them
    _refuse_other_pages(server)
    return server


def is_own_page(origin: str | None, address: str | None) -> bool:
    """Whether a connection comes from the page that this server gave out; programs that are no page have no origin.

    A browser lets every web page connect to servers on the user's machine, and tells where the page came from.

    >>> is_own_page("http://127.0.0.1:8080", "127.0.0.1:8080"), is_own_page("https://example.org", "127.0.0.1:8080")
    (True, False)
    """
    return origin is None or urlsplit(origin).netloc == address


def _refuse_other_pages(server: Any) -> None:
    connections = server._websock_server._live_connections

    async def check(client: Any) -> None:
        connection = connections[client.client_id]
        headers = connection.request.headers
        if not is_own_page(headers.get("Origin"), headers.get("Host")):
            await connection.close(1008, "another page")

    # Ahead of viser's own callbacks, so that nothing has been sent yet.
    server._websock_server._client_connect_cb.insert(0, check)


def stop_server(server: Any) -> None:
    """Ends a server and its threads."""
    with quiet():
        server.stop()
