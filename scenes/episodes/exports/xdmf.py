"""Export of the tumour's and, if recorded, the cortex's motion as XDMF with arrays in HDF5, for ParaView."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import h5py
import numpy as np

from sim.runtime.atomic_files import write_folder_atomically, write_stream_atomically

from ..reading.bodies import find_anatomy, find_surface_rows
from ..reading.contents import EpisodeContents, get_array, open_episode
from ..reading.windows import read_numbers
from .columns import SPACE, measure_stored_size, name_files, write_notices

SURFACES = {"tumour": "tumour_surface", "cortex": "open_surface"}
"""Attribute of the anatomy with the triangles of each exported surface, by name."""


def write_xdmf(
    episodes: Sequence[EpisodeContents], folder: Path, progress: Callable[[Iterable], Iterable] = iter
) -> dict[str, Any]:
    """Write two files per episode, atomically: `.xdmf`, which ParaView opens, and `.h5` with the arrays.

    Arrays are positions [m], displacements from the scan [m], and distances from the FEM solution [m] in solved frames.
    Episodes whose anatomy is not found contain points without triangles; `points_only` in the summary counts them.

    Raises
    ------
    InputError
        An episode is damaged, or the folder cannot be written.
    """
    bare = 0
    with write_folder_atomically(folder, measure_stored_size(episodes)) as partial:
        names = name_files(episodes)
        for contents in progress(episodes):
            anatomy = find_anatomy(contents)
            bare += anatomy is None
            root = Element("Xdmf", Version="3.0")
            domain = SubElement(root, "Domain")
            SubElement(domain, "Information", Name="space", Value=SPACE)
            with open_episode(contents.path) as file, open_hdf5(partial / f"{names[contents]}.h5") as out:
                times = read_numbers(file, contents, "time")
                for name, surface in SURFACES.items():
                    if f"{name}_predicted" in contents.shapes and f"{name}_rest" in contents.shapes:
                        nodes = read_numbers(file, contents, f"{name}_nodes")
                        triangles = None if anatomy is None else find_surface_rows(getattr(anatomy, surface), nodes)
                        group = out.create_group(name)
                        write_arrays(group, file, contents, name, triangles)
                        add_surface_series(domain, group, f"{names[contents]}.h5", times)
            indent(root)
            ElementTree(root).write(partial / f"{names[contents]}.xdmf", "utf-8", xml_declaration=True)
        write_notices(episodes, partial)
    return {"out": str(folder), "episodes": len(episodes), "points_only": bare}


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Create an HDF5 file, atomically, and yield it; a full disk raises an InputError."""
    with write_stream_atomically(path, ".h5") as stream, h5py.File(stream, "w") as file:
        yield file


def write_arrays(
    group: h5py.Group, file: h5py.File, contents: EpisodeContents, name: str, triangles: np.ndarray | None
) -> None:
    """Write positions, displacements and distances from FEM of surface `name`, by frame, in single precision."""
    at = read_numbers(file, contents, f"{name}_predicted")
    arrays = {"positions": at, "displacement": at - read_numbers(file, contents, f"{name}_rest")}
    if f"{name}_fem" in contents.shapes:
        truth = read_numbers(file, contents, f"{name}_fem")
        arrays["from_finite_elements"] = np.linalg.norm(at - truth, axis=2)
    for key, rows in arrays.items():
        for frame, row in enumerate(rows):
            if np.isfinite(row).all():
                group.create_dataset(f"{key}/{frame:06d}", data=row.astype(np.float32), compression="gzip")
    cells = np.arange(at.shape[1])[:, None] if triangles is None or not len(triangles) else triangles
    group.create_dataset("cells", data=cells.astype(np.int32), compression="gzip")


def add_surface_series(domain: Element, group: h5py.Group, name: str, times: np.ndarray) -> None:
    """Add the grids of a surface, one for each frame, to the XDMF tree."""
    item = SubElement(domain, "Grid", Name=str(group.name).strip("/"), GridType="Collection", CollectionType="Temporal")
    cells = get_array(group, "cells")
    kind = (
        {"TopologyType": "Triangle"} if cells.shape[1] == 3 else {"TopologyType": "Polyvertex", "NodesPerElement": "1"}
    )
    for frame in map(str, group.require_group("positions")):
        grid = SubElement(item, "Grid", Name=frame, GridType="Uniform")
        SubElement(grid, "Time", Value=repr(float(times[int(frame)])))
        add_data_item(SubElement(grid, "Topology", kind, NumberOfElements=str(len(cells))), cells, name)
        add_data_item(SubElement(grid, "Geometry", GeometryType="XYZ"), get_array(group, f"positions/{frame}"), name)
        for key, form in (("displacement", "Vector"), ("from_finite_elements", "Scalar")):
            if f"{key}/{frame}" in group:
                attribute = SubElement(grid, "Attribute", Name=f"{key} [m]", AttributeType=form, Center="Node")
                add_data_item(attribute, get_array(group, f"{key}/{frame}"), name)


def add_data_item(parent: Element, array: h5py.Dataset, name: str) -> None:
    """Add a reference to an array of the HDF5 file `name` to an XDMF element."""
    kind, size = ("Int", "4") if array.dtype.kind == "i" else ("Float", "4")
    shape = " ".join(map(str, array.shape))
    item = SubElement(parent, "DataItem", Dimensions=shape, NumberType=kind, Precision=size, Format="HDF")
    item.text = f"{name}:{array.name}"
