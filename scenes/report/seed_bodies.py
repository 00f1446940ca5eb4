"""Meshes and loads of the protocol of Tonutti, Gras, Yang 2017: the authors' mesh from a file, or the template."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.bodies.subject import MeshPlan
from sim.bodies.template import Tumour
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads
from sim.material import Ogden
from sim.runtime.outside_files import wrap_errors
from surrogate.data.cortex_patch import open_patch
from surrogate.data.tool_loads import PublishedSettings, build_published_loads, draw
from surrogate.model.npz_archive import Archive

from .finite_elements import build_mesh_once

# Tissue of brain and tumour in the authors' public FEBio model; c [Pa], m, and the bulk modulus [Pa].
SEED_TISSUE = Ogden(((1044.0, 4.309), (1183.0, 7.736)), 1e5)
SEED_TUMOUR = Tumour(cover=8e-3)  # Radius of 12 mm, 20 mm from its centre to the cortex.
SEED_CRANIOTOMY = 0.11  # Diameter of the craniotomy [m]: 98 cm2 of exposed cortex.
POINT_FOOTPRINT = 1e-4  # Radius of a force on a vertex [m], the smallest of `Pushed`: 0.2 % from a nodal force.
MAX_SEED_BYTES = 200_000_000  # Largest size of the arrays of a mesh file [bytes].
SEED_ARRAYS = {
    "nodes_mm": ("f", 2),
    "tets": ("iu", 2),
    "region": ("iu", 1),
    "held": ("iu", 1),
    "force_nodes": ("iu", 1),
}
"""Required arrays of a mesh file: allowed kinds of NumPy types, and number of dimensions, by name."""
REMEDY = "Give an .npz file with nodes_mm (V, 3), tets (T, 4), region (T,), held (h,) and force_nodes (p,)."


def read_seed_mesh(path: Path, count: int) -> tuple[Anatomy, Loads]:
    """Read the authors' mesh, and build at most `count` loads at its `force_nodes`; its free surface is open cortex.

    Raises
    ------
    InputError
        The file cannot be read, arrays are missing or inconsistent, or `TetMesh` rejects the mesh.
    """
    with wrap_errors(path, "a mesh of the seed's protocol", REMEDY), path.open("rb") as file:
        arrays = Archive(file, REMEDY, MAX_SEED_BYTES).read_arrays(SEED_ARRAYS)
        for name, (kinds, dimensions) in SEED_ARRAYS.items():
            if arrays[name].dtype.kind not in kinds or arrays[name].ndim != dimensions:
                raise InputError(f"{name} has type {arrays[name].dtype}, shape {arrays[name].shape}. {REMEDY}")
        mesh = TetMesh(1e-3 * arrays["nodes_mm"], arrays["tets"], arrays["region"])
        vertices, held, loaded = np.arange(len(mesh.nodes)), arrays["held"], np.unique(arrays["force_nodes"])
        fixed = np.isin(vertices, held)
        free = np.isin(vertices, mesh.surface) & ~fixed
        wrong = np.setdiff1d(held, vertices)
        if len(wrong):
            raise InputError(f"held names vertex {wrong[0]}: the mesh has 0 to {len(vertices) - 1}.")
        wrong = np.setdiff1d(loaded, np.flatnonzero(free))
        if len(wrong) or len(loaded) < 2:
            raise InputError(
                f"force_nodes {loaded.tolist()}: give 2 or more vertices of the surface that are not held."
            )
        body = Anatomy(mesh, np.repeat(fixed[:, None], 3, axis=1), np.zeros((len(vertices), 3)), free)
        if not len(body.tumour_nodes):
            raise InputError(f"region has no tumour, label 2. {REMEDY}")
        settings = replace(PublishedSettings(), radius=POINT_FOOTPRINT)
        return body, build_published_loads(open_patch(body), mesh.nodes[loaded], count, 0, settings)


def make_seed_template(folder: Path, count: int) -> tuple[Anatomy, Loads]:
    """Return a template anatomy similar to the authors', stored in `folder`, and at most `count` published loads."""
    plan = MeshPlan(craniotomy=SEED_CRANIOTOMY)
    body = read_anatomy(build_mesh_once(folder / "meshes" / "seed_template.vtu", SEED_TUMOUR, plan))
    return body, draw("seed", body, count, 0)
