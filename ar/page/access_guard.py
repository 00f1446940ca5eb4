"""Access guard of the page's server: only the page's clients may connect and send messages of `ar.page.messages`.

Any program that reaches the server may send requests: another page in a user's browser, a host name that its owner
points to this machine (DNS rebinding), or a script. Each request is checked against the page's own address and, if
other machines can reach the server, a secret token in the page's address.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from .client_page import build_document
from .messages import MAX_MESSAGE_BYTES, MessageError, check_message

VISER_VERSION = "1.1."  # Supported viser release line: the guard relies on internals of it.
DEFAULT_PORTS = {"http": 80, "https": 443}  # Default ports by scheme.
HOST_PATTERN = re.compile(r"[a-z0-9](?:[a-z0-9.-]*[a-z0-9])?")  # Pattern of a valid host name.
# HTTP headers so that another page can neither frame this one (clickjacking) nor learn its address.
HEADERS = {"Content-Security-Policy": "frame-ancestors 'self'", "Referrer-Policy": "no-referrer"}


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of the traffic between a page and its clients.

    Parameters
    ----------
    max_clients
        Maximum number of connected browsers.
    max_burst, messages_per_second
        Maximum number of messages of one client at once, and per second in the long term; viser's own page sends at
        most some 50 per second.
    updates_per_second
        Maximum number of updates per second that the page sends.
    slice_updates_per_second
        Maximum number of updates per second of slices and charts, which take longer to draw.
    """

    max_clients: int = 32
    max_burst: float = 1000.0
    messages_per_second: float = 200.0
    updates_per_second: float = 30.0
    slice_updates_per_second: float = 2.0


DEFAULT_LIMITS = ConnectionLimits()  # Default limits of connections.


class ViserError(RuntimeError):
    """Error for a viser release that is not supported."""


@dataclass(frozen=True)
class AccessPolicy:
    """Access policy: `host` of the page, and secret `token` (None: any program on this machine may connect).

    `origins` are further addresses of the page, by a proxy or another port, in the form of `format_origin`.
    """

    host: str
    token: str | None
    origins: tuple[str, ...] = ()

    @classmethod
    def create(cls, host: str, origins: tuple[str, ...] = ()) -> AccessPolicy:
        """Build a policy with a new token; without one if only this machine reaches the host and there are no origins.

        Raises
        ------
        OSError
            The host has no address.
        """
        addresses = [entry[4][0] for entry in socket.getaddrinfo(host, None)]
        near = all(ipaddress.ip_address(str(address).split("%")[0]).is_loopback for address in addresses)
        return cls(host, None if near and not origins else secrets.token_urlsafe(24), origins)

    def find_rejection(self, request: Request, address: str, port: int) -> str | None:
        """Return the reason to reject a request received at this address and port; None if it is accepted."""
        names = {"localhost", "127.0.0.1", "[::1]", to_url_host(self.host), to_url_host(address)}
        if self.token is not None:
            names.add(socket.gethostname())
        places = {f"{name}:{port}".lower() for name in names}
        if port == 80:  # browsers leave it out
            places |= {name.lower() for name in names}
        allowed = {f"http://{place}" for place in places} | set(self.origins)
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or hosts[0].lower() not in places.union(*map(list_hosts, self.origins)):
            return (
                f"This page is not served under that host name. Open it as it was printed, at port {port}, or start it "
                "with --address and the address that your browser shows.\n"
            )
        if origins and (len(origins) > 1 or origins[0].lower() not in allowed):
            return "Requests from other web pages are rejected.\n"
        if self.token is not None and not any(map(self.is_token, self.read_tokens(request, port))):
            return "This page asks for a token: open the address that was printed, with its ?token=...\n"
        return None

    def is_encrypted(self, request: Request) -> bool:
        """Return True if the host of a request is served only by https."""
        schemes = [
            each.split(":")[0] for each in self.origins if request.headers.get("Host", "").lower() in list_hosts(each)
        ]
        return set(schemes) == {"https"}

    def is_token(self, text: str) -> bool:
        """Return True if a text equals the token; the comparison takes constant time."""
        return self.token is not None and hmac.compare_digest(text.encode(), self.token.encode())

    def read_tokens(self, request: Request, port: int) -> Iterator[str]:
        """Yield the tokens in a request's address and cookies."""
        yield from parse_qs(urlsplit(to_plain_text(request.path)).query).get("token", [])
        for header in request.headers.get_all("Cookie"):
            for pair in to_plain_text(header).split(";"):
                name, _, value = pair.strip().partition("=")
                if name == get_cookie_name(port):
                    yield value


