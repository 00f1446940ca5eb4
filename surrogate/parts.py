"""What each learner is made of: the summands of its response, fitted to displacements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sim.accuracy import REFERENCE
from sim.effects import pushed_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.files import written_whole
from sim.loads import Pushed
from sim.material import tissue_from_json
from sim.reading import read_as

from .ann import Ann
from .condense import condensed, side_by_side
from .contact import Contact
from .dataset import Dataset
from .encode import ENCODERS, Basis, directions, reduce, tool_features
from .gp import Gp
from .learned import Part, only_pushed
from .learner import find_own, name_of
from .linear import Linear
from .patch import Patch, open_patch
from .pcr import Pcr
from .regressor import Regressor
from .remainder import Remainder
from .series import Series
from .svr import Svr
from .tabulate import radii_between, tabulated, with_middles

# Encoder and regressor of each but the table itself; principal components are those of the forces at the nodes.
LEARNT: dict[str, tuple[str, Callable[[], Regressor]]] = {
    "pcr": ("nodal", Pcr),
    "ann": ("tool", Ann),
    "svr": ("tool", Svr),
    "gp": ("tool", Gp),
    "residual": ("tool", Ann),
}
# Those that poses teach: where the ball is stands for what it presses with.
POSED = ("gp", "ann", "svr")
# The same, of those that ask the finite elements how linear tissue gives; the second learns what that leaves.
TOUCHED = ("contact", "contact-gp")
# Those that ask the finite elements for their series, of which the second learns what it leaves.
EXPANDED = ("series", "series-gp")
# Share of the responses that a learner's basis may lose, and its most modes; the same of the tables, and of the series.
COARSE = (1e-3, 60)
TABLE_TOLERANCE = 1e-4
FINE = (2e-4, 64)
# The same of the bases that series are tabulated in: 192 modes keep all but 1e-4 of the tumour's motion.
WIDE = (1e-5, 192)


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
    """What a data set's finite elements say without learning: compliance, power series, contact; made when asked for.

    The series is tabulated in wide bases, of what all loads do, that the basis of any lesson nearly lies in: what a
    table holds does not depend on the lesson, and grows neither with the tumour nor with the cortex.

    Parameters
    ----------
    data
        Its anatomy, tissue and element; its loads say how wide tools are.
    device
        Where the finite elements work.
    progress
        Hears which place is done, and of how many.
    kept
        Where the series' table is read from, and written to where there is none: of these data, as the caller knows.
    """

    data: Dataset
    device: str = "auto"
    progress: Callable[[int, int], object] = lambda done, total: None
    kept: Path | None = None

    @cached_property
    def patch(self) -> Patch:
        """The open cortex."""
        return open_patch(self.data.anatomy)

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

    def bases(self, lesson: Lesson, tumour: tuple[float, int], cortex: tuple[float, int]) -> list[Basis]:
        """What a lesson's loads do to the tumour, and to the cortex, if there is more, beyond its compliance.

        `tumour` and `cortex` are what may be left of it, as a share, and the most modes.
        """
        size = directions(lesson.loads)[0][:, None, None]
        at_tumour = reduce(self.tumour, lesson.tumour / size, *tumour)
        if not len(self.cortex):
            return [at_tumour]
        # A dent as small as its tool is no sum of a few modes, but what nonlinearity adds to it is.
        linear = sum(part.response(ENCODERS[part.encoder](self.patch, lesson.loads)) for part in self.cortex_table)
        return [at_tumour, reduce(self.cortex, lesson.cortex / size - linear, *cortex)]

    def on(self, bases: list[Basis]) -> list[Series]:
        """The series as coefficients of the `bases` of a lesson.

        Raises
        ------
        InputError
            Data that do not say what tissue they are of.
        """
        bases_of_all, table_of_all = self.coefficients
        cuts = np.cumsum([len(wide.modes) for wide in bases_of_all])
        tables = np.split(table_of_all, cuts[:-1], axis=-1)
        triangles = with_middles(self.patch)[0]
        found = []
        for table, wide, basis in zip(tables, bases_of_all, bases, strict=True):
            exact = Series(self.patch.points, triangles, self._radii, table @ (wide.modes @ basis.modes.T))
            found.append(Series.restored(exact.state()))  # what is used is what can be stored
        return found

    @cached_property
    def contact(self) -> tuple[Contact, list[Basis]]:
        """The ball on linear tissue, and the bases of tumour and cortex whose coefficients it answers with.

        Raises
        ------
        InputError
            Data that do not say what tissue they are of.
        """
        return condensed(self._fem(), [some for some in (self.tumour, self.cortex) if len(some)])

    def _compliance(self, nodes: np.ndarray) -> Part:
        """The compliance table of some vertices, from the unit responses, in as many modes as it needs."""
        response = self.data.unit_response(nodes)
        basis = reduce(nodes, response, TABLE_TOLERANCE, len(response))
        return Part("nodal", Linear().fit(np.eye(len(response)), basis.encode(response)), basis)

    @cached_property
    def coefficients(self) -> tuple[list[Basis], np.ndarray]:
        """The wide bases of tumour and cortex, and coefficients (places, radii, 19, r) float32 of all their modes.

        Raises
        ------
        InputError
            Data that do not say what tissue they are of.
        """
        nodes = [some for some in (self.tumour, self.cortex) if len(some)]
        if self.kept is not None and self.kept.exists():
            with (
                read_as(self.kept, "a table of the series", "Delete it: it is made anew."),
                self.kept.open("rb") as raw,
                np.load(raw) as file,
            ):
                modes = [file[f"arr_{k}"] for k in range(1, len(nodes) + 1)]
                return [Basis(*each) for each in zip(nodes, modes, strict=True)], file["arr_0"]
        fem, wide = self._fem(), self._wide()
        whole = side_by_side(wide)
        reading = fem.reading(whole.nodes, whole.modes.reshape(len(whole.modes), -1, 3))
        table = tabulated(fem, self.patch, self._radii, reading, self.progress)
        if self.kept is not None:
            with written_whole(self.kept, ".npz") as partial:
                np.savez(partial, table, *(basis.modes for basis in wide))
        return wide, table

    def _wide(self) -> list[Basis]:
        good = self.data.good
        loads = only_pushed(self.data.loads.rows(np.flatnonzero(good)))
        tumour, cortex = (self.data.displacement(nodes)[good] for nodes in (self.tumour, self.cortex))
        return self.bases(Lesson(loads, tumour, cortex), WIDE, WIDE)

    @cached_property
    def _radii(self) -> np.ndarray:
        footprint = only_pushed(self.data.loads).footprint
        return radii_between(float(footprint.min()), float(footprint.max()))

    def _fem(self) -> Fem:
        said = self.data.provenance
        if "tissue" not in said:
            raise InputError(
                f"{self.data.path}: does not say what tissue it is of, so no series or contact can be had of it: "
                "choose other learners, or simulate anew."
            )
        effects = pushed_effects(self.data.anatomy, tissue_from_json(said["tissue"]))
        return Fem(self.data.anatomy, effects, REFERENCE, self.device, element=said.get("element"))


@dataclass(frozen=True, eq=False)
class Classroom:
    """What every learner of a data set is given, made when it is asked for.

    Parameters
    ----------
    basis_from
        The lesson whose responses the series' bases span.
    expansion
        Of the same data.
    """

    basis_from: Lesson
    expansion: Expansion

    @cached_property
    def series(self) -> tuple[Part, Part | None]:
        """The finite elements' series at the tumour, and at the cortex what it adds to the compliance there."""
        bases = self.expansion.bases(self.basis_from, FINE, COARSE)
        found = self.expansion.on(bases)
        at_cortex = Part("tool", found[1].from_second_order(), bases[1]) if len(bases) > 1 else None
        return Part("tool", found[0], bases[0]), at_cortex


