"""Rows of a data set: one answer each, with a checksum that damage does not survive."""

from __future__ import annotations

import zlib

import numpy as np

from sim.deformation import Deformation, Outcome

NAME_TYPE = f"S{max(len(outcome.name) for outcome in Outcome)}"

CHECKSUM = np.dtype("<u4")


def row_type(vertices: int, tools: int = 0) -> np.dtype:
    """One row: displacement (vertices, 3), how it came about, and the reaction (tools, 6) of tools moved by pose."""
    # In the width of the file, 64 kB a load on a brain of 5,300 nodes: HDF5 converts at a third of the speed. It is not
    # packed: deflate, with its bytes in the best order, saves a sixth and takes longer than a card takes to solve.
    return np.dtype(
        [
            ("displacement", "<f4", (vertices, 3)),
            ("outcome", NAME_TYPE),
            ("iterations", "<i4"),
            ("residual", "<f8"),
            *([("reaction", "<f8", (tools, 6))] if tools else []),
        ]
    )


def rows_of(answer: Deformation, unit: float, tools: int = 0) -> np.ndarray:
    """Rows (B,) of answers at every vertex, whose displacements are in units of `unit` [m].

    The reactions of `tools` moved by pose are NaN where the answer does not know them.
    """
    rows = np.empty(len(answer), row_type(answer.displacement.shape[1], tools))
    rows["displacement"] = answer.displacement / unit if unit != 1.0 else answer.displacement
    rows["outcome"] = [outcome.name for outcome in answer.outcome]
    rows["iterations"] = answer.iterations
    rows["residual"] = answer.residual
    if tools:
        rows["reaction"] = answer.reaction if answer.reaction.shape[1] == tools else np.nan
    return rows


def checksums(rows: np.ndarray) -> np.ndarray:
    """CRC-32 (B,) uint32 of the bytes of each row."""
    return np.array([zlib.crc32(row.data) for row in rows.view(np.uint8).reshape(len(rows), -1)], CHECKSUM)


def numbered(rows: np.ndarray) -> str:
    """Row numbers as a person reads them: a few, and how many there are."""
    shown = ", ".join(map(str, rows[:5]))
    return f"row {shown}" if len(rows) == 1 else f"rows {shown}{f' ... ({len(rows)} in all)' if len(rows) > 5 else ''}"
