"""Connections of several OpenIGTLink clients; received data are checked, and no client blocks another client."""

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import count

from .frame import (
    HEADER,
    WRONG_CHECKSUM,
    BadMessageError,
    Header,
    pack_message,
    read_content,
    read_header,
    read_metadata,
)
from .messages import Status, encode_status

REJECTED_DEVICE = "SulcusRefused"
"""Device name of STATUS messages about rejected data, which are sent only to the client concerned."""
MAX_BODY_BYTES = 1 << 28  # Maximum size of a message body [bytes]; a longer one ends the connection.


@dataclass(frozen=True)
class ClientLimits:
    """Limits of a connection."""

    timeout: float = 10.0  # Time limit for an announced body to arrive, and for a client to read its messages [s].
    greeting_time: float = 0.2  # Time in which a new client may send a request before everything is sent to it [s].
    farewell_time: float = 1.0  # Time for sending the reason of a rejection, and for ending a connection [s].
    last_message_time: float = 0.1  # Time to read the last message when a server ends [s].
    # Size of a slow client's system buffer [bytes]: its content is not replaced by newer messages.
    buffer_bytes: int = 1 << 18
    chunk_bytes: int = 1 << 16  # Size of the chunks in which a body is skipped [bytes].


CLIENT_LIMITS = ClientLimits()
# First letters of the message types that are requests, and of those that ask for selected messages.
REQUESTS, QUERIES = ("GET_", "STT_", "STP_"), ("GET_", "STP_")

Receive = Callable[[int, Header, bytes], None]
"""Callback that receives a client's number, a message's header and its content; raises `BadMessageError`."""
Longest = Callable[[str], int]
"""Function that returns the maximum size [bytes] of messages of a type; 0 if the type is not used."""


@dataclass(eq=False)
class Client:
    """Connected client, its unsent messages (`pending`) by key, and True in `polls` if it requests each message."""

    number: int
    writer: asyncio.StreamWriter
    pending: dict[str, tuple[bytes, ...]] = field(default_factory=dict)
    news: asyncio.Event = field(default_factory=asyncio.Event)
    spoke: asyncio.Event = field(default_factory=asyncio.Event)
    polls: bool = False
    leaving: bool = False

    def offer(self, key: str, messages: tuple[bytes, ...]) -> None:
        """Queue messages for sending; they replace unsent messages with the same key."""
        self.pending[key] = messages
        self.news.set()

    def leave(self) -> None:
        """Request the end of the connection after all queued messages are sent."""
        self.leaving = True
        self.news.set()


