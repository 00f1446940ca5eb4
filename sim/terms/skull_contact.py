"""A skull that brain rests against and comes away from: each of its nodes stays on its side of a curved wall.

    d = g - n . u - u . H u / 2,

with the normal n and its change H along the skull: a brain that turns slides along the skull, and not off its planes.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.spatial import KDTree

from ..anatomy import Anatomy
from ..device import Device
from ..discretisation import Discretisation
from ..effects import SkullContact
from ..errors import InputError
from ..term import Cases
from .barrier import RELAXED, barrier, barrier_curvature, barrier_slope

# The skull is felt in the last of the gap: so far [m] from it, or within all of a narrower one.
FELT = 1e-4
# A step takes no node farther than this share of its distance to the bone.
ROOM_KEPT = 0.9
# Preconditioners count the skull as stiff as this share of the shear modulus over what is felt: between open and shut.
HALF_SHUT = 0.2
# How far [m] brain may come at once, from rest and from where it was: the barrier is as wide at first.
AT_FIRST, AGAIN = 1e-2, 5e-4
# The wall's bend at a node is read off so many nearest nodes, of those whose normals are less than 60 degrees apart.
NEIGHBOURS, FACING = 16, 0.5
# Of a quadratic triangle's area each corner's share, and each middle's: all positive, so that no node is forgotten.
CORNER, MIDDLE = 1.0 / 12.0, 1.0 / 4.0


@dataclass(frozen=True)
class Kernels:
    """Loops over (skull node, column)."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    bound_step: wp.Kernel


@wp.struct
class Wall:
    """Nodes, normals and bends [1/m] of their walls, areas [m^2]; gap and what is felt of it [m], stiffness [Pa/m]."""

    nodes: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.vec3d)
    bend: wp.array(dtype=wp.mat33d)
    area: wp.array(dtype=wp.float64)
    gap: wp.float64
    felt: wp.float64
    stiffness: wp.float64


@wp.func
def distance(wall: Wall, s: int, x: wp.vec3d) -> wp.float64:
    """d = gap - n . u - u . H u / 2."""
    return wall.gap - wp.dot(wall.normal[s], x) - wp.float64(0.5) * wp.dot(x, wall.bend[s] * x)


@wp.func
def slope(wall: Wall, s: int, x: wp.vec3d) -> wp.vec3d:
    """m = n + H u: d falls by m . du."""
    return wall.normal[s] + wall.bend[s] * x


@wp.func
def block_of(wall: Wall, s: int, x: wp.vec3d) -> wp.mat33d:
    """w k (b'' m (x) m - b' H): never negative, as H is not."""
    d, m = distance(wall, s, x), slope(wall, s, x)
    bent = barrier_slope(d, wall.felt) * wall.bend[s]
    return wall.area[s] * (wall.stiffness * (barrier_curvature(d, wall.felt) * wp.outer(m, m) - bent))


