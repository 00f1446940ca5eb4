"""Principal stretches of deformed tissue, and the tissue volume with strain beyond measurements on brain."""

from functools import cache

import numpy as np
import warp as wp

from ..discretisation.space import Discretisation
from ..runtime.device import Device, forward_kernel

# Range of principal stretches in tests of human brain: engineering strains of 50 % in Jin, Zhu, Mao, Shen, Yang 2013,
# "A comprehensive experimental study on material properties of human brain tissue", J. Biomech. 46:2795-2801.
MIN_STRETCH, MAX_STRETCH = 0.5, 1.5
ROUND_OFF = 1e-4  # tolerance of the range, for a stretch of 1.5 in single precision
# Volume beyond that range above which a deformation is unreliable. Tools strain some tissue beyond it at their edges:
# surgical loads up to 0.6 ml, the hardest spatulas 2.5 ml.
MAX_VOLUME = 1e-6  # [m^3].
MAX_FRACTION = 0.1  # Relative to a small mesh.


@cache
def build_kernel(device: Device) -> wp.Kernel:
    """Return the kernel over (element, load case)."""
    scalar, vec, mat = device.scalar, device.vector, device.matrix
    low, high = (
        wp.constant(wp.float64((MIN_STRETCH - ROUND_OFF) ** 2)),
        wp.constant(wp.float64((MAX_STRETCH + ROUND_OFF) ** 2)),
    )

    @forward_kernel(module="unique")
    def measure_stretch(
        u: wp.array2d(dtype=scalar),
        sizes: wp.array(dtype=wp.int32),
        elements: wp.array2d(dtype=wp.int32),
        gradients: wp.array3d(dtype=vec),
        weights: wp.array2d(dtype=wp.float64),
        # outputs: least and most square stretch, volume
        extremes: wp.array2d(dtype=wp.float64),
    ):
        """Compute the extreme eigenvalues of C = F^T F: q + 2 p cos(phi) and q + 2 p cos(phi + 2 pi / 3).

        q = tr C / 3, 6 p^2 = |C - q I|^2, cos(3 phi) = det((C - q I) / p) / 2: Smith 1961, "Eigenvalues of a symmetric
        3 x 3 matrix", Commun. ACM 4:168. For most elements the bounds q +- 2 p suffice.
        """
        e, c = wp.tid()
        for k in range(gradients.shape[1]):
            H = mat()
            for a in range(sizes[e]):
                i = 3 * elements[e, a]
                H += wp.outer(vec(u[i, c], u[i + 1, c], u[i + 2, c]), gradients[e, k, a])
            F = wp.identity(n=3, dtype=wp.float64) + wp.mat33d(H)
            C = wp.transpose(F) * F
            q = wp.trace(C) / wp.float64(3.0)
            B = C - q * wp.identity(n=3, dtype=wp.float64)
            p = wp.sqrt(wp.ddot(B, B) / wp.float64(6.0))
            above, below = q + wp.float64(2.0) * p, q - wp.float64(2.0) * p
            if above > extremes[1, c] or below < extremes[0, c] or above > high or below < low:
                phi = wp.acos(wp.clamp(wp.determinant(B / p) / wp.float64(2.0), wp.float64(-1.0), wp.float64(1.0)))
                phi /= wp.float64(3.0)
                above = q + wp.float64(2.0) * p * wp.cos(phi)
                below = q + wp.float64(2.0) * p * wp.cos(phi + wp.float64(2.0 * wp.pi / 3.0))
                wp.atomic_max(extremes, 1, c, above)
                wp.atomic_min(extremes, 0, c, below)
                if above > high or below < low:
                    wp.atomic_add(extremes, 2, c, weights[e, k])

    return measure_stretch


class TissueStretch:
    """Stretch of the deformation gradients that the material law uses; these are averages in smoothed elements."""

    def __init__(self, space: Discretisation, device: Device):
        elements = space.build_elements(np.ones(len(space.mesh.tets), bool))[0].elements
        count, most = elements.table.shape
        size = np.full(count, most, np.int32) if elements.sizes is None else elements.sizes
        self._device, self._limit = device, min(MAX_VOLUME, MAX_FRACTION * float(elements.weight.sum()))
        self._shape = [
            device.upload(size, wp.int32),
            device.upload(elements.table, wp.int32),
            device.upload(elements.gradient, device.vector),
            device.upload(elements.weight, wp.float64),
        ]

    def measure_stretch(self, u: wp.array) -> dict[str, np.ndarray]:
        """Return the fields `stretch` and `strained` of a `Deformation`, by name, at u (3N, B) [m]."""
        found = self._device.upload(np.repeat([[1.0], [1.0], [0.0]], u.shape[1], axis=1), wp.float64)
        self._device.launch(build_kernel(self._device), (len(self._shape[1]), u.shape[1]), [u, *self._shape], [found])
        least, most, volume = found.numpy()
        return {"stretch": np.sqrt(np.stack([least.clip(0.0), most])), "strained": volume}

    def is_beyond_range(self, strained: np.ndarray) -> np.ndarray:
        """Return a mask (B,): True if the volume `strained` (B,) [m^3] is so large that the result is unreliable."""
        return strained > self._limit
