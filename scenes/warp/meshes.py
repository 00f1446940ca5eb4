"""Writers of triangle surfaces as VTP, STL and glTF, each in the coordinate system that the format requires."""

import base64
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.geometry.surface import compute_vertex_normals

from .nrrd_files import LPS

STL_HEADER = 80  # Length of an STL header [bytes].
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942  # glTF's numbers of a file and of its chunks.
# glTF's numbers of component types, and of what a buffer contains.
FLOAT, UNSIGNED, VERTICES, INDICES = 5126, 5125, 34962, 34963
TO_GLTF = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""Rotation from RAS to the axes of glTF: x to the patient's left, y to the head, z to the front."""


@dataclass(frozen=True, eq=False)
class NamedSurface:
    """Named deformed surface: vertices (n, 3) [m, RAS], displacements (n, 3) [m], triangles (m, 3), colour (RGBA)."""

    name: str
    vertices: np.ndarray
    displacement: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float, float]


def build_surface_mesh(
    name: str, triangles: np.ndarray, nodes: np.ndarray, motion: np.ndarray, colour: tuple[float, float, float, float]
) -> NamedSurface:
    """Build the deformed surface of triangles of nodes (V, 3) [m] with displacements `motion` (V, 3) [m]."""
    used, numbers = np.unique(triangles, return_inverse=True)
    return NamedSurface(name, nodes[used] + motion[used], motion[used], numbers.reshape(-1, 3), colour)


def write_vtp(path: Path, mesh: NamedSurface) -> None:
    """Write VTP in millimetres, LPS, with point data `displacement` [mm]; the field SPACE states LPS for 3D Slicer."""
    points, moved = (1e3 * values * LPS for values in (mesh.vertices, mesh.displacement))
    ends = 3 * np.arange(1, len(mesh.triangles) + 1)
    space = " ".join(str(code) for code in (*b"LPS", 0))
    path.write_text(
        f"""<?xml version="1.0"?>
<!-- sulcus: {mesh.name}, deformed; millimetres, LPS -->
<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32">
<PolyData>
<FieldData>
<DataArray type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{space}</DataArray>
</FieldData>
<Piece NumberOfPoints="{len(points)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" """
        f"""NumberOfPolys="{len(mesh.triangles)}">
<PointData Vectors="displacement">
{_format_array("displacement", "Float32", 3, moved.astype("<f4"))}
</PointData>
<Points>
{_format_array("Points", "Float32", 3, points.astype("<f4"))}
</Points>
<Polys>
{_format_array("connectivity", "Int32", 1, mesh.triangles.astype("<i4"))}
{_format_array("offsets", "Int32", 1, ends.astype("<i4"))}
</Polys>
</Piece>
</PolyData>
</VTKFile>
"""
    )


def _format_array(name: str, vtk_type: str, components: int, values: np.ndarray) -> str:
    data = values.tobytes()
    text = base64.b64encode(struct.pack("<I", len(data)) + data).decode()
    head = f'<DataArray type="{vtk_type}" Name="{name}" NumberOfComponents="{components}" format="binary">'
    return f"{head}{text}</DataArray>"


def write_stl(path: Path, mesh: NamedSurface) -> None:
    """Write binary STL in millimetres, LPS; 3D Slicer reads the coordinate system from the header."""
    corners = (1e3 * mesh.vertices * LPS)[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    facets = np.zeros(len(corners), [("vectors", "<f4", (4, 3)), ("attribute", "<u2")])
    facets["vectors"] = np.concatenate([normals[:, None], corners], axis=1)
    header = f"sulcus {mesh.name}; UNIT=mm; SPACE=LPS".encode("ascii").ljust(STL_HEADER)
    path.write_bytes(header + struct.pack("<I", len(corners)) + facets.tobytes())


def write_glb(path: Path, meshes: Sequence[NamedSurface]) -> None:
    """Write surfaces as binary glTF 2.0, with one named node per surface, in metres; for the axes, see `TO_GLTF`."""
    data, views, accessors, parts = b"", [], [], []
    for mesh in meshes:
        place = (mesh.vertices @ TO_GLTF.T).astype("<f4")
        normals = compute_vertex_normals(place.astype(np.float64), mesh.triangles).astype("<f4")
        for values, target in ((place, VERTICES), (normals, VERTICES), (mesh.triangles.astype("<u4"), INDICES)):
            views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": target})
            view = {"bufferView": len(views) - 1}
            if target == INDICES:
                accessors.append({**view, "componentType": UNSIGNED, "count": values.size, "type": "SCALAR"})
            else:
                bounds = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
                accessors.append({**view, "componentType": FLOAT, "count": len(values), "type": "VEC3", **bounds})
            data += values.tobytes()  # all values have four bytes: no padding
        first = len(accessors) - 3
        parts.append({"attributes": {"POSITION": first, "NORMAL": first + 1}, "indices": first + 2})
    said = {
        "asset": {"version": "2.0", "generator": "sulcus warp", "extras": {"unit": "m", "axes": "left, head, front"}},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh.name, "mesh": number} for number, mesh in enumerate(meshes)],
        "meshes": [
            {"name": mesh.name, "primitives": [{**parts[number], "material": number}]}
            for number, mesh in enumerate(meshes)
        ],
        "materials": [_build_material(mesh) for mesh in meshes],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(said).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(data), BINARY_CHUNK) + data
    path.write_bytes(struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks)


def _build_material(mesh: NamedSurface) -> Mapping[str, object]:
    look = {"baseColorFactor": list(mesh.colour), "metallicFactor": 0.0, "roughnessFactor": 0.8}
    clear = {"alphaMode": "BLEND", "doubleSided": True} if mesh.colour[3] < 1.0 else {"doubleSided": True}
    return {"name": mesh.name, "pbrMetallicRoughness": look, **clear}