@cache
def kernels_of(device: Device) -> Kernels:
    """Kernels of a device's scalar type; distances are in double precision."""
    scalar, mat, kept = device.scalar, device.matrix, wp.constant(wp.float64(ROOM_KEPT))

    @wp.func
    def motion(u: wp.array2d(dtype=scalar), i: int, c: int) -> wp.vec3d:
        """u_i in double precision."""
        return wp.vec3d(wp.float64(u[3 * i, c]), wp.float64(u[3 * i + 1, c]), wp.float64(u[3 * i + 2, c]))

    @wp.kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """E += sum over nodes of w k b(d)."""
        s, c = wp.tid()
        d = distance(wall, s, motion(u, wall.nodes[s], c))
        if d < wall.felt:
            wp.atomic_add(out, c, wall.stiffness * wall.area[s] * barrier(d, wall.felt))

    @wp.kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """g -= w k b'(d) m."""
        s, c = wp.tid()
        x = motion(u, wall.nodes[s], c)
        f = -wall.stiffness * wall.area[s] * barrier_slope(distance(wall, s, x), wall.felt)
        m = slope(wall, s, x)
        for k in range(3):
            out[3 * wall.nodes[s] + k, c] += scalar(f * m[k])

    @wp.kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f += K_ii p_i."""
        s, c = wp.tid()
        f = block_of(wall, s, motion(u, wall.nodes[s], c)) * motion(p, wall.nodes[s], c)
        for k in range(3):
            out[3 * wall.nodes[s] + k, c] += scalar(f[k])

    @wp.kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """K_ii."""
        s, c = wp.tid()
        K = block_of(wall, s, motion(u, wall.nodes[s], c))
        block = mat()
        for row in range(3):
            for column in range(3):
                block[row, column] = scalar(K[row, column])
        out[wall.nodes[s], c] += block

    @wp.kernel(module="unique")
    def bound_step(
        u: wp.array2d(dtype=scalar),
        du: wp.array2d(dtype=scalar),
        wall: Wall,
        # outputs
        out: wp.array(dtype=scalar),
    ):
        """d(u + t du) >= (1 - kept) d: no node that is on its side leaves it at once; d is a falling parabola in t."""
        s, c = wp.tid()
        x, along = motion(u, wall.nodes[s], c), motion(du, wall.nodes[s], c)
        d = distance(wall, s, x)
        if d > wp.float64(RELAXED) * wall.felt:
            falls = wp.dot(slope(wall, s, x), along)
            square = wp.float64(2.0) * kept * d * wp.dot(along, wall.bend[s] * along)
            root = falls + wp.sqrt(falls * falls + square)
            if root > wp.float64(2.0) * kept * d:
                wp.atomic_min(out, c, scalar(wp.float64(2.0) * kept * d / root))

    return Kernels(add_energy, add_gradient, add_curvature, add_diagonal, bound_step)


class Skull:
    """A Term: the barrier of `barrier.py` between nodes and the wall that they stood `gap` [m] under at rest.

    Parameters
    ----------
    nodes, normal, bend, area
        (k,) node numbers, (k, 3) unit normals towards the bone, (k, 3, 3) [1/m] how they change along it, none of them
        hollow, (k,) [m^2] of surface that each stands for.
    count
        N.
    gap, felt
        [m], and the last part of it [m] in which the bone is felt.
    shear
        Shear modulus [Pa] of the tissue.
    device
        Where its arrays live.
    """

    name = "skull contact"
    constant, passive, steep = False, False, True

    def __init__(
        self,
        nodes: np.ndarray,
        normal: np.ndarray,
        bend: np.ndarray,
        area: np.ndarray,
        count: int,
        gap: float,
        felt: float,
        shear: float,
        device: Device,
    ):
        self._device, self._kernels, self._nodes = device, kernels_of(device), nodes
        self._gap, self._felt, self._shear = gap, felt, shear
        self._wall = Wall()
        self._wall.nodes = device.array(nodes, wp.int32)
        self._wall.normal = device.array(normal, wp.vec3d)
        self._wall.bend = device.array(bend, wp.mat33d)
        self._wall.area = device.array(area, wp.float64)
        self.widen(1.0)
        blocks = (HALF_SHUT * shear / felt * area)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        row = (3 * nodes[:, None, None] + np.arange(3)[:, None]).repeat(3, axis=2)
        place = row.ravel(), row.swapaxes(1, 2).ravel()
        self._rest = sp.csc_array(sp.coo_array((blocks.ravel(), place), shape=(3 * count, 3 * count)))

    def stride(self, cases: Cases) -> np.ndarray:
        """The skull stays where it is."""
        return np.ones(len(cases.loads))

    def gaps(self, cases: Cases) -> np.ndarray:
        """As far as brain may have to come from rest, or else from where it was."""
        known = np.full(len(cases.loads), cases.displacement is not None)
        if cases.anew is not None:
            known &= ~cases.anew
        return np.where(known, AGAIN, AT_FIRST) / self._felt

    def buried(self, u: wp.array) -> np.ndarray:
        """The skull is never inside what it holds."""
        return np.zeros(u.shape[1], bool)

    def widen(self, times: float) -> None:
        """The barrier as many times as wide, and as much softer; the bone steps back by as much."""
        self._wall.gap = self._gap + (times - 1.0) * self._felt
        self._wall.felt = times * self._felt
        self._wall.stiffness = self._shear / (times * self._felt)

    def reaction(self, u: wp.array) -> np.ndarray:
        """Nobody holds the skull: no tools."""
        return np.zeros((u.shape[1], 0, 6))

    def begin(self, cases: Cases) -> None:
        """The gap is its own again."""
        self.widen(1.0)

    def keep(self, columns: np.ndarray) -> None:
        """Columns are all alike to the skull."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E += barriers."""
        self._launch(self._kernels.add_energy, [u], out)

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """g += their slopes."""
        self._launch(self._kernels.add_gradient, [u], out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Curvature is recomputed from u; it is never negative."""
        self._at = wp.clone(u)

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, self._at], out)

    def add_diagonal(self, out: wp.array) -> None:
        """Blocks += diagonal of K(u)."""
        self._launch(self._kernels.add_diagonal, [self._at], out)

    def rest_curvature(self) -> sp.csc_array:
        """A skull half shut everywhere, for preconditioners: at rest nothing touches, under load some nodes do."""
        return self._rest

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Nodes stay on their side of the bone; those that are behind it are pushed back."""
        self._launch(self._kernels.bound_step, [u, du], out)

    def end(self, u: wp.array) -> None:
        """The skull remembers nothing."""

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array) -> None:
        self._device.launch(kernel, (len(self._nodes), out.shape[-1]), [*inputs, self._wall], [out])


