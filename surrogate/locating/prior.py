"""Prior of brain motions: shapes of every cause for every skull, and sets of causes that may act together.

A motion is a sum of shapes with independent weights. The shapes of drainage, swelling and oedema are principal
components of an ensemble. The shapes of tools are responses of linear tissue to smooth forces on the open cortex,
either on all of it or round one place: a position that a tool may press.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import SKULLS
from sim.errors import InputError

from .causes import DRAINAGE, OEDEMA, SWELLING, TOOL, TUMOUR_SWELLING, PressResponses, select_spaced_points
from .ensemble import Ensemble, compute_surface_motion

# Maximum number of shapes of each cause in each skull model.
MAX_SHAPES = {DRAINAGE: 12, SWELLING: 12, TUMOUR_SWELLING: 4, OEDEMA: 8, TOOL: 40}
MIN_SHAPE_SHARE = 1e-6  # Smallest share of the variance that a used shape explains.
# Prior size of motions by cause, as a share of the observed motion. `TUMOUR_SWELLING` acts with a swelling brain;
# `TOOL` is for forces on the whole cortex, which compensate for missing shapes.
CAUSE_SIZES = {DRAINAGE: 1.0, SWELLING: 1.0, TUMOUR_SWELLING: 0.3, OEDEMA: 1.0, TOOL: 0.15}
# Candidate rigid errors relative to the reported one (a sinking brain resembles a rigid error); inf: a slip.
RIGID_RATIOS = (0.1, 1.0, np.inf)
# Skull whose tool shapes are used: a separating skull keeps contact under a tool, as sliding contact does.
TOOL_SKULLS = {"bonded": "bonded", "slide": "slide", "contact": "slide"}
OTHER_CAUSES = (DRAINAGE, SWELLING, TUMOUR_SWELLING, OEDEMA)  # Causes other than tools.
# Sets of causes other than tools that may act together.
CAUSE_SETS = (
    (), (DRAINAGE,), (SWELLING,), (OEDEMA,), (DRAINAGE, SWELLING), (SWELLING, OEDEMA),
    (DRAINAGE, SWELLING, TUMOUR_SWELLING),
)  # fmt: skip
PLACE_SETS = CAUSE_SETS[:6]  # Sets with which a tool may press on one place.
NO_PLACE = -1  # Place number of shapes that belong to no place.


@dataclass(frozen=True)
class PressSettings:
    """Settings of the prior of a tool that presses on one place of the cortex."""

    place_count: int = 30  # Number of places that one tool may press on.
    max_place_shapes: int = 6  # Maximum number of shapes of each place.
    place_deviation: float = 6e-3  # Standard deviation of the weight of forces round a place [m].
    # Standard deviation of the distance between a touching tip and the pressed place [m].
    touch_deviation: float = 4e-3
    no_place_probability: float = 0.05  # Probability that a touching tip presses on no place.


PRESS = PressSettings()


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Hypothesis: a set of causes that act together, with prior sizes.

    Parameters
    ----------
    rows
        Row numbers (k,) of the hypothesis's shapes in the prior.
    deviations
        Prior standard deviations (k,) of the shapes' weights, relative to the observed motion.
    rigid_ratio
        Size of the rigid error relative to the reported one; inf for a slipped registration.
    place_rows
        Row numbers (p, q) of shapes of a tool that presses on one of p places; the shapes of one place may be added.
    """

    rows: np.ndarray
    deviations: np.ndarray
    rigid_ratio: float
    place_rows: np.ndarray


