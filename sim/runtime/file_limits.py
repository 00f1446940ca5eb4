"""Size limits for untrusted files, so that a malicious or damaged file cannot exhaust the memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError

# Maximum inflation of deflate (.npz, .nii.gz, .vtu, HDF5): a file that declares more is invalid.
MAX_INFLATION = 1032
# Allowed inflated size of a small bzip2 file [bytes], which has no such maximum: 512 x 512 x 512 voxels of 16 bits.
BZIP2_ALLOWANCE = 2**28
# Maximum size of one array [bytes]: quadratic tetrahedra (10 numbers of 8 bytes) of the finest brain meshes in use, 10
# million, take 0.8 GB.
MAX_ARRAY_BYTES = 2 * 1024**3
# Maximum inflated size of a model file's arrays [bytes]: the shipped file, of five models, has 0.04 GB.
MAX_MODEL_BYTES = 2 * 1024**3
# Maximum inflated size of a video's ground truth [bytes]: an hour at 25 images/s of 500 tumour vertices has 0.5 GB.
MAX_TRUTH_BYTES = 2**29
# Maximum size of a model file's text header [bytes]: the shipped one has 0.02 MB.
MAX_HEADER_BYTES = 16 * 1024**2
MAX_COORDINATE = 10.0  # Largest coordinate in or near a head [m].
MAX_VOXELS = 2**29  # Maximum number of voxels of a volume: that of a head of 200 mm at 0.25 mm.


@dataclass(frozen=True)
class MeshSizeLimits:
    """Limits of the decompressed size of the arrays in a mesh file.

    Parameters
    ----------
    max_bytes
        Maximum size of all arrays together [bytes]: nodes, cells, and a few fields.
    max_ratio
        Maximum ratio of decompressed size to file size; coordinates of a mesh do not compress better.
    min_limit
        Decompressed size that is permitted for every file [bytes].
    """

    max_bytes: int = 4 * 1024**3
    max_ratio: int = 100
    min_limit: int = 2**28

    def limit_bytes(self, size: int) -> int:
        """Return the maximum decompressed size [bytes] for a file of `size` bytes.

        Raises
        ------
        InputError
            The file itself is larger than the limit.
        """
        if size > self.max_bytes:
            raise InputError(
                f"its size is {size / 1e9:,.3g} GB: at most {self.max_bytes / 1e9:.3g} GB are allowed. Mesh coarser."
            )
        return min(self.max_bytes, max(self.min_limit, self.max_ratio * size))


MESH_BYTES = MeshSizeLimits()
"""Default limits: four gigabytes, and a hundred times the file size."""


def build_too_large_error(max_bytes: int) -> InputError:
    """Return the error for a mesh file whose arrays need more than `max_bytes` bytes."""
    return InputError(
        f"its arrays take more than {max_bytes / 1e9:.3g} GB: too much for a brain mesh in a file of this size. "
        "Write it again, or use a coarser mesh."
    )


@contextmanager
def limit_memory(max_bytes: int) -> Iterator[None]:
    """Limit the additional memory that a block may allocate to `max_bytes` bytes, if the system supports this.

    Use this around libraries that trust the sizes in the header of a file. The limit applies to the whole process, so
    other threads should allocate little memory in the meantime.

    Raises
    ------
    InputError
        The block requested more memory.
    """
    try:
        import resource  # on Unix only

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ceiling = taken + max_bytes if soft == resource.RLIM_INFINITY else min(taken + max_bytes, soft)
    resource.setrlimit(resource.RLIMIT_AS, (ceiling, hard))
    try:
        yield
    except MemoryError as error:
        raise build_too_large_error(max_bytes) from error
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