def skull_of(effect: SkullContact, anatomy: Anatomy, space: Discretisation, shear: float, device: Device) -> Skull:
    """The term of `SkullContact` on tissue with a shear modulus [Pa]; nodes that are held do not move against it."""
    normal = space.sliding(anatomy.slide_normal, anatomy.held)
    free = (normal != 0.0).any(axis=1) & ~space.held(anatomy.held).all(axis=1)
    a, b, c = np.moveaxis(space.nodes[space.surface[:, :3]], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    shares = np.full(3, 1.0 / 3.0) if space.surface.shape[1] == 3 else np.repeat([CORNER, MIDDLE], 3)
    own = np.bincount(space.surface.ravel(), (area[:, None] * shares).ravel(), space.count)
    nodes = np.flatnonzero(free)
    if not len(nodes):
        raise InputError(
            "SkullContact finds no node that could touch: this anatomy has no slide normals, or holds all."
        )
    bend = bend_of(space.nodes[nodes], normal[nodes])
    felt = min(FELT, effect.gap)
    return Skull(nodes, normal[nodes], bend, own[nodes], space.count, effect.gap, felt, shear, device)


def bend_of(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How unit normals (k, 3) at points (k, 3) [m] of a wall change along it: (k, 3, 3) [1/m], symmetric.

    The least-squares fit of n_j - n_i = H (x_j - x_i) to the nearest points whose normals face the same way, along the
    wall alone; where the wall is hollow (a negative curvature) it counts as flat.
    """
    count = min(NEIGHBOURS, len(points))
    near = KDTree(points).query(points, count)[1].reshape(len(points), count)
    across = np.linalg.svd(normal[:, None])[2][:, 1:]  # two directions along the wall
    step = np.einsum("kja,kia->kij", across, points[near] - points[:, None])
    turn = np.einsum("kja,kia->kij", across, normal[near] - normal[:, None])
    weight = np.einsum("kia,ka->ki", normal[near], normal) > FACING
    x, y = np.moveaxis(step * weight[:, :, None], 2, 0)
    none = np.zeros_like(x)
    # Unknowns H_xx, H_xy, H_yy.
    rows = np.stack([np.stack([x, y, none], axis=2), np.stack([none, x, y], axis=2)], axis=2).reshape(
        len(points), -1, 3
    )
    found = np.linalg.pinv(rows) @ (turn * weight[:, :, None]).reshape(len(points), -1, 1)
    flat = found[:, [0, 1, 1, 2], 0].reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(flat)
    along = np.einsum("kja,kjm->kam", across, vectors)
    return np.einsum("kam,km,kbm->kab", along, values.clip(0.0), along)
