"""Records of a run as they come, in a file that neither a kill nor damage can make wrong.

A run that resumes its rows or batches does so by this file (docs/architecture.md).
Every record proves itself: its digest is keyed with what the run is, so that a torn record, a damaged one and one of
another run are none. They follow each other; behind one that is none, the next is found by its mark.
"""

from __future__ import annotations

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

MARK = b"sulcus\r\n"
# Mark, group, first row, length of the payload that follows, digest of all that is not the mark.
HEAD = struct.Struct("<8s8sQQ16s")
# The group of the first record, which describes the run; it has no key, so that another run can read it.
RUN = "run"
Batch = tuple[str, int]
Held = bytes | mmap.mmap
R = TypeVar("R")
LONGEST = 1 << 16
"""Bytes of a description that are read of a file."""


class DamageWarning(UserWarning):
    """Work that was done is lost to damage, and is done anew."""


class Journal:
    """The whole records of one run, by group and first row, open while the run goes on."""

    def __init__(self, path: Path, file: BinaryIO, key: bytes, places: dict[Batch, tuple[int, int]]) -> None:
        self._path, self._file, self._key, self._places = path, file, key, places

    def __contains__(self, batch: Batch) -> bool:
        return batch in self._places

    def __len__(self) -> int:
        return len(self._places)

    def add(self, batch: Batch, payload: bytes) -> None:
        """Append a record; then a kill of this process does not lose it.

        Raises
        ------
        InputError
            A disk that takes no more; what was added before stays.
        """
        try:
            start = self._file.seek(0, os.SEEK_END)
            self._file.write(_record(batch, payload, self._key))
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"{self._path}: takes no more ({explain_error(error)}). Make room there: the same command goes on."
            ) from error
        self._places[batch] = start, HEAD.size + len(payload)

    def read(self, batch: Batch) -> bytes:
        """What was added.

        Raises
        ------
        InputError
            A record that was damaged since.
        """
        start, size = self._places[batch]
        self._file.seek(start)
        record = self._file.read(size)
        if _proved(record, 0, self._key) != batch:
            raise InputError(
                f"{self._path}: rows from {batch[1]} on of `{batch[0]}` were damaged just now: give the same command "
                "again, and they are solved anew."
            )
        return record[HEAD.size :]

    def append(self, row: Any) -> None:
        """Add a dataclass of plain numbers and texts as the next row; InputError as `add`."""
        _, last = next(reversed(self._places), ("row", -1))
        self.add(("row", last + 1), json.dumps(asdict(row)).encode())

    def rows(self, kind: type[R]) -> list[R]:
        """Rows that were appended, as dataclasses of one kind; InputError as `read`."""
        return [kind(**json.loads(self.read(batch))) for batch in sorted(self._places)]


@contextmanager
def open_journal(path: Path, stated: Mapping[str, str]) -> Iterator[Journal]:
    """Yield the journal of the run that `stated` describes, begun or gone on with; the file stays.

    Raises
    ------
    InputError
        A file that another run is writing, that is of another run, or no journal; a folder that cannot be written to.

    Warns
    -----
    DamageWarning
        Records that are damaged, which are left out.
    """
    opening = _record((RUN, 0), json.dumps(dict(stated)).encode(), b"")
    key = hashlib.sha256(opening).digest()
    if not path.exists():
        with write_atomically(path, path.suffix) as draft:
            draft.write_bytes(opening)
    try:
        file = path.open("r+b")
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({explain_error(error)}). Delete it.") from error
    with file:
        _lock(path, file)
        yield Journal(path, file, key, _taken_up(path, file, opening, key, stated))


def run_of(path: Path) -> dict[str, str]:
    """Return description of the run whose journal a file is; empty where none can be read."""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(LONGEST)
        if _proved(head, 0, b"") == (RUN, 0):
            return json.loads(_payload(head))
    return {}


def _payload(held: Held) -> bytes:
    """Payload of the first record, which is whole."""
    return held[HEAD.size : HEAD.size + HEAD.unpack(held[: HEAD.size])[3]]


