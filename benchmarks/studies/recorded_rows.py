"""CSV files of rows that a run keeps one by one, so that it can go on."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from sim.errors import InputError
from sim.runtime.outside_files import read_as

R = TypeVar("R")


def read_rows(path: Path, stated: str, kind: type[R]) -> list[R]:
    """The rows of an earlier run of the same trial, each a dataclass of one `kind`; none if there is no file.

    Raises
    ------
    InputError
        A file of another trial, or that is no record.
    """
    if not path.exists():
        return []
    remedy = "Choose another --out, or remove it."
    with read_as(path, "the record of a trial", remedy), open(path, newline="") as file:
        first, *written = file.read().splitlines(keepends=True) or [""]
        if first.strip() != f"# {stated}":
            raise InputError(f"{path}: holds another trial, or none: choose another --out, or remove it.")
        if written and not written[-1].endswith("\n"):  # its last number may be cut short
            raise InputError(f"{path}: its last line is not whole: remove that line.")
        rows, lines = [], csv.DictReader(written)
        for row in lines:
            try:
                rows.append(msgspec.convert(row, kind, strict=False))
            except msgspec.ValidationError as error:
                raise InputError(f"{path}: its line {lines.line_num + 1} is not whole: remove that line.") from error
        return rows


def append_rows(path: Path, stated: str, found: Sequence[Any]) -> None:
    """Add dataclasses of one kind to a file, which begins with what is tried."""
    begin = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, [item.name for item in fields(found[0])] if found else [])
        if begin:
            file.write(f"# {stated}\n")
            writer.writeheader()
        writer.writerows(asdict(row) for row in found)
