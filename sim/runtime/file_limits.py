"""How much a file may hold before it is refused: a file from outside decides nothing about memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError

# Deflate, the packing of .npz, .nii.gz, .vtu and HDF5, makes at most 1,032 bytes of one: more is declared, not stored.
INFLATION = 1032
# Bytes that a small file of bzip2 may inflate to, whose packing has no limit: 512 x 512 x 512 voxels of 16 bits.
LITTLE = 2**28
# One array [bytes]: quadratic tetrahedra (10 numbers of 8 bytes) of the finest brain meshes in use, 10 million, take
# 0.8 GB.
LARGEST_ARRAY = 2 * 1024**3
# All arrays of a model file, inflated [bytes]: the shipped one, of five learners, has 0.04 GB.
LARGEST_MODEL = 2 * 1024**3
# What is true of a film, inflated [bytes]: an hour at 25 images a second of a tumour of 500 vertices has 0.5 GB.
LARGEST_FILM = 2**29
# Text that heads a model file [bytes]: the shipped one has 0.02 MB.
LARGEST_HEADER = 16 * 1024**2
# Coordinates of what lies in or near a head [m].
FARTHEST = 10.0
# Voxels of one volume: a head of 200 mm at 0.25 mm has as many.
MOST_VOXELS = 2**29


@dataclass(frozen=True)
class MeshBytes:
    """How many bytes the arrays of a mesh file may inflate to.

    Parameters
    ----------
    largest
        [bytes] Of all arrays together: nodes, cells, and a few fields beside them.
    inflation
        Times the file's size. What inflates further is no mesh: its coordinates hardly repeat.
    small
        [bytes] A small file may inflate to so many all the same.
    """

    largest: int = 4 * 1024**3
    inflation: int = 100
    small: int = 2**28

    def of(self, size: int) -> int:
        """Bytes to which the arrays of a file of `size` bytes may inflate.

        Raises
        ------
        InputError
            A file that is larger itself.
        """
        if size > self.largest:
            raise InputError(
                f"it is of {size / 1e9:,.3g} GB, and {self.largest / 1e9:.3g} GB are the most. Mesh coarser."
            )
        return min(self.largest, max(self.small, self.inflation * size))


MESH_BYTES = MeshBytes()
"""Four gigabytes, and a hundred times a file's size."""


def build_too_large_error(most: int) -> InputError:
    """What is said of a mesh file that asks for more than `most` bytes."""
    return InputError(
        f"its arrays take more than {most / 1e9:.3g} GB: a file of its size holds no such mesh of a brain. "
        "Write it anew, or mesh coarser."
    )


@contextmanager
def limit_memory(most: int) -> Iterator[None]:
    """Refuse a block that takes more than `most` bytes beyond what the process has, where the system counts them.

    For what a library reads: no count in a file's header is believed, whatever its format. The limit is the whole
    process's, so that other threads should ask for little meanwhile.

    Raises
    ------
    InputError
        More was asked for.
    """
    try:
        import resource  # of Unix alone

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ceiling = taken + most if soft == resource.RLIM_INFINITY else min(taken + most, soft)
    resource.setrlimit(resource.RLIMIT_AS, (ceiling, hard))
    try:
        yield
    except MemoryError as error:
        raise build_too_large_error(most) from error
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
