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
from .ladder import LEARNT_KEY
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
        """As `Fem.deform`; `start` may be an answer after other steps: positions, what nodes remember and tools go on.

        Raises
        ------
        InputError
            As `Fem.deform`; more steps done than there are.
        """
        done, most = self._done(loads), len(self._bodies) - 1
        if (done > most).any():
            raise InputError(f"Resected.done is {done.max()}, but Resection has {most} steps: give at most that.")
        same = np.zeros(len(done), bool) if start is None or DONE not in start.history else start.history[DONE] == done
        order, parts = [], []
        for stage, stays in sorted(set(zip(done.tolist(), same.tolist(), strict=True))) or [(most, False)]:
            rows = np.flatnonzero((done == stage) & (same == stays))
            begun = None if start is None else self._carried(start.rows(rows), stage, stays)
            answer = self._solver(stage).deform(loads.but(Resected).rows(rows), begun, at)
            order.append(rows)
            parts.append(self._masked(answer, stage))
        return _together(parts).rows(np.argsort(np.concatenate(order))) if len(parts) > 1 else parts[0]

    def _done(self, loads: Loads) -> np.ndarray:
        cause = loads.of(Resected)
        return np.full(len(loads), len(self._bodies) - 1) if cause is None else cause.done.astype(int)

    def _carried(self, start: Deformation, stage: int, stays: bool) -> Deformation:
        """An earlier answer as one of this body: after other steps, what elements remember is another body's."""
        history = {name: _stripped(value) for name, value in start.history.items() if name != DONE}
        if not stays:
            vertex, pose = (len(self.anatomy.mesh.nodes), 3), (4, 4)
            history = {
                name: value for name, value in history.items() if value.shape[1:] == vertex or value.shape[2:] == pose
            }
        history = {name: value for name, value in history.items() if value.size or not len(start)}
        return self._masked(replace(start, history=history), stage, marked=False)

    def _masked(self, answer: Deformation, stage: int, marked: bool = True) -> Deformation:
        """The answer with orphaned vertices at rest; `marked` with the steps that it is of."""
        orphaned = self._bodies[stage].anatomy.orphaned[answer.nodes]
        displacement = np.where(orphaned[:, None], 0.0, answer.displacement)
        history = {**answer.history, DONE: np.full(len(answer), float(stage))} if marked else answer.history
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

    def kept(effect: Effect) -> Effect | None:
        if isinstance(effect, Pulsation) and effect.regions is not None:
            left = tuple(label for label in effect.regions if label not in gone)
            return replace(effect, regions=left) if left else None
        if not isinstance(effect, Elasticity):
            return effect
        return replace(effect, regions={label: law for label, law in effect.regions.items() if label not in gone})

    return tuple(effect for effect in map(kept, effects) if effect is not None)


def _together(parts: list[Deformation]) -> Deformation:
    """Answers of several bodies; what fewer elements remember is filled up to one shape, as `_stripped` takes off."""
    shapes: dict[str, list[tuple[int, ...]]] = {}
    for part in parts:
        for name, value in part.history.items():
            if not name.startswith(LEARNT_KEY):
                shapes.setdefault(name, []).append(value.shape[1:])

    def filled(part: Deformation, name: str) -> np.ndarray:
        whole = np.full((len(part), *np.max(shapes[name], axis=0).astype(int)), np.nan)
        value = part.history.get(name)
        if value is not None:
            whole[tuple(map(slice, value.shape))] = value
        return whole

    return joined([replace(part, history={name: filled(part, name) for name in shapes}) for part in parts])


def _stripped(value: np.ndarray) -> np.ndarray:
    """History (B, ...) without the rows of each axis but the first that `_together` filled up."""
    if not np.isnan(value).any():
        return value
    known = ~np.isnan(value)
    for axis in range(1, value.ndim):
        some = known.any(axis=tuple(other for other in range(value.ndim) if other != axis))
        value, known = (np.take(array, np.flatnonzero(some), axis=axis) for array in (value, known))
    return value
