"""Journal of a run: a file to which records are appended, and which stays valid after a kill or damage.

A run resumes its rows or batches from this file (docs/architecture.md). The digest of each record is keyed with the
description of the run, so that incomplete, damaged or foreign records are detected. After an invalid record, the
next record is found by its mark.
"""

import hashlib
import json
import mmap
import os
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from ..errors import InputError
from .atomic_files import explain_error, write_atomically

RECORD_MARK = b"sulcus\r\n"  # First bytes of every record.
# Header of a record: mark, group, first row, length of the payload that follows, digest of all but the mark.
RECORD_HEADER = struct.Struct("<8s8sQQ16s")
# Group of the first record, which describes the run; its digest has no key, so that another run can read it.
RUN_GROUP = "run"
Batch = tuple[str, int]  # Group and first row.
Held = bytes | mmap.mmap  # Contents of a journal.
R = TypeVar("R")
MAX_DESCRIPTION_BYTES = 1 << 16
"""Maximum number of bytes that are read for a description."""


class DamageWarning(UserWarning):
    """Warning that finished work was lost because of damage and is repeated."""


class Journal:
    """Open journal with the valid records of one run, by group and first row."""

    def __init__(self, path: Path, file: BinaryIO, key: bytes, record_positions: dict[Batch, tuple[int, int]]) -> None:
        self._path, self._file, self._key, self._places = path, file, key, record_positions

    def __contains__(self, batch: Batch) -> bool:
        return batch in self._places

    def __len__(self) -> int:
        return len(self._places)

    def add(self, batch: Batch, payload: bytes) -> None:
        """Append the record of a batch, which then survives a kill of this process.

        Raises
        ------
        InputError
            The disk is full; earlier records remain valid.
        """
        try:
            start = self._file.seek(0, os.SEEK_END)
            self._file.write(_build_record(batch, payload, self._key))
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"{self._path}: cannot be extended ({explain_error(error)}). Free space there, then run the "
                "same command again to resume."
            ) from error
        self._places[batch] = start, RECORD_HEADER.size + len(payload)

    def read(self, batch: Batch) -> bytes:
        """Return the payload of the record of a batch.

        Raises
        ------
        InputError
            The record was damaged after the journal was opened.
        """
        start, size = self._places[batch]
        self._file.seek(start)
        record = self._file.read(size)
        if _verify_record(record, 0, self._key) != batch:
            raise InputError(
                f"{self._path}: rows from {batch[1]} on of `{batch[0]}` are corrupted: run the same command again to "
                "recompute them."
            )
        return record[RECORD_HEADER.size :]

    def append(self, row: Any) -> None:
        """Append a dataclass of plain numbers and texts as the next row; raise InputError as `add`."""
        _, last = next(reversed(self._places), ("row", -1))
        self.add(("row", last + 1), json.dumps(asdict(row)).encode())

    def read_rows(self, row_type: type[R]) -> list[R]:
        """Return the appended rows as dataclasses of the type `row_type`; raise InputError as `read`."""
        return [row_type(**json.loads(self.read(batch))) for batch in sorted(self._places)]


@contextmanager
def open_journal(path: Path, description: Mapping[str, str]) -> Iterator[Journal]:
    """Yield the journal of the run with this `description`, new or resumed from `path`; the file remains on exit.

    Raises
    ------
    InputError
        The file is in use by another run, belongs to another run or is not a journal, or the folder is not writable.

    Warns
    -----
    DamageWarning
        Damaged records are omitted.
    """
    opening = _build_record((RUN_GROUP, 0), json.dumps(dict(description)).encode(), b"")
    key = hashlib.sha256(opening).digest()
    if not path.exists():
        with write_atomically(path, path.suffix) as draft:
            draft.write_bytes(opening)
    try:
        file = path.open("r+b")
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({explain_error(error)}). Delete it.") from error
    with file:
        _lock_file(path, file)
        yield Journal(path, file, key, _restore_records(path, file, opening, key, description))


