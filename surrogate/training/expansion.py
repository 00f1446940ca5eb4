"""Quantities computed by the FEM of a data set, without training: compliance, power series and contact."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sim.accuracy import REFERENCE
from sim.effects import build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import compute_digest
from sim.loads import Pushed
from sim.minimisers.second_order import compute_second_order
from sim.runtime.atomic_files import write_atomically
from sim.runtime.journal import open_journal
from sim.runtime.outside_files import wrap_errors
from sim.runtime.versions import get_version

from ..array_functions import QuantisedTable, round_to_half
from ..data.cortex_patch import Patch, open_patch
from ..data.dataset import Dataset
from ..data.encode import Basis, compute_unit_nodal_forces, fit_basis, split_forces
from ..data.solution_rows import read_tissue_text
from ..data.tool_loads import pick_far_points
from ..model.applicability import read_trained_skull
from ..model.kept_arrays import REMEDY
from ..model.learned import ModelPart, get_only_pushes
from ..model.npz_archive import Archive
from ..regressors.force_series import FACTORS, ORDER_COLUMNS, ForcePairs, Series, interpolate_table
from ..regressors.protocol import Linear
from ..regressors.rigid_contact import RigidContact
from .examples import Examples, compute_residual_responses
from .fem_tables import add_edge_midpoints, choose_radii, condense_contact, find_disc_nodes, join_bases, tabulate_series

COARSE_BASIS = (1e-3, 60)  # Truncation tolerance and maximum number of modes of a model's basis.
# Truncation tolerance and maximum number of modes of the series beyond the exact orders, which are 2 % of the motion.
ADDED_BASIS = (5e-3, 160)
# Models with the contact on linear tissue; the second also has a part trained on the residual.
CONTACT_MODELS = ("contact", "contact-gp")
SERIES_MODELS = ("series", "series-gp")  # Models with the power series; the second also fits its residual.


@dataclass(frozen=True)
class ExpansionSettings:
    """Accuracy settings of an `Expansion`."""

    table_tolerance: float = 1e-4  # Truncation tolerance of the compliance matrix.
    second_order_tolerance: float = 3e-3  # Truncation tolerance of the second order's modes, 0.1 % of the motion.
    # Truncation tolerance and maximum number of modes of the series' table.
    wide_basis: tuple[float, int] = (1e-5, 192)
    table_places: int = 40  # Number of distant positions whose series span the bases of the table.
    # Rounding of the second order's table relative to its largest entry. On the template this and `series_step` move
    # the tumour's worst vertex by at most 0.01 mm in 95 % of loads, a ninth of the model's error.
    pair_step: float = 1e-3
    series_step: float = 2e-3  # Rounding of the series' tables, relative to the largest motion at the largest force.
    strip_size: int = 1536  # Number of motion components computed at once, to limit memory.


@dataclass(frozen=True, eq=False)
class Expansion:
    """Compliance, power series and contact from the FEM of a data set; each is computed on first use.

    An expansion does not depend on the data's results. The series is tabulated in wide bases, spanned by the series at
    a few positions, so that the table's size does not depend on the size of tumour and cortex.

    Parameters
    ----------
    data
        Data set with anatomy, tissue and element; its loads give the range of tool radii.
    device
        Device of the FEM.
    progress
        Receives the number of tabulated positions and their total.
    table_path
        File of the series' table, read if it exists, else written; the caller ensures that it belongs to this data set.
    max_pairs
        Maximum number of pairs of force components in the second order; 150,000 take minutes, and 60 MB in a file.
    batch
        Maximum number of load cases solved together; None: as many as fit on a GPU that no other process uses.
    journal_path
        Journal of finished table rows, so that an interrupted run resumes; the caller deletes this file.
    settings
        Accuracy of tables and bases; an existing file `table_path` must have been written with the same settings.
    """

    data: Dataset
    device: str = "auto"
    progress: Callable[[int, int], object] = lambda done, total: None
    table_path: Path | None = None
    max_pairs: int = 150_000
    batch: int | None = None
    journal_path: Path | None = None
    settings: ExpansionSettings = ExpansionSettings()

    @cached_property
    def patch(self) -> Patch:
        """Open cortex of the anatomy."""
        return open_patch(self.data.anatomy)

    @cached_property
    def tumour(self) -> np.ndarray:
        """Mesh vertices of the tumour."""
        return self.data.anatomy.tumour_nodes

    @cached_property
    def cortex(self) -> np.ndarray:
        """Mesh vertices of the open cortex without those of the tumour."""
        return np.setdiff1d(self.patch.nodes, self.tumour)

    @cached_property
    def positions(self) -> np.ndarray:
        """Positions (P, 3) [m] of the series' table: nodes of the open cortex and midpoints of its edges."""
        return add_edge_midpoints(self.patch)[1]

    @cached_property
    def compliance_parts(self) -> tuple[ModelPart, ...]:
        """Compliance of the tumour and of the cortex (if it has vertices), exact for forces at open-cortex nodes.

        The number of modes follows from `ExpansionSettings.table_tolerance`.
        """
        return tuple(self._build_compliance(nodes) for nodes in self._vertex_sets)

    @cached_property
    def second_order_part(self) -> ModelPart:
        """Second order of the tumour's response, exact for forces at all nodes of the open cortex.

        Raises
        ------
        InputError
            The data set does not give its tissue.
        """
        known = self.table
        table = QuantisedTable.quantise(known.second_order, self.settings.pair_step * np.abs(known.second_order).max())
        return ModelPart("rooted", ForcePairs(known.pairs, table), known.pair_basis)

    @cached_property
    def exact_parts(self) -> list[tuple[ModelPart, ...]]:
        """Exact parts, without training or interpolation: two orders for the tumour, the first for the cortex.

        If there are more than `max_pairs` pairs, the tumour's second order is in the table instead.
        """
        paired = (self.second_order_part,) if len(self.table.pairs) else ()
        return [(table, *paired) if k == 0 else (table,) for k, table in enumerate(self.compliance_parts)]

    def build_bases(self, examples: Examples, tumour: tuple[float, int], cortex: tuple[float, int]) -> list[Basis]:
        """Compute a basis of the residual motion after the exact parts, for the tumour and for the cortex, if any.

        The linear dent under a tool needs many modes, but its nonlinear part needs few. `tumour` and `cortex` give the
        truncation tolerance and the maximum number of modes of each basis.
        """
        both = zip(self.exact_parts, (examples.tumour, examples.cortex), (tumour, cortex), strict=False)
        return [
            fit_basis(
                parts[0].basis.nodes, compute_residual_responses(parts, self.patch, examples.loads, moved), *limits
            )
            for parts, moved, limits in both
        ]

    def build_series(self, bases: list[Basis], held_out: np.ndarray) -> list[Series]:
        """Return the series beyond the exact parts, in `bases`; rows of `held_out` (P,) positions are interpolated.

        Raises
        ------
        InputError
            The data set does not give its tissue.
        """
        triangles = add_edge_midpoints(self.patch)[0]
        inside = self.patch.compute_edge_distance(self.positions)[:, None] > self.radii
        strongest = split_forces(get_only_pushes(self.data.loads))[0].max()
        unit = strongest ** np.repeat([1, 2, 3], [factors.shape[1] for factors in FACTORS])
        found = []
        for added, parts, wide, basis in zip(self._remainders, self.exact_parts, self.table.bases, bases, strict=True):
            # Footprints across the edge press on nodes beyond the open cortex. For others the exact parts leave no
            # residual.
            every = interpolate_table(self.positions, added @ (wide.modes @ basis.modes.T), held_out)
            for order in ORDER_COLUMNS[: len(parts)]:
                every[inside, order] = 0.0
            step = self.settings.series_step * (np.abs(every).max(axis=(0, 1, 3)) * unit).max() / unit
            found.append(Series.quantise_table(self.patch.points, triangles, self.radii, every, step))
        return found

    @cached_property
    def _remainders(self) -> list[np.ndarray]:
        """Tables (P, R, 19, r) of the series minus the exact parts, for the tumour and the cortex."""
        known, found = self.table, []
        for table, parts, wide in zip(known.basis_columns, self.exact_parts, known.bases, strict=True):
            added = table.copy()
            for part, order, form_of in zip(parts, ORDER_COLUMNS, (_compute_linear_form, _square_form), strict=False):
                met = form_of(part, self._unit_nodal_forces) @ (part.basis.modes @ wide.modes.T)
                added[:, :, order] -= met.reshape(added[:, :, order].shape)
            found.append(added)
        return found

    @cached_property
    def _unit_nodal_forces(self) -> np.ndarray:
        """Nodal forces (P R, 3, 3 m) for one newton along each axis, at each position and radius."""
        point = np.repeat(self.positions, 3 * len(self.radii), axis=0)
        radius = np.tile(np.repeat(self.radii, 3), len(self.positions))
        shares = compute_unit_nodal_forces(self.patch, Pushed(point, np.tile(np.eye(3), (len(point) // 3, 1)), radius))
        return shares.reshape(len(point) // 3, 3, -1)

    @cached_property
    def contact(self) -> tuple[RigidContact, list[Basis], float]:
        """Contact of the tool on linear tissue, bases of its result for tumour and cortex, and computing time [s].

        Raises
        ------
        InputError
            The data set does not give its tissue.
        """
        begun = time.perf_counter()
        contact, bases = condense_contact(self.build_fem(), self._vertex_sets, self.data.tool)
        return contact, bases, time.perf_counter() - begun

    def _build_compliance(self, nodes: np.ndarray) -> ModelPart:
        response = self.data.compute_unit_response(nodes)
        basis = fit_basis(nodes, response, self.settings.table_tolerance, len(response))
        return ModelPart("nodal", Linear().fit(np.eye(len(response)), round_to_half(basis.encode(response))), basis)

    @cached_property
    def table(self) -> SeriesTable:
        """Power series at all positions and radii.

        Raises
        ------
        InputError
            The data set does not give its tissue.
        """
        if self.table_path is not None and self.table_path.exists():
            with wrap_errors(self.table_path, "a table of the series", REMEDY), self.table_path.open("rb") as raw:
                modes = [f"modes{k}" for k in range(len(self._vertex_sets))]
                file = Archive(raw, REMEDY).read_arrays([*modes, "pairs", "second", "second_modes", "table", "seconds"])
                bases = [Basis(nodes, file[name]) for name, nodes in zip(modes, self._vertex_sets, strict=True)]
                pair_basis = Basis(self.tumour, file["second_modes"])
                return SeriesTable(
                    bases, file["table"], file["pairs"], file["second"], pair_basis, float(file["seconds"])
                )
        begun = time.perf_counter()
        fem = self.build_fem()
        bases, table, anew = self._tabulate(fem)
        pairs, second, pair_basis = self._compute_pairs(fem, bases[0])
        seconds = time.perf_counter() - begun if anew else np.nan
        found = SeriesTable(bases, table, pairs, second, pair_basis, seconds)
        if self.table_path is not None:
            arrays = {f"modes{k}": basis.modes for k, basis in enumerate(bases)}
            arrays |= {"table": table, "pairs": pairs, "second": second, "second_modes": pair_basis.modes}
            with write_atomically(self.table_path, ".npz") as partial:
                np.savez(partial, seconds=np.array(found.seconds), **arrays)  # pyright: ignore[reportArgumentType]
        return found

    def _compute_pairs(self, fem: Fem, basis: Basis) -> tuple[np.ndarray, np.ndarray, Basis]:
        """Compute node pairs within one footprint, the tumour's second order for each pair, and a basis for it."""
        near = find_disc_nodes(self.patch, float(self.radii[-1]))
        if 4.5 * near.sum() > self.max_pairs:
            return np.zeros((0, 2), int), np.zeros((0, 0), np.float32), Basis(basis.nodes, basis.modes[:0])
        reading = fem.build_reading(basis.nodes, basis.modes.reshape(len(basis.modes), -1, 3))
        nodes = self.patch.nodes
        units = fem.build_reading(nodes, np.eye(3 * len(nodes)).reshape(-1, len(nodes), 3))
        pairs, table = compute_second_order(fem.problem, units.solutions, reading.solutions, near)
        turn = fit_basis(basis.nodes, table, self.settings.second_order_tolerance, len(basis.modes)).modes
        return pairs, table @ turn.T, Basis(basis.nodes, round_to_half(turn @ basis.modes))

    def _tabulate(self, fem: Fem) -> tuple[list[Basis], np.ndarray, bool]:
        """Compute the bases from the series at a few positions, and the table of all positions in these bases.

        Return the bases, the table, and True if the whole table was computed in this run.
        """
        count = len(self.positions)
        few = np.sort(pick_far_points(self.positions, self.settings.table_places))
        every, motions = np.concatenate(self._vertex_sets), []
        for first in range(0, 3 * len(every), self.settings.strip_size):
            components = np.eye(3 * len(every))[first : first + self.settings.strip_size].reshape(-1, len(every), 3)
            reading = fem.build_reading(every, components)
            motions.append(
                tabulate_series(fem, self.positions[few], self.radii, reading, lambda n, _: self.progress(n, count))
            )
        cuts = 3 * np.cumsum([len(nodes) for nodes in self._vertex_sets])[:-1]
        parts = np.split(np.concatenate(motions, axis=-1), cuts, axis=-1)
        # The cortex's first order is given by its compliance.
        orders = (ORDER_COLUMNS, ORDER_COLUMNS[1:])
        wide = self.settings.wide_basis
        bases = [_build_wide_basis(*each, wide) for each in zip(self._vertex_sets, parts, orders, strict=False)]
        whole = join_bases(bases)
        reading = fem.build_reading(whole.nodes, whole.modes.reshape(len(whole.modes), -1, 3))
        table = np.empty((count, *parts[0].shape[1:3], reading.count), np.float32)
        others = np.setdiff1d(np.arange(count), few)
        table[few] = np.concatenate([part @ basis.modes.T for part, basis in zip(parts, bases, strict=True)], axis=-1)
        anew = True
        if len(others):
            what = {"version": get_version("sulcus"), "table": compute_digest(whole.modes, self.positions, self.radii)}
            with nullcontext() if self.journal_path is None else open_journal(self.journal_path, what) as journal:
                anew = not journal
                table[others] = tabulate_series(
                    fem, self.positions[others], self.radii, reading, lambda n, _: self.progress(n + len(few), count),
                    journal,
                )  # fmt: skip
        return bases, table, anew

    @cached_property
    def _vertex_sets(self) -> list[np.ndarray]:
        """Vertex sets of the tumour and, if it has further vertices, of the cortex."""
        return [nodes for nodes in (self.tumour, self.cortex) if len(nodes)]

    @cached_property
    def radii(self) -> np.ndarray:
        """Radii (R,) [m] of the series' table, from the smallest to the largest footprint of the data."""
        footprint = get_only_pushes(self.data.loads).footprint
        return choose_radii(float(footprint.min()), float(footprint.max()))

    def build_fem(self) -> Fem:
        """Build the FEM of the data set, in double precision.

        Raises
        ------
        InputError
            The data set does not give its tissue.
        """
        stated = self.data.provenance
        if "tissue" not in stated:
            raise InputError(
                f"{self.data.path}: does not state its tissue, so series and contact are not available: "
                "choose other learners, or simulate again."
            )
        effects = build_push_effects(self.data.anatomy, read_tissue_text(stated), read_trained_skull(stated))
        return Fem(self.data.anatomy, effects, REFERENCE, self.device, self.batch, stated.get("element"))


@dataclass(frozen=True, eq=False)
class SeriesTable:
    """Power series at all tabulated positions, in bases of tumour and cortex, with its computing time.

    Parameters
    ----------
    bases
        Basis of the tumour, and of the cortex if it has further vertices.
    table
        Coefficients (P, R, 19, r) float32 of the modes of all bases, one basis after the other.
    pairs, second_order, pair_basis
        Pairs of force components (P, 2), the tumour's second order for each (P, r) float32, and its basis.
    seconds
        Computing time [s]; NaN if an interrupted run was resumed.
    """

    bases: list[Basis]
    table: np.ndarray
    pairs: np.ndarray
    second_order: np.ndarray
    pair_basis: Basis
    seconds: float

    @property
    def basis_columns(self) -> list[np.ndarray]:
        """Columns of the table that belong to each basis."""
        return np.split(self.table, np.cumsum([len(basis.modes) for basis in self.bases])[:-1], axis=-1)


def _compute_linear_form(part: ModelPart, nodal_forces: np.ndarray) -> np.ndarray:
    """Compute basis coefficients (n, 3, r) for `nodal_forces` (n, 3, 3 m) along each axis."""
    return part.regressor.predict(nodal_forces.reshape(-1, nodal_forces.shape[2])).reshape(*nodal_forces.shape[:2], -1)


def _square_form(part: ModelPart, nodal_forces: np.ndarray) -> np.ndarray:
    """Compute coefficients (n, 6, r) of the direction products in `FACTORS`, for `nodal_forces` (n, 3, 3 m)."""
    own = [part.regressor.predict(nodal_forces[:, axis]) for axis in range(3)]
    both = [
        own[a] if a == b else part.regressor.predict(nodal_forces[:, a] + nodal_forces[:, b]) - own[a] - own[b]
        for a, b in FACTORS[1].T
    ]
    return np.stack(both, axis=1)


def _build_wide_basis(
    nodes: np.ndarray, motions: np.ndarray, order_columns: Sequence[slice], basis_settings: tuple[float, int]
) -> Basis:
    """Compute a basis of motions (F, R, 19, 3 n) of vertices (n,), in which the given orders have equal weight."""
    rows = [motions[:, :, order].reshape(-1, len(nodes), 3) for order in order_columns]
    tiny = np.finfo(np.float32).tiny
    return fit_basis(nodes, np.concatenate([each / max(np.linalg.norm(each), tiny) for each in rows]), *basis_settings)
