"""What is believed of a motion before it is seen: shapes of every cause in every skull, and which may take part.

A motion is a sum of shapes with independent weights. Shapes of drainage and swelling are the principal ones of an
ensemble. Those of tools are what smooth forces on the open cortex do to linear tissue, all over it or round one place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import SKULLS
from sim.errors import InputError

from .causes import DRAINAGE, OEDEMA, SWELLING, TOOL, TUMOUR_SWELLING, Presses, spaced
from .ensemble import Ensemble, surface_size

# Shapes of each kind in each skull, at most; the least share of the variance that one of them has.
MOST = {DRAINAGE: 12, SWELLING: 12, TUMOUR_SWELLING: 4, OEDEMA: 8, TOOL: 40}
SMALLEST_SHARE = 1e-6
# Places that one tool may press on, shapes of each, and how far [m] its forces reach round it.
PLACES, PLACE_SHAPES, REACH = 30, 6, 6e-3
# Sizes as shares of the seen motion: of what takes part; of a tumour's swelling where a brain swells; of forces all
# over the cortex, which make good what the other shapes lack.
SIZE = {DRAINAGE: 1.0, SWELLING: 1.0, TUMOUR_SWELLING: 0.3, OEDEMA: 1.0, TOOL: 0.15}
# The rigid error, as shares of what an observation states: a brain that sinks looks much like one. The last is that of
# a registration that slipped, which nobody states.
RIGIDS = (0.1, 1.0, np.inf)
# A skull that lets go holds what tools press against it, as one does in which the brain slides.
PRESSED = {"bonded": "bonded", "slide": "slide", "contact": "slide"}
# Causes beside tools, and which of them may take part.
BESIDE = (DRAINAGE, SWELLING, TUMOUR_SWELLING, OEDEMA)
SETS = (
    (), (DRAINAGE,), (SWELLING,), (OEDEMA,), (DRAINAGE, SWELLING), (SWELLING, OEDEMA),
    (DRAINAGE, SWELLING, TUMOUR_SWELLING),
)  # fmt: skip
# With one of these a tool may press on one place.
WITH_PLACE = SETS[:6]
NOWHERE = -1
# A tip that touches presses on a place so near [m] as a standard deviation, and so seldom on none.
TOUCHED, UNTOUCHED = 4e-3, 0.05


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What takes part in a motion.

    Parameters
    ----------
    rows
        (k,) of the prior's shapes.
    size
        (k,) standard deviations of their weights, as shares of the seen motion.
    rigid
        That of the rigid error, as a share of what an observation states; inf of a registration that slipped.
    places
        (p, q) rows of shapes, of which those of one line may take part too: of a tool that presses on one place.
    """

    rows: np.ndarray
    size: np.ndarray
    rigid: float
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class Together:
    """What may take part in each of s skulls, in tables whose columns are of one kind.

    Parameters
    ----------
    rows
        (s, k) of the prior's shapes. A skull with fewer of a kind has some row instead, of size 0.
    size
        (s, k), as of a `Hypothesis`.
    kind
        (k,) of the columns; tools all over the cortex.
    places
        (s, p, q), as of a `Hypothesis`.
    """

    rows: np.ndarray
    size: np.ndarray
    kind: np.ndarray
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class Prior:
    """Shapes of one anatomy.

    Parameters
    ----------
    anatomy
        The body.
    shape
        (r, n, 3) float32 [m] at `nodes`. Those of one kind, skull and place together, with weights of variance 1, move
        the open cortex or the tumour by 1 mm in root mean square.
    kind, skull
        (r,) indices into `KINDS` and into the names of `sim.effects.SKULLS`.
    place
        (r,) number of the place that a tool presses on, or `NOWHERE`.
    centre
        (p, 3) [m] of these places, at rest.
    nodes
        (n,) sorted mesh vertices that shapes are known at; None: at all.
    """

    anatomy: Anatomy
    shape: np.ndarray
    kind: np.ndarray
    skull: np.ndarray
    place: np.ndarray
    centre: np.ndarray
    nodes: np.ndarray | None = None

    def at(self, nodes: np.ndarray) -> np.ndarray:
        """The shapes (r, k, 3) [m] at some vertices (k,).

        Raises
        ------
        InputError
            A vertex that is not among `nodes`.
        """
        return self.shape[:, self._columns(nodes)]

    def restricted(self, nodes: np.ndarray) -> Prior:
        """The same, known at some vertices (k,) alone; it raises InputError as `at` does.

        Answers stay the same wherever they can be given. An observation that touches other vertices is refused.
        """
        some = np.unique(nodes)
        return replace(self, shape=self.at(some), nodes=some)

    def prepare(self) -> None:
        """Compute the tables that all observations share, unless they are there."""
        _ = self.middle, self.hypotheses, self.together, self._by_vertex

    @cached_property
    def middle(self) -> np.ndarray:
        """(r, 3) [m]: how each shape moves the middle of the tumour's volume."""
        tumour = self.anatomy.tumour_nodes
        return np.einsum("v,rvi->ri", tumour_share(self.anatomy)[tumour], self.at(tumour))

    @cached_property
    def on_cortex(self) -> np.ndarray:
        """(r, r) [m^2]: products of the shapes with each other, summed over the open cortex's vertices."""
        flat = self.at(np.unique(self.anatomy.open_surface)).reshape(len(self.shape), -1).astype(float)
        return flat @ flat.T

    def _columns(self, nodes: np.ndarray) -> np.ndarray:
        """Where vertices (k,) are among those that are known."""
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
    def _by_vertex(self) -> np.ndarray:
        """(n, 3, r) float32 [m]: the shapes, so that those at a few places are near each other."""
        return np.ascontiguousarray(self.shape.transpose(1, 2, 0))

    def at_vertices(self, nodes: np.ndarray) -> np.ndarray:
        """The shapes (k, 3, r) float32 [m] at some vertices (k,); it raises InputError as `at` does."""
        return self._by_vertex[self._columns(nodes)]

    def seen(self, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """What would be seen (m, r) [m] of each shape, by vertices and weights as `Evidence.weights` has them."""
        shape = self.at_vertices(vertices)
        return (weights @ shape.reshape(weights.shape[1], -1)).reshape(-1, shape.shape[2])

    def odds(self, tips: np.ndarray) -> np.ndarray:
        """Logarithms (1 + p,) of how likely no tool presses, or one on each place, where tips (k, 3) [m] touch."""
        if not len(tips):
            return np.zeros(1 + len(self.centre))
        away = ((self.centre[:, None] - tips) ** 2).sum(axis=2).min(axis=1)
        return np.append(np.log(UNTOUCHED), -away / (2.0 * TOUCHED**2))

    def _in_skull(self, number: int) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """Rows by kind in a skull, of tools those all over the cortex; and (p, q), those of a tool on each place."""
        rows = {kind: np.flatnonzero((self.kind == kind) & (self.skull == number)) for kind in BESIDE}
        pressed = (self.kind == TOOL) & (self.skull == list(SKULLS).index(PRESSED[list(SKULLS)[number]]))
        places = [np.flatnonzero(pressed & (self.place == place)) for place in range(self.place.max() + 1)]
        return rows | {TOOL: np.flatnonzero(pressed & (self.place == NOWHERE))}, np.array(places)

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """Every set of causes in every skull, with little of a rigid error, with much, and where it slipped."""
        made = []
        for number in range(len(SKULLS)):
            rows, places = self._in_skull(number)
            for some, rigid in product(SETS, RIGIDS):
                own = [rows[kind] for kind in (*some, TOOL)]
                size = np.repeat([SIZE[kind] for kind in (*some, TOOL)], [len(each) for each in own])
                some_places = places if some in WITH_PLACE else places[:0]
                made.append(Hypothesis(np.concatenate(own), size, rigid, some_places))
        return tuple(made)

    @cached_property
    def together(self) -> Together:
        """What may take part in each skull, in tables."""
        found, places = zip(*map(self._in_skull, range(len(SKULLS))), strict=True)
        rows, size, kinds = [], [], []
        for kind in (TOOL, *BESIDE):
            most = max(len(own[kind]) for own in found)
            rows.append([np.pad(own[kind], (0, most - len(own[kind]))) for own in found])
            size.append([np.where(np.arange(most) < len(own[kind]), SIZE[kind], 0.0) for own in found])
            kinds += most * [kind]
        return Together(np.concatenate(rows, axis=1), np.concatenate(size, axis=1), np.array(kinds), np.array(places))


def prior_of(ensemble: Ensemble, presses: Presses, members: np.ndarray | None = None) -> Prior:
    """The prior of an ensemble, or of some of its members (N,) bool, and of forces on the open cortex."""
    anatomy, parts = ensemble.anatomy, []
    chosen = np.ones(len(ensemble.kind), bool) if members is None else members
    for kind, skull in product(BESIDE, range(len(SKULLS))):
        some = np.flatnonzero(chosen & (ensemble.kind == kind) & (ensemble.skull == skull))
        if len(some):
            shape = principal(unit(anatomy, ensemble.motion[some]) / np.float32(np.sqrt(len(some))), MOST[kind])
            parts.append((shape, kind, skull, NOWHERE))
    centres = spaced(presses.points, PLACES)
    for name in dict.fromkeys(PRESSED.values()):
        skull, motion = list(SKULLS).index(name), presses.motion[name]
        parts.append(
            (alike(anatomy, principal(motion.reshape(-1, *motion.shape[-2:]), MOST[TOOL])), TOOL, skull, NOWHERE)
        )
        for place, centre in enumerate(centres):
            away = ((presses.points - presses.points[centre]) ** 2).sum(axis=1)
            near = np.flatnonzero(away < (3.0 * REACH) ** 2)
            weight = np.exp(-away[near] / (2.0 * REACH**2)).astype(np.float32)
            some = motion[:, near] * weight[:, None, None, None]
            parts.append(
                (alike(anatomy, principal(some.reshape(-1, *motion.shape[-2:]), PLACE_SHAPES)), TOOL, skull, place)
            )
    shapes, *labels = zip(*parts, strict=True)
    counts = [len(shape) for shape in shapes]
    labels = [np.repeat(label, counts) for label in labels]
    return Prior(anatomy, np.concatenate(shapes), *labels, presses.points[centres])


def unit(anatomy: Anatomy, motion: np.ndarray) -> np.ndarray:
    """Motions (n, V, 3) [m], made so large that they move the open cortex or the tumour by 1 mm, what moves farther.

    A motion that leaves the cortex nearly still says little of what is seen.
    """
    tumour = np.sqrt((motion[:, anatomy.tumour_nodes] ** 2).sum(axis=2).mean(axis=1))
    size = np.maximum(surface_size(anatomy, motion), tumour)
    return motion * (1e-3 / size)[:, None, None].astype(np.float32)


def alike(anatomy: Anatomy, shape: np.ndarray) -> np.ndarray:
    """Shapes (k, V, 3) [m] that together move the open cortex by 1 mm."""
    return shape * np.float32(1e-3 / np.sqrt((surface_size(anatomy, shape) ** 2).sum()))


def principal(motion: np.ndarray, most: int) -> np.ndarray:
    """At most so many principal parts (k, V, 3) of motions (n, V, 3): their products sum to those of the motions."""
    flat = motion.reshape(len(motion), -1)
    value, vector = np.linalg.eigh((flat @ flat.T).astype(float))
    chosen = np.argsort(-value)[:most]
    chosen = chosen[value[chosen] > SMALLEST_SHARE * value.sum()]
    return (vector[:, chosen].T.astype(np.float32) @ flat).reshape(-1, *motion.shape[1:])


def middle_of(anatomy: Anatomy, motion: np.ndarray) -> np.ndarray:
    """How motions (n, V, 3) [m] move the middle of the tumour's volume (n, 3) [m]."""
    return np.einsum("v,nvi->ni", tumour_share(anatomy), motion)


def tumour_share(anatomy: Anatomy) -> np.ndarray:
    """Share (V,) of each vertex in the middle of the tumour's volume."""
    mesh = anatomy.mesh
    inside = anatomy.in_tumour
    share = np.zeros(len(mesh.nodes))
    np.add.at(share, mesh.tets[inside], np.repeat(mesh.volumes[inside][:, None] / 4.0, 4, axis=1))
    return share / share.sum()