def read_description(path: Path) -> dict[str, str]:
    """Return the description of the run of a journal; empty if it cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(MAX_DESCRIPTION_BYTES)
        if _verify_record(head, 0, b"") == (RUN_GROUP, 0):
            return json.loads(_get_payload(head))
    return {}


def _get_payload(data: Held) -> bytes:
    """Return the payload of the first record, which must be valid."""
    return data[RECORD_HEADER.size : RECORD_HEADER.size + RECORD_HEADER.unpack(data[: RECORD_HEADER.size])[3]]


def _restore_records(
    path: Path, file: BinaryIO, header: bytes, key: bytes, description: Mapping[str, str]
) -> dict[Batch, tuple[int, int]]:
    """Return start and size of the valid records, by batch, and truncate the file after the last valid record."""
    foreign = f"{path}: is not an unfinished run, or its beginning is damaged: delete it, and run the command again."
    if not file.seek(0, os.SEEK_END):
        raise InputError(foreign)
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as held:
        whole = held[: len(header)] == header
        if not whole and _verify_record(held, 0, b"") == (RUN_GROUP, 0):
            check_same_description(path, json.loads(_get_payload(held)), description)
        places, damaged = _find_records(held, len(header), key)
    if not whole and not places:
        raise InputError(foreign)
    end = max((start + size for start, size in places.values()), default=len(header))
    names = ([] if whole else ["its beginning"]) + [name for start, name in damaged if start < end]
    if names:
        warnings.warn(
            f"{path}: {', '.join(names[:5])}{' and more' if names[5:] else ''}: damaged. The lost part is recomputed, "
            "the remainder is kept.",
            DamageWarning,
            stacklevel=4,
        )
    file.seek(0)
    file.write(header)
    file.truncate(end)  # a kill tears the last record
    return places


def check_same_description(
    path: Path,
    stored: Mapping[str, str],
    description: Mapping[str, str],
    verb: str = "begun",
    remedy: str = "delete it, ",
) -> None:
    """Reject a file whose description `stored` differs from the current `description`.

    Raises
    ------
    InputError
        The descriptions differ; the message gives the first difference. `verb` and `remedy` are parts of the message.
    """
    for name, wanted in description.items():
        found = stored.get(name, "nothing")
        if found != wanted:
            raise InputError(
                f"{path}: was {verb} with {name} {found}, but now {name} is {wanted}: repeat the first command, "
                f"{remedy}or choose another --out."
            )


def _find_records(data: Held, start: int, key: bytes) -> tuple[dict[Batch, tuple[int, int]], list[tuple[int, str]]]:
    """Return start and size of the valid records from position `start`, and start and name of the invalid records."""
    places: dict[Batch, tuple[int, int]] = {}
    damaged: list[tuple[int, str]] = []
    while start < len(data):
        batch = _verify_record(data, start, key)
        if batch is None:
            damaged.append((start, _describe_record(data, start)))
            following = data.find(RECORD_MARK, start + 1)
            start = len(data) if following < 0 else following
        else:
            size = RECORD_HEADER.size + RECORD_HEADER.unpack(data[start : start + RECORD_HEADER.size])[3]
            places[batch] = start, size
            start += size
    return places, damaged


def _build_record(batch: Batch, payload: bytes, key: bytes) -> bytes:
    head = RECORD_HEADER.pack(RECORD_MARK, batch[0].encode(), batch[1], len(payload), b"")[len(RECORD_MARK) : -16]
    return RECORD_MARK + head + _compute_digest(head, payload, key) + payload


def _verify_record(data: Held, start: int, key: bytes) -> Batch | None:
    """Return the batch of the record at position `start`, or None if there is no valid record with this key."""
    head = data[start : start + RECORD_HEADER.size]
    if len(head) < RECORD_HEADER.size:
        return None
    mark, group, first, length, digest = RECORD_HEADER.unpack(head)
    end = start + RECORD_HEADER.size + length
    if mark != RECORD_MARK or end > len(data):
        return None
    if _compute_digest(head[len(RECORD_MARK) : -16], data[start + RECORD_HEADER.size : end], key) != digest:
        return None
    return group.rstrip(b"\0").decode(), first


def _describe_record(data: Held, start: int) -> str:
    """Return the name of a damaged record at position `start`, if it can be read."""
    head = data[start : start + RECORD_HEADER.size]
    if len(head) == RECORD_HEADER.size and head.startswith(RECORD_MARK):
        _, group, first, _, _ = RECORD_HEADER.unpack(head)
        if group.rstrip(b"\0").isalpha():
            return f"rows from {first} on of `{group.rstrip(bytes(1)).decode()}`"
    return "rows with an unreadable number"


def _compute_digest(header: bytes, payload: bytes, key: bytes) -> bytes:
    state = hashlib.sha256(key + header)  # fast, by instructions of the processor
    state.update(payload)
    return state.digest()[:16]


def _lock_file(path: Path, file: BinaryIO) -> None:
    """Lock the file against other runs until it is closed, if the system supports this."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(f"{path}: another run is writing it. Wait for it, or choose another --out.") from error
    except OSError:  # a file system without locks
        return
