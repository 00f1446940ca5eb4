"""Anatomies of episodes, found by digest: the template, or files next to the episodes."""

from functools import cache
from pathlib import Path

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError

from ...script.shipped_files import get_template_path
from .contents import EpisodeContents


def find_anatomy(contents: EpisodeContents) -> Anatomy | None:
    """Find the anatomy with the digest of an episode; None if it is neither the template nor in a nearby folder.

    Files `bodies/*/anatomy.vtu` in the episode's folder and in its parent folder are searched.
    """
    return _find_anatomy(str(contents.attributes.get("anatomy")), contents.path.resolve().parent)


def is_template(digest: str) -> bool:
    """Return True if a digest is that of the template anatomy."""
    template = _read_anatomy(get_template_path())
    return template is not None and template.digest == digest


def find_surface_rows(surface: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Select the triangles (S, 3) with all corners in sorted `nodes` (n,); return them as indices into `nodes`."""
    places = np.searchsorted(nodes, surface).clip(max=len(nodes) - 1)
    return places[(nodes[places] == surface).all(axis=1)]


@cache
def _find_anatomy(digest: str, folder: Path) -> Anatomy | None:
    places = [path for above in (folder, folder.parent) for path in sorted(above.glob("bodies/*/anatomy.vtu"))]
    for path in (get_template_path(), *places):
        anatomy = _read_anatomy(path)
        if anatomy is not None and anatomy.digest == digest:
            return anatomy
    return None


@cache
def _read_anatomy(path: Path) -> Anatomy | None:
    """Read an anatomy; None if the file cannot be read."""
    try:
        return read_anatomy(path)
    except InputError:
        return None
