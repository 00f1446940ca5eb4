"""Frictionless contact of a tissue surface with rigid tools of prescribed pose."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from ...anatomy import Anatomy
from ...discretisation.space import Discretisation
from ...discretisation.term import Cases
from ...effects import Retraction, ToolContact
from ...errors import InputError
from ...geometry.surface import compute_areas, compute_edge_lengths, compute_vertex_normals
from ...loads import Retracted, Touching
from ...runtime.device import Device
from ...tools import Tool, list_cores
from .enclosure import find_enclosing_columns
from .reduced import ReducedToolBarrier
from .tool_blocks import ContactStruct, NearPairs
from .tool_functions import BarrierScale, Surface, Tools
from .tool_kernels import build_kernels
from .tool_path import CONTACT_SAMPLING, ContactSampling, ToolPath, find_approach

# Distance from a point in a subdivided triangle to the nearest sample point, at most [edges of the subdivision].
MAX_SAMPLE_DISTANCE = 2.0 / 3.0


class ToolContactTerm:
    """Energy term of tool contact: barrier between tissue and rigid tools, integrated over the undeformed surface.

    Parameters
    ----------
    name
        Unique name in the problem.
    tools
        Shapes of the tools.
    way
        Function that returns the `ToolPath` of `Cases`, or None if there is no tool.
    nodes, triangles
        Undeformed nodes (N, 3) [m], and triangles (S, 3) or (S, 6) of the surface that tools can touch.
    whole
        Corners (W, 3) of the outward triangles of the whole surface.
    bone
        Triangles (K, 3) or (K, 6) of the surface that is fixed or under the skull, where tools cannot be.
    gap
        Activation distance of contact [m]; a distance always remains.
    shear
        Shear modulus [Pa] of the tissue, to scale the contact stiffness.
    device
        Device of the arrays.
    touch
        Sampling of the surface, and maximum tool motion per step.
    """

    constant, passive, steep = False, False, True

    def __init__(
        self,
        name: str,
        tools: tuple[Tool, ...],
        compute_path: Callable[[Cases], ToolPath | None],
        nodes: np.ndarray,
        triangles: np.ndarray,
        is_closed: np.ndarray,
        bone: np.ndarray,
        gap: float,
        shear: float,
        device: Device,
        sampling: ContactSampling = CONTACT_SAMPLING,
    ):
        self.name = name
        cores = [core for tool in tools for core in list_cores(tool)]
        self._owner = np.repeat(np.arange(len(tools)), [len(list_cores(tool)) for tool in tools])
        self._first, self._sag = np.unique(self._owner, return_index=True)[1], sampling.max_sag * gap
        self._nodes, self._corners = nodes, [core.corners for core in cores]
        self._triangles, self._closed = triangles, device.upload(is_closed, wp.int32)
        self._shapes, self._way, self._device, self._touch = tools, compute_path, device, sampling
        self._kernels = build_kernels(device, triangles.shape[1])
        fine = np.sqrt(2.0 * min(core.radius for core in cores) * sampling.max_sag * gap) / MAX_SAMPLE_DISTANCE
        self._surface, self._rows = _build_surface(nodes, triangles, fine / sampling.max_stretch, device)
        self._bone, _ = _build_surface(nodes, bone, fine, device)
        self._cores = [
            device.upload(np.array([core.centre for core in cores]), wp.vec3d),
            device.upload(np.array([core.half for core in cores]), wp.vec3d),
            device.upload(np.array([core.radius + self._sag for core in cores]), wp.float64),
        ]
        self._asked, self._gap, self._shear = gap, (1.0 - sampling.max_sag) * gap, shear
        self.widen_gap(1.0)
        self._pose: np.ndarray | None = None
        # a step needs the same poses several times
        self._stood = lru_cache(4)(self._build_tools)
        self._single: list[Tools] = []

    def compute_stride(self, cases: Cases, u: wp.array) -> np.ndarray:
        """Return the path fraction (B,) of `ToolPath.compute_stride`, for the clearance of each tool."""
        way = self._way(cases)
        if way is None:
            return np.ones(len(cases.loads))
        clear = wp.full((len(self._owner), u.shape[1]), np.inf, dtype=wp.float64, device=self._device.name)
        inputs = [u, self._surface, self._get_tools(way.interpolate(cases.path_fraction))]
        self._device.launch(self._kernels.bound_clearance, (len(self._triangles), u.shape[1]), inputs, [clear])
        of_tools = np.minimum.reduceat(clear.numpy(), self._first, axis=0).T + self._sag
        return way.compute_stride(self._shapes, of_tools.clip(0.0), self._touch)

    def compute_path_in_gaps(self, cases: Cases) -> np.ndarray:
        """Return the largest motion (B,) of all tools, in units of the gap."""
        way = self._way(cases)
        return np.zeros(len(cases.loads)) if way is None else way.measure_motion(self._shapes).max(axis=1) / self._gap

    def find_penetrating(self, u: wp.array) -> np.ndarray:
        """Return a mask (b,) of load cases with a tool centre, or a corner of a tool core, inside the tissue."""
        if self._pose is None:
            return np.zeros(u.shape[1], bool)
        points = [
            corners @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
            for corners, pose in zip(self._corners, self._pose[:, self._owner].swapaxes(0, 1), strict=True)
        ]
        return find_enclosing_columns(self._device, np.concatenate(points, axis=1), self._surface.rest, self._closed, u)

    def find_overlaps(self, u: wp.array) -> np.ndarray:
        """Return the masks of `Barrier.find_overlaps`, for penetrations deeper than the gap."""
        if self._pose is None:
            return np.zeros((2, u.shape[1]), bool)
        dim, found = (len(self._owner), u.shape[1]), []
        for moved, surface in ((u, self._surface), (wp.zeros_like(u), self._bone)):
            out = wp.zeros(dim, dtype=wp.float64, device=self._device.name)
            inputs = [moved, surface, self._tools]
            self._device.launch(self._kernels.measure_depth, (len(surface.table), u.shape[1]), inputs, [out])
            found.append((out.numpy() < -self._asked - self._sag).any(axis=0))
        return np.stack(found)

    def widen_gap(self, factor: float) -> None:
        """Multiply the barrier width by `factor`, and divide the barrier stiffness by it."""
        self._scale = BarrierScale()
        self._scale.gap, self._scale.stiffness = factor * self._gap, self._shear / (factor * self._gap)

    def begin(self, cases: Cases) -> None:
        """Set the tool poses at the path fractions of the load cases, and reset the gap."""
        way = self._way(cases)
        self._set_pose(None if way is None else way.interpolate(cases.path_fraction))
        self.widen_gap(1.0)

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the tools of the load cases `columns`."""
        self._set_pose(None if self._pose is None else self._pose[columns])

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the barrier energies."""
        self._launch(self._kernels.add_energy, [u], out, u.shape[1])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the barrier gradients."""
        self._launch(self._kernels.add_gradient, [u], out, u.shape[1])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Set the linearisation point u; in `definite` load cases the curvature of the tools is ignored."""
        self._at = [wp.clone(u), definite]

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness times p: f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, *self._at], out, p.shape[1])

    def add_diagonal(self, out: wp.array) -> None:
        """Add the diagonal blocks of K(u)."""
        self._launch(self._kernels.add_diagonal, self._at, out, out.shape[1])

    def rest_curvature(self) -> None:
        """Return None, since there is no contact in the undeformed configuration."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Limit the step so that no point of the surface passes through a tool."""
        self._launch(self._kernels.bound_step, [u, du], out, u.shape[1])

    def add_matrix(self, u: wp.array, definite: wp.array, index: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness to `out`; see `DenseTerm.add_matrix`."""
        self._launch(self._kernels.add_matrix, [u, definite, index], out, u.shape[1])

    @cached_property
    def touchable_nodes(self) -> np.ndarray:
        """Sorted nodes (n,) of the surface that tools can touch."""
        return np.unique(self._triangles)

    def select_nodes(self, max_nodes: int) -> np.ndarray:
        """Return the touchable nodes and the nearest other nodes; see `LocalBarrier.select_nodes`."""
        own = self.touchable_nodes
        far, _ = KDTree(self._nodes[own]).query(self._nodes)
        far[own] = -1.0
        others = np.argsort(far, kind="stable")[len(own) : max(max_nodes, len(own))]
        return np.concatenate([own, np.sort(others)])

    @cached_property
    def _local(self) -> "tuple[ToolContactTerm, ReducedToolBarrier]":
        """Copy of the term on only the touchable nodes, also as a `ReducedBarrier`."""
        nodes, own = self._nodes[self.touchable_nodes], np.searchsorted(self.touchable_nodes, self._triangles)
        corners, exact = own[:, :3], replace(self._device, precision="float64")
        term = ToolContactTerm(
            self.name, self._shapes, self._way, nodes=nodes, triangles=own, is_closed=corners, bone=own[:0],
            gap=self._asked, shear=self._shear, device=exact, sampling=self._touch,
        )  # fmt: skip
        return term, ReducedToolBarrier(term, len(nodes), own.shape[1], exact)

    def reduce(self, columns: np.ndarray) -> ReducedToolBarrier | None:
        """Return the barrier on the touchable nodes, or None; see `LocalBarrier.reduce`."""
        if self._pose is None:
            return None
        term, reduced = self._local
        term._set_pose(self._pose[columns])
        term._scale = self._scale
        return reduced

    def get_active_stiffness(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the active nodes and their tangent stiffness; see `LocalBarrier.get_active_stiffness`."""
        barrier = self.reduce(np.zeros(1, int))
        if barrier is None:
            return np.zeros(0, int), np.zeros((0, 0))
        w = self._at[0].numpy().reshape(-1, 3)[self.touchable_nodes].reshape(-1, 1).astype(np.float64)
        active = barrier.compute_gradient(w).reshape(-1, 3).any(axis=1)
        place = np.where(active, active.cumsum() - 1, -1)[:, None]
        return np.flatnonzero(active), barrier.compute_stiffness(w, place, int(active.sum()), np.ones(1, bool))[0]

    def compute_reaction(self, u: wp.array) -> np.ndarray:
        """Return the force [N] and the moment about its origin [N m] of each tool, at u (3N, b): (b, tools, 6)."""
        out = wp.zeros((u.shape[1], len(self._owner), 6), dtype=wp.float64, device=self._device.name)
        self._launch(self._kernels.add_reaction, [u], out, u.shape[1])
        return np.add.reduceat(out.numpy(), self._first, axis=1)

    def end(self, u: wp.array) -> np.ndarray | None:
        """Return the tool poses (b, tools, 4, 4), at which the next path begins; None without tools."""
        return self._pose

    def _set_pose(self, pose: np.ndarray | None) -> None:
        self._pose = pose
        if pose is not None:
            self._tools = self._get_tools(pose)
        if pose is not None and len(pose) == 1:
            self._tools = self._copy_tools(self._tools)

    def _copy_tools(self, tools: Tools) -> Tools:
        """Return the tools; those of a single load case are copied to fixed arrays, which a captured graph reads."""
        if not self._single:
            self._single.append(self._build_tools(np.ascontiguousarray(self._pose, np.float64).tobytes()))
        for mine, its in ((self._single[0].rotation, tools.rotation), (self._single[0].origin, tools.origin)):
            wp.copy(mine, its)
        return self._single[0]

    def _get_tools(self, pose: np.ndarray) -> Tools:
        return self._stood(np.ascontiguousarray(pose, np.float64).tobytes())

    def _build_tools(self, pose: bytes) -> Tools:
        """Return the tools at poses (b, tools, 4, 4) in double precision."""
        of_cores = np.frombuffer(pose).reshape(-1, len(self._shapes), 4, 4)[:, self._owner].swapaxes(0, 1)
        out = Tools()
        out.centre, out.half, out.radius = self._cores
        out.rotation = self._device.upload(of_cores[:, :, :3, :3], wp.mat33d)
        out.origin = self._device.upload(of_cores[:, :, :3, 3], wp.vec3d)
        return out

    def build_structs(self, columns: np.ndarray) -> tuple[ContactStruct, NearPairs]:
        """Return the arguments of the kernels; see `DenseTerm.build_structs`."""
        if self._pose is None:
            raise ValueError("no tool is there")
        out, near, name = ContactStruct(), NearPairs(), self._device.name
        every = len(columns) == len(self._pose)
        out.tools = self._tools if every else self._get_tools(self._pose[columns])
        out.surface, out.scale = self._surface, self._scale
        out.rows = self._rows
        near.pairs = wp.empty((len(columns), len(self._triangles) * len(self._owner)), dtype=wp.int32, device=name)
        near.count = wp.empty(len(columns), dtype=wp.int32, device=name)
        near.least = wp.empty(len(columns), dtype=wp.float64, device=name)
        return out, near

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, columns: int) -> None:
        if self._pose is not None:
            dim = (len(self._surface.table), columns)
            self._device.launch(kernel, dim, [*inputs, self._surface, self._tools, self._scale], [out])


