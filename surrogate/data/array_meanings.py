"""Descriptions of a data set's arrays, stored as HDF5 attributes, so that other programs can read the file."""

from dataclasses import dataclass

import h5py

FILE_DESCRIPTION = (  # Description of the whole file.
    "Results of a finite-element solver to loads of a tool on a brain. anatomy/ is the body; loads/CAUSE/ are the "
    "loads, one row each; `answers/` has the result of each load, row by row; unit/ has responses to unit forces. SI "
    "units; coordinates are the anatomy's own, in RAS (x to the right, y to the front, z up)."
)
GROUP_DESCRIPTIONS = {  # Descriptions of the file's groups.
    "anatomy": "The body in its rest configuration, and how it is held. `digest` is a hash of all arrays here.",
    "loads": "What the tool does, one row a load case. `digest` is a hash of all arrays here.",
    "answers": "The static result for each row of loads/.",
    "unit": "Small-strain responses to a unit force of 1 N at one node of the open cortex: of each node in unit/node "
    "along x, then y, then z. They are scaled from 1e-6 N, and superpose. Empty where the loads are poses.",
}
CASE, VERTEX, RAS = "load case", "mesh vertex, as the rows of anatomy/nodes", "x, y, z (RAS)"  # Names of array axes.
CHECKSUM_MEANING = (  # Meaning of the checksums.
    "zlib.crc32 of the row's bytes, little-endian and in this order: displacement, outcome (padded with zeros), "
    "iterations, residual, and reaction where there is one"
)


@dataclass(frozen=True)
class ArrayInfo:
    """Description of an array: unit, names of its axes in order (separated by ;), and meaning. Vectors are in RAS."""

    unit: str
    axes: str
    text: str

    def write_to(self, array: h5py.Dataset) -> None:
        """Write the description to the attributes of an HDF5 array."""
        array.attrs.update(unit=self.unit, axes=self.axes, meaning=self.text)
        if "RAS" in self.axes:
            array.attrs["frame"] = "RAS"


_ROWS = {  # Meanings of the arrays that have one row per load case or unit force.
    "outcome": ArrayInfo("1", CASE, "outcome of the solver; rows with names that begin with CONVERGED are reliable"),
    "iterations": ArrayInfo("1", CASE, "steps that the solver took"),
    "residual": ArrayInfo(
        "1", CASE, "norm of the forces left over, over that of the largest of elasticity, load and hold"
    ),
    "checksum": ArrayInfo("1", CASE, CHECKSUM_MEANING),
}
MEANINGS = {  # Meanings of all arrays, by their path in the file.
    "anatomy/nodes": ArrayInfo("m", f"vertex; {RAS}", "positions at rest"),
    "anatomy/tets": ArrayInfo("1", "tetrahedron; corner", "rows of anatomy/nodes, of positive volume"),
    "anatomy/middles": ArrayInfo(
        "1", "tetrahedron; edge 01, 12, 02, 03, 13, 23", "rows of anatomy/nodes on the edges of quadratic tetrahedra"
    ),
    "anatomy/region": ArrayInfo("1", "tetrahedron", "1 brain, 2 tumour"),
    "anatomy/held": ArrayInfo("1", f"vertex; {RAS}", "which components of the displacement are prescribed, as zero"),
    "anatomy/slide_normal": ArrayInfo(
        "1", f"vertex; {RAS}", "unit normal along which the vertex cannot move, as it slides along the skull; else zero"
    ),
    "anatomy/craniotomy": ArrayInfo("1", "vertex", "which vertices of the surface are free and may be touched"),
    "loads/time": ArrayInfo(
        "s", CASE, "time of the result; in relaxing tissue, since the tool began to arrive; 0 without time dependence"
    ),
    "loads/Pushed/point": ArrayInfo("m", f"{CASE}; {RAS}", "centre of the tool's round footprint, on the body at rest"),
    "loads/Pushed/force": ArrayInfo("N", f"{CASE}; {RAS}", "total force on the body, of fixed direction"),
    "loads/Pushed/footprint": ArrayInfo(
        "m",
        CASE,
        "radius r of the footprint; the traction at a distance s r from the point is in proportion to sqrt(1 - s^2)",
    ),
    "loads/Touching/pose": ArrayInfo(
        "m",
        f"{CASE}; tool; row; column (RAS)",
        "T_world_tool, from the tool's frame to RAS: a rotation, and in the last column the tool's origin",
    ),
    "answers/displacement": ArrayInfo("m", f"{CASE}; {VERTEX}; {RAS}", "displacement from rest"),
    "answers/reaction": ArrayInfo(
        "N, N m",
        f"{CASE}; tool; force along {RAS}, then moment about the tool's origin",
        "what each tool exerts on the body",
    ),
    "unit/displacement": ArrayInfo(
        "m/N", f"node and axis of the force, as in unit/node; {VERTEX}; {RAS}", "response per newton"
    ),
    "unit/node": ArrayInfo(
        "1", "row of the responses", "the vertex that the unit force acts on; rows 3 k, 3 k + 1, 3 k + 2 along x, y, z"
    ),
    **{f"{group}/{name}": meaning for group in ("answers", "unit") for name, meaning in _ROWS.items()},
}


def describe_arrays(file: h5py.File) -> None:
    """Write the descriptions of all arrays and groups to their attributes in the file."""
    for name, text in GROUP_DESCRIPTIONS.items():
        file.require_group(name).attrs["meaning"] = text

    def describe_item(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset) and name in MEANINGS:
            MEANINGS[name].write_to(item)

    file.visititems(describe_item)