@dataclass(frozen=True, eq=False)
class PriorTables:
    """Tables of the shapes that may act in each of s skulls; all shapes in a column have the same cause.

    Parameters
    ----------
    rows
        Row numbers (s, k) of shapes in the prior; a skull with fewer shapes of a cause is padded with row 0, of size 0.
    deviations
        Prior standard deviations (s, k), see `Hypothesis`.
    kind
        Cause (k,) of each column; tools act on the whole cortex.
    place_rows
        Row numbers (s, p, q), see `Hypothesis`.
    """

    rows: np.ndarray
    deviations: np.ndarray
    kind: np.ndarray
    place_rows: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Prior of motions of one anatomy, by its shapes.

    Parameters
    ----------
    anatomy
        Anatomy of the shapes.
    shape
        Shapes (r, n, 3) float32 [m] at `nodes`. Together, with weights of variance 1, the shapes of one cause, skull
        and place move the open cortex or the tumour by 1 mm in root mean square.
    kind, skull
        Indices (r,) into `KINDS` and into the names of `sim.effects.SKULLS`.
    place
        Number (r,) of the place under the tool, or `NO_PLACE`.
    centre
        Undeformed positions (p, 3) [m] of the places.
    nodes
        Sorted mesh vertices (n,) of the shapes; None: all vertices.
    """

    anatomy: Anatomy
    shape: np.ndarray
    kind: np.ndarray
    skull: np.ndarray
    place: np.ndarray
    centre: np.ndarray
    nodes: np.ndarray | None = None

    def restrict_shapes(self, nodes: np.ndarray) -> np.ndarray:
        """Return the shapes (r, k, 3) [m] at the vertices `nodes` (k,).

        Raises
        ------
        InputError
            The prior does not have one of the vertices.
        """
        return self.shape[:, self._find_columns(nodes)]

    def restrict(self, nodes: np.ndarray) -> MotionPrior:
        """Return this prior restricted to the vertices `nodes` (k,); raises InputError as `restrict_shapes`.

        Results at these vertices are unchanged. An observation that depends on other vertices is rejected.
        """
        some = np.unique(nodes)
        return replace(self, shape=self.restrict_shapes(some), nodes=some)

    def prepare(self) -> None:
        """Compute the cached tables that all observations share."""
        _ = self.centroid_motion, self.hypotheses, self.tables, self._shapes_by_vertex

    @cached_property
    def centroid_motion(self) -> np.ndarray:
        """Motion (r, 3) [m] of the tumour's centroid (by volume) for each shape."""
        tumour = self.anatomy.tumour_nodes
        return np.einsum("v,rvi->ri", compute_tumour_weights(self.anatomy)[tumour], self.restrict_shapes(tumour))

    @cached_property
    def cortex_products(self) -> np.ndarray:
        """Inner products (r, r) [m^2] of the shapes over the open cortex's vertices."""
        flat = self.restrict_shapes(np.unique(self.anatomy.open_surface)).reshape(len(self.shape), -1).astype(float)
        return flat @ flat.T

    def _find_columns(self, nodes: np.ndarray) -> np.ndarray:
        """Return the indices of the vertices `nodes` (k,) among those of the prior."""
        if self.nodes is None:
            return nodes
        column = np.searchsorted(self.nodes, nodes).clip(max=len(self.nodes) - 1)
        if (self.nodes[column] != nodes).any():
            raise InputError(
                f"this locator knows {len(self.nodes)} vertices of {len(self.anatomy.mesh.nodes)}, and more are asked "
                "for: give points on the open cortex itself, or a whole locator, as `sulcus locator` makes it."
            )
        return column

    @cached_property
    def _shapes_by_vertex(self) -> np.ndarray:
        """Shapes (n, 3, r) float32 [m], with the shapes of a vertex contiguous in memory."""
        return np.ascontiguousarray(self.shape.transpose(1, 2, 0))

    def restrict_to_vertices(self, nodes: np.ndarray) -> np.ndarray:
        """Return the shapes (k, 3, r) float32 [m] at the vertices (k,); raises InputError as `restrict_shapes`."""
        return self._shapes_by_vertex[self._find_columns(nodes)]

    def project_shapes(self, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Compute observed displacements (m, r) [m] of each shape, by vertices and weights of `Evidence.weights`."""
        shape = self.restrict_to_vertices(vertices)
        return (weights @ shape.reshape(weights.shape[1], -1)).reshape(-1, shape.shape[2])

    def compute_log_odds(self, tips: np.ndarray) -> np.ndarray:
        """Compute log-odds (1 + p,) of no tool and of a tool on each of p places, given touching `tips` (k, 3) [m]."""
        if not len(tips):
            return np.zeros(1 + len(self.centre))
        away = ((self.centre[:, None] - tips) ** 2).sum(axis=2).min(axis=1)
        return np.append(np.log(PRESS.no_place_probability), -away / (2.0 * PRESS.touch_deviation**2))

    def _select_skull_rows(self, number: int) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """Return a skull's row numbers by cause (tools: whole cortex), and those (p, q) of a tool on each place."""
        rows = {kind: np.flatnonzero((self.kind == kind) & (self.skull == number)) for kind in OTHER_CAUSES}
        pressed = (self.kind == TOOL) & (self.skull == list(SKULLS).index(TOOL_SKULLS[list(SKULLS)[number]]))
        places = [np.flatnonzero(pressed & (self.place == place)) for place in range(self.place.max() + 1)]
        return rows | {TOOL: np.flatnonzero(pressed & (self.place == NO_PLACE))}, np.array(places)

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """Every set of causes for every skull, each with a small, a reported and a slipped rigid error."""
        made = []
        for number in range(len(SKULLS)):
            rows, places = self._select_skull_rows(number)
            for some, rigid in product(CAUSE_SETS, RIGID_RATIOS):
                own = [rows[kind] for kind in (*some, TOOL)]
                size = np.repeat([CAUSE_SIZES[kind] for kind in (*some, TOOL)], [len(each) for each in own])
                some_places = places if some in PLACE_SETS else places[:0]
                made.append(Hypothesis(np.concatenate(own), size, rigid, some_places))
        return tuple(made)

    @cached_property
    def tables(self) -> PriorTables:
        """Tables of the shapes that may act, by skull."""
        found, places = zip(*map(self._select_skull_rows, range(len(SKULLS))), strict=True)
        rows, size, kinds = [], [], []
        for kind in (TOOL, *OTHER_CAUSES):
            most = max(len(own[kind]) for own in found)
            rows.append([np.pad(own[kind], (0, most - len(own[kind]))) for own in found])
            size.append([np.where(np.arange(most) < len(own[kind]), CAUSE_SIZES[kind], 0.0) for own in found])
            kinds += most * [kind]
        return PriorTables(
            np.concatenate(rows, axis=1), np.concatenate(size, axis=1), np.array(kinds), np.array(places)
        )


def build_prior(ensemble: Ensemble, presses: PressResponses, members: np.ndarray | None = None) -> MotionPrior:
    """Build the prior from ensemble members (mask (N,); None: all) and from responses to forces on the cortex."""
    anatomy, parts = ensemble.anatomy, []
    chosen = np.ones(len(ensemble.kind), bool) if members is None else members
    for kind, skull in product(OTHER_CAUSES, range(len(SKULLS))):
        some = np.flatnonzero(chosen & (ensemble.kind == kind) & (ensemble.skull == skull))
        if len(some):
            shape = compute_principal_components(
                normalise_motions(anatomy, ensemble.motion[some]) / np.float32(np.sqrt(len(some))), MAX_SHAPES[kind]
            )
            parts.append((shape, kind, skull, NO_PLACE))
    centres = select_spaced_points(presses.points, PRESS.place_count)
    for name in dict.fromkeys(TOOL_SKULLS.values()):
        skull, motion = list(SKULLS).index(name), presses.motion[name]
        shape = compute_principal_components(motion.reshape(-1, *motion.shape[-2:]), MAX_SHAPES[TOOL])
        parts.append((normalise_shapes(anatomy, shape), TOOL, skull, NO_PLACE))
        for place, centre in enumerate(centres):
            away = ((presses.points - presses.points[centre]) ** 2).sum(axis=1)
            near = np.flatnonzero(away < (3.0 * PRESS.place_deviation) ** 2)
            weight = np.exp(-away[near] / (2.0 * PRESS.place_deviation**2)).astype(np.float32)
            some = motion[:, near] * weight[:, None, None, None]
            shape = compute_principal_components(some.reshape(-1, *motion.shape[-2:]), PRESS.max_place_shapes)
            parts.append((normalise_shapes(anatomy, shape), TOOL, skull, place))
    shapes, *labels = zip(*parts, strict=True)
    counts = [len(shape) for shape in shapes]
    labels = [np.repeat(label, counts) for label in labels]
    return MotionPrior(anatomy, np.concatenate(shapes), *labels, presses.points[centres])


def normalise_motions(anatomy: Anatomy, motion: np.ndarray) -> np.ndarray:
    """Scale each of n motions (n, V, 3) to a root mean square of 1 mm on the open cortex or in the tumour (the larger).

    Scaling by the cortex alone would magnify motions that hardly deform the cortex.
    """
    tumour = np.sqrt((motion[:, anatomy.tumour_nodes] ** 2).sum(axis=2).mean(axis=1))
    size = np.maximum(compute_surface_motion(anatomy, motion), tumour)
    return motion * (1e-3 / size)[:, None, None].astype(np.float32)


def normalise_shapes(anatomy: Anatomy, shapes: np.ndarray) -> np.ndarray:
    """Scale shapes (k, V, 3) [m] by one factor, so that together they move the open cortex by 1 mm (RMS)."""
    return shapes * np.float32(1e-3 / np.sqrt((compute_surface_motion(anatomy, shapes) ** 2).sum()))


def compute_principal_components(motion: np.ndarray, max_components: int) -> np.ndarray:
    """Compute up to `max_components` uncentred principal components (k, V, 3) of motions, times singular values."""
    flat = motion.reshape(len(motion), -1)
    value, vector = np.linalg.eigh((flat @ flat.T).astype(float))
    chosen = np.argsort(-value)[:max_components]
    chosen = chosen[value[chosen] > MIN_SHAPE_SHARE * value.sum()]
    return (vector[:, chosen].T.astype(np.float32) @ flat).reshape(-1, *motion.shape[1:])


def compute_centroid_motion(anatomy: Anatomy, motion: np.ndarray) -> np.ndarray:
    """Compute the motion (n, 3) [m] of the tumour's centroid (by volume) for motions (n, V, 3) [m]."""
    return np.einsum("v,nvi->ni", compute_tumour_weights(anatomy), motion)


def compute_tumour_weights(anatomy: Anatomy) -> np.ndarray:
    """Compute the weight (V,) of each vertex in the position of the tumour's centroid (by volume)."""
    mesh = anatomy.mesh
    inside = anatomy.in_tumour
    share = np.zeros(len(mesh.nodes))
    np.add.at(share, mesh.tets[inside], np.repeat(mesh.volumes[inside][:, None] / 4.0, 4, axis=1))
    return share / share.sum()
