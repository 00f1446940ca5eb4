"""Reader for Abaqus input files: nodes, elements and element sets of all blocks."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

SOLID = re.compile(r"[AD]?C3D(4|5|6|8|10|13|15|20|27)(?!\d)")  # types of solid elements, by number of nodes
# meshio's names of solid elements by their number of nodes.
SOLIDS = {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13", 15: "wedge15",
          20: "hexahedron20", 27: "hexahedron27"}  # fmt: skip
# Integers per element: its own number, and those of its nodes.
WIDTHS = {"tetra": 5, "tetra10": 11}
# Keywords that make or move nodes and elements.
GENERATORS = "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"


@dataclass(frozen=True, eq=False)
class CellBlock:
    """Elements of one type, with node indices (n, k) for tetrahedra and (n, 0) for other elements."""

    type: str
    data: np.ndarray


@dataclass(frozen=True, eq=False)
class AbaqusMesh:
    """Contents of an Abaqus file, with the attribute names of a meshio mesh. A set lists row indices for each block."""

    points: np.ndarray
    cells: list[CellBlock]
    cell_sets: Mapping[str, list[np.ndarray]]
    point_data: Mapping[str, Any] = field(default_factory=dict)
    cell_data: Mapping[str, Any] = field(default_factory=dict)
    field_data: Mapping[str, Any] = field(default_factory=dict)


def read_abaqus(path: Path) -> AbaqusMesh:
    """Read the nodes, elements and element sets of all blocks of a file; set names are converted to capitals.

    Raises
    ------
    InputError
        The file includes another file, generates nodes by a rule, defines a node twice or uses an undefined node.
        Instances are rotated, have different translations, or belong to the same part.
    """
    index, points = dict[int, int](), list[list[float]]()
    blocks, sets = list[tuple[str, np.ndarray]](), dict[str, list[np.ndarray]]()
    instances = list[tuple[str, list[str]]]()
    apart = False  # nodes of an assembly that are in none of its instances: reference points
    with path.open(encoding="utf-8-sig", errors="replace") as lines:
        for keyword, options, rows in _iterate_sections(lines):
            if keyword == "INCLUDE" or (keyword in ("NODE", "ELEMENT", "ELSET") and "INPUT" in options):
                raise InputError("it includes another file. Merge both into one file.")
            if keyword in GENERATORS or (keyword == "NODE" and options.get("SYSTEM", "R") != "R"):
                raise InputError(f"its *{keyword} computes coordinates or elements: save it with all of them listed.")
            if keyword in ("ASSEMBLY", "INSTANCE", "END INSTANCE", "END ASSEMBLY"):
                apart = keyword in ("ASSEMBLY", "END INSTANCE")
                instances += [(options.get("PART", ""), rows)] if keyword == "INSTANCE" else []
            elif keyword == "NODE" and not apart:
                _add_nodes(rows, index, points)
            elif keyword == "ELEMENT" and rows:
                blocks.append(_parse_elements(options.get("TYPE", ""), rows))
                if "ELSET" in options:
                    sets.setdefault(options["ELSET"], []).append(blocks[-1][1][:, 0])
            elif keyword == "ELSET" and "INTERNAL" not in options:
                sets.setdefault(options["ELSET"], []).extend(_parse_set_members(rows, "GENERATE" in options, sets))
    try:
        cells = [
            CellBlock(kind, np.array([[index[n] for n in row[1:]] for row in table.tolist()])) for kind, table in blocks
        ]
    except KeyError as error:
        raise InputError(f"an element names node {error}, which no *NODE lists: list it there.") from error
    known = {name: np.concatenate(numbers) for name, numbers in sets.items() if numbers}
    within = {name: [np.flatnonzero(np.isin(table[:, 0], n)) for _, table in blocks] for name, n in known.items()}
    return AbaqusMesh(np.array(points).reshape(-1, 3) + _parse_translation(instances), cells, within)


def _iterate_sections(lines: Iterable[str]) -> Iterator[tuple[str, dict[str, str], list[str]]]:
    """Yield each keyword with its options and data lines; comments and blank lines are dropped."""
    head, rows = "", list[str]()
    for line in chain(map(str.strip, lines), "*"):
        if line.startswith("*") and not line.startswith("**"):
            keyword, *options = (part.strip() for part in head.upper().split(","))
            pairs = (option.partition("=") for option in options)
            yield keyword, {name.strip(): value.strip(' "') for name, _, value in pairs}, rows
            head, rows = line[1:], []
        elif head.endswith(",") and not rows and line[:1].isalpha():
            head += line  # its parameters continue
        elif line and not line.startswith("**"):
            rows.append(line)


def _parse_translation(instances: list[tuple[str, list[str]]]) -> np.ndarray:
    """Return the translation (3,) that all instances (part name, data lines) share; 0 without instances."""
    parts = [part for part, _ in instances if part]
    if any(len(rows) > 1 for _, rows in instances):
        raise InputError("an *INSTANCE is rotated: its nodes must be listed where they lie. Save it as one mesh.")
    moves = {tuple(float(cell or 0.0) for cell in f"{''.join(rows)},,,".replace(" ", "").split(",")[:3])
             for _, rows in instances}  # fmt: skip
    if len(moves) > 1 or len(set(parts)) < len(parts):
        raise InputError(
            "its instances are moved apart, or several of one part: every node must be listed where it lies. Save it "
            "as one mesh."
        )
    return np.array(moves.pop() if moves else (0.0, 0.0, 0.0))


def _add_nodes(rows: list[str], index: dict[int, int], points: list[list[float]]) -> None:
    """Append the nodes of a block to `index` and `points`; blank coordinates are 0."""
    for row in rows:
        number, *cells = (cell.strip() for cell in f"{row},,,".split(","))
        place = [float(cell or 0.0) for cell in cells[:3]]
        at = index.setdefault(int(number), len(points))
        if at == len(points):
            points.append(place)
        elif points[at] != place:
            raise InputError(
                f"node {number} is listed at two places, as in a file of several parts: save it as one mesh, in which "
                "each node has its own number."
            )


def _parse_elements(name: str, rows: list[str]) -> tuple[str, np.ndarray]:
    """Return the element type of a block, and a table (n, 1 + k): element number, and k node numbers of tetrahedra."""
    if not name:
        raise InputError("an *ELEMENT has no TYPE: state it, such as TYPE=C3D4.")
    solid = SOLID.match(name)
    kind = SOLIDS[int(solid[1])] if solid else name
    if kind in WIDTHS:
        return kind, np.array(_parse_integers(rows), int).reshape(-1, WIDTHS[kind])
    first = (row for row, before in zip(rows, ["", *rows], strict=False) if not before.endswith(","))
    return kind, np.array([int(row.split(",")[0]) for row in first], int).reshape(-1, 1)


def _parse_set_members(rows: list[str], is_range: bool, sets: Mapping[str, list[np.ndarray]]) -> list[np.ndarray]:
    """Return the element numbers of a set: listed, as first, last, step if `is_range`, or by names of other sets."""
    if is_range:
        return [np.arange(first, last + 1, *step) for first, last, *step in (_parse_integers([row]) for row in rows)]
    cells = [cell.strip(' "') for row in rows for cell in row.split(",")]
    named = [numbers for cell in cells for numbers in sets.get(cell.upper(), [])]
    return [np.array([int(cell) for cell in cells if cell.isdecimal()], int), *named]


def _parse_integers(rows: list[str]) -> list[int]:
    """Return the integers of comma-separated rows; blank cells are skipped."""
    return [int(cell) for row in rows for cell in row.split(",") if cell.strip()]
