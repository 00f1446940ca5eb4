"""Unilateral contact of brain and skull: each node has a curved bone surface, which ends at the craniotomy.

    h = g - n . u - u . H u / 2,    r = r_0 + e . u,    d = |max((h + R, r + R), 0)| - R,

h is the distance to bone, and r the distance inside the craniotomy. With the normal n and its derivative H along the
skull, a rotating brain slides along the curved skull, not along tangent planes. With the direction e into the
craniotomy, exposed cortex can rise through the craniotomy, but not through its edge with radius R.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ...anatomy import Anatomy
from ...discretisation.space import Discretisation
from ...discretisation.term import Cases
from ...effects import SkullContact
from ...runtime.device import Device, forward_kernel
from .barrier import PARABOLA_FRACTION, barrier, barrier_curvature, barrier_slope
from .skull_surface import BONE_SETTINGS, Bone, BoneSettings, build_bone

# Maximum displacement per step, as a fraction of a node's distance to the bone.
MAX_STEP_FRACTION = wp.constant(0.9)


@dataclass(frozen=True)
class SkullBarrier:
    """Options of the skull barrier: contact stiffness in preconditioners, and initial width.

    Parameters
    ----------
    stiffness_ratio
        Contact stiffness in preconditioners, as a fraction of shear modulus / activation distance: between
        open and closed contact.
    first_width, next_width
        Initial barrier width: maximum displacement per step, from the undeformed or from a previous state [m].
    """

    stiffness_ratio: float = 0.2
    first_width: float = 1e-2
    next_width: float = 5e-4


@dataclass(frozen=True)
class SkullKernels:
    """Kernels of skull contact, launched over (skull node, load case)."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    bound_step: wp.Kernel


@wp.struct
class Wall:
    """Bone data: node numbers, normals, curvatures [1/m], directions into the craniotomy and distances inside it [m].

    Further data: activation distances [m] and their current factor, areas [m^2], gap [m], radius of the bone's edge
    [m], and shear modulus [Pa].
    """

    nodes: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.vec3d)
    curvature: wp.array(dtype=wp.mat33d)
    inward: wp.array(dtype=wp.vec3d)
    inside_distance: wp.array(dtype=wp.float64)
    activation: wp.array(dtype=wp.float64)
    area: wp.array(dtype=wp.float64)
    gap: wp.float64
    edge: wp.float64
    widening: wp.float64
    shear: wp.float64


@wp.func
def to_bone_frame(wall: Wall, s: int, x: wp.vec3d) -> wp.vec2d:
    """Return (h + R, r + R) of node s at displacement x; the bone recedes by the added width of a widened barrier."""
    gap = wall.gap + (wall.widening - wp.float64(1.0)) * wall.activation[s]
    h = gap - wp.dot(wall.normal[s], x) - wp.float64(0.5) * wp.dot(x, wall.curvature[s] * x)
    return wp.vec2d(h + wall.edge, wall.inside_distance[s] + wp.dot(wall.inward[s], x) + wall.edge)


@wp.func
def get_distance_gradient(p: wp.vec2d) -> wp.vec2d:
    """Return the gradient of d with respect to (h, r): a unit vector away from the bone."""
    if wp.max(p[0], p[1]) > wp.float64(0.0):
        return wp.normalize(wp.vec2d(wp.max(p[0], wp.float64(0.0)), wp.max(p[1], wp.float64(0.0))))
    if p[0] >= p[1]:
        return wp.vec2d(wp.float64(1.0), wp.float64(0.0))
    return wp.vec2d(wp.float64(0.0), wp.float64(1.0))


@wp.func
def get_distance(wall: Wall, p: wp.vec2d) -> wp.float64:
    """Return the distance d to the bone [m]."""
    return wp.dot(get_distance_gradient(p), p) - wall.edge


@wp.func
def to_displacement(wall: Wall, s: int, x: wp.vec3d, h_decrease: wp.float64, r_increase: wp.float64) -> wp.vec3d:
    """Return the displacement vector that reduces h by `h_decrease` and increases r by `r_increase`."""
    return h_decrease * (wall.normal[s] + wall.curvature[s] * x) + r_increase * wall.inward[s]


@wp.func
def get_approach(wall: Wall, s: int, x: wp.vec3d, p: wp.vec2d) -> wp.vec3d:
    """Return m = -grad d: d decreases by m . du."""
    at = get_distance_gradient(p)
    return to_displacement(wall, s, x, at[0], -at[1])


@wp.func
def get_stiffness(wall: Wall, s: int) -> wp.float64:
    """Return the stiffness w k = w mu / (activation distance) [N/m^2]."""
    return wall.area[s] * wall.shear / (wall.widening * wall.activation[s])


