"""FEM solver for an anatomy under resection: one solver for each number of completed resection steps."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from threading import RLock

import numpy as np

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .deformation import Deformation, check_start, join_deformations
from .discretisation.resected_body import RemainingBody, list_remaining_bodies
from .discretisation.term import HistoryTerm
from .effects import Effect, Elasticity, Held, Pulsation, Resection
from .errors import InputError
from .fem import MID_EDGE_KEY, Fem
from .loads import Loads, Resected, check_loads
from .runtime.method_lock import lock_method

# Key in the memory: number of completed steps (B,).
DONE_KEY = "resection"
# shape of a tool pose
POSE_SHAPE = (4, 4)


class ResectedFem:
    """FEM deformation model that solves each load case on the tissue that remains after its resection steps.

    Vertices without remaining tissue keep their undeformed position. History variables have one row for each element or
    node before resection; rows of removed elements and nodes are zero. Instances are thread-safe, as `Fem`.

    Parameters
    ----------
    bodies
        Remaining bodies after 0, 1, ... all resection steps.
    build
        Function that builds the solver of an anatomy.
    eager
        True: build all solvers immediately and keep all of them. False: build each solver on first use.
    limit
        Maximum number of solvers in memory if solvers are built on first use.
    """

    def __init__(
        self, bodies: tuple[RemainingBody, ...], build: Callable[[Anatomy], Fem], eager: bool = False, limit: int = 4
    ):
        self.lock = RLock()
        self._bodies = bodies
        self._solver = lru_cache(len(bodies) if eager else limit)(lambda done: build(bodies[done].anatomy))
        self._rows = lru_cache(None)(lambda done: _list_memory_rows(self._solver(done)))
        self._place = lru_cache(None)(lambda done, name: _find_rows(self._rows(0)[name][0], self._rows(done)[name][0]))
        for done in range(len(bodies) if eager else 0):
            self._solver(done)

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy before resection."""
        return self._bodies[0].anatomy

    def get_remaining_body(self, steps_done: int) -> RemainingBody:
        """Return the body that remains after `steps_done` resection steps."""
        return self._bodies[steps_done]

    @lock_method
    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the equilibrium as `Fem.deform`; `start` may be a solution after another number of resection steps.

        Raises
        ------
        InputError
            See `Fem.deform`; also if a load has more completed steps than the `Resection` has steps.
        """
        check_loads(loads)
        if start is not None:
            check_start(start, len(loads), len(self.anatomy.mesh.nodes))
        done, most = self._get_steps_done(loads), len(self._bodies) - 1
        if (done > most).any():
            raise InputError(f"Resected.done is {done.max()}, but Resection has {most} steps: give at most that.")
        same = (
            np.zeros(len(done), bool)
            if start is None or DONE_KEY not in start.memory
            else start.memory[DONE_KEY] == done
        )
        order, parts, stages = [], [], []
        for stage, stays in sorted(set(zip(done.tolist(), same.tolist(), strict=True))) or [(most, False)]:
            rows = np.flatnonzero((done == stage) & (same == stays))
            begun = None if start is None else self._convert_to_stage(start.select(rows), stage, stays)
            result = self._solver(stage).deform(loads.drop(Resected).select(rows), begun, at)
            order.append(rows)
            stages.append(stage)
            parts.append(self._convert_from_stage(result, stage))
        return (
            self._join_stages(parts, stages).select(np.argsort(np.concatenate(order))) if len(parts) > 1 else parts[0]
        )

    def _get_steps_done(self, loads: Loads) -> np.ndarray:
        cause = loads.get(Resected)
        return np.full(len(loads), len(self._bodies) - 1) if cause is None else cause.done.astype(int)

    def _convert_to_stage(self, start: Deformation, stage: int, is_same: bool) -> Deformation:
        """Return `start` for the solver after `stage` steps; `is_same` is True if `start` has the same number."""
        memory = dict(start.memory) if is_same else self._filter_memory(start.memory, stage)
        memory.pop(DONE_KEY, None)
        for name, place in self._index_memories(memory, stage).items():
            if memory[name].shape[1:] == self._get_shape(name):  # a mismatch is rejected where the memory is read
                memory[name] = memory[name][place]
        return replace(
            start, displacement=self._mask_orphans(start, stage), memory=memory, warm=start.warm if is_same else {}
        )

    def _convert_from_stage(self, result: Deformation, stage: int) -> Deformation:
        """Return a solution after `stage` steps with the history rows of the whole anatomy and its number of steps."""
        memory = {**result.memory, DONE_KEY: np.full(len(result), float(stage))}
        for name, place in self._index_memories(memory, stage).items():
            own = memory[name]
            memory[name] = np.zeros((len(own), *self._get_shape(name)), own.dtype)
            memory[name][place] = own
        return replace(result, displacement=self._mask_orphans(result, stage), memory=memory)

    def _mask_orphans(self, result: Deformation, stage: int) -> np.ndarray:
        """Return the displacements of a solution, with zeros at vertices without a tetrahedron after `stage` steps."""
        orphaned = self._bodies[stage].anatomy.orphaned[result.nodes]
        return np.where(orphaned[:, None], 0.0, result.displacement)

    def _join_stages(self, parts: list[Deformation], stages: list[int]) -> Deformation:
        """Join solutions after different numbers of steps; history variables that a solution lacks are zero."""
        memories = [self._filter_memory(part.memory, stage) for part, stage in zip(parts, stages, strict=True)]
        shapes = {name: value.shape[1:] for memory in memories for name, value in memory.items()}
        whole = [
            {name: np.zeros((len(part), *shape)) for name, shape in shapes.items()} | memory
            for part, memory in zip(parts, memories, strict=True)
        ]
        return join_deformations(
            [replace(part, memory=memory, warm={}) for part, memory in zip(parts, whole, strict=True)]
        )

    def _filter_memory(self, memory: Mapping[str, np.ndarray], stage: int) -> dict[str, np.ndarray]:
        """Return the history variables that are valid after other steps too: element and node data, poses, steps."""
        rows = self._rows(stage)
        return {
            name: value
            for name, value in memory.items()
            if name in rows or name == DONE_KEY or value.shape[2:] == POSE_SHAPE
        }

    def _index_memories(
        self, memory: Mapping[str, np.ndarray], stage: int
    ) -> dict[str, tuple[slice, np.ndarray, slice]]:
        """Return, by name, the index into each history variable of the whole anatomy for its rows after `stage` steps.

        The rows are shorter if the removed tissue had a longer Prony series than the remaining tissue.
        """
        rows = self._rows(stage) if stage else {}
        return {name: (slice(None), self._place(stage, name), slice(rows[name][1])) for name in memory if name in rows}

    def _get_shape(self, name: str) -> tuple[int, int]:
        """Return the shape (rows, row length) of the history variable `name` of the anatomy before resection."""
        marks, width = self._rows(0)[name]
        return len(marks), width


def _list_memory_rows(fem: Fem) -> dict[str, tuple[np.ndarray, int]]:
    """Return the unique row keys (n, k) and the row length of each history variable of elements or nodes, by name."""
    terms = [term for term in fem.problem.terms if isinstance(term, HistoryTerm)]
    return {MID_EDGE_KEY: (fem.space.edges, 3)} | {term.name: (term.keys, term.width) for term in terms}


def _find_rows(table: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the index (n,) in `table` (m, k) of each row of `rows` (n, k)."""
    _, number = np.unique(np.concatenate([table, rows]), axis=0, return_inverse=True)
    known, asked = np.split(number.ravel(), [len(table)])
    order = np.argsort(known)
    return order[np.searchsorted(known, asked, sorter=order)]


