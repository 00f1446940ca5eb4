"""Deformation model that is linear in the forces on the free surface: a table of responses, applied by a product."""

import time
from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np

from ..anatomy import Anatomy
from ..arguments import check_vertex_numbers
from ..compile import check_causes
from ..deformation import Cost, Deformation, Outcome
from ..diagnostics.stretch import Stretch
from ..discretisation.footprint import ContactSurface, compute_push_reactions
from ..discretisation.inverted_elements import Inversion
from ..discretisation.space import discretise
from ..effects import Effect
from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from ..loads import Loads, Nodal, Pushed, check_field
from ..runtime.device import find_device
from .linear_body import LinearBody, build_body

Respond = Callable[[LinearBody, np.ndarray], np.ndarray]
"""Function (body, nodes (n,)) -> displacements (a, 3, n, 3) [m/N] of vertices under unit forces at `body.acting`."""


class LinearModel:
    """Deformation model with a table of responses to unit forces at the free surface.

    `inverted`, `stretch` and `strained` of its results count tetrahedra at the free surface and in the tumour only.

    Parameters
    ----------
    name
        Name of the family, for messages.
    anatomy, effects
        Arguments of `Fem`; only forces on tissue that is fixed to bone.
    respond
        Function that computes responses.
    outcome
        Outcome of load cases whose tissue is neither inverted nor strained too far.

    Raises
    ------
    InputError
        Input that `build_body` or `respond` rejects.
    """

    def __init__(
        self,
        name: str,
        anatomy: Anatomy,
        effects: Iterable[Effect],
        respond: Respond,
        outcome: Outcome = Outcome.CONVERGED,
    ):
        self.effects = tuple(effects)
        self._body, self._name, self._good = build_body(name, anatomy, self.effects), name, outcome
        device, mesh = find_device("cpu", "float64"), anatomy.mesh
        self._surface = ContactSurface(mesh.nodes, mesh.surface, device)
        self._respond = lru_cache(2)(lambda nodes: respond(self._body, np.frombuffer(nodes, np.int64)))
        free = np.isin(mesh.tets, self._body.acting).any(axis=1) | anatomy.in_tumour
        self._watched, table = np.unique(mesh.tets[free].astype(np.int64), return_inverse=True)
        part = discretise(TetMesh(mesh.nodes[self._watched], table.reshape(-1, 4), mesh.region[free]), "p1")
        self._device, self._stretch, self._inversion = device, Stretch(part, device), Inversion(part, device)
        self._respond(self._watched.tobytes())

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy that is deformed."""
        return self._body.anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the displacement under every load case; `start` has no influence.

        Raises
        ------
        InputError
            Loads other than `Pushed` and `Nodal`; forces at vertices inside the body; a vertex that the mesh lacks.
        """
        check_causes(self.effects, loads)
        begun = time.perf_counter()
        count = len(self.anatomy.mesh.nodes)
        nodes = np.arange(count) if at is None else check_vertex_numbers("at", at, count)
        force = self._compute_forces(loads)
        acting = np.flatnonzero(force.any(axis=(0, 2)))
        watched = self._compute_motion(force, acting, self._watched)
        known = np.isin(nodes, self._watched).all()
        place = np.searchsorted(self._watched, nodes) if known else nodes
        motion = (watched if known else self._compute_motion(force, acting, np.arange(count)))[:, place]
        u = self._device.upload(watched.reshape(len(loads), -1).T)
        strains, inverted = self._stretch.measure(u), self._inversion.count(u)
        outcome = np.full(len(loads), self._good)
        outcome[self._stretch.is_beyond_range(strains["strained"])] = Outcome.OVERSTRAINED
        outcome[inverted > 0] = Outcome.INVERTED
        return Deformation(
            displacement=motion,
            nodes=nodes,
            outcome=tuple(outcome),
            iterations=np.zeros(len(loads), int),
            residual=np.full(len(loads), np.nan),
            time=loads.times,
            reaction=compute_push_reactions(self._surface, loads),
            cost=Cost({"response": time.perf_counter() - begun}),
            inverted=inverted,
            stretch=strains["stretch"],
            strained=strains["strained"],
            source=f"{self._name} ({self._body.tissue})",
        )

    def _compute_motion(self, force: np.ndarray, acting: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return displacements (B, n, 3) [m] of `nodes` under forces (B, a, 3) [N], nonzero at `acting` only."""
        table = self._respond(nodes.tobytes())[acting]
        return np.tensordot(force[:, acting], table, axes=2)

    def _compute_forces(self, loads: Loads) -> np.ndarray:
        """Return the forces (B, a, 3) [N] at `body.acting`; fixed vertices bear the rest."""
        acting, count = self._body.acting, len(self.anatomy.mesh.nodes)
        force = np.zeros((len(loads), len(acting), 3))
        for cause in loads.causes:
            if isinstance(cause, Pushed):
                weight = self._surface.press(cause.point, cause.footprint).to_matrix(count)[:, acting]
                force += weight.toarray()[:, :, None] * cause.force[:, None]
            elif isinstance(cause, Nodal):
                check_field("Nodal.force", cause.force, count)
                inside = np.setdiff1d(np.flatnonzero(cause.force.any(axis=(0, 2)) & ~self._body.fixed), acting)
                if len(inside):
                    raise InputError(
                        f"{self._name} computes forces on the free surface; vertex {inside[0]} lies inside: use finite "
                        "elements (--deformer fem)."
                    )
                force += cause.force[:, acting]
            else:
                raise InputError(f"{self._name} does not compute {type(cause).__name__}: use finite elements.")
        return force
