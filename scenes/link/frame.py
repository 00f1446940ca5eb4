"""Header, checksum and metadata of OpenIGTLink messages."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from sim.runtime.optional_packages import require_extra

with require_extra("slicer", "OpenIGTLink's checksums need"):
    from fastcrc import crc64

HEADER = struct.Struct(">H12s20sQQQ")
"""Layout of a header (58 bytes, big-endian): version, type, device name, time stamp, size of the body, checksum."""
# Extended header of version 2: its size, the sizes of the metadata's index and of the metadata, message number.
EXTENDED = struct.Struct(">HHII")
INDEXED = struct.Struct(">HHI")
"""Layout of an entry of the metadata index: size of the key, encoding of the value, size of the value."""
VERSIONS = (1, 2)  # Supported versions of the protocol.
TICKS = 1 << 32  # Units of a time stamp per second; a stamp of 0 is 1970.
NAME_BYTES = 20  # Maximum length of a device name [bytes].
WRONG_CHECKSUM = "wrong checksum"  # Error message.


class BadMessageError(ValueError):
    """Invalid message; the text states the reason, and is sent to the sender of the message."""


@dataclass(frozen=True)
class Header:
    """Header of a message.

    Parameters
    ----------
    version
        Version 1; or version 2, whose body also contains an extended header and metadata.
    kind, name
        Type and device name.
    stamp
        Time stamp of the content, in 2^-32 s since 1970; 0: not given.
    size
        Size of the body [bytes].
    checksum
        CRC-64 of the body (ECMA-182, initial value 0).
    metadata
        Metadata by key; empty until the body is read.
    """

    version: int
    kind: str
    name: str
    stamp: int
    size: int
    checksum: int
    metadata: Mapping[str, str] = field(default_factory=dict)


def read_header(raw_bytes: bytes) -> Header:
    """Decode a header of 58 bytes.

    Raises
    ------
    BadMessageError
        The version is unknown, or type or name contain characters other than printable ASCII.
    """
    version, kind, name, stamp, size, checksum = HEADER.unpack(raw_bytes)
    words = [text.split(b"\0", 1)[0] for text in (kind, name)]
    if version not in VERSIONS or not words[0] or not all(32 <= byte < 127 for text in words for byte in text):
        raise BadMessageError("these bytes are no OpenIGTLink message of version 1 or 2")
    return Header(version, words[0].decode().strip(), words[1].decode().strip(), stamp, size, checksum)


def read_content(header: Header, body: bytes) -> bytes:
    """Check the checksum, and return the content of a body; in version 1, the content is the whole body.

    Raises
    ------
    BadMessageError
        The checksum is wrong, or sizes in the extended header do not match the body.
    """
    if crc64.ecma_182(body) != header.checksum:
        raise BadMessageError(WRONG_CHECKSUM)
    if header.version == 1:
        return body
    if len(body) < EXTENDED.size:
        raise BadMessageError("too short for an extended header")
    start, index, metadata, _ = EXTENDED.unpack_from(body)
    end = len(body) - index - metadata
    if not EXTENDED.size <= start <= end:
        raise BadMessageError("its extended header names other sizes than the message has")
    return body[start:end]


def read_metadata(header: Header, body: bytes) -> dict[str, str]:
    """Return the metadata of a message by key; empty for version 1.

    Raises
    ------
    BadMessageError
        Sizes of the metadata do not match their index.
    """
    _, index, size, _ = EXTENDED.unpack_from(body) if header.version > 1 else (0, 0, 0, 0)
    if not index:
        return {}
    table, text = body[len(body) - index - size : len(body) - size], body[len(body) - size :]
    count = int.from_bytes(table[:2])
    rows = list(INDEXED.iter_unpack(table[2:])) if len(table) == 2 + count * INDEXED.size else []
    if len(rows) != count or sum(key + value for key, _, value in rows) != size:
        raise BadMessageError("its metadata has other sizes than its index names")
    found, at = {}, 0
    for key, _, value in rows:
        words = text[at : at + key], text[at + key : at + key + value]
        key_text, value_text = (each.decode("utf-8", "replace").strip("\0 ") for each in words)
        found[key_text] = value_text
        at += key + value
    return found


def pack_message(message_type: str, device_name: str, content: bytes, stamp: int) -> bytes:
    """Return a message of version 1 with its header, which all clients support; names are cut after 20 bytes."""
    text = device_name.encode("ascii", "replace")[:NAME_BYTES]
    return HEADER.pack(1, message_type.encode(), text, stamp, len(content), crc64.ecma_182(content)) + content


def to_stamp(time: float) -> int:
    """Convert a time [s since 1970] to a time stamp [2^-32 s since 1970]."""
    return int(time * TICKS)


def to_time(stamp: int) -> float:
    """Convert a time stamp [2^-32 s since 1970] to a time [s since 1970]."""
    return stamp / TICKS