def build_fem(
    anatomy: Anatomy,
    effects: Iterable[Effect],
    accuracy: Accuracy = TRAIN,
    device: str = "auto",
    batch: int | None = None,
    element: str | None = None,
    live: bool = False,
) -> Fem | ResectedFem:
    """Return the FEM solver for effects, which may include `Resection`; the arguments are those of `Fem`.

    Raises
    ------
    InputError
        See `Fem`; also if a resection step is not possible on this mesh.
    """
    effects = tuple(effects)
    cuts = [effect for effect in effects if isinstance(effect, Resection)]
    if len(cuts) != 1:
        return Fem(anatomy, effects, accuracy, device, batch, element, live)
    # vertices without remaining tissue are fixed, even if the user has no `Held`
    others = [effect for effect in effects if not isinstance(effect, Resection | Held)]

    def build(body: Anatomy) -> Fem:
        return Fem(body, (*_restrict_effects(others, anatomy, body), Held()), accuracy, device, batch, element, live)

    return ResectedFem(list_remaining_bodies(anatomy, effects), build, eager=live)


def _restrict_effects(effects: Iterable[Effect], anatomy: Anatomy, remaining_anatomy: Anatomy) -> tuple[Effect, ...]:
    """Return the effects without references to the regions that resection has completely removed."""
    present = set(remaining_anatomy.mesh.region.tolist())
    removed = set(anatomy.mesh.region.tolist()) - present

    def restrict(effect: Effect) -> Effect | None:
        if isinstance(effect, Pulsation) and effect.regions is not None:
            left = tuple(label for label in effect.regions if label not in removed)
            return replace(effect, regions=left) if left else None
        return effect.restrict(present | set(effect.regions) - removed) if isinstance(effect, Elasticity) else effect

    return tuple(effect for effect in map(restrict, effects) if effect is not None)
