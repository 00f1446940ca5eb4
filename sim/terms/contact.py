"""Frictionless contact of a body's surface with rigid tools that are moved by pose."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import warp as wp

from ..anatomy import Anatomy
from ..device import Device
from ..discretisation import Discretisation
from ..effects import Retraction, ToolContact
from ..errors import InputError
from ..loads import Retracted, Touching
from ..motion import Way, approach
from ..term import Cases
from ..tools import Tool, core_of
from .barrier import barrier, barrier_curvature, barrier_slope

# Surfaces are looked at in points; between them they are nearer to a tool by at most this share of the gap, which is
# added to the tool's radius: no point of a surface is inside.
SAG = 0.25
# Triangles may be stretched so many times.
STRETCH = 1.3
# Of a triangle cut into smaller ones, the farthest point is so many of their edges from the nearest centre.
FARTHEST = 2.0 / 3.0
# Curved triangles reach farther from their centre than their nodes do.
BULGE = 1.5


@dataclass(frozen=True)
class Kernels:
    """Loops over (triangle, column) for triangles of one number of nodes."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel
    add_reaction: wp.Kernel


@wp.struct
class Tools:
    """T tools in b columns: cores as `tools.Core`, and how they stand: rotations and places."""

    centre: wp.array(dtype=wp.vec3d)
    half: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    rotation: wp.array2d(dtype=wp.mat33d)
    origin: wp.array2d(dtype=wp.vec3d)


@wp.struct
class Touch:
    """Distance to a tool [m], its gradient, and its second derivative [1/m]."""

    distance: wp.float64
    normal: wp.vec3d
    bend: wp.mat33d


@wp.func
def touch_of(x: wp.vec3d, tools: Tools, k: int, c: int) -> Touch:
    """d = |v| - r, v from the nearest point of the core to x; n = v / |v|; dn = (M - n (x) n) / |v|.

    M keeps the components in which x lies beyond the core.
    """
    one, zero = wp.float64(1.0), wp.float64(0.0)
    R, half = tools.rotation[k, c], tools.half[k]
    p = wp.transpose(R) * (x - tools.origin[k, c]) - tools.centre[k]
    v, beyond = wp.vec3d(), wp.vec3d()
    for i in range(3):
        v[i] = p[i] - wp.clamp(p[i], -half[i], half[i])
        beyond[i] = wp.where(v[i] != zero or half[i] == zero, one, zero)
    length = wp.length(v)
    out = Touch()
    out.distance = length - tools.radius[k]
    out.normal = R * wp.vec3d(zero, zero, -one)  # on the core itself: away from the shaft
    if length > zero:
        n = v / length
        out.normal = R * n
        out.bend = R * ((wp.diag(beyond) - wp.outer(n, n)) / length) * wp.transpose(R)
    return out