class Connection(ServerConnection):
    """WebSocket connection of a client; messages are checked before viser gets them, with the lookup `controls`."""

    def __init__(
        self, *args: Any, controls: Callable[[str], object], limits: ConnectionLimits, **settings: Any
    ) -> None:
        super().__init__(*args, **settings)
        self.controls, self.limits = controls, limits
        self.credit, self.counted = limits.max_burst, self.loop.time()

    def data_received(self, data: bytes) -> None:
        """Reject requests other than GET, to which websockets would not respond."""
        if self.request is None and not data.startswith(b"GET "[: len(data)]):
            self.transport.write(b"HTTP/1.1 405 Method Not Allowed\r\nAllow: GET\r\nContent-Length: 0\r\n\r\n")
            self.transport.close()
        elif not self.transport.is_closing():
            super().data_received(data)

    async def recv(self, decode: bool | None = None) -> Any:
        """Wait for the next valid message; malformed or too many messages close the connection."""
        while True:
            message = await super().recv(decode)
            try:
                self.count_message()
                return check_message(message, self.controls)
            except MessageError as error:
                self.logger.warning("A client's message was rejected: %s.", error)
                if self.credit < 0.0:
                    self.transport.abort()  # do not wait for unread data
                elif error.malformed:
                    await self.close(1008, "The message has an invalid format.")

    def count_message(self) -> None:
        """Count a message towards the rate limit.

        Raises
        ------
        MessageError
            The client exceeds the rate limit.
        """
        now, limits = self.loop.time(), self.limits
        self.credit = min(limits.max_burst, self.credit + (now - self.counted) * limits.messages_per_second) - 1.0
        self.counted = now
        if self.credit < 0.0:
            raise MessageError("there are too many", malformed=True)


class ConnectionLog(logging.Filter):
    """Log filter for client connections: it shows each message once, without traceback, and no failed handshakes."""

    def __init__(self) -> None:
        super().__init__()
        self.said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a record is to be shown, and remove its traceback."""
        record.exc_info = None
        text = record.getMessage()
        new = text not in self.said and text != "opening handshake failed"
        self.said.add(text)
        return new and record.levelno >= logging.WARNING


@dataclass
class ControlLookup:
    """Lookup of controls and commands by identifier; it finds nothing before viser's server runs."""

    server: viser.ViserServer | None = None

    def __call__(self, identifier: str) -> object:
        """Return the control or command with this identifier, for all clients or for one client; None if not found."""
        if self.server is None:
            return None
        for gui in (self.server.gui, *(client.gui for client in self.server.get_clients().values())):
            if identifier in gui._gui_input_handle_from_uuid:
                return gui._gui_input_handle_from_uuid[identifier]
        return self.server.gui._command_handle_from_uuid.get(identifier)


def open_server(
    host: str, port: int, title: str, limits: ConnectionLimits = DEFAULT_LIMITS, origins: tuple[str, ...] = ()
) -> tuple[viser.ViserServer, str | None]:
    """Start viser's server with the guard; return it, and the token of the page's address, or None.

    Raises
    ------
    ViserError
        The viser release is not supported; no server is started.
    """
    if not viser.__version__.startswith(VISER_VERSION):
        raise ViserError(f"viser {viser.__version__} cannot be guarded: install viser {VISER_VERSION}*.")
    door, controls = AccessPolicy.create(host, origins), ControlLookup()
    with guard_server(door, controls, limits) as opened:
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    try:
        assert opened
        controls.server = server
        controls("")
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            server._websock_server.unregister_handler(message)
    except (AttributeError, AssertionError, KeyError) as error:
        server.stop()
        raise ViserError(f"viser {viser.__version__} cannot be guarded: install viser {VISER_VERSION}1.") from error
    return server, door.token


PATCH_LOCK = threading.Lock()  # Lock while websockets' `serve` is replaced.