class LinkClients:
    """Clients of a server, or the connection of this program to a server.

    All methods must be called in the thread of the event loop.

    Parameters
    ----------
    receive
        Callback for each message of a used type with a valid checksum.
    max_size
        Function that returns the maximum size [bytes] of messages of a type; 0 if the type is not used.
    max_clients
        Maximum number of clients; further clients are rejected.
    log
        Callback for a line of text when a client connects or leaves, and when a message is rejected for a new reason.
    """

    def __init__(
        self, receive: Receive, max_size: Longest, max_clients: int = 16, log: Callable[[str], None] = lambda line: None
    ) -> None:
        self.refused: Counter[str] = Counter()
        """Number of rejected messages, by reason."""
        self._receive, self._longest, self._most, self._note = receive, max_size, max_clients, log
        self._numbers = count()
        self._clients: dict[int, Client] = {}
        self._newest: dict[str, tuple[bytes, ...]] = {}
        self._attending: set[asyncio.Task] = set()

    def __len__(self) -> int:
        """Return the number of connected clients."""
        return len(self._clients)

    def publish(self, key: str, messages: Iterable[bytes]) -> None:
        """Queue messages for all clients that do not poll; they replace unsent messages with the same key."""
        self._newest[key] = tuple(messages)
        for client in self._clients.values():
            if not client.polls:
                client.offer(key, self._newest[key])

    def reject(self, client_number: int, code: Status, reason: str, text: str) -> None:
        """Count a rejected message, and send a STATUS to its client; this STATUS replaces an unsent one."""
        self._count_rejection(reason, text)
        client = self._clients.get(client_number)
        if client is not None and not client.polls:
            client.offer(REJECTED_DEVICE, (pack_message("STATUS", REJECTED_DEVICE, encode_status(code, text), 0),))

    async def serve_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a new client until its connection ends; reject it with a STATUS if there are too many clients."""
        task = asyncio.current_task()
        assert task is not None
        self._attending.add(task)
        task.add_done_callback(self._attending.discard)
        _limit_send_buffer(writer)
        if len(self._clients) < self._most:
            await self._serve_client(Client(next(self._numbers), writer), reader)
            return
        self._count_rejection("too many clients")
        text = f"{self._most} clients are connected, and no more are taken: end one of them"
        writer.write(pack_message("STATUS", REJECTED_DEVICE, encode_status(Status.BUSY, text), 0))
        await _close(writer)

    async def close(self) -> None:
        """Send all queued messages within a time limit, then end all connections."""
        for client in self._clients.values():
            client.leave()
        for patience in (CLIENT_LIMITS.last_message_time, CLIENT_LIMITS.farewell_time):
            if self._attending:
                await asyncio.wait(self._attending, timeout=patience)
            for client in self._clients.values():
                client.writer.transport.abort()

    async def listen(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Receive the messages of a server until the connection ends; no results are published to this server."""
        await self._attend(Client(next(self._numbers), writer, polls=True), reader)

    async def _serve_client(self, client: Client, reader: asyncio.StreamReader) -> None:
        peer = client.writer.get_extra_info("peername")
        name = f"client {peer[0]}:{peer[1]}" if peer else "a client"
        self._note(f"{name} comes; clients: {len(self) + 1}")
        try:
            await self._attend(client, reader)
        finally:
            self._note(f"{name} goes; clients: {len(self)}")

    async def _attend(self, client: Client, reader: asyncio.StreamReader) -> None:
        self._clients[client.number] = client
        sending = asyncio.create_task(self._send(client))
        reading = asyncio.create_task(self._read(client, reader))
        try:
            await asyncio.wait((sending, reading), return_when=asyncio.FIRST_COMPLETED)
            if reading.done() and not sending.done():
                client.leave()
                await asyncio.wait((sending,), timeout=CLIENT_LIMITS.farewell_time)
        finally:
            del self._clients[client.number]
            for task in (sending, reading):
                task.cancel()
            await asyncio.gather(sending, reading, return_exceptions=True)
            await _close(client.writer)

    async def _send(self, client: Client) -> None:
        """Send queued messages to a client, as fast as the client reads, until it leaves."""
        try:
            async with asyncio.timeout(CLIENT_LIMITS.greeting_time):
                await client.spoke.wait()
        except TimeoutError:
            pass
        if not client.polls:
            client.pending = self._newest | client.pending
            client.news.set()
        try:
            while not client.leaving or client.pending:
                await client.news.wait()
                client.news.clear()
                while client.pending:
                    messages = client.pending.pop(next(iter(client.pending)))
                    client.writer.writelines(messages)
                    async with asyncio.timeout(CLIENT_LIMITS.timeout):
                        await client.writer.drain()
        except TimeoutError:
            self._count_rejection("client that does not read")
            client.writer.transport.abort()
        except OSError:
            self._count_rejection("client that vanished")

    async def _read(self, client: Client, reader: asyncio.StreamReader) -> None:
        """Receive messages of a client until the client closes the connection or sends an invalid header."""
        try:
            while True:
                raw = await reader.readexactly(HEADER.size)
                header = read_header(raw)
                if header.size > MAX_BODY_BYTES:
                    raise BadMessageError(
                        f"{_format_name(header)} announces {header.size} bytes; {MAX_BODY_BYTES} are the most"
                    )
                async with asyncio.timeout(CLIENT_LIMITS.timeout):
                    await self._receive_body(client, reader, header)
                await asyncio.sleep(0)  # lets other tasks run if a client sends without pause
        except TimeoutError:
            self.reject(client.number, Status.TIMEOUT, "message that does not end", "a message did not end: reconnect")
        except BadMessageError as error:
            self.reject(client.number, Status.OVERFLOW, "no message", f"{error}: reconnect")
        except asyncio.IncompleteReadError as error:
            if error.partial:
                self._count_rejection("message that breaks off")
        except OSError:
            self._count_rejection("client that vanished")

    async def _receive_body(self, client: Client, reader: asyncio.StreamReader, header: Header) -> None:
        """Receive and process the body of one message; reject it if its type is not used or its content is invalid."""
        if header.kind[:4] in REQUESTS:
            await _skip_bytes(reader, header.size)
            self._handle_request(client, header)
            return
        client.spoke.set()
        longest = self._longest(header.kind)
        if header.size > longest:
            await _skip_bytes(reader, header.size)
            why, code = ("too long", Status.OVERFLOW) if longest else ("type not used", Status.UNKNOWN_INSTRUCTION)
            self.reject(client.number, code, why, f"{_format_name(header)} is passed over: {why}")
            return
        body = await reader.readexactly(header.size)
        try:
            content = read_content(header, body)
            self._receive(client.number, replace(header, metadata=read_metadata(header, body)), content)
        except BadMessageError as error:
            code = Status.CHECKSUM if str(error) == WRONG_CHECKSUM else Status.CONFIGURATION
            why = str(error).partition(":")[0]  # The text after a colon differs from message to message.
            self.reject(client.number, code, why, f"{_format_name(header)} is rejected: {error}")

    def _handle_request(self, client: Client, header: Header) -> None:
        """Process a request: queue one message (GET_), stop all messages (STP_), or start sending messages (STT_)."""
        client.polls = header.kind.startswith(QUERIES)
        client.spoke.set()
        if header.kind.startswith("STP_"):
            client.pending.clear()
        elif client.polls:
            found = _find_message(self._newest, header.kind.removeprefix("GET_"), header.name)
            text = f"there is no {header.kind.removeprefix('GET_')} yet"
            none = pack_message("STATUS", REJECTED_DEVICE, encode_status(Status.NOT_FOUND, text), 0)
            client.pending.clear()
            client.offer("asked", (found or none,))
        else:
            client.pending = dict(self._newest)
            client.news.set()

    def _count_rejection(self, reason: str, text: str = "") -> None:
        """Count a rejected message, and log the first message that is rejected for this reason."""
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            self._note(f"rejected: {text or reason}")