@cache
def kernels_of(device: Device, size: int) -> Kernels:
    """Kernels for surface triangles of `size` nodes, 3 or 6.

    Positions and distances are in double precision whatever the device's scalar: gaps are small beside bodies. Each
    launches over (triangle, column); a triangle that is near a tool is looked at in the centres of pieces^2 equal parts.
    """
    scalar, mat = device.scalar, device.matrix
    shares = wp.types.vector(length=size, dtype=wp.float64)
    forces = wp.types.matrix(shape=(size, 3), dtype=wp.float64)
    bulge = wp.constant(wp.float64(BULGE if size == 6 else 1.0))

    @wp.func
    def shape_of(i: int, j: int, n: int) -> shares:
        """Shape functions at the centre of the j-th part of the i-th row; odd parts are turned round."""
        third, turned = wp.float64(1.0) / wp.float64(3 * n), j % 2
        y = wp.float64(3 * i + 1 + turned) * third
        z = wp.float64(3 * (j // 2) + 1 + turned) * third
        L = wp.vec3d(wp.float64(1.0) - y - z, y, z)
        out = shares()
        for a in range(3):
            if wp.static(size == 3):
                out[a] = L[a]
            else:
                out[a] = L[a] * (wp.float64(2.0) * L[a] - wp.float64(1.0))
                out[wp.static(size - 3) + a] = wp.float64(4.0) * L[a] * L[(a + 1) % 3]
        return out

    @wp.func
    def nodes_of(
        rest: wp.array(dtype=wp.vec3d), table: wp.array2d(dtype=wp.int32), u: wp.array2d(dtype=scalar), s: int, c: int
    ) -> forces:
        """Where a triangle's nodes are (size, 3)."""
        out = forces()
        for a in range(size):
            i = table[s, a]
            for k in range(3):
                out[a, k] = rest[i][k] + wp.float64(u[3 * i + k, c])
        return out

    @wp.func
    def is_near(at: forces, tools: Tools, gap: wp.float64, k: int, c: int) -> bool:
        """Whether any point of a triangle may be in a tool's reach."""
        middle = wp.vec3d()
        for a in range(3):
            middle += at[a] / wp.float64(3.0)
        reach = wp.float64(0.0)
        for a in range(size):
            reach = wp.max(reach, wp.length(at[a] - middle))
        return touch_of(middle, tools, k, c).distance < gap + bulge * reach

    @wp.kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        rest: wp.array(dtype=wp.vec3d),
        table: wp.array2d(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        area: wp.array(dtype=wp.float64),
        tools: Tools,
        gap: wp.float64,
        stiffness: wp.float64,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """E += sum over points of w k b(d)."""
        s, c = wp.tid()
        at, n = nodes_of(rest, table, u, s, c), pieces[s]
        weight = stiffness * area[s] / wp.float64(n * n)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, gap, k, c):
                total = wp.float64(0.0)
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        total += barrier(touch_of(N * at, tools, k, c).distance, gap)
                wp.atomic_add(out, c, weight * total)

    @wp.kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        rest: wp.array(dtype=wp.vec3d),
        table: wp.array2d(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        area: wp.array(dtype=wp.float64),
        tools: Tools,
        gap: wp.float64,
        stiffness: wp.float64,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """g_a += sum over points of w k b'(d) n N_a."""
        s, c = wp.tid()
        at, n = nodes_of(rest, table, u, s, c), pieces[s]
        weight = stiffness * area[s] / wp.float64(n * n)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, gap, k, c):
                total = forces()
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < gap:
                            total += wp.outer(N, weight * barrier_slope(touch.distance, gap) * touch.normal)
                for a in range(size):
                    for i in range(3):
                        wp.atomic_add(out, 3 * table[s, a] + i, c, scalar(total[a, i]))

    @wp.func
    def curvature_at(touch: Touch, gap: wp.float64, definite: int) -> wp.mat33d:
        """b'' n (x) n + b' dn; the first alone, which is never negative, where `definite`."""
        out = barrier_curvature(touch.distance, gap) * wp.outer(touch.normal, touch.normal)
        if definite == 0:
            out += barrier_slope(touch.distance, gap) * touch.bend
        return out

    @wp.kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=wp.vec3d),
        table: wp.array2d(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        area: wp.array(dtype=wp.float64),
        tools: Tools,
        gap: wp.float64,
        stiffness: wp.float64,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f_a += sum over points of w k H N_a sum over nodes of N_b p_b."""
        s, c = wp.tid()
        at, n = nodes_of(rest, table, u, s, c), pieces[s]
        weight = stiffness * area[s] / wp.float64(n * n)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, gap, k, c):
                along, total = forces(), forces()
                for a in range(size):
                    for i in range(3):
                        along[a, i] = wp.float64(p[3 * table[s, a] + i, c])
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < gap:
                            total += wp.outer(N, weight * (curvature_at(touch, gap, definite[c]) * (N * along)))
                for a in range(size):
                    for i in range(3):
                        wp.atomic_add(out, 3 * table[s, a] + i, c, scalar(total[a, i]))

    @wp.kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        definite: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=wp.vec3d),
        table: wp.array2d(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        area: wp.array(dtype=wp.float64),
        tools: Tools,
        gap: wp.float64,
        stiffness: wp.float64,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """K_aa += sum over points of w k H N_a^2."""
        s, c = wp.tid()
        at, n = nodes_of(rest, table, u, s, c), pieces[s]
        weight = stiffness * area[s] / wp.float64(n * n)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, gap, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        N = shape_of(i, j, n)
                        touch = touch_of(N * at, tools, k, c)
                        if touch.distance < gap:
                            H = weight * curvature_at(touch, gap, definite[c])
                            for a in range(size):
                                block = mat()
                                for row in range(3):
                                    for column in range(3):
                                        block[row, column] = scalar(N[a] * N[a] * H[row, column])
                                wp.atomic_add(out, table[s, a], c, block)

    @wp.kernel(module="unique")
    def add_reaction(
        u: wp.array2d(dtype=scalar),
        rest: wp.array(dtype=wp.vec3d),
        table: wp.array2d(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        area: wp.array(dtype=wp.float64),
        tools: Tools,
        gap: wp.float64,
        stiffness: wp.float64,
        # outputs
        out: wp.array3d(dtype=wp.float64),
    ):
        """Force and moment about each tool's origin, as the tool exerts them: sums of -w k b'(d) n and its moments."""
        s, c = wp.tid()
        at, n = nodes_of(rest, table, u, s, c), pieces[s]
        weight = stiffness * area[s] / wp.float64(n * n)
        for k in range(tools.radius.shape[0]):
            if is_near(at, tools, gap, k, c):
                for i in range(n):
                    for j in range(2 * (n - i) - 1):
                        x = shape_of(i, j, n) * at
                        touch = touch_of(x, tools, k, c)
                        force = -weight * barrier_slope(touch.distance, gap) * touch.normal
                        moment = wp.cross(x - tools.origin[k, c], force)
                        for row in range(3):
                            wp.atomic_add(out, c, k, row, force[row])
                            wp.atomic_add(out, c, k, 3 + row, moment[row])

    return Kernels(add_energy, add_gradient, add_curvature, add_diagonal, add_reaction)


class Contact:
    """A Term: the barrier between a body's surface and rigid tools, integrated over the surface at rest.

    Parameters
    ----------
    name
        Unique in its problem.
    tools
        Their shapes.
    way
        Cases -> from where to where they go; None where no tool is there.
    nodes, triangles
        (N, 3) [m] at rest; (S, 3) or (S, 6), what may be touched of the surface.
    gap
        Distance [m] at which tissue begins to feel a tool; it is never touched quite.
    shear
        Shear modulus [Pa] of the tissue: contact is as stiff as fits it.
    device
        Where its arrays live.
    """

    constant, passive, steep = False, False, True

    def __init__(
        self,
        name: str,
        tools: tuple[Tool, ...],
        way: Callable[[Cases], Way | None],
        nodes: np.ndarray,
        triangles: np.ndarray,
        gap: float,
        shear: float,
        device: Device,
    ):
        self.name = name
        self._shapes, self._way, self._device = tools, way, device
        self._kernels = kernels_of(device, triangles.shape[1])
        cores = [core_of(tool) for tool in tools]
        a, b, c = np.moveaxis(nodes[triangles[:, :3]], 1, 0)
        longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0) * STRETCH
        fine = np.sqrt(2.0 * min(core.radius for core in cores) * SAG * gap) / FARTHEST
        self._skin = [
            device.array(nodes, wp.vec3d),
            device.array(triangles, wp.int32),
            device.array(np.ceil(longest / fine), wp.int32),
            device.array(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), wp.float64),
        ]
        self._tools = Tools()
        self._tools.centre = device.array(np.array([core.centre for core in cores]), wp.vec3d)
        self._tools.half = device.array(np.array([core.half for core in cores]), wp.vec3d)
        self._tools.radius = device.array(np.array([core.radius + SAG * gap for core in cores]), wp.float64)
        self._gap, self._shear = (1.0 - SAG) * gap, shear
        self.widen(1.0)
        self._pose: np.ndarray | None = None

    def stride(self, cases: Cases) -> np.ndarray:
        """As `Way.stride`."""
        way = self._way(cases)
        return np.ones(len(cases.loads)) if way is None else way.stride(self._shapes)

    def gaps(self, cases: Cases) -> np.ndarray:
        """As the farthest-moved tool goes."""
        way = self._way(cases)
        return np.zeros(len(cases.loads)) if way is None else way.travel(self._shapes).max(axis=1) / self._gap

    def widen(self, times: float) -> None:
        """The barrier as many times as wide, and as much softer."""
        self._scale = [wp.float64(times * self._gap), wp.float64(self._shear / (times * self._gap))]

    def begin(self, cases: Cases) -> None:
        """Put the tools where they are after their share of the way; the gap is its own again."""
        way, share = self._way(cases), np.ones(len(cases.loads)) if cases.share is None else cases.share
        self._stand(None if way is None else way.at(share))
        self.widen(1.0)

    def keep(self, columns: np.ndarray) -> None:
        """Leave the others' tools."""
        self._stand(None if self._pose is None else self._pose[columns])

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E += barriers."""
        self._launch(self._kernels.add_energy, [u], out, u.shape[1])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """g += their slopes."""
        self._launch(self._kernels.add_gradient, [u], out, u.shape[1])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Curvature is recomputed from u; where `definite`, tools count as flat."""
        self._at = [wp.clone(u), definite]

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, *self._at], out, p.shape[1])

    def add_diagonal(self, out: wp.array) -> None:
        """Blocks += diagonal of K(u)."""
        self._launch(self._kernels.add_diagonal, self._at, out, out.shape[1])

    def rest_curvature(self) -> None:
        """Nothing is touched at rest."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Barriers go on inside a tool; how far tools move at once is bounded by `Way.stride`."""

    def reaction(self, u: wp.array) -> np.ndarray:
        """(b, tools, 6): force [N] and moment [N m] about its origin that each tool exerts at u (3N, b) [m]."""
        count = len(self._tools.radius)
        out = wp.zeros((u.shape[1], count, 6), dtype=wp.float64, device=self._device.name)
        self._launch(self._kernels.add_reaction, [u], out, u.shape[1])
        return out.numpy()

    def end(self, u: wp.array) -> np.ndarray | None:
        """Where the tools are (b, tools, 4, 4): the next way begins there."""
        return self._pose

    def _stand(self, pose: np.ndarray | None) -> None:
        self._pose = pose
        if pose is not None:
            self._tools.rotation = self._device.array(pose[:, :, :3, :3].swapaxes(0, 1), wp.mat33d)
            self._tools.origin = self._device.array(pose[:, :, :3, 3].swapaxes(0, 1), wp.vec3d)

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, columns: int) -> None:
        if self._pose is not None:
            dim = (len(self._skin[1]), columns)
            self._device.launch(kernel, dim, [*inputs, *self._skin, self._tools, *self._scale], [out])



