"""A pushed box, images of it on four grids, and the warp of all by the command."""

import nibabel
import numpy as np

from scenes.cli import main
from sim.bodies.meshfile import write_anatomy, write_mesh

BLOBS = 1e-3 * np.array([[0, 2, -24], [13, 6, -13], [-14, 7, -12], [5, -14, -15], [-11, -9, -26]], float)
"""Middles of Gaussian spots in the body [m], and how wide they are [m]."""
WIDTH = 1.9e-3
TURN = np.array([[0.8660254, -0.4698463, 0.1710101], [0.5, 0.8137977, -0.2961981], [0.0, 0.3420201, 0.9396926]])
GRIDS = {
    "straight": (np.eye(3), (1.0, 1.0, 1.0)),
    "oblique": (TURN, (1.0, 1.0, 1.0)),
    "anisotropic": (TURN[[1, 2, 0]], (0.9, 1.1, 2.0)),
    "mirrored": (np.diag([-1.0, 1.0, 1.0]) @ TURN, (1.1, 1.0, 1.2)),
}
"""Directions of a volume's axes (columns, RAS), and the edges of its voxels [mm]."""
MAPPED = ("oblique", "mirrored")
"""Those with a label map, too."""
LPS = np.array([-1.0, -1.0, 1.0])


def bump(nodes):
    """A push of 5 mm on the top, which dies away to the held sides: (V, 3) [m]."""
    share = np.clip(1.0 - (np.linalg.norm(nodes[:, :2], axis=1) / 25e-3) ** 2, 0.0, 1.0)
    push = -5e-3 * share * np.clip(1.0 + nodes[:, 2] / 42e-3, 0.0, 1.0)
    return np.stack([-0.4 * push * nodes[:, 0] / 14e-3, 0.2 * push, push], axis=1)


def places(affine, shape):
    """Of the voxels (I, J, K, 3) [m, RAS]."""
    return 1e-3 * (np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3])


def volume(kind):
    """The affine [mm] and the shape of a grid that holds the body."""
    directions, edges = GRIDS[kind]
    shape = tuple(int(np.ceil(78 / edge)) for edge in edges)
    affine = np.eye(4)
    affine[:3, :3] = directions * edges
    affine[:3, 3] = [0.3, -0.4, -20.0] - affine[:3, :3] @ (0.5 * np.array(shape))
    return affine, shape


def spots(points):
    """Brightness (5, ...) at points (..., 3) [m], spot by spot."""
    return np.stack([np.exp(-((points - blob) ** 2).sum(axis=-1) / (2 * WIDTH**2)) for blob in BLOBS])


def write_warp(folder, box):
    """An anatomy, its displacement, images on four grids with a label map each, and the warp of all in `out`."""
    write_anatomy(folder / "box.vtu", box)
    # 1e-6 I + 3e-6 u u' with u along (1, 2, 3): xx, yy, zz, xy, yz, xz; its largest eigenvalue is 4e-6.
    covariance = 1e-6 * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) + 3e-6 / 14.0 * np.array([1, 4, 9, 2, 6, 3])
    covariance = np.tile(covariance, (len(box.mesh.nodes), 1))
    deviation = np.full(len(box.mesh.nodes), 6e-6**0.5)
    data = {"displacement": bump(box.mesh.nodes), "deviation": deviation, "covariance": covariance}
    write_mesh(folder / "located.vtu", box.mesh, data)
    for kind in GRIDS:
        affine, shape = volume(kind)
        bright = spots(places(affine, shape))
        nibabel.save(
            nibabel.Nifti1Image((1e3 * bright.max(axis=0)).astype(np.float32), affine), folder / f"{kind}.nii.gz"
        )
        if kind not in MAPPED:
            continue
        labels = np.where(bright.max(axis=0) > 0.3, 1 + bright.argmax(axis=0), 0).astype(np.uint8)
        nibabel.save(nibabel.Nifti1Image(labels, affine), folder / f"{kind}_labels.nii.gz")
    images = [str(folder / f"{kind}.nii.gz") for kind in GRIDS]
    labels = [str(folder / f"{kind}_labels.nii.gz") for kind in MAPPED]
    words = ["--located", str(folder / "located.vtu"), "--image", *images, "--labels", *labels]
    assert main(["warp", str(folder / "box.vtu"), *words, "--out", str(folder / "out")]) == 0
