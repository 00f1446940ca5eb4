"""Checks of a mesh file's format and of the files that it refers to, before a library opens it."""

from pathlib import Path
from xml.etree import ElementTree

from ..errors import InputError

# Formats of meshio whose readers terminate on truncated files (those of .mdpa, .tec and .node do not), and
# whose files give their uncompressed size (.gz does not).
SUFFIXES = (
    *(".vtu", ".vtk", ".msh", ".inp", ".xdmf", ".xmf", ".mesh", ".meshb", ".bdf", ".nas", ".fem", ".med", ".cgns"),
    *(".h5m", ".hmf", ".avs", ".vol", ".su2", ".ugrid", ".f3grid", ".post", ".dato"),
)


def check_mesh_references(path: Path) -> None:
    """Reject formats other than `SUFFIXES`, and XDMF with numbers outside its folder.

    Raises
    ------
    InputError
        With the format or the reference.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        given = suffix or "a name without ending"
        raise InputError(f"no mesh is read from {given}: give a tetrahedral mesh as {', '.join(SUFFIXES)}.")
    if suffix not in (".xdmf", ".xmf"):
        return
    folder = path.resolve().parent
    for item in ElementTree.parse(path).iter():
        kind = item.get("Format")
        if kind == "HDF":
            name = (item.text or "").strip().split(":")[0]
            other = (folder / name).resolve()
            if not other.is_relative_to(folder):
                raise InputError(f"it refers to {name}, outside of its folder. Put that file into the folder.")
            if not other.is_file():
                raise InputError(f"it refers to {name}, which is not there. Put that file into the folder.")
        elif kind not in (None, "XML"):
            raise InputError(f"its numbers are of the format {kind}. Write them as HDF, or as XML.")
