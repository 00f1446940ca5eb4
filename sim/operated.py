"""Finite elements of a body from which tissue is taken: one solver for each state that it passes through."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .deformation import Deformation, joined
from .effects import Effect, Elasticity, Held, Pulsation, Resection
from .errors import InputError
from .fem import Fem
from .loads import Loads, Resected
from .resection import Remains, bodies

# The history's key for how many steps (B,) were done.
DONE = "resection"
# Solvers that are kept.
KEPT = 4


class Operated:
    """A Deformer: each load case is answered by the finite elements of what is left of the body.

    Vertices of which nothing is left stay where they were in the scan.

    Parameters
    ----------
    bodies
        After 0, 1, ... all steps.
    make
        Makes the solver of one of them.
    ahead
        All are made at once, and kept: no load waits for one. Else each when it is first asked for, and a few are kept.
    """

    def __init__(self, bodies: tuple[Remains, ...], make: Callable[[Anatomy], Fem], ahead: bool = False):
        self._bodies = bodies
        self._solver = lru_cache(len(bodies) if ahead else KEPT)(lambda done: make(bodies[done].anatomy))
        for done in range(len(bodies) if ahead else 0):
            self._solver(done)

    @property
    def anatomy(self) -> Anatomy:
        """The whole body."""
        return self._bodies[0].anatomy

    def remains(self, done: int) -> Remains:
        """What is left after so many steps."""
        return self._bodies[done]

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """As `Fem.deform`; `start` may be an answer after other steps: positions and what nodes remember go on.

        Raises
        ------
        InputError
            As `Fem.deform`; more steps done than there are.
        """
        done, most = self._done(loads), len(self._bodies) - 1
        if (done > most).any():
            raise InputError(f"Resected.done is {done.max()}, but Resection has {most} steps: give at most that.")
        order, parts = [], []
        for stage in np.unique(done).tolist():
            rows = np.flatnonzero(done == stage)
            begun = None if start is None else self._carried(start.rows(rows), stage)
            answer = self._solver(stage).deform(loads.but(Resected).rows(rows), begun, at)
            order.append(rows)
            parts.append(self._masked(answer, stage))
        return _together(parts).rows(np.argsort(np.concatenate(order))) if len(parts) > 1 else parts[0]

    def _done(self, loads: Loads) -> np.ndarray:
        cause = loads.of(Resected)
        return np.full(len(loads), len(self._bodies) - 1) if cause is None else cause.done.astype(int)

    def _carried(self, start: Deformation, stage: int) -> Deformation:
        """An earlier answer as one of this body: after other steps, what elements remember is another body's."""
        history = dict(start.history)
        before = history.pop(DONE, None)
        if before is None or (before != stage).any():
            vertex = (len(self.anatomy.mesh.nodes), 3)
            history = {name: value for name, value in history.items() if value.shape[1:] == vertex}
        return self._masked(replace(start, history=history), stage, marked=False)

    def _masked(self, answer: Deformation, stage: int, marked: bool = True) -> Deformation:
        """The answer with orphaned vertices at rest; `marked` with the steps that it is of."""
        orphaned = self._bodies[stage].anatomy.orphaned[answer.nodes]
        displacement = np.where(orphaned[:, None], 0.0, answer.displacement)
        history = {**answer.history, DONE: np.full(len(answer), stage)} if marked else answer.history
        return replace(answer, displacement=displacement, history=history)


def finite_elements(
    anatomy: Anatomy,
    effects: Iterable[Effect],
    accuracy: Accuracy = TRAIN,
    device: str = "auto",
    batch: int | None = None,
    element: str | None = None,
    live: bool = False,
) -> Fem | Operated:
    """The finite elements that effects ask for, `Resection` among them; else as `Fem`.

    Raises
    ------
    InputError
        As `Fem`; steps that cannot be done.
    """
    effects = tuple(effects)
    cuts = [effect for effect in effects if isinstance(effect, Resection)]
    if len(cuts) != 1:
        return Fem(anatomy, effects, accuracy, device, batch, element, live)
    # Vertices of which nothing is left are held, whoever asks for it.
    others = [effect for effect in effects if not isinstance(effect, Resection | Held)]

    def make(body: Anatomy) -> Fem:
        return Fem(body, (*_of(others, anatomy, body), Held()), accuracy, device, batch, element, live)

    return Operated(bodies(anatomy, effects), make, ahead=live)


def _of(effects: Iterable[Effect], whole: Anatomy, body: Anatomy) -> tuple[Effect, ...]:
    """Effects without what they say of regions that are gone altogether."""
    gone = set(whole.mesh.region.tolist()) - set(body.mesh.region.tolist())

    def kept(effect: Effect) -> Effect:
        if isinstance(effect, Pulsation) and effect.regions is not None:
            return replace(effect, regions=tuple(label for label in effect.regions if label not in gone))
        if not isinstance(effect, Elasticity):
            return effect
        return replace(effect, regions={label: law for label, law in effect.regions.items() if label not in gone})

    return tuple(map(kept, effects))


def _together(parts: list[Deformation]) -> Deformation:
    """Answers of several bodies; of what nodes and elements remember, that which has the same shape in all."""
    shapes: dict[str, set[tuple[int, ...]]] = {}
    for part in parts:
        for name, value in part.history.items():
            shapes.setdefault(name, set()).add(value.shape[1:])
    kept = {name for name, found in shapes.items() if len(found) == 1}
    return joined(
        [replace(part, history={name: part.history[name] for name in kept & set(part.history)}) for part in parts]
    )
