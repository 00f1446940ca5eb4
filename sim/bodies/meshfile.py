"""Mesh files: reader for tetrahedra in most formats of meshio, and atomic writer for `.vtu`."""

from __future__ import annotations

import re
import traceback
import warnings
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.tetmesh import MeshWarning, TetMesh, orient_tetrahedra
from ..runtime.atomic_files import write_atomically
from ..runtime.file_limits import MESH_BYTES, MeshSizeLimits, limit_memory
from ..runtime.outside_files import to_path, wrap_errors
from .abaqus import AbaqusMesh, read_abaqus
from .markups import SIGNS
from .mesh_checks import check_cell_types, check_overlaps, collect_regions, merge_nodes, note_components
from .mesh_references import check_mesh_references
from .vtu_size import check_vtu_size

if TYPE_CHECKING:
    import meshio

UNITS = {"m": 1.0, "mm": 1e-3}  # length units [m]
# meshio's names of tetrahedra by number of nodes; it converts the mid-edge order of all formats to VTK's.
CELLS = {4: "tetra", 10: "tetra10"}

REMEDY = "Convert it to .vtu or .msh."
MAX_REASON_LENGTH = 200  # maximum length of meshio's reason in a message [characters]
MAX_TITLE_LENGTH = 400  # maximum length of a VTK title line [characters]
REASONS = {
    r"Incompatible cell data '([^']+)'": (
        "its `{}` is given of some cells only: put every volume into a group, and save it again."
    ),
    r"[Pp]arametric ?[Nn]odes": (
        "its nodes have parameters of the geometry: save it without them (Mesh.SaveParametric = 0 in Gmsh)."
    ),
    r"Illegal data type 'String'": (
        "it has an array of text, as 3D Slicer writes of the space: save it as .vtk, whose title states the space."
    ),
    r"\$NOD": "it is of MSH 1, of which no mesh is read: save it as MSH 4.1.",
    r"np\.float": "it has `np.float64(...)` in place of numbers, as meshio writes ASCII: save it as binary.",
    r" string$": "it has an array of text (`string`): save it without, as arrays of numbers alone are read.",
}
"""Error messages, by a pattern in the error text of meshio or in a line that meshio cannot read."""
UNREAD = re.compile(rb"^\$ParametricNodes|^\$NOD\b|np\.float|^\S+ \d+ \d+ string$")  # lines that meshio cannot read