def contact_of(
    effect: ToolContact | Retraction, anatomy: Anatomy, space: Discretisation, shear: float, device: Device
) -> Contact:
    """The term of an effect on tissue with a shear modulus [Pa]."""
    contact = isinstance(effect, ToolContact)
    name, tools = ("tool contact", effect.tools) if contact else ("retraction", (effect.blade,))
    covered = anatomy.held.any(axis=1) | anatomy.slide_normal.any(axis=1)
    triangles = space.surface[~covered[space.mesh.surface].all(axis=1)]
    if not len(triangles):
        raise InputError(f"{type(effect).__name__} finds no surface to touch: all of it is held or slides.")
    corners = space.nodes[triangles[:, :3]]
    reach = 0.5 * float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    clear = partial(approach, tools, points=space.nodes[np.unique(triangles)], reach=reach)

    def way(cases: Cases) -> Way | None:
        last = None if cases.anew else cases.history.get(name)
        if contact:
            cause = cases.loads.of(Touching)
            if cause is None:
                return None
            if cause.pose.shape[1] != len(tools):
                raise InputError(f"Touching has poses of {cause.pose.shape[1]} tools, but ToolContact has {len(tools)}.")
            return Way(clear(cause.pose) if last is None else last, cause.pose)
        cause = cases.loads.of(Retracted)
        if cause is None:
            return None
        laid = cause.pose[:, None]
        held = laid.copy()
        held[:, 0, :3, 3] += cause.displacement
        return Way(laid if last is None else last, held)

    return Contact(name, tools, way, space.nodes, triangles, effect.gap, shear, device)
