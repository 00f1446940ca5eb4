"""A label volume that many commands are tried on."""

import nibabel
import numpy as np

# Of a head: a ball would turn in a smooth skull.
EGG = np.array([0.86, 1.1, 1.0])


def ball(folder, shape=(1.0, 1.0, 1.0)):
    """A ball of 55 mm radius with a ball of 10 mm in it, 2 mm voxels, and intensities that rise towards the right.

    `shape` stretches the large one along each axis.
    """
    index = np.moveaxis(np.indices((64, 64, 64)), 0, -1)
    places = 2.0 * (index - 31.5)
    labels = np.where(np.linalg.norm(places / shape, axis=-1) < 55.0, 1, 0)
    labels[np.linalg.norm(places - [20.0, 0.0, 20.0], axis=-1) < 10.0] = 2
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -63.0
    nibabel.save(nibabel.Nifti1Image(labels.astype(np.uint8), affine), folder / "labels.nii.gz")
    nibabel.save(nibabel.Nifti1Image((places[..., 0] + 70.0).astype(np.float32), affine), folder / "t1.nii.gz")
