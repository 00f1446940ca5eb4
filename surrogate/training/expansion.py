"""What a data set's finite elements give without learning: compliance, power series, contact."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sim.accuracy import REFERENCE
from sim.effects import pushed_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import digest_of
from sim.loads import Pushed
from sim.minimisers.second_order import second_order
from sim.runtime.atomic_files import written_whole
from sim.runtime.journal import opened
from sim.runtime.outside_files import read_as
from sim.runtime.versions import version_of

from ..array_functions import Rounded, half_precision
from ..data.answer_rows import stated_tissue
from ..data.cortex_patch import Patch, open_patch
from ..data.dataset import Dataset
from ..data.encode import Basis, directions, nodal_shares, reduce
from ..data.tool_loads import spread
from ..model.applicability import trained_skull
from ..model.kept_arrays import REMADE
from ..model.learned import Part, only_pushed
from ..model.npz_archive import Archive
from ..regressors.force_series import FACTORS, SPANS, Pairs, Series, filled
from ..regressors.protocol import Linear
from ..regressors.rigid_contact import Contact
from .examples import Examples, left_by
from .fem_tables import condensed, in_one_disc, radii_between, side_by_side, tabulated, with_middles

# Share of the responses that a learner's basis may lose, and its most modes; the same of what the series adds to the
# exact orders, a fiftieth of the motion, and of compliance.
COARSE = (1e-3, 60)
ADDED = (5e-3, 160)
TABLE_TOLERANCE = 1e-4
# What the modes of the second order may leave of it: of the motion, one in 1,000.
SECOND = 3e-3
# The same of the bases that series are tabulated in, made of what is had at so many places far from each other.
WIDE, FEW = (1e-5, 192), 40
# Learners that ask the finite elements how linear tissue gives; the second learns what that leaves.
TOUCHED = ("contact", "contact-gp")
# Those that ask the finite elements for their series, of which the second learns what it leaves.
EXPANDED = ("series", "series-gp")
# What tables are rounded to, as a share of their largest motion at the largest force. On the template this moves the
# worst vertex of the tumour by 0.01 mm at most in 95 of 100 loads, a ninth of the model's error.
PAIR_STEP, SERIES_STEP = 1e-3, 2e-3
# Components of motion that are read at once there: bounds the memory that it takes.
STRIP = 1536


@dataclass(frozen=True, eq=False)
class Expansion:
    """What a data set's finite elements give without learning: compliance, power series, contact; made when asked for.

    It does not depend on answers to the data's loads. The series is tabulated in wide bases, of its own values at a
    few places, so that a table grows neither with the tumour nor with the cortex.

    Parameters
    ----------
    data
        Its anatomy, tissue and element; its loads give the widths of tools.
    device
        Where the finite elements work.
    progress
        Hears which place is done, and of how many.
    kept
        Where the series' table is read from, and written to where there is none: of these data, as the caller knows.
    most_pairs
        Of force components, for which the second order is had: so many take minutes, and 60 MB of a model.
    batch
        Most load cases that are solved together; None: as many as fit now, on a card that is nobody else's.
    begun
        Where the table's rows are kept while it is made, so that a stopped run goes on; the caller removes it.
    """

    data: Dataset
    device: str = "auto"
    progress: Callable[[int, int], object] = lambda done, total: None
    kept: Path | None = None
    most_pairs: int = 150_000
    batch: int | None = None
    begun: Path | None = None

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
    def places(self) -> np.ndarray:
        """Where the series is tabulated (P, 3) [m]: nodes of the open cortex, and middles of its edges."""
        return with_middles(self.patch)[1]

    @cached_property
    def tables(self) -> tuple[Part, ...]:
        """The tumour's compliance, and the cortex's, if there is more: exact at every node of the open cortex.

        In as many modes as the unit responses need.
        """
        return tuple(self._compliance(nodes) for nodes in self._known)

    @cached_property
    def pairs(self) -> Part:
        """The second order of the tumour: exact for forces on the nodes of the open cortex, wherever they are.

        Raises
        ------
        InputError
            Data that do not state what tissue they are of.
        """
        known = self.tabulated
        table = Rounded.of(known.second, PAIR_STEP * np.abs(known.second).max())
        return Part("rooted", Pairs(known.pairs, table), known.pair_basis)

    @cached_property
    def exact(self) -> list[tuple[Part, ...]]:
        """What needs neither learning nor interpolation: two orders of the tumour, and the first of the cortex.

        Where pairs of nodes are too many, the tumour's second order is in the table.
        """
        paired = (self.pairs,) if len(self.tabulated.pairs) else ()
        return [(table, *paired) if k == 0 else (table,) for k, table in enumerate(self.tables)]

    def bases(self, examples: Examples, tumour: tuple[float, int], cortex: tuple[float, int]) -> list[Basis]:
        """What a set of examples does to the tumour, and to the cortex, if there is more, beyond what is exact.

        A dent as small as its tool is no sum of a few modes, but what nonlinearity adds to it is. `tumour` and `cortex`
        are what may be left of it, as a share, and the most modes.
        """
        both = zip(self.exact, (examples.tumour, examples.cortex), (tumour, cortex), strict=False)
        return [
            reduce(parts[0].basis.nodes, left_by(parts, self.patch, examples.loads, moved), *limits)
            for parts, moved, limits in both
        ]

    def on(self, bases: list[Basis], left_out: np.ndarray) -> list[Series]:
        """What the series adds to what is exact, as coefficients of the `bases` of examples, without some places (P,).

        Raises
        ------
        InputError
            Data that do not state what tissue they are of.
        """
        triangles = with_middles(self.patch)[0]
        inside = self.patch.rim_distance(self.places)[:, None] > self.radii
        strongest = directions(only_pushed(self.data.loads))[0].max()
        unit = strongest ** np.repeat([1, 2, 3], [factors.shape[1] for factors in FACTORS])
        found = []
        for added, parts, wide, basis in zip(self._beyond, self.exact, self.tabulated.bases, bases, strict=True):
            # Footprints over the rim press on nodes beyond the open cortex. Of others nothing is left.
            every = filled(self.places, added @ (wide.modes @ basis.modes.T), left_out)
            for order in SPANS[: len(parts)]:
                every[inside, order] = 0.0
            step = SERIES_STEP * (np.abs(every).max(axis=(0, 1, 3)) * unit).max() / unit
            found.append(Series.rounded(self.patch.points, triangles, self.radii, every, step))
        return found

    @cached_property
    def _beyond(self) -> list[np.ndarray]:
        """The tables (P, R, 19, r) less what is exact."""
        known, found = self.tabulated, []
        for table, parts, wide in zip(known.tables, self.exact, known.bases, strict=True):
            added = table.copy()
            for part, order, form_of in zip(parts, SPANS, (_linear_form, _square_form), strict=False):
                met = form_of(part, self._unit_shares) @ (part.basis.modes @ wide.modes.T)
                added[:, :, order] -= met.reshape(added[:, :, order].shape)
            found.append(added)
        return found

    @cached_property
    def _unit_shares(self) -> np.ndarray:
        """Forces (P R, 3, 3 m) at the patch's nodes of one newton along each axis, at each place and radius."""
        point = np.repeat(self.places, 3 * len(self.radii), axis=0)
        radius = np.tile(np.repeat(self.radii, 3), len(self.places))
        shares = nodal_shares(self.patch, Pushed(point, np.tile(np.eye(3), (len(point) // 3, 1)), radius))
        return shares.reshape(len(point) // 3, 3, -1)

    @cached_property
    def contact(self) -> tuple[Contact, list[Basis], float]:
        """The tool on linear tissue, the bases of tumour and cortex whose coefficients it answers with, and seconds.

        Raises
        ------
        InputError
            Data that do not state what tissue they are of.
        """
        begun = time.perf_counter()
        contact, bases = condensed(self.fem(), self._known, self.data.tool)
        return contact, bases, time.perf_counter() - begun

    def _compliance(self, nodes: np.ndarray) -> Part:
        response = self.data.unit_response(nodes)
        basis = reduce(nodes, response, TABLE_TOLERANCE, len(response))
        return Part("nodal", Linear().fit(np.eye(len(response)), half_precision(basis.encode(response))), basis)

    @cached_property
    def tabulated(self) -> Tabulated:
        """The series at every place.

        Raises
        ------
        InputError
            Data that do not state what tissue they are of.
        """
        if self.kept is not None and self.kept.exists():
            with read_as(self.kept, "a table of the series", REMADE), self.kept.open("rb") as raw:
                modes = [f"modes{k}" for k in range(len(self._known))]
                file = Archive(raw, REMADE).arrays([*modes, "pairs", "second", "second_modes", "table", "seconds"])
                bases = [Basis(nodes, file[name]) for name, nodes in zip(modes, self._known, strict=True)]
                pair_basis = Basis(self.tumour, file["second_modes"])
                return Tabulated(
                    bases, file["table"], file["pairs"], file["second"], pair_basis, float(file["seconds"])
                )
        begun = time.perf_counter()
        fem = self.fem()
        bases, table, anew = self._tabulate(fem)
        pairs, second, pair_basis = self._paired(fem, bases[0])
        seconds = time.perf_counter() - begun if anew else np.nan
        found = Tabulated(bases, table, pairs, second, pair_basis, seconds)
        if self.kept is not None:
            arrays = {f"modes{k}": basis.modes for k, basis in enumerate(bases)}
            arrays |= {"table": table, "pairs": pairs, "second": second, "second_modes": pair_basis.modes}
            with written_whole(self.kept, ".npz") as partial:
                np.savez(partial, seconds=np.array(found.seconds), **arrays)  # pyright: ignore[reportArgumentType]
        return found

    def _paired(self, fem: Fem, basis: Basis) -> tuple[np.ndarray, np.ndarray, Basis]:
        """Pairs that one footprint may press, the tumour's second order of each, and the modes of a basis for it."""
        near = in_one_disc(self.patch, float(self.radii[-1]))
        if 4.5 * near.sum() > self.most_pairs:
            return np.zeros((0, 2), int), np.zeros((0, 0), np.float32), Basis(basis.nodes, basis.modes[:0])
        reading = fem.reading(basis.nodes, basis.modes.reshape(len(basis.modes), -1, 3))
        nodes = self.patch.nodes
        units = fem.reading(nodes, np.eye(3 * len(nodes)).reshape(-1, len(nodes), 3))
        pairs, table = second_order(fem.problem, units.answers, reading.answers, near)
        turn = reduce(basis.nodes, table, SECOND, len(basis.modes)).modes
        return pairs, table @ turn.T, Basis(basis.nodes, half_precision(turn @ basis.modes))

    def _tabulate(self, fem: Fem) -> tuple[list[Basis], np.ndarray, bool]:
        """Every motion at a few places, the bases that these span, and what is at all places as their coefficients.

        Last whether all of it was made now.
        """
        count = len(self.places)
        few = np.sort(spread(self.places, FEW))
        every, motions = np.concatenate(self._known), []
        for first in range(0, 3 * len(every), STRIP):
            components = np.eye(3 * len(every))[first : first + STRIP].reshape(-1, len(every), 3)
            reading = fem.reading(every, components)
            motions.append(tabulated(fem, self.places[few], self.radii, reading, lambda n, _: self.progress(n, count)))
        cuts = 3 * np.cumsum([len(nodes) for nodes in self._known])[:-1]
        parts = np.split(np.concatenate(motions, axis=-1), cuts, axis=-1)
        # The cortex's first order is in its compliance.
        orders = (SPANS, SPANS[1:])
        bases = [_spanned(*each) for each in zip(self._known, parts, orders, strict=False)]
        whole = side_by_side(bases)
        reading = fem.reading(whole.nodes, whole.modes.reshape(len(whole.modes), -1, 3))
        table = np.empty((count, *parts[0].shape[1:3], reading.count), np.float32)
        others = np.setdiff1d(np.arange(count), few)
        table[few] = np.concatenate([part @ basis.modes.T for part, basis in zip(parts, bases, strict=True)], axis=-1)
        anew = True
        if len(others):
            what = {"version": version_of("sulcus"), "table": digest_of(whole.modes, self.places, self.radii)}
            with nullcontext() if self.begun is None else opened(self.begun, what) as journal:
                anew = not journal
                table[others] = tabulated(
                    fem, self.places[others], self.radii, reading, lambda n, _: self.progress(n + len(few), count),
                    journal,
                )  # fmt: skip
        return bases, table, anew

    @cached_property
    def _known(self) -> list[np.ndarray]:
        """Vertices of the tumour, and of the cortex, if there is more."""
        return [nodes for nodes in (self.tumour, self.cortex) if len(nodes)]

    @cached_property
    def radii(self) -> np.ndarray:
        """At which the series is tabulated (R,) [m]: from the narrowest tool of the data to the widest."""
        footprint = only_pushed(self.data.loads).footprint
        return radii_between(float(footprint.min()), float(footprint.max()))

    def fem(self) -> Fem:
        """Make the data's finite elements, in double precision.

        Raises
        ------
        InputError
            Data that do not state what tissue they are of.
        """
        stated = self.data.provenance
        if "tissue" not in stated:
            raise InputError(
                f"{self.data.path}: does not state its tissue, so no series or contact can be had of it: "
                "choose other learners, or simulate anew."
            )
        effects = pushed_effects(self.data.anatomy, stated_tissue(stated), trained_skull(stated))
        return Fem(self.data.anatomy, effects, REFERENCE, self.device, self.batch, stated.get("element"))


@dataclass(frozen=True, eq=False)
class Tabulated:
    """A table of the series: bases of tumour and cortex, what all places have of both, and the seconds it took.

    Parameters
    ----------
    bases
        One, or two.
    table
        (P, R, 19, r) float32: coefficients of the bases' modes, one after the other.
    pairs, second, pair_basis
        Pairs of nodal forces (P, 2), and the tumour's second order of each (P, r) float32 in a basis.
    seconds
        [s]; NaN where a stopped run went on.
    """

    bases: list[Basis]
    table: np.ndarray
    pairs: np.ndarray
    second: np.ndarray
    pair_basis: Basis
    seconds: float

    @property
    def tables(self) -> list[np.ndarray]:
        """The part of each basis."""
        return np.split(self.table, np.cumsum([len(basis.modes) for basis in self.bases])[:-1], axis=-1)


def _linear_form(part: Part, shares: np.ndarray) -> np.ndarray:
    """Coefficients (n, 3, r) of unit forces with shares (n, 3, 3 m)."""
    return part.regressor.predict(shares.reshape(-1, shares.shape[2])).reshape(*shares.shape[:2], -1)


def _square_form(part: Part, shares: np.ndarray) -> np.ndarray:
    """Coefficients (n, 6, r) of the products in `FACTORS` of a direction's components, for shares (n, 3, 3 m)."""
    own = [part.regressor.predict(shares[:, axis]) for axis in range(3)]
    both = [
        own[a] if a == b else part.regressor.predict(shares[:, a] + shares[:, b]) - own[a] - own[b]
        for a, b in FACTORS[1].T
    ]
    return np.stack(both, axis=1)


def _spanned(nodes: np.ndarray, motions: np.ndarray, orders: Sequence[slice]) -> Basis:
    """The wide basis of motions (F, R, 19, 3 n) of vertices (n,): of some of the orders, which count alike."""
    rows = [motions[:, :, order].reshape(-1, len(nodes), 3) for order in orders]
    tiny = np.finfo(np.float32).tiny
    return reduce(nodes, np.concatenate([each / max(np.linalg.norm(each), tiny) for each in rows]), *WIDE)
