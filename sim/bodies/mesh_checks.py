"""Checks that a given tetrahedral mesh is conforming and without overlaps, and its regions."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..anatomy import REGION_NAMES, describe_region
from ..errors import InputError
from ..geometry.tetmesh import FACES, TetMesh

# Prefixes of meshio's names of volume cells.
VOLUMES = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron", "VTK_LAGRANGE_TETRA", "VTK_LAGRANGE_HEXA",
           "VTK_LAGRANGE_WEDGE", "VTK_LAGRANGE_PYRAMID")  # fmt: skip
# Maximum number of cells for which one region per cell is accepted; for more cells, unique values are an index.
MAX_ONE_CELL_REGIONS = 8
# Merge distance of nodes, as a fraction of the body's size.
MERGE_TOLERANCE = 1e-9
# Minimum barycentric coordinate of a point strictly inside a tetrahedron.
MIN_INSIDE_WEIGHT = 1e-3
# Maximum number of nodes and centroids tested for overlap: enough to detect an overlap of 0.1 % of the volume.
MAX_PROBES = 2**13
SPELLINGS = {"tumor": "tumour", "edema": "oedema", "ventricle": "ventricles", **{name: name for name in REGION_NAMES}}
"""Region names, by alternative spelling in lower case."""


def check_cell_types(mesh: Any, supported: set[str]) -> None:
    """Reject a mesh with volume cells whose type is not in `supported`.

    Raises
    ------
    InputError
        A type is not supported; the message lists all such types.
    """
    others = {block.type for block in mesh.cells if block.type.startswith(VOLUMES)} - supported
    if others and supported:
        counts = ", ".join(f"{sum(len(b.data) for b in mesh.cells if b.type == one)} {one}" for one in sorted(others))
        raise InputError(
            f"a part of its volume is {counts}: all of it must be tetrahedra. Split them, or mesh the volume again."
        )


def merge_nodes(
    points: np.ndarray, cells: np.ndarray, data: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], int]:
    """Merge coincident nodes; return points (V, 3), cells (T, n), point data, and the number of removed nodes.

    Raises
    ------
    InputError
        Coincident nodes have different point data.
    """
    used = np.unique(cells)
    whole = used[0] >= 0 and used[-1] < len(points)  # invalid node numbers are rejected with the mesh
    size = np.ptp(points[used], axis=0).max() if whole else 0.0
    pairs = KDTree(points[used]).query_pairs(MERGE_TOLERANCE * size, output_type="ndarray") if whole else used[:0]
    if not len(pairs):
        return points, cells, dict(data), 0
    first = np.arange(len(points))
    np.minimum.at(first, used[pairs.max(axis=1)], used[pairs.min(axis=1)])
    while (first != first[first]).any():
        first = first[first]
    for name, field in data.items():
        if not np.array_equal(field, field[first]):
            raise InputError(f"nodes that coincide have different `{name}`: give them one value, or merge them.")
    left = first == np.arange(len(points))
    return (
        points[left],
        (np.cumsum(left) - 1)[first[cells]],
        {k: v[left] for k, v in data.items()},
        int((~left).sum()),
    )


def check_overlaps(points: np.ndarray, tets: np.ndarray) -> None:
    """Reject positively oriented tetrahedra (T, 4) that are listed twice or overlap.

    Raises
    ------
    InputError
        Tetrahedra are duplicate or overlap; the message gives the number of duplicates, faces or points concerned.
    """
    faces = tets[:, FACES].reshape(-1, 3)
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    sides = np.take_along_axis(faces, turn, axis=1).astype(np.int64) @ [len(points) ** 2, len(points), 1]
    folded = len(faces) - len(np.unique(sides))  # faces that two tetrahedra share on the same side
    twice = len(tets) - len(np.unique(np.sort(tets, axis=1), axis=0)) if folded else 0
    if twice:
        raise InputError(f"{twice} tetrahedra are listed twice: list each once.")
    inside = folded or _count_overlaps(points, tets)
    if inside:
        raise InputError(
            f"its tetrahedra overlap, at {inside} {'faces' if folded else 'nodes or middles'}: each place must lie in "
            "one. Mesh it again; of several bodies, cut them out of each other first, and mesh them together."
        )


def note_components(mesh: TetMesh) -> tuple[str, ...]:
    """Return a note if the mesh consists of several components without common nodes, else ()."""
    links = mesh.tets[:, [0, 0, 0]].ravel(), mesh.tets[:, 1:].ravel()
    graph = coo_array((np.ones(len(links[0])), links), shape=(len(mesh.nodes),) * 2)
    piece, used = connected_components(graph, directed=False)[1], np.unique(mesh.tets)
    count = len(np.unique(piece[used]))
    if count == 1:
        return ()
    first = piece[used] == piece[used[0]]
    near = KDTree(mesh.nodes[used[first]]).query(mesh.nodes[used[~first]])[0].min()
    return (
        f"it is in {count} pieces that share no node, {1e3 * near:.3g} mm apart: nothing holds them together. Where "
        "they touch, mesh them together, with common nodes at their interface",
    )


def _count_overlaps(points: np.ndarray, tets: np.ndarray) -> int:
    """Return the number of probes, at most `MAX_PROBES` nodes and centroids, that are inside another tetrahedron."""
    corners = points[tets]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    probes = np.concatenate([middle, points[np.unique(tets)]])
    chosen = np.linspace(0, len(probes) - 1, min(MAX_PROBES, len(probes))).astype(int)
    near = KDTree(probes[chosen]).query_ball_point(middle, reach)
    which = np.repeat(np.arange(len(tets)), [len(one) for one in near])
    probe = chosen[np.concatenate(near).astype(int)]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    inner = np.einsum("nij,nj->ni", np.linalg.inv(edges)[which], probes[probe] - corners[which, 0])
    least = np.minimum(inner.min(axis=1), 1.0 - inner.sum(axis=1))
    return len(np.unique(probe[(least > MIN_INSIDE_WEIGHT) & (probe != which)]))


def collect_regions(mesh: Any, blocks: list[int]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the regions (T,) of the tetrahedra in the cell `blocks`, and a note if there is no cell data `region`.

    Without cell data `region`, the regions are the only integer cell array that partitions the cells, or the cell sets.

    Raises
    ------
    InputError
        `region` is not one integer per tetrahedron, several possible arrays differ, or cell sets overlap.
    """
    if "region" in mesh.cell_data:
        region = _to_integers(np.concatenate([mesh.cell_data["region"][number] for number in blocks]))
        if region is None:
            raise InputError("cell data `region` must be one whole number for each tetrahedron.")
        return region, ()
    stored = {
        name: _to_integers(np.concatenate([on[number] for number in blocks])) for name, on in mesh.cell_data.items()
    }
    varied = {name: one for name, one in stored.items() if one is not None and _is_partition(one)}
    if "gmsh:physical" in varied:
        varied.pop("gmsh:geometrical", None)  # geometrical entities of the physical groups
    groups = {name: np.atleast_1d(value) for name, value in mesh.field_data.items()}
    names = {int(v[0]): name for name, v in groups.items() if v.dtype.kind in "iu" and v.size == 2 and v[1] == 3}
    names |= {number: ", ".join(said) for number, said in getattr(mesh, "cell_tags", {}).items()}
    if not varied:
        return _assign_regions_by_sets(mesh, blocks)
    name, region = next(iter(varied.items()))
    if any(not np.array_equal(region, other) for other in varied.values()):
        said = ", ".join(f"`{one}`" for one in varied)
        raise InputError(f"its cell data {said} may each be its regions: call the right one `region`.")
    return _match_group_names(region, names, f"cell data `{name}`")


