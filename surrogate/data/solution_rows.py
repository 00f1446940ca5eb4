"""Rows of a data set: one result per row, with a checksum that detects damage."""

import zlib
from collections.abc import Iterable, Mapping

import numpy as np

from sim.anatomy import TUMOUR_LABEL
from sim.deformation import Deformation, Outcome
from sim.effects import Elasticity
from sim.material import read_tissue_json, to_tissue_json

TISSUE_KEY = "tissue"
"""Provenance key of the brain's tissue. Regions with the brain's tissue have no key."""
TUMOUR_KEY, REGION_KEY = "tumour's tissue", "tissue of region "
"""Provenance key of the tumour's tissue, and prefix of another region's key, followed by the region's label."""
# HDF5 type of an outcome's name, as long as the longest.
NAME_TYPE = f"S{max(len(outcome.name) for outcome in Outcome)}"

CHECKSUM_TYPE = np.dtype("<u4")  # HDF5 type of a row's CRC-32.


def describe_tissue_source(tissue: Elasticity) -> dict[str, str]:
    """Return the provenance entries that describe a tissue; the brain's entry is missing if it has no material law."""
    stated = {} if tissue.default is None else {TISSUE_KEY: to_tissue_json(tissue.default)}
    return stated | {_to_key(label): to_tissue_json(tissue.regions[label]) for label in sorted(tissue.regions)}


def read_tissue_text(provenance: Mapping[str, str]) -> Elasticity:
    """Read the tissue from a provenance that has an entry for the brain.

    Raises
    ------
    InputError
        An entry does not describe a tissue.
    """
    numbers = (key.removeprefix(REGION_KEY) for key in provenance if key.startswith(REGION_KEY))
    labels = {TUMOUR_LABEL, *(int(number) for number in numbers if number.lstrip("-").isdecimal())}
    regions = {
        label: read_tissue_json(provenance[_to_key(label)]) for label in sorted(labels) if _to_key(label) in provenance
    }
    return Elasticity(read_tissue_json(provenance[TISSUE_KEY]), regions)


def find_first_tissue(provenances: Iterable[Mapping[str, str]]) -> Elasticity | None:
    """Return the tissue in the first provenance that has an entry for the brain; None if no provenance has one."""
    stated = next((one for one in provenances if TISSUE_KEY in one), None)
    return None if stated is None else read_tissue_text(stated)


def _to_key(label: int) -> str:
    return TUMOUR_KEY if label == TUMOUR_LABEL else f"{REGION_KEY}{label}"


def get_row_dtype(vertex_count: int, tool_count: int = 0) -> np.dtype:
    """Return the dtype of a row: displacement, outcome, iterations, residual, and (for posed tools) reaction."""
    # Number widths are those of the file, 64 kB a load on a brain of 5,300 nodes: conversion by HDF5 takes 3 times as
    # long. It is not compressed: deflate, with its bytes in the best order, saves a sixth and takes longer than the
    # solve on a GPU.
    return np.dtype(
        [
            ("displacement", "<f4", (vertex_count, 3)),
            ("outcome", NAME_TYPE),
            ("iterations", "<i4"),
            ("residual", "<f8"),
            *([("reaction", "<f8", (tool_count, 6))] if tool_count else []),
        ]
    )


def to_rows(result: Deformation, displacement_unit: float, tool_count: int = 0) -> np.ndarray:
    """Convert results at all mesh vertices to rows (B,), with displacements divided by `displacement_unit`.

    The reactions of `tool_count` tools moved by pose are NaN if the result does not contain them.
    """
    rows = np.empty(len(result), get_row_dtype(result.displacement.shape[1], tool_count))
    rows["displacement"] = result.displacement / displacement_unit if displacement_unit != 1.0 else result.displacement
    rows["outcome"] = [outcome.name for outcome in result.outcome]
    rows["iterations"] = result.iterations
    rows["residual"] = result.residual
    if tool_count:
        rows["reaction"] = result.reaction if result.reaction.shape[1] == tool_count else np.nan
    return rows


def compute_row_checksums(rows: np.ndarray) -> np.ndarray:
    """Compute the CRC-32 checksum (B,) uint32 of the bytes of each row."""
    return np.array([zlib.crc32(row.data) for row in rows.view(np.uint8).reshape(len(rows), -1)], CHECKSUM_TYPE)


def format_row_numbers(rows: np.ndarray) -> str:
    """Format row numbers for a message: the first five and, if there are more, their count."""
    shown = ", ".join(map(str, rows[:5]))
    return f"row {shown}" if len(rows) == 1 else f"rows {shown}{f' ... ({len(rows)} in all)' if len(rows) > 5 else ''}"