@contextmanager
def guard_server(policy: AccessPolicy, controls: ControlLookup, limits: ConnectionLimits) -> Iterator[list[bool]]:
    """Guard the server that viser opens within this context; the yielded list is not empty once it is open."""
    opened: list[bool] = []
    serve = websockets.asyncio.server.serve
    log = logging.Logger("page", logging.WARNING)
    log.addFilter(ConnectionLog())

    def serve_guarded(*args: Any, process_request: Callable, **settings: Any) -> Any:
        opened.append(True)
        visit = partial(Connection, controls=controls, limits=limits)
        settings |= {"max_size": MAX_MESSAGE_BYTES, "logger": log, "create_connection": visit}
        return serve(*args, process_request=partial(handle_request, policy, limits, process_request), **settings)

    with PATCH_LOCK:
        websockets.asyncio.server.serve = serve_guarded
        try:
            yield opened
        finally:
            websockets.asyncio.server.serve = serve


def handle_request(
    policy: AccessPolicy, limits: ConnectionLimits, respond: Callable, connection: ServerConnection, request: Request
) -> Response | None:
    """Reject a request, or respond as viser does; return None to open a WebSocket connection."""
    address, port = connection.local_address[:2]
    refusal = policy.find_rejection(request, address, port)
    if refusal is not None:
        return connection.respond(HTTPStatus.FORBIDDEN, refusal)
    if request.headers.get_all("Upgrade"):
        if request.headers.get_all("Sec-WebSocket-Protocol") != [f"viser-v{viser.__version__}"]:
            return connection.respond(HTTPStatus.BAD_REQUEST, "The page is of another version: reload it.\n")
        if len(connection.server.connections) >= limits.max_clients:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"At most {limits.max_clients} visitors.\n")
    try:
        response = respond(connection, request)
    except (OSError, ValueError):
        response = connection.respond(HTTPStatus.NOT_FOUND, "There is no such file.\n")
    if response is not None:
        response.headers.update(HEADERS)
        if response.headers.get("Content-Type", "").startswith("text/html"):
            response.body = build_document(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        if policy.token is not None:
            secret = f"{get_cookie_name(port)}={policy.token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = secret + "; Secure" * policy.is_encrypted(request)
    return response


def format_origin(address: str) -> str:
    """Format a page's address as browsers do: lower case, and no port if the scheme implies it.

    Raises
    ------
    ValueError
        The text is not an address, or has a path, user or query.
    """
    try:
        parts = urlsplit(address)
        scheme, name, port = parts.scheme.lower(), parts.hostname or "", parts.port
        rebuilt = f"{to_url_host(name)}{'' if port is None else f':{port}'}"
        if ":" in name:
            ipaddress.IPv6Address(name)
    except ValueError:
        scheme, name, port, rebuilt = "", "", None, ""
    plain_name = ":" in name or bool(HOST_PATTERN.fullmatch(name))
    if (
        scheme not in DEFAULT_PORTS
        or not plain_name
        or port == 0
        or address.lower().rstrip("/") != f"{scheme}://{rebuilt}"
    ):
        raise ValueError(f"{address!r}: must be https://NAME or https://NAME:PORT, without a path.")
    return f"{scheme}://{to_url_host(name)}" + ("" if port in (None, DEFAULT_PORTS[scheme]) else f":{port}")


def list_hosts(origin: str) -> set[str]:
    """Return the host names of requests to an address, with and without a port that the scheme implies."""
    scheme, _, place = origin.partition("://")
    return {place} if place.rpartition(":")[2].isdecimal() else {place, f"{place}:{DEFAULT_PORTS[scheme]}"}


def to_url_host(host: str) -> str:
    """Return a host in the notation of addresses, with IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def get_cookie_name(port: int) -> str:
    """Return the name of a page's cookie, which differs between ports of a host."""
    return f"page-{port}"


def to_plain_text(text: str) -> str:
    """Return a header's text as ASCII, because websockets keeps bytes that are not characters."""
    return text.encode("ascii", "replace").decode()


def check_address(host: str, port: int) -> None:
    """Raise an error if no page can be served there, because viser would fail in another thread and never return.

    Raises
    ------
    ValueError
        The port is outside 0 .. 65535.
    OSError
        The host is not this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"{port} is no port: give 0 .. 65535.")
    family = socket.getaddrinfo(host, None)[0][0]
    with socket.create_server((host, 0), family=family):
        pass