def parts_of(name: str, room: Classroom, lesson: Lesson) -> tuple[Part, ...]:
    """The summands of one learner, taught with a lesson: for the tumour, and for the cortex beside it."""
    known = room.expansion
    if name in EXPANDED:
        tumour, more = room.series
        cortex = () if more is None else (*known.cortex_table, more)
        if name == "series":
            return (tumour, *cortex)
        learnt = _taught(("tool", Remainder), (tumour,), tumour.basis, known.patch, lesson.loads, lesson.tumour)
        if more is None:
            return (tumour, learnt)
        left = _taught(("tool", Remainder), cortex, more.basis, known.patch, lesson.loads, lesson.cortex)
        return (tumour, learnt, *cortex, left)
    if name == "linear":
        return (known.table, *known.cortex_table)
    if name in TOUCHED:
        contact, left = _touched(known, lesson)
        if name == "contact":
            return (contact,)
        return (contact, *(_taught(LEARNT["gp"], (), nodes, known.patch, lesson.loads, rest) for nodes, rest in left))
    if known.data.ball is not None:
        both = ((known.tumour, lesson.tumour), (known.cortex, lesson.cortex))
        return tuple(
            _taught(_learnt(name), (), nodes, known.patch, lesson.loads, truth) for nodes, truth in both if len(nodes)
        )
    before = (known.table,) if name == "residual" else ()
    learnt = _taught(_learnt(name), before, known.tumour, known.patch, lesson.loads, lesson.tumour)
    return (*before, learnt, *known.cortex_table)


def _learnt(name: str) -> tuple[str, Callable[[], Regressor]]:
    """Encoder and regressor of a learner, a user's own too."""
    if name in LEARNT:
        return LEARNT[name]
    own = find_own(name)
    assert own is not None, name  # who trains has looked
    return own.encoder, own.regressor


def _touched(known: Expansion, lesson: Lesson) -> tuple[Part, list[tuple[np.ndarray, np.ndarray]]]:
    """The ball on tissue that stiffens as a lesson has it, and what that leaves of it: vertices, and (B, n, 3) [m]."""
    contact, bases = known.contact
    features, size = tool_features(known.patch, lesson.loads), directions(lesson.loads)[0][:, None, None]
    truth = [lesson.tumour, lesson.cortex][: len(bases)]
    coefficients = np.hstack([basis.encode(each / size) for basis, each in zip(bases, truth, strict=True)])
    alike = np.repeat(np.arange(len(bases)), [len(basis.modes) for basis in bases])
    part = Part("tool", contact.taught(features, coefficients, alike), side_by_side(bases))
    answered = np.split(size * part.response(features), [len(known.tumour)], axis=1)
    return part, [(basis.nodes, one - other) for basis, one, other in zip(bases, truth, answered, strict=False)]


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
    basis = on if isinstance(on, Basis) else reduce(on, response, *COARSE)
    encoder, make = kind
    X, Y = ENCODERS[encoder](patch, loads), basis.encode(response)
    regressor = make().fit(X, Y)
    if name_of(type(regressor)) is not None:
        _check_own(regressor, X, Y)
    return Part(encoder, regressor, basis)


def _check_own(regressor: Regressor, X: np.ndarray, Y: np.ndarray) -> None:
    """Refuse a user's regressor that does not answer what it was taught with finite coefficients of its shape."""
    found = np.asarray(regressor.predict(X))
    if found.shape != Y.shape or not np.isfinite(found).all():
        raise InputError(
            f"the learner {name_of(type(regressor))} answers {X.shape[0]} loads with numbers of shape {found.shape}: "
            f"let `predict` give {Y.shape}, all finite."
        )
