"""Meshes of a warp, read by trimesh: coordinate space and unit."""

import struct
from xml.etree import ElementTree

import numpy as np
import trimesh
from warped import LPS, bump


def test_mesh_files_state_their_coordinate_space(box, warp_out):
    now = 1e3 * (box.mesh.nodes + bump(box.mesh.nodes))[box.tumour_surface]
    stl = (warp_out / "tumour.stl").read_bytes()
    assert b"SPACE=LPS" in stl[:80] and not stl.startswith(b"solid")
    assert struct.unpack("<I", stl[80:84])[0] == len(now)
    read = trimesh.load(warp_out / "tumour.stl")
    assert np.allclose(read.bounds, np.stack([(now * LPS).min(axis=(0, 1)), (now * LPS).max(axis=(0, 1))]), atol=1e-3)
    assert read.is_watertight and read.volume > 0.0
    tree = ElementTree.parse(warp_out / "tumour.vtp").getroot()
    space = next(array for array in tree.iter("DataArray") if array.get("Name") == "SPACE")
    assert bytes(int(code) for code in space.text.split()) == b"LPS\0"
    assert tree.get("type") == "PolyData"


def test_gltf_is_in_metres_with_the_head_up(box, warp_out):
    read = trimesh.load(warp_out / "deformed.glb")
    assert set(read.geometry) == {"brain", "cortex", "tumour"}
    now = (box.mesh.nodes + bump(box.mesh.nodes))[np.unique(box.tumour_surface)]
    right, front, head = now.mean(axis=0)
    found = read.geometry["tumour"].vertices
    assert np.allclose(np.unique(found.round(6), axis=0).mean(axis=0), [-right, head, front], atol=1e-4)
    assert read.geometry["tumour"].volume > 0.0  # a mirrored one would be inside out