def _is_partition(values: np.ndarray) -> bool:
    """Return True if integers (T,) form at least two groups of cells and are not merely cell numbers."""
    count = len(np.unique(values))
    return count > 1 and (count < len(values) or count <= MAX_ONE_CELL_REGIONS)


def _to_integers(values: np.ndarray) -> np.ndarray | None:
    """Return the values (T,) as integers; None if they are not integers."""
    if values.ndim != 1 or values.dtype.kind not in "biuf":
        return None
    with np.errstate(invalid="ignore"):  # casts of NaN or overflow fail the comparison below
        whole = values.astype(np.int32)
    return whole if np.array_equal(values, whole) else None


def _assign_regions_by_sets(raw: Any, blocks: list[int]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the regions (T,) by the named cell sets of a file, or 0 if no set divides the mesh, and a note."""
    marked, total = {}, sum(len(raw.cells[number].data) for number in blocks)
    for name, on in raw.cell_sets.items():
        masks = [np.zeros(len(raw.cells[number].data), bool) for number in blocks]
        for mask, number in zip(masks, blocks, strict=True):
            if on[number] is not None:
                mask[np.asarray(on[number], int)] = True
        mask = np.concatenate(masks)
        if not name.startswith("gmsh:") and 0 < mask.sum() < total:
            marked[name] = mask
    if not marked:
        return np.zeros(total, np.int32), ()
    if np.sum([*marked.values()], axis=0).max() > 1:
        raise InputError(f"its sets of cells {', '.join(marked)} overlap: store cell data `region` in their place.")
    region = np.select([*marked.values()], range(1, len(marked) + 1), 0).astype(np.int32)
    return _match_group_names(region, dict(enumerate(marked, 1)), "its sets of cells", can_renumber=True)


def _match_group_names(
    region: np.ndarray, names: Mapping[int, str], group_kind: str, can_renumber: bool = False
) -> tuple[np.ndarray, tuple[str]]:
    """Return the regions (T,), renumbered to match the group `names`, and a note.

    Numbers from the file are kept if they contradict no known name; with `can_renumber`, numbers are not from it.
    """
    known = {number: SPELLINGS.get(names.get(number, "").strip().lower()) for number in np.unique(region).tolist()}
    wrong = [number for number, name in known.items() if name and REGION_NAMES[name] != number]
    if wrong or (can_renumber and any(known.values())):
        number = {old: REGION_NAMES[name] for old, name in known.items() if name}
        spare = iter(new for new in range(1, 2**16) if new not in REGION_NAMES.values())
        kept = {old for old in known if old not in number and old not in REGION_NAMES.values() and not can_renumber}
        number |= {old: old if old in kept or old == 0 else next(spare) for old in known if old not in number}
        region = np.array([number[old] for old in known], np.int32)[np.searchsorted([*known], region)]
        names = {number[old]: names.get(old, f"group {old}") for old in known}
    parts = (
        describe_region(one) + (f" from {names[one]}" if names.get(one) else "") for one in np.unique(region).tolist()
    )
    return region, (f"regions are those of {group_kind}: {', '.join(parts)}",)