def build_tool_contact(
    effect: ToolContact | Retraction,
    anatomy: Anatomy,
    space: Discretisation,
    shear: float,
    device: Device,
    sampling: ContactSampling = CONTACT_SAMPLING,
) -> ToolContactTerm:
    """Return the contact term of an effect on tissue with the shear modulus `shear` [Pa]."""
    contact = isinstance(effect, ToolContact)
    name, tools = ("tool contact", effect.tools) if contact else ("retraction", (effect.blade,))
    triangles = space.surface[anatomy.bare]
    if not len(triangles):
        raise InputError(f"{type(effect).__name__} finds no surface to touch: all of it is fixed or under the skull.")
    touchable, reach = np.unique(triangles), _compute_node_reach(space.nodes, triangles)
    points, normals = space.nodes[touchable], compute_vertex_normals(space.nodes, triangles[:, :3])[touchable]

    @lru_cache(sampling.cached_poses)
    def find_start(number: int, pose: bytes) -> np.ndarray:
        goal = np.frombuffer(pose).reshape(4, 4)
        return find_approach(tools[number], goal, points, normals, reach, sampling.max_steps)

    def find_clear_poses(pose: np.ndarray) -> np.ndarray:
        """Return the contact-free poses (B, tools, 4, 4) from which tools approach the poses `pose`."""
        starts = [find_start(number, one.tobytes()) for case in pose for number, one in enumerate(case)]
        return np.reshape(starts, pose.shape)

    def compute_path(cases: Cases) -> ToolPath | None:
        last = cases.get_past(name, (len(tools), 4, 4)) if name in cases.memory else None
        if contact:
            cause = cases.loads.get(Touching)
            if cause is None:
                return None
            if cause.pose.shape[1] != len(tools):
                raise InputError(
                    f"Touching has poses of {cause.pose.shape[1]} tools, but ToolContact has {len(tools)}."
                )
            return ToolPath(_find_path_starts(last, cases.restarted, find_clear_poses, cause.pose), cause.pose)
        cause = cases.loads.get(Retracted)
        if cause is None:
            return None
        laid = cause.pose[:, None]
        held = laid.copy()
        held[:, 0, :3, 3] += cause.displacement
        return ToolPath(_find_path_starts(last, cases.restarted, lambda pose: pose, laid), held)

    whole = space.surface[:, :3]
    solid = np.logical_or(anatomy.fixed.all(axis=1), anatomy.slide_normal.any(axis=1))
    bone = space.surface[solid[whole].all(axis=1)]
    return ToolContactTerm(
        name, tools, compute_path, nodes=space.nodes, triangles=triangles, is_closed=whole, bone=bone,
        gap=effect.gap, shear=shear, device=device, sampling=sampling,
    )  # fmt: skip


