"""Checks that a mesh file has no external references and no oversized arrays, before a library opens the file."""

from pathlib import Path
from xml.etree import ElementTree

from ..errors import InputError
from ..runtime.file_limits import MAX_INFLATION, MeshSizeLimits, build_too_large_error

# Formats of meshio whose readers terminate on truncated files (those of .mdpa, .tec and .node do not), and
# whose files give their uncompressed size (.gz does not).
SUFFIXES = (
    *(".vtu", ".vtk", ".msh", ".inp", ".xdmf", ".xmf", ".mesh", ".meshb", ".bdf", ".nas", ".fem", ".med", ".cgns"),
    *(".h5m", ".hmf", ".avs", ".vol", ".su2", ".ugrid", ".f3grid", ".post", ".dato"),
)


def check_mesh_references(path: Path, limits: MeshSizeLimits) -> None:
    """Reject files with a suffix not in `SUFFIXES`, with data outside their folder, or with HDF5 data beyond `limits`.

    Raises
    ------
    InputError
        The file is rejected; the message gives the reference or the limit.
    """
    import h5py  # optional dependency, like meshio

    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        given = suffix or "a name without ending"
        raise InputError(f"no mesh is read from {given}: give a tetrahedral mesh as {', '.join(SUFFIXES)}.")
    if suffix in (".xdmf", ".xmf"):
        for other in _find_references(path):
            check_hdf5_storage(other, limits)
    elif h5py.is_hdf5(path):
        check_hdf5_storage(path, limits)


def check_hdf5_storage(path: Path, limits: MeshSizeLimits) -> None:
    """Reject HDF5 files with external references, or with arrays larger than the limit or the stored data.

    Raises
    ------
    InputError
        The file is rejected; the message gives the array or the link.
    """
    import h5py

    most = limits.limit_bytes(path.stat().st_size)
    left, seen = most, set()

    def check_group(group: h5py.Group, prefix: str) -> None:
        nonlocal left
        for name in group:
            here = f"{prefix}/{name}"
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise InputError(f"`{here}` is a link of {path.name} to another place. Store the array itself there.")
            found = group[name]
            if found in seen:  # hard link to an object visited before
                continue
            seen.add(found)
            if isinstance(found, h5py.Group):
                check_group(found, here)
            elif isinstance(found, h5py.Dataset) and found.shape is not None:
                if found.is_virtual or found.external:
                    raise InputError(f"`{here}` of {path.name} lies in another file. Store the array itself there.")
                if found.nbytes > MAX_INFLATION * found.id.get_storage_size():
                    raise InputError(f"`{here}` of {path.name} declares more than it holds. Write the file again.")
                left -= found.nbytes
                if left < 0:
                    raise build_too_large_error(most)

    with h5py.File(path, "r") as file:
        check_group(file, "")


def _find_references(path: Path) -> set[Path]:
    """Return the paths of the HDF5 files in the same folder to which an XDMF file refers."""
    folder, named = path.resolve().parent, set()
    for item in ElementTree.parse(path).iter():
        kind = item.get("Format")
        if kind == "HDF":
            name = (item.text or "").strip().split(":")[0]
            other = (folder / name).resolve()
            if not other.is_relative_to(folder):
                raise InputError(f"it refers to {name}, outside of its folder. Put that file into the folder.")
            if not other.is_file():
                raise InputError(f"it refers to {name}, which is not there. Put that file into the folder.")
            named.add(other)
        elif kind not in (None, "XML"):
            raise InputError(f"its numbers are of the format {kind}. Write them as HDF, or as XML.")
    return named