@wp.func
def compute_stiffness_block(wall: Wall, s: int, x: wp.vec3d, definite: int) -> wp.mat33d:
    """Return the block w k (b'' m (x) m + b' d''); if `definite`, without the edge curvature, which may be negative."""
    p = to_bone_frame(wall, s, x)
    d, m, at = get_distance(wall, p), get_approach(wall, s, x, p), get_distance_gradient(p)
    width = wall.widening * wall.activation[s]
    pressure = barrier_slope(d, width)
    K = barrier_curvature(d, width) * wp.outer(m, m) - pressure * at[0] * wall.curvature[s]
    if definite == 0 and wp.min(at[0], at[1]) > wp.float64(0.0):
        round = to_displacement(wall, s, x, at[1], at[0])
        K += pressure / wp.dot(at, p) * wp.outer(round, round)
    return get_stiffness(wall, s) * K


@wp.func
def bound_fraction(distance: wp.float64, slope: wp.float64, curvature: wp.float64) -> wp.float64:
    """Return the largest t <= 1 with distance - t slope - t^2 curvature / 2 >= (1 - MAX_STEP_FRACTION) distance.

    The curvature `curvature` must be >= 0.
    """
    lost = wp.float64(MAX_STEP_FRACTION) * distance
    root = slope + wp.sqrt(slope * slope + wp.float64(2.0) * lost * curvature)
    if root > wp.float64(2.0) * lost:
        return wp.float64(2.0) * lost / root
    return wp.float64(1.0)


