"""Clients of a live link on 127.0.0.1: newest messages, invalid messages and many connections."""

import asyncio
import socket
from contextlib import asynccontextmanager, suppress

import pytest
from links import HOST, NOW, Peer, peers, played

from scenes.link.clients import CLIENT_LIMITS, LinkClients
from scenes.link.frame import HEADER, BadMessageError, pack_message
from scenes.link.messages import encode_string


@asynccontextmanager
async def served(receive=lambda number, header, content: None, most=16, longest=1 << 16):
    clients = LinkClients(receive, lambda kind: longest if kind == "TRANSFORM" else 0, most)
    server = await asyncio.start_server(clients.serve_connection, HOST, 0)
    try:
        yield clients, server.sockets[0].getsockname()[1]
    finally:
        server.close()


async def until(what):
    async with asyncio.timeout(5.0):
        while not what():
            await asyncio.sleep(0.005)


def test_each_client_receives_the_newest_message():
    async def scene():
        async with served() as (clients, port):
            clients.publish("a", [pack_message("STRING", "A", encode_string("one"), NOW)])
            async with peers(port, 3) as three:
                for each in three:
                    header, body = await each.next()
                    assert (header.name, body[4:], header.stamp) == ("A", b"one", NOW)
                three[0].writer.transport.abort()
                await until(lambda: len(clients) == 2)
                clients.publish("a", [pack_message("STRING", "A", encode_string("two"), NOW + 1)])
                assert [(await each.next())[1][4:] for each in three[1:]] == [b"two", b"two"]

    played(scene())


def test_slow_client_gets_newest_message_and_blocks_no_other():
    count, large = 200, bytes(200_000)

    async def scene():
        async with served() as (clients, port):
            slow = socket.socket()
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
            slow.connect((HOST, port))
            async with peers(port, 1) as (quick,):
                await until(lambda: len(clients) == 2)
                await asyncio.sleep(1.2 * CLIENT_LIMITS.greeting_time)
                for number in range(count):
                    clients.publish("a", [pack_message("STRING", f"{number}", large, NOW)])
                    assert (await quick.next())[0].name == f"{number}"
            slow.setblocking(False)
            late = Peer(*await asyncio.open_connection(sock=slow))
            names = [(await late.next())[0].name]
            while names[-1] != f"{count - 1}":
                names.append((await late.next())[0].name)
            late.writer.transport.abort()
        assert len(names) < 20  # what it did not read in time was never queued

    played(scene())


@pytest.mark.parametrize(
    ("sent", "why", "goes_on"),
    [
        (b"\x16\x03\x01" + bytes(80), "no OpenIGTLink message", False),
        (pack_message("TRANSFORM", "A", bytes(48), 0)[:-1] + b"\1", "TRANSFORM A is rejected: wrong checksum", True),
        (pack_message("TRANSFORM", "bad", bytes(48), 0), "TRANSFORM bad is rejected: what", True),
        (pack_message("NDARRAY", "A", bytes(90), 0), "NDARRAY A is passed over: type not used", True),
        (pack_message("TRANSFORM", "A", bytes(1 << 17), 0), "too long", True),
        (HEADER.pack(1, b"POINT", b"A", 0, 1 << 60, 0), "announces 1152921504606846976 bytes", False),
    ],
)
def test_invalid_message_is_reported_to_its_sender_only(sent, why, goes_on):
    heard = []

    def receive(number, header, content):
        if header.name == "bad":
            raise BadMessageError("what: 7")
        heard.append(header.name)

    async def scene():
        async with served(receive) as (clients, port), peers(port, 2) as (bad, good):
            bad.writer.write(sent)
            assert why in await bad.said()
            assert clients.refused.total() == 1
            bad.send("TRANSFORM", "next", bytes(48))
            good.send("TRANSFORM", "fine", bytes(48))
            if not goes_on:
                with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
                    await bad.next()
            await until(lambda: len(heard) == 1 + goes_on)
            assert sorted(heard) == sorted(["fine", *["next"] * goes_on])
            await asyncio.sleep(1.2 * CLIENT_LIMITS.greeting_time)
            clients.publish("a", [pack_message("STRING", "A", b"", 0)])
            assert (await good.next())[0].kind == "STRING"  # and no STATUS before it

    played(scene())


def test_number_of_clients_is_limited_during_many_connections():
    async def scene():
        async with served(most=4) as (clients, port), peers(port, 1) as (first,):
            await until(lambda: len(clients) == 1)
            for _ in range(100):
                _, writer = await asyncio.open_connection(HOST, port)
                writer.write(b"\0\1TRANS")  # and vanish in the middle of a message
                assert len(clients) <= 4
                writer.close()
            async with peers(port, 8) as many:
                await until(lambda: len(clients) == 4)
                refused = [each for each in many if await busy(each)]
                assert len(refused) >= 5
            await until(lambda: len(clients) == 1)
            clients.publish("a", [pack_message("STRING", "A", b"", 0)])
            assert (await first.next())[0].name == "A"

    async def busy(peer):
        with suppress(TimeoutError):
            async with asyncio.timeout(0.4):
                return "4 clients are connected" in await peer.said()
        return False

    played(scene())


def test_client_request_returns_only_the_requested_message():
    async def scene():
        async with served() as (clients, port), peers(port, 1) as (one,):
            surfaces = [
                pack_message("POLYDATA", name, bytes(40), stamp) for name, stamp in (("O", 1), ("P", 2), ("Q", 2))
            ]
            clients.publish("a", [pack_message("STRING", "A", encode_string("s"), 0), *surfaces])
            for _ in range(2):
                clients.publish("b", [pack_message("STRING", "B", encode_string("s"), 0)])
                one.send("GET_POLYDATA", "", b"")
                assert (await one.next())[0].name == "P"
            one.send("GET_IMAGE", "", b"")
            assert "no IMAGE yet" in await one.said()
            one.send("STT_STRING", "", b"")
            assert [(await one.next())[0].name for _ in range(5)] == ["A", "O", "P", "Q", "B"]

    played(scene())