def _build_surface(nodes: np.ndarray, triangles: np.ndarray, spacing: float, device: Device) -> tuple[Surface, int]:
    """Return the surface with sample points at most `spacing` [m] apart, and the maximum rows per triangle."""
    corners = nodes[triangles[:, :3]]
    pieces = np.ceil(compute_edge_lengths(corners).max(axis=1) / spacing).astype(np.int32)
    out = Surface()
    out.rest = device.upload(nodes, wp.vec3d)
    out.table = device.upload(triangles, wp.int32)
    out.pieces = device.upload(pieces, wp.int32)
    out.area = device.upload(compute_areas(corners), wp.float64)
    return out, int(pieces.max(initial=0))


def _find_path_starts(
    last: np.ndarray | None, restarted: np.ndarray | None, retract: Callable[[np.ndarray], np.ndarray], pose: np.ndarray
) -> np.ndarray:
    """Return path starts (B, tools, 4, 4): the last poses; without history or if `restarted`, poses without contact."""
    begin = pose.copy() if last is None else last.copy()
    new = np.ones(len(pose), bool) if last is None else np.zeros(len(pose), bool) if restarted is None else restarted
    begin[new] = retract(pose[new])
    return begin


def _compute_node_reach(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return, for each surface node, sorted, the maximum distance (n,) [m] to surface points nearest to this node."""
    numbers, table = np.unique(triangles, return_inverse=True)
    out = np.zeros(len(numbers))
    np.maximum.at(
        out, table.reshape(triangles.shape), compute_edge_lengths(nodes[triangles[:, :3]]).max(axis=1)[:, None]
    )
    return out / np.sqrt(3.0)
