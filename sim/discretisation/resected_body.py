"""Remaining body after each step of a resection; disconnected parts are removed too."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..anatomy import Anatomy
from ..effects import Bonded, Effect, Held, Resection, Slide
from ..errors import InputError
from .rigid_modes import check_fixed, find_loose_tetrahedra


@dataclass(frozen=True, eq=False)
class RemainingBody:
    """Remaining body after a number of resection steps.

    Parameters
    ----------
    steps_done
        Number of completed resection steps.
    anatomy
        Remaining anatomy, with the vertex numbers of the anatomy before resection.
    loose_tetrahedra
        Numbers (n,), before resection, of tetrahedra removed because they lost the connection to all fixed nodes.
    """

    steps_done: int
    anatomy: Anatomy
    loose_tetrahedra: np.ndarray

    def __str__(self) -> str:
        """Return a description for users."""
        said = f"{self.steps_done} step{'' if self.steps_done == 1 else 's'} done"
        if not len(self.loose_tetrahedra):
            return said
        return f"{said}; {len(self.loose_tetrahedra)} tetrahedra that nothing held any more went too"


def list_remaining_bodies(anatomy: Anatomy, effects: Iterable[Effect]) -> tuple[RemainingBody, ...]:
    """Return the remaining bodies for effects with `Resection`; without `Held`, `Anatomy.fixed` is ignored.

    Raises
    ------
    InputError
        See `compute_remaining_bodies`.
    """
    effects = tuple(effects)
    cut = next(effect for effect in effects if isinstance(effect, Resection))
    kinds = {type(effect) for effect in effects}
    held = Held in kinds or not anatomy.fixed.any()
    whole = anatomy if held else replace(anatomy, fixed=np.zeros_like(anatomy.fixed))
    return compute_remaining_bodies(whole, cut, bool(kinds & {Bonded, Slide}))


def compute_remaining_bodies(anatomy: Anatomy, effect: Resection, can_slide: bool = True) -> tuple[RemainingBody, ...]:
    """Return the remaining bodies after 0, 1, ... all steps; `can_slide` is True if slide normals also support tissue.

    Raises
    ------
    InputError
        The body is not fixed, a step contains a tetrahedron that the mesh does not have, or no tetrahedron remains.
    """
    return tuple(_iterate_bodies(anatomy, effect, can_slide))


def _iterate_bodies(anatomy: Anatomy, effect: Resection, can_slide: bool) -> Iterator[RemainingBody]:
    normal = anatomy.slide_normal if can_slide else np.zeros_like(anatomy.slide_normal)
    check_fixed(anatomy.mesh, anatomy.fixed, normal)  # else all of it would count as disconnected
    yield RemainingBody(0, anatomy, np.zeros(0, np.int64))
    taken: set[int] = set()
    for done, step in enumerate(effect.steps, start=1):
        taken.update(step)
        removed = np.array(sorted(taken))
        try:
            left = anatomy.remove_elements(removed)
            kept = np.setdiff1d(np.arange(len(anatomy.mesh.tets)), removed)
            loose = kept[find_loose_tetrahedra(left, can_slide)]
            yield RemainingBody(
                done, anatomy.remove_elements(np.concatenate([removed, loose])) if len(loose) else left, loose
            )
        except InputError as error:
            raise InputError(f"step {done} of Resection cannot be done: {error}") from error
