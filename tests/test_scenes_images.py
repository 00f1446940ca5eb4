"""Fields read by ANTs: runs where SULCUS_ANTS_PYTHON names a Python that has antspyx."""

import json
import os
import subprocess

import nibabel
import numpy as np
import pytest

from scenes.cli import main
from sim.bodies.meshfile import write_anatomy, write_mesh

ANTS = os.environ.get("SULCUS_ANTS_PYTHON")
CODE = """
import json, sys, ants, numpy
folder = sys.argv[1]
scan = ants.image_read(folder + "/scan.nii.gz")
now = ants.apply_transforms(scan, scan, [folder + "/out/field_resampling.nii.gz"], interpolator="linear")
ours = ants.image_read(folder + "/out/scan_deformed.nii.gz")
apart = numpy.abs(now.numpy() - ours.numpy())
print(json.dumps([float(apart.max()), float(numpy.abs(scan.numpy() - ours.numpy()).max())]))
"""


@pytest.mark.skipif(ANTS is None, reason="SULCUS_ANTS_PYTHON names no Python with antspyx")
def test_ants_deforms_oblique_image_as_warp_command(tmp_path, box):
    write_anatomy(tmp_path / "box.vtu", box)
    share = np.clip(1.0 - (np.linalg.norm(box.mesh.nodes[:, :2], axis=1) / 25e-3) ** 2, 0.0, 1.0)
    moved = np.outer(share * (1.0 + box.mesh.nodes[:, 2] / 42e-3), [1e-3, 0.0, -4e-3])
    write_mesh(tmp_path / "located.vtu", box.mesh, {"displacement": moved})
    affine = np.array([[1.2, -0.5, 0.0, -22.0], [0.6, 1.0, 0.1, -40.0], [0.0, -0.1, 1.5, -48.0], [0.0, 0.0, 0.0, 1.0]])
    u, _, v = np.linalg.svd(affine[:3, :3])
    affine[:3, :3] = u @ v * [1.3, 1.1, 1.5]
    grey = (50 + 20 * np.sin(np.indices((50, 50, 36)).sum(axis=0) / 3.0)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(grey, affine), tmp_path / "scan.nii.gz")
    words = ["--located", str(tmp_path / "located.vtu"), "--image", str(tmp_path / "scan.nii.gz")]
    assert main(["warp", str(tmp_path / "box.vtu"), *words, "--spacing", "2", "--out", str(tmp_path / "out")]) == 0
    said = subprocess.run([str(ANTS), "-c", CODE, str(tmp_path)], capture_output=True, text=True, check=True).stdout
    apart, changed = json.loads(said.strip().splitlines()[-1])
    assert apart < 0.02 and changed > 5.0