MIN_SIZE = 5e-3  # minimum of an anatomy's longest side [m]; a mouse brain has 15 mm
MAX_SIZE = 1.0  # maximum of an anatomy's longest side [m]; a whole head has 0.3 m


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Mesh in metres, point data (not scaled; vectors in the coordinates of the mesh), and notes on changes."""

    mesh: TetMesh
    point_data: Mapping[str, np.ndarray]
    notes: tuple[str, ...]


def read_mesh(path: str | Path, unit: str = "m", limits: MeshSizeLimits = MESH_BYTES) -> MeshFile:
    """Read tetrahedra with regions from cell data `region` or else from the groups of a mesh generator (default: 0).

    Quadratic tetrahedra (`tetra10`) keep their curved edges. Points, lines and surfaces are dropped, coincident nodes
    are merged, and negatively oriented tetrahedra are reoriented. If the title of a `.vtk` file specifies LPS, the file
    is converted to RAS. Notes report each change. `limits` bound the decompressed size.

    Raises
    ------
    InputError
        The file is missing or unreadable, has no tetrahedra, has linear and quadratic ones, other volume cells, or
        inconsistent data. Tetrahedra are listed twice or overlap. The title specifies an unknown space.
    """
    path = to_path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file. Give a tetrahedral mesh, such as .vtu or .msh.")
    if unit not in UNITS:
        raise InputError(f"no unit is called {unit!r}: choose one of {', '.join(UNITS)}.")
    with wrap_errors(path, "a mesh", REMEDY):
        most = limits.limit_bytes(path.stat().st_size)
        counted = path.suffix.lower() == ".vtu" and check_vtu_size(path, most)
        with warnings.catch_warnings(), nullcontext() if counted else limit_memory(limits.max_bytes):
            warnings.simplefilter("ignore")  # meshio warns about arrays that it skips
            check_mesh_references(path, limits)
            raw = read_abaqus(path) if path.suffix.lower() == ".inp" else _read_with_meshio(path)
    with wrap_errors(path, "a mesh", REMEDY):
        return _build_mesh_file(path, raw, UNITS[unit])


def _read_with_meshio(path: Path) -> meshio.Mesh:
    """Read a mesh in a format other than Abaqus.

    Raises
    ------
    InputError
        meshio cannot read the file; the message has the reason. A damaged file may cause other exceptions of meshio.
    """
    import meshio  # optional dependency, missing on machines for training alone

    printed = StringIO()  # meshio prints its reason
    try:
        with redirect_stdout(printed), redirect_stderr(StringIO()):
            return meshio.read(path)
    except (Exception, SystemExit) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        if (last.line or "").startswith("raise ") and "meshio" in Path(last.filename).parts:
            printed.write(str(error))
        said = " ".join(re.sub(r"[^!-~]", " ", printed.getvalue()).split()).rstrip(".")
        if not said and path.suffix.lower() in (".msh", ".vtk"):
            with path.open("rb") as lines:
                said = next((str(found[0], "ascii") for line in lines if (found := UNREAD.search(line.strip()))), "")
        if not said:
            raise
        reason = f"meshio reports `{said[:MAX_REASON_LENGTH]}`. {REMEDY}"
        known = ((re.search(words, said), reason) for words, reason in REASONS.items())
        raise InputError(next((own.format(*found.groups()) for found, own in known if found), reason)) from error


def _build_mesh_file(path: Path, raw: meshio.Mesh | AbaqusMesh, unit_size: float) -> MeshFile:
    """Return the mesh of a parsed file whose length unit is `unit_size` [m]."""
    kinds = {block.type for block in raw.cells}
    found = kinds.intersection(CELLS.values())
    if not found:
        held = ", ".join(sorted(kinds)) or "no cells"
        raise InputError(f"{path}: holds {held}, but no tetrahedra (`tetra` or `tetra10`). Mesh its volume first.")
    if len(found) > 1:
        raise InputError(
            f"{path}: holds {' and '.join(sorted(found))}, which do not conform: mesh it with one of them."
        )
    check_cell_types(raw, found)
    blocks, notes = [number for number, block in enumerate(raw.cells) if block.type in found], []
    dropped = sorted({f"{len(block.data)} {block.type}" for block in raw.cells if block.type not in found})
    if dropped:
        notes.append(f"dropped cells that are not tetrahedra: {', '.join(dropped)}")
    region, said = collect_regions(raw, blocks)
    table, turned = orient_tetrahedra(raw.points, np.concatenate([raw.cells[number].data for number in blocks]))
    data, places = {name: np.asarray(field) for name, field in raw.point_data.items()}, np.asarray(raw.points, float)
    if _read_space(path) == "LPS":  # half a turn about z, which preserves orientation
        places = places * SIGNS["LPS"]
        vectors = {name for name, field in data.items() if field.shape[1:] == (3,) and field.dtype.kind in "if"}
        data.update({name: data[name] * SIGNS["LPS"] for name in vectors})
        notes.append("turned x and y of points and vectors from LPS, which its title states, to RAS")
    points, table, data, merged = merge_nodes(places, table, data)
    if merged:
        notes.append(f"merged {merged} nodes with others at the same place: results are numbered without them")
    tets, middles = np.split(table, [4], axis=1)
    mesh = TetMesh(points * unit_size, tets, region, middles if middles.size else None)
    check_overlaps(points, tets)
    if turned:
        notes.append(f"turned {turned} tetrahedra of negative orientation")
    return MeshFile(mesh, data, (*notes, *said, *note_components(mesh)))


def _read_space(path: Path) -> str:
    """Return the space in the title of a `.vtk` file, as 3D Slicer writes it (`SPACE=LPS`); empty if absent."""
    if path.suffix.lower() != ".vtk":
        return ""
    with path.open("rb") as lines:
        lines.readline(MAX_TITLE_LENGTH)
        said = re.search(
            r"\bSPACE\s*=\s*([LRAPSI]{3})\b", lines.readline(MAX_TITLE_LENGTH).decode(errors="replace"), re.IGNORECASE
        )
    if said and said[1].upper() not in SIGNS:
        raise InputError(f"{path}: its title states SPACE={said[1]}: {' or '.join(SIGNS)} is required. {REMEDY}")
    return said[1].upper() if said else ""


def write_mesh(path: str | Path, mesh: TetMesh, point_data: Mapping[str, np.ndarray], space: str = "") -> None:
    """Write `.vtu` in metres, with cell data `region`; `tetra10` cells if the mesh has mid-edge nodes.

    The file records its unit and, if given, its `space`. The file is written atomically.

    Raises
    ------
    InputError
        The name does not end in .vtu, or the folder is not writable.
    """
    import meshio

    with write_atomically(path, ".vtu") as partial:
        meshio.Mesh(
            mesh.nodes,
            [(CELLS[mesh.table.shape[1]], mesh.table)],
            point_data=dict(point_data),
            cell_data={"region": [mesh.region]},
        ).write(partial)
        head, grid, rest = partial.read_bytes().partition(b"<UnstructuredGrid>")
        partial.write_bytes(head + grid + _format_space(space).encode() + rest)


def _format_space(space: str) -> str:
    """Return unit and space, as a comment and as field data.

    The name of the field data contains the information, since meshio cannot read text as field data.
    """
    name = f"{space}, metres per unit".removeprefix(", ")
    return (
        f"<!-- sulcus: {space or 'a space of its own'}; metres --><FieldData>"
        f'<DataArray type="Float64" Name="{name}" NumberOfTuples="1" format="ascii">1</DataArray></FieldData>'
    )


def read_anatomy(path: str | Path) -> Anatomy:
    """Read an anatomy written by `write_anatomy`.

    Raises
    ------
    InputError
        See `read_mesh`. The point data `held`, `slide_normal` or `craniotomy` are missing or not finite, or the size of
        the mesh is outside the limits for coordinates in metres.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import read_anatomy
    >>> anatomy = read_anatomy(get_template_path())
    >>> anatomy.mesh.nodes.shape, anatomy.mesh.tets.shape, anatomy.tumour_nodes.shape
    ((5312, 3), (25633, 4), (243,))
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the body measures", MeshWarning)  # rejected below instead
        file = read_mesh(path)
    missing = [name for name in ("held", "slide_normal", "craniotomy") if name not in file.point_data]
    if missing:
        raise InputError(
            f"{path}: has no point data {', '.join(f'`{name}`' for name in missing)}, so it is a mesh but not an "
            "anatomy. Make one with `sulcus anatomy`, or add them."
        )
    data = file.point_data
    with wrap_errors(path, "an anatomy", "Make one with `sulcus anatomy`."):
        for name in ("held", "slide_normal", "craniotomy"):
            if data[name].dtype.kind not in "fiub" or not np.isfinite(data[name]).all():
                raise InputError(f"`{name}` has values that are no finite numbers: give 0 or 1, or unit normals.")
        anatomy = Anatomy(file.mesh, data["held"] != 0, data["slide_normal"], data["craniotomy"] != 0)
        size = float(np.ptp(anatomy.mesh.nodes, axis=0).max())
        if not MIN_SIZE <= size <= MAX_SIZE:
            raise InputError(
                f"the body measures {1e3 * size:,.3g} mm, and an anatomy {1e3 * MIN_SIZE:g} to {1e3 * MAX_SIZE:g} mm: "
                "its coordinates must be metres."
            )
        return anatomy


def write_anatomy(path: str | Path, anatomy: Anatomy) -> None:
    """Write an anatomy as `.vtu` in metres (RAS), with the data `region`, `held`, `slide_normal` and `craniotomy`."""
    write_mesh(
        path,
        anatomy.mesh,
        {
            "held": anatomy.fixed.astype(np.uint8),
            "slide_normal": anatomy.slide_normal,
            "craniotomy": anatomy.craniotomy.astype(np.uint8),
        },
        "RAS",
    )
