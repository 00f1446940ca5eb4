"""What each learner is made of: the summands of its response, fitted to displacements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sim.accuracy import REFERENCE
from sim.effects import pushed_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Pushed
from sim.material import tissue_from_json

from .ann import Ann
from .dataset import Dataset
from .encode import ENCODERS, Basis, directions, reduce
from .gp import Gp
from .learned import Part, only_pushed
from .linear import Linear
from .patch import Patch, open_patch
from .pcr import Pcr
from .regressor import Regressor
from .remainder import Remainder
from .series import Series
from .svr import Svr
from .tabulate import radii_between, series_of, tabulated

# Encoder and regressor of each but the table itself; principal components are those of the forces at the nodes.
LEARNT: dict[str, tuple[str, Callable[[], Regressor]]] = {
    "pcr": ("nodal", Pcr),
    "ann": ("tool", Ann),
    "svr": ("tool", Svr),
    "gp": ("tool", Gp),
    "residual": ("tool", Ann),
}
# Those that ask the finite elements for their series, of which the second learns what it leaves.
EXPANDED = ("series", "series-gp")
# Share of the responses that a learner's basis may lose, and its most modes; the same of the tables, and of the series.
TOLERANCE, MODES = 1e-3, 60
TABLE_TOLERANCE = 1e-4
FINE_TOLERANCE, FINE_MODES = 2e-4, 64


@dataclass(frozen=True, eq=False)
class Lesson:
    """Loads and what they did to the tumour and to the rest of the open cortex.

    Parameters
    ----------
    loads
        B pushes.
    tumour, cortex
        Displacements (B, n, 3) [m].
    """

    loads: Pushed
    tumour: np.ndarray
    cortex: np.ndarray


@dataclass(frozen=True, eq=False)
class Expansion:
    """The power series of a data set's finite elements, made once, when it is first asked for.

    Parameters
    ----------
    data
        Its anatomy, tissue and element; its loads say how wide tools are.
    device
        Where the finite elements work.
    progress
        Hears which place is done, and of how many.
    """

    data: Dataset
    device: str = "auto"
    progress: Callable[[int, int], object] = lambda done, total: None

    def on(self, basis: Basis) -> Series:
        """The series as coefficients of a basis of tumour or open cortex.

        Raises
        ------
        InputError
            Data that do not say what tissue they are of.
        """
        return series_of(self._table, self._nodes, self._patch, self._radii, basis)

    @cached_property
    def _patch(self) -> Patch:
        return open_patch(self.data.anatomy)

    @cached_property
    def _nodes(self) -> np.ndarray:
        return np.union1d(self._patch.nodes, self.data.anatomy.tumour_nodes)

    @cached_property
    def _radii(self) -> np.ndarray:
        footprint = only_pushed(self.data.loads).footprint
        return radii_between(float(footprint.min()), float(footprint.max()))

    @cached_property
    def _table(self) -> np.ndarray:
        return tabulated(self._fem(), self._patch, self._radii, self._nodes, self.progress)

    def _fem(self) -> Fem:
        said = self.data.provenance
        if "tissue" not in said:
            raise InputError(
                f"{self.data.path}: does not say what tissue it is of, so no series can be had of it: choose other "
                "learners, or simulate anew."
            )
        effects = pushed_effects(self.data.anatomy, tissue_from_json(said["tissue"]))
        return Fem(self.data.anatomy, effects, REFERENCE, self.device, element=said.get("element"))


@dataclass(frozen=True, eq=False)
class Classroom:
    """What every learner of a data set is given, made when it is asked for.

    Parameters
    ----------
    data
        Its anatomy and its unit responses.
    patch
        Its open cortex.
    basis_from
        The lesson whose responses the series' bases span.
    expansion
        Of the same data.
    """

    data: Dataset
    patch: Patch
    basis_from: Lesson
    expansion: Expansion

    @cached_property
    def tumour(self) -> np.ndarray:
        """Vertices of the tumour."""
        return self.data.anatomy.tumour_nodes

    @cached_property
    def cortex(self) -> np.ndarray:
        """Vertices of the open cortex beside the tumour's."""
        return np.setdiff1d(self.patch.nodes, self.tumour)

    @cached_property
    def table(self) -> Part:
        """The tumour's compliance."""
        return self._compliance(self.tumour)

    @cached_property
    def cortex_table(self) -> tuple[Part, ...]:
        """The cortex's compliance, if there is more than the tumour."""
        return (self._compliance(self.cortex),) if len(self.cortex) else ()

    @cached_property
    def series(self) -> tuple[Part, Part | None]:
        """The finite elements' series at the tumour, and at the cortex what it adds to the compliance there."""
        taught = self.basis_from
        size = directions(taught.loads)[0][:, None, None]
        bases = [reduce(self.tumour, taught.tumour / size, FINE_TOLERANCE, FINE_MODES)]
        if len(self.cortex):
            # A dent as small as its tool is no sum of a few modes, but what nonlinearity adds to it is.
            linear = sum(part.response(ENCODERS[part.encoder](self.patch, taught.loads)) for part in self.cortex_table)
            bases.append(reduce(self.cortex, taught.cortex / size - linear, TOLERANCE, MODES))
        found = [self.expansion.on(basis) for basis in bases]
        at_cortex = Part("tool", found[1].from_second_order(), bases[1]) if len(self.cortex) else None
        return Part("tool", found[0], bases[0]), at_cortex

    def _compliance(self, nodes: np.ndarray) -> Part:
        """The compliance table of some vertices, from the unit responses, in as many modes as it needs."""
        response = self.data.unit_response(nodes)
        basis = reduce(nodes, response, TABLE_TOLERANCE, len(response))
        return Part("nodal", Linear().fit(np.eye(len(response)), basis.encode(response)), basis)


def parts_of(name: str, room: Classroom, lesson: Lesson) -> tuple[Part, ...]:
    """The summands of one learner, taught with a lesson: for the tumour, and for the cortex beside it."""
    if name in EXPANDED:
        tumour, more = room.series
        cortex = () if more is None else (*room.cortex_table, more)
        if name == "series":
            return (tumour, *cortex)
        learnt = _taught(("tool", Remainder), (tumour,), tumour.basis, room.patch, lesson.loads, lesson.tumour)
        if more is None:
            return (tumour, learnt)
        left = _taught(("tool", Remainder), cortex, more.basis, room.patch, lesson.loads, lesson.cortex)
        return (tumour, learnt, *cortex, left)
    if name == "linear":
        return (room.table, *room.cortex_table)
    before = (room.table,) if name == "residual" else ()
    learnt = _taught(LEARNT[name], before, room.tumour, room.patch, lesson.loads, lesson.tumour)
    return (*before, learnt, *room.cortex_table)


def _taught(
    kind: tuple[str, Callable[[], Regressor]],
    before: tuple[Part, ...],
    on: Basis | np.ndarray,
    patch: Patch,
    loads: Pushed,
    truth: np.ndarray,
) -> Part:
    """A part for what those `before` leave of `truth` (B, n, 3) [m]: `on` a basis, or on vertices (n,)."""
    response = truth / directions(loads)[0][:, None, None]
    for part in before:
        response = response - part.response(ENCODERS[part.encoder](patch, loads))
    basis = on if isinstance(on, Basis) else reduce(on, response, TOLERANCE, MODES)
    encoder, regressor = kind
    return Part(encoder, regressor().fit(ENCODERS[encoder](patch, loads), basis.encode(response)), basis)
