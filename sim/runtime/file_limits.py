"""Size limits of files from outside, so that a malicious or damaged file cannot exhaust the memory."""

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
    """Limits of the inflated size of a mesh file's arrays.

    Parameters
    ----------
    max_bytes
        Maximum size of all arrays together [bytes]: nodes, cells, and a few fields.
    max_ratio
        Maximum ratio to the file's size; a mesh does not inflate further, because its coordinates hardly repeat.
    min_limit
        Size that every file may inflate to [bytes].
    """

    max_bytes: int = 4 * 1024**3
    max_ratio: int = 100
    min_limit: int = 2**28

    def limit_bytes(self, size: int) -> int:
        """Return the inflated size [bytes] that is allowed for a file of `size` bytes.

        Raises
        ------
        InputError
            A file that is larger than the limit itself.
        """
        if size > self.max_bytes:
            raise InputError(
                f"its size is {size / 1e9:,.3g} GB: at most {self.max_bytes / 1e9:.3g} GB are allowed. Mesh coarser."
            )
        return min(self.max_bytes, max(self.min_limit, self.max_ratio * size))


MESH_BYTES = MeshSizeLimits()
"""Default limits: four gigabytes, and a hundred times a file's size."""


def build_too_large_error(max_bytes: int) -> InputError:
    """Build the error for a mesh file whose arrays take more than `max_bytes` bytes."""
    return InputError(
        f"its arrays take more than {max_bytes / 1e9:.3g} GB: too much for a brain mesh in a file of this size. "
        "Write it again, or use a coarser mesh."
    )


@contextmanager
def limit_memory(max_bytes: int) -> Iterator[None]:
    """Limit the memory that a block may take in addition, to `max_bytes` bytes, where the system supports it.

    For reading with libraries, which trust sizes in a file's header. The limit applies to the whole process, so other
    threads should allocate little meanwhile.

    Raises
    ------
    InputError
        The block asked for more.
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