def _find_message(newest_messages: Mapping[str, tuple[bytes, ...]], message_type: str, name: str) -> bytes | None:
    """Return the message with a type and name, else the newest message of the type; None if there is no such type."""
    every = [(read_header(each[: HEADER.size]), each) for messages in newest_messages.values() for each in messages]
    alike = [(header, each) for header, each in every if header.kind == message_type]
    named = (each for header, each in alike if header.name == name)
    return next(named, max(alike, key=lambda pair: pair[0].stamp)[1] if alike else None)


def _format_name(header: Header) -> str:
    return f"{header.kind} {header.name}".strip()


async def _skip_bytes(reader: asyncio.StreamReader, size: int) -> None:
    """Read and discard `size` bytes."""
    while size:
        size -= len(await reader.readexactly(min(size, CLIENT_LIMITS.chunk_bytes)))


def _limit_send_buffer(writer: asyncio.StreamWriter) -> None:
    """Limit the system's send buffer, and enable TCP keep-alive, which detects lost clients."""
    writer.transport.set_write_buffer_limits(high=0)
    own = writer.get_extra_info("socket")
    own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CLIENT_LIMITS.buffer_bytes)
    own.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)


async def _close(writer: asyncio.StreamWriter) -> None:
    try:
        writer.close()
        async with asyncio.timeout(CLIENT_LIMITS.farewell_time):
            await writer.wait_closed()
    except (OSError, TimeoutError):
        writer.transport.abort()