@cache
def build_kernels(device: Device) -> SkullKernels:
    """Return kernels for the scalar type of a device; distances are in double precision."""
    scalar, mat = device.scalar, device.matrix

    @wp.func
    def get_vector(u: wp.array2d(dtype=scalar), i: int, c: int) -> wp.vec3d:
        """Return the displacement u_i of a node in double precision."""
        return wp.vec3d(wp.float64(u[3 * i, c]), wp.float64(u[3 * i + 1, c]), wp.float64(u[3 * i + 2, c]))

    @forward_kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add the energy: E += sum over nodes of w k b(d)."""
        s, c = wp.tid()
        d = get_distance(wall, to_bone_frame(wall, s, get_vector(u, wall.nodes[s], c)))
        width = wall.widening * wall.activation[s]
        if d < width:
            wp.atomic_add(out, c, get_stiffness(wall, s) * barrier(d, width))

    @forward_kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the gradient: g -= w k b'(d) m."""
        s, c = wp.tid()
        x = get_vector(u, wall.nodes[s], c)
        p = to_bone_frame(wall, s, x)
        f = -get_stiffness(wall, s) * barrier_slope(get_distance(wall, p), wall.widening * wall.activation[s])
        m = get_approach(wall, s, x, p)
        for k in range(3):
            out[3 * wall.nodes[s] + k, c] += scalar(f * m[k])

    @forward_kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add the tangent stiffness times p: f += K_ii p_i."""
        s, c = wp.tid()
        K = compute_stiffness_block(wall, s, get_vector(u, wall.nodes[s], c), definite[c])
        f = K * get_vector(p, wall.nodes[s], c)
        for k in range(3):
            out[3 * wall.nodes[s] + k, c] += scalar(f[k])

    @forward_kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """Add the diagonal blocks K_ii."""
        s, c = wp.tid()
        K = compute_stiffness_block(wall, s, get_vector(u, wall.nodes[s], c), definite[c])
        block = mat()
        for row in range(3):
            for column in range(3):
                block[row, column] = scalar(K[row, column])
        out[wall.nodes[s], c] += block

    @forward_kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """Limit t so that d(u + t du) >= (1 - kept) d and no node crosses the bone; d is convex in h and r."""
        s, c = wp.tid()
        x, along = get_vector(u, wall.nodes[s], c), get_vector(du, wall.nodes[s], c)
        p = to_bone_frame(wall, s, x)
        d = get_distance(wall, p)
        if d > wp.float64(PARABOLA_FRACTION) * wall.widening * wall.activation[s]:
            bends = get_distance_gradient(p)[0] * wp.dot(along, wall.curvature[s] * along)
            wp.atomic_min(out, c, scalar(bound_fraction(d, wp.dot(get_approach(wall, s, x, p), along), bends)))

    return SkullKernels(add_energy, add_gradient, add_curvature, add_diagonal, bound_step)


class Skull:
    """Energy term of skull contact: barrier of `barrier.py` between nodes and the bone that covers these nodes.

    Parameters
    ----------
    bone
        Bone over the nodes.
    count
        Number of nodes N.
    shear
        Shear modulus [Pa] of the tissue.
    device
        Device of the arrays.
    settings
        Options of the barrier.
    """

    name = "skull contact"
    constant, passive, steep = False, False, True

    def __init__(self, bone: Bone, count: int, shear: float, device: Device, settings: SkullBarrier = SkullBarrier()):
        self._device, self._kernels, self._bone, self._settings = device, build_kernels(device), bone, settings
        self._wall = Wall()
        self._wall.nodes = device.upload(bone.nodes, wp.int32)
        self._wall.curvature = device.upload(bone.curvature, wp.mat33d)
        for name in ("normal", "inward"):
            setattr(self._wall, name, device.upload(getattr(bone, name), wp.vec3d))
        for name in ("inside_distance", "activation", "area"):
            setattr(self._wall, name, device.upload(getattr(bone, name), wp.float64))
        self._wall.gap, self._wall.edge, self._wall.shear = bone.gap, bone.edge_radius, shear
        self.widen_gap(1.0)
        covered = bone.inside_distance < 0.0
        nodes, normal, times = bone.nodes[covered], bone.normal[covered], (bone.area / bone.activation)[covered]
        blocks = (settings.stiffness_ratio * shear * times)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        row = (3 * nodes[:, None, None] + np.arange(3)[:, None]).repeat(3, axis=2)
        place = row.ravel(), row.swapaxes(1, 2).ravel()
        self._rest = sp.csc_array(sp.coo_array((blocks.ravel(), place), shape=(3 * count, 3 * count)))

    def compute_stride(self, cases: Cases, u: wp.array) -> np.ndarray:
        """Return 1 for every load case, since the skull does not move."""
        return np.ones(len(cases.loads))

    def compute_path_in_gaps(self, cases: Cases) -> np.ndarray:
        """Return the initial barrier width (b,) in units of its normal width; larger if the start is undeformed."""
        known = np.zeros(len(cases.loads), bool)
        if cases.displacement is not None:
            known |= cases.displacement.any(axis=(1, 2))
        if cases.restarted is not None:
            known &= ~cases.restarted
        return np.where(known, self._settings.next_width, self._settings.first_width) / self._bone.activation.min()

    def find_penetrating(self, u: wp.array) -> np.ndarray:
        """Return False for every load case, since the skull is not a tool."""
        return np.zeros(u.shape[1], bool)

    def find_overlaps(self, u: wp.array) -> np.ndarray:
        """Return False for every load case and both masks, since the skull is not a tool."""
        return np.zeros((2, u.shape[1]), bool)

    def widen_gap(self, factor: float) -> None:
        """Multiply the barrier width, and divide the stiffness, by `factor`; the bone recedes by the added width."""
        self._wall.widening = factor

    def compute_reaction(self, u: wp.array) -> np.ndarray:
        """Return an empty array (b, 0, 6), since there are no tools."""
        return np.zeros((u.shape[1], 0, 6))

    def begin(self, cases: Cases) -> None:
        """Reset the barrier to its normal width."""
        self.widen_gap(1.0)

    def keep(self, columns: np.ndarray) -> None:
        """Do nothing, since the skull is the same in all load cases."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the barrier energies."""
        self._launch(self._kernels.add_energy, [u], out)

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the barrier gradients."""
        self._launch(self._kernels.add_gradient, [u], out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Set the linearisation point u; in `definite` load cases the curvature of the bone's edge is ignored."""
        self._at = [wp.clone(u), definite]

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness times p: f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, *self._at], out)

    def add_diagonal(self, out: wp.array) -> None:
        """Add the diagonal blocks of K(u)."""
        self._launch(self._kernels.add_diagonal, self._at, out)

    def rest_curvature(self) -> sp.csc_array:
        """Return a partial contact stiffness (3N, 3N) [N/m] for preconditioners, since some nodes touch under load."""
        return self._rest

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Limit the step so that no node crosses the bone; nodes that already penetrate do not limit the step."""
        self._launch(self._kernels.bound_step, [u, du], out)

    def end(self, u: wp.array) -> None:
        """Return None, since the skull has no history variables."""

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array) -> None:
        self._device.launch(kernel, (len(self._bone.nodes), out.shape[-1]), [*inputs, self._wall], [out])


def build_skull(
    effect: SkullContact,
    anatomy: Anatomy,
    space: Discretisation,
    shear: float,
    device: Device,
    bone: BoneSettings = BONE_SETTINGS,
    settings: SkullBarrier = SkullBarrier(),
) -> Skull:
    """Return the term of `SkullContact` on tissue with the shear modulus `shear` [Pa]."""
    return Skull(build_bone(anatomy, space, effect.gap, bone), space.count, shear, device, settings)