def _taken_up(
    path: Path, file: BinaryIO, opening: bytes, key: bytes, stated: Mapping[str, str]
) -> dict[Batch, tuple[int, int]]:
    """Start and size of the whole records, after the last of which the file is cut."""
    foreign = f"{path}: is no unfinished run, or its beginning is damaged: delete it, and the same command begins anew."
    if not file.seek(0, os.SEEK_END):
        raise InputError(foreign)
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as held:
        whole = held[: len(opening)] == opening
        if not whole and _proved(held, 0, b"") == (RUN, 0):
            check_same_description(path, json.loads(_payload(held)), stated)
        places, damaged = _records(held, len(opening), key)
    if not whole and not places:
        raise InputError(foreign)
    end = max((start + size for start, size in places.values()), default=len(opening))
    names = ([] if whole else ["its beginning"]) + [name for start, name in damaged if start < end]
    if names:
        warnings.warn(
            f"{path}: {', '.join(names[:5])}{' and more' if names[5:] else ''}: damaged. What was lost is solved anew, "
            "and all else goes on.",
            DamageWarning,
            stacklevel=4,
        )
    file.seek(0)
    file.write(opening)
    file.truncate(end)  # a kill tears the last record
    return places


def check_same_description(
    path: Path, before: Mapping[str, str], stated: Mapping[str, str], verb: str = "begun", remedy: str = "delete it, "
) -> None:
    """Reject a file whose description `before` differs from what is `stated` now.

    Raises
    ------
    InputError
        The first name whose text differs; a finished file says "made" in place of the `verb`, and has no `remedy`.
    """
    for name, wanted in stated.items():
        found = before.get(name, "nothing")
        if found != wanted:
            raise InputError(
                f"{path}: was {verb} with {name} {found}, but now {name} is {wanted}: repeat the first command, "
                f"{remedy}or choose another --out."
            )


def _records(held: Held, start: int, key: bytes) -> tuple[dict[Batch, tuple[int, int]], list[tuple[int, str]]]:
    """Start and size of the whole records from `start` on; start and name of what is none."""
    places: dict[Batch, tuple[int, int]] = {}
    damaged: list[tuple[int, str]] = []
    while start < len(held):
        batch = _proved(held, start, key)
        if batch is None:
            damaged.append((start, _name(held, start)))
            following = held.find(MARK, start + 1)
            start = len(held) if following < 0 else following
        else:
            size = HEAD.size + HEAD.unpack(held[start : start + HEAD.size])[3]
            places[batch] = start, size
            start += size
    return places, damaged


def _record(batch: Batch, payload: bytes, key: bytes) -> bytes:
    head = HEAD.pack(MARK, batch[0].encode(), batch[1], len(payload), b"")[len(MARK) : -16]
    return MARK + head + _digest(head, payload, key) + payload


def _proved(held: Held, start: int, key: bytes) -> Batch | None:
    """Return the batch of the record at a place, or None where no whole record of this key is."""
    head = held[start : start + HEAD.size]
    if len(head) < HEAD.size:
        return None
    mark, group, first, length, digest = HEAD.unpack(head)
    end = start + HEAD.size + length
    if mark != MARK or end > len(held):
        return None
    if _digest(head[len(MARK) : -16], held[start + HEAD.size : end], key) != digest:
        return None
    return group.rstrip(b"\0").decode(), first


def _name(held: Held, start: int) -> str:
    """What a damaged record was, where it can be read."""
    head = held[start : start + HEAD.size]
    if len(head) == HEAD.size and head.startswith(MARK):
        _, group, first, _, _ = HEAD.unpack(head)
        if group.rstrip(b"\0").isalpha():
            return f"rows from {first} on of `{group.rstrip(bytes(1)).decode()}`"
    return "rows whose number is lost"


def _digest(head: bytes, payload: bytes, key: bytes) -> bytes:
    state = hashlib.sha256(key + head)  # processors have instructions for it
    state.update(payload)
    return state.digest()[:16]


def _lock(path: Path, file: BinaryIO) -> None:
    """Keep other runs out until the file is closed, where the system can."""
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
