"""Sampling of loads by surgical tools: position, force, direction and footprint radius."""

from dataclasses import dataclass, replace

import numpy as np

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.loads import Loads, Pushed
from sim.material import BRAIN

from .cortex_patch import Patch, find_nearest, open_patch

MAX_ATTEMPTS = 2000  # Maximum number of draws of a load.
BLOCK_LOADS = 8192  # Number of loads sampled together: larger blocks take more memory and no less time.
NUMBERS_PER_LOAD = 8  # Number of random numbers of a load in each attempt.
MAX_DEPTH = 15e-3  # Largest depth of a tool [m]; a deeper tool perforates the tissue.
MAX_PRESSURE = 8e3  # Largest mean contact pressure [Pa]; above it a tool perforates. Damage begins at 2.7-4 kPa.
# E* = E / (1 - nu^2) of the default tissue: Hertz's depth 3 F / (4 E* r) estimates a load's depth before it is solved.
PLANE_MODULUS = BRAIN.young / (1.0 - BRAIN.poisson**2)
LATTICE_SIZE = 200  # Number of radii and of forces of a tool in the grid of its nominal loads.


@dataclass(frozen=True)
class ToolLoadRange:
    """Range of a surgical tool's loads.

    Parameters
    ----------
    name
        Name for `--preset`.
    radius_range
        Smallest and largest radius [m], sampled uniformly; a plate is represented by a disc of equal area.
    force_range
        Smallest and largest force [N], sampled log-uniformly, or uniformly if `is_uniform`.
    pressure_range
        Smallest and largest mean contact pressure F / (pi r^2) [Pa]; samples outside are rejected and repeated.
    max_depth
        Largest depth by Hertz's formula [m]; deeper samples are rejected and repeated.
    max_angle
        Largest angle [rad] between the force and the inward normal; directions are uniform by solid angle.
    """

    name: str
    radius_range: tuple[float, float]
    force_range: tuple[float, float]
    pressure_range: tuple[float, float] = (0.0, MAX_PRESSURE)
    max_depth: float = MAX_DEPTH
    max_angle: float = np.pi / 4.0
    is_uniform: bool = False

    def is_surgical(self, force: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of forces (n,) [N] with radii (n,) [m] that have an allowed pressure and Hertz depth."""
        pressure = force / (np.pi * radius**2)
        depth = 3.0 * force / (4.0 * PLANE_MODULUS * radius)
        return (self.pressure_range[0] <= pressure) & (pressure <= self.pressure_range[1]) & (depth <= self.max_depth)


TOOLS = {  # Ranges of loads of common tools, by name.
    tool.name: tool
    for tool in (
        ToolLoadRange("palpation", (5e-3, 7.5e-3), (0.05, 0.4), max_depth=10e-3),
        ToolLoadRange("bipolar", (0.5e-3, 1e-3), (0.01, 0.05)),
        ToolLoadRange("dissector", (1.5e-3, 2e-3), (0.02, 0.25)),
        # 5-30 mmHg under plates of 10-20 x 20-40 mm.
        ToolLoadRange("spatula", (8e-3, 16e-3), (0.13, 3.2), pressure_range=(700.0, 4000.0)),
    )
}
# Stress test of the solver, not surgery: 1 N on 3 mm would be a flat punch 40 mm deep.
BRUTAL = ToolLoadRange(
    "brutal", (3e-3, 10e-3), (0.02, 1.05), pressure_range=(0.0, np.inf), max_depth=np.inf, is_uniform=True
)
PRESETS = (*TOOLS, "mixed", "seed", BRUTAL.name)  # Names of all presets.
OVERLOAD_PRESETS = ("seed", BRUTAL.name)
"""Presets whose loads strain tissue beyond measurements on brain; their solutions are stored nevertheless."""


def draw(preset: str, anatomy: Anatomy, count: int, seed: int) -> Loads:
    """Sample `count` loads on the open cortex; load i depends only on the preset, the anatomy, the seed and i.

    `mixed` first samples the tool; `brutal` is far beyond surgery. `seed` is the protocol of Tonutti, Gras, Yang 2017,
    Artif. Intell. Med. 80:39-47, in an order shuffled by `seed`: it has at most 22,000 loads, so that a larger `count`
    returns fewer.

    Raises
    ------
    InputError
        The preset is unknown, the count is below one, the seed is negative, the anatomy has no open cortex or (for
        `seed`) no tumour, or the patch is too small for the tool.

    Examples
    --------
    >>> from scenes import open_theatre
    >>> from surrogate import draw
    >>> loads = draw("palpation", open_theatre(device="cpu").anatomy, count=100, seed=0)
    >>> len(loads), bool((np.linalg.norm(loads.causes[0].force, axis=1) <= 0.4).all())  # [N]
    (100, True)
    """
    if preset not in PRESETS:
        raise InputError(f"no preset is called {preset!r}: choose one of {', '.join(PRESETS)}.")
    if count < 1 or seed < 0:
        raise InputError(f"a count of {count} with seed {seed} draws nothing: give --count >= 1 and --seed >= 0.")
    patch = open_patch(anatomy)
    if preset == "seed":
        return _place_published_loads(anatomy, patch, count, seed)
    tools = list(TOOLS.values()) if preset == "mixed" else [{**TOOLS, BRUTAL.name: BRUTAL}[preset]]
    rows = _sample_in_blocks(tools, patch, count, seed)
    return Loads((Pushed(rows[:, :3], rows[:, 3:6], rows[:, 6]),))


def sample_pushes(tool: ToolLoadRange, patch: Patch, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample positions (count, 3) [m] and unit directions (count, 3) of a tool as `draw`, without pressure limits."""
    free = replace(tool, pressure_range=(0.0, np.inf), max_depth=np.inf)
    rows = _sample_in_blocks([free], patch, count, seed)
    return rows[:, :3], rows[:, 3:6] / np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True)


def _sample_in_blocks(tools: list[ToolLoadRange], patch: Patch, count: int, seed: int) -> np.ndarray:
    """Sample `count` loads of randomly chosen tools as rows (count, 7): point [m], force [N], footprint radius [m]."""
    key = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0])
    blocks = [range(first, min(first + BLOCK_LOADS, count)) for first in range(0, count, BLOCK_LOADS)]
    return np.concatenate([_sample_block(tools, patch, key, block) for block in blocks])


def compute_rejected_share(preset: str) -> float:
    """Compute the share of a preset's nominal loads, on a grid of radii and forces, that are too strong or too deep.

    These loads are not sampled, so no model is trained on them. The share is zero for presets without such limits.
    """
    tools = {**{name: [tool] for name, tool in TOOLS.items()}, "mixed": list(TOOLS.values())}.get(preset, [])
    middles = (np.arange(LATTICE_SIZE) + 0.5) / LATTICE_SIZE
    first, second = (axis.ravel() for axis in np.meshgrid(middles, middles))
    shares = []
    for tool in tools:
        force, footprint = (
            np.exp(interpolate_range(np.log(tool.force_range), first)),
            interpolate_range(tool.radius_range, second),
        )
        shares.append(1.0 - tool.is_surgical(force, footprint).mean())
    return float(np.mean(shares)) if shares else 0.0


def describe_rejected_loads(preset: str) -> str:
    """Describe the share of a preset's rejected loads in a sentence; empty if the share is zero."""
    share = compute_rejected_share(preset)
    return (
        f"{100.0 * share:.0f} % of the nominal loads of {preset} exceed the pressure or depth of surgery: they are not "
        "sampled, and are outside the training range."
        if share > 0.0
        else ""
    )


def _sample_block(tools: list[ToolLoadRange], patch: Patch, key: int, block: range) -> np.ndarray:
    """Sample the loads of a block as rows (n, 7): point [m], force [N], footprint radius [m]."""
    kind = (len(tools) * _generate_random_numbers(key, 0, block)[:, -1]).astype(int)
    out = np.zeros((len(block), 7))
    for number, tool in enumerate(tools):
        rows = np.flatnonzero(kind == number)
        out[rows] = _sample_tool(tool, patch, key, block, rows)
    return out


def _generate_random_numbers(key: int, attempt: int, block: range) -> np.ndarray:
    """Generate uniform random numbers (n, NUMBERS_PER_LOAD) in [0, 1), one row for each load of a block.

    Salmon, Moraes, Dror, Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3": a counter-based generator, so that a
    load's numbers do not require those of earlier loads.
    """
    source = np.random.Philox(key=np.array([key, attempt], np.uint64))
    source.advance(block.start * NUMBERS_PER_LOAD // 4)  # each count gives four numbers
    return np.random.Generator(source).random((len(block), NUMBERS_PER_LOAD))


def _sample_tool(tool: ToolLoadRange, patch: Patch, key: int, block: range, rows: np.ndarray) -> np.ndarray:
    """Sample `rows` (k,) of a block as `_sample_block`, for one tool; rejected loads are sampled again."""
    out, waiting = np.zeros((len(block), 7)), rows
    for attempt in range(MAX_ATTEMPTS):
        if not len(waiting):
            return out[rows]
        uniform = _generate_random_numbers(key, attempt, block)[waiting]
        footprint = interpolate_range(tool.radius_range, uniform[:, 0])
        force = (
            interpolate_range(tool.force_range, uniform[:, 1])
            if tool.is_uniform
            else np.exp(interpolate_range(np.log(tool.force_range), uniform[:, 1]))
        )
        fits = np.flatnonzero(tool.is_surgical(force, footprint))
        point, normal = patch.place_points(uniform[fits, 2:5])
        inside = patch.compute_edge_distance(point) >= footprint[fits]
        fits, point, normal = fits[inside], point[inside], normal[inside]
        direction = _sample_in_cone(normal, tool.max_angle, uniform[fits, 5:7])
        out[waiting[fits]] = np.column_stack([point, force[fits, None] * direction, footprint[fits]])
        waiting = np.delete(waiting, fits)
    low, high = tool.radius_range
    raise InputError(
        f"in {MAX_ATTEMPTS} draws no {tool.name} of radius {1e3 * low:g}-{1e3 * high:g} mm "
        "fitted into the open cortex: widen the --craniotomy, or choose a smaller tool with --preset."
    )


def interpolate_range(limits: tuple[float, float] | np.ndarray, random_numbers: np.ndarray) -> np.ndarray:
    """Map uniform random numbers (n,) in [0, 1) linearly to the range between two limits."""
    return limits[0] + (limits[1] - limits[0]) * random_numbers


def _sample_in_cone(axis: np.ndarray, angle: float, random_numbers: np.ndarray) -> np.ndarray:
    """Sample unit vectors (n, 3) within `angle` [rad] of unit vectors `axis` (n, 3), uniformly by solid angle."""
    cosine = (1.0 - random_numbers[:, 0] * (1.0 - np.cos(angle)))[:, None]
    around = (2.0 * np.pi * random_numbers[:, 1])[:, None]
    first, second = find_perpendiculars(axis)
    sideways = np.cos(around) * first + np.sin(around) * second
    return cosine * axis + np.sqrt(1.0 - cosine**2) * sideways


def find_perpendiculars(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute two unit vectors (n, 3) that are perpendicular to unit vectors `axis` (n, 3) and to each other."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def build_rotations_about(shaft: np.ndarray) -> np.ndarray:
    """Build rotations (n, 3, 3) with z axes `shaft` (n, 3), which are unit vectors, and arbitrary x axes."""
    return np.stack([*find_perpendiculars(shaft), shaft], axis=2)


PUBLISHED_FORCES = np.linspace(0.10, 1.05, 20)  # Forces of the published loads [N].


@dataclass(frozen=True)
class PublishedSettings:
    """Settings of the published loads, which the preset `seed` samples."""

    position_count: int = 11  # Number of positions of the published loads.
    direction_count: int = 100  # Number of directions of the published loads.
    radius: float = 7e-3  # Radius of a disc with the area of one free surface node of the published mesh [m].
    max_angle: float = np.pi / 3.0  # Largest angle between a published force and the inward normal [rad].


def _place_published_loads(
    anatomy: Anatomy, patch: Patch, count: int, seed: int, settings: PublishedSettings = PublishedSettings()
) -> Loads:
    """Build `build_published_loads` at 11 nodes of the open cortex, 20-28 mm from the tumour's centre."""
    if not len(anatomy.tumour_nodes):
        raise InputError("the anatomy has no tumour, so no position is 20-28 mm from it: choose another --preset.")
    centre = anatomy.mesh.nodes[anatomy.tumour_nodes].mean(axis=0)
    distance = np.linalg.norm(patch.points - centre, axis=1)
    inside = patch.compute_edge_distance(patch.points) >= settings.radius
    near = np.flatnonzero((distance >= 20e-3) & (distance <= 28e-3) & inside)
    if not len(near):
        raise InputError(
            f"the open cortex is {1e3 * distance.min():.1f}-{1e3 * distance.max():.1f} mm from the tumour's centre. "
            f"No node at 20-28 mm lies {1e3 * settings.radius:g} mm inside its rim: make the anatomy with --preset "
            "seed, or choose another --preset here."
        )
    return build_published_loads(
        patch, patch.points[near[pick_far_points(patch.points[near], settings.position_count)]], count, seed, settings
    )


def build_published_loads(
    patch: Patch, positions: np.ndarray, count: int, seed: int, settings: PublishedSettings = PublishedSettings()
) -> Loads:
    """Build the published loads, shuffled: `positions` (m, 3) [m] x 100 directions x 20 forces; return at most `count`.

    The authors sample directions at random; here they are a spherical Fibonacci lattice within 60 degrees of the inward
    normal.
    """
    golden = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(settings.direction_count) / (2.0 * np.pi)
    lattice = np.column_stack([(np.arange(settings.direction_count) + 0.5) / settings.direction_count, golden % 1.0])
    axes = [np.broadcast_to(inward, (settings.direction_count, 3)) for inward in patch.find_normals(positions)]
    direction = np.array([_sample_in_cone(axis, settings.max_angle, lattice) for axis in axes])
    whole = np.random.default_rng(seed).permutation(len(positions) * settings.direction_count * len(PUBLISHED_FORCES))
    position, way, magnitude = np.unravel_index(
        whole[:count], (len(positions), settings.direction_count, len(PUBLISHED_FORCES))
    )
    force = PUBLISHED_FORCES[magnitude, None] * direction[position, way]
    return Loads((Pushed(positions[position], force, np.full(len(position), settings.radius)),))


def pick_far_points(points: np.ndarray, count: int) -> np.ndarray:
    """Select at most `count` of the `points` (n, 3) by farthest-point sampling; return their indices (k,).

    The first point is nearest to the mean, so that the result depends only on the points. Gonzalez 1985, Theor. Comput.
    Sci. 38:293-306.
    """
    chosen = [int(find_nearest(points.mean(axis=0, keepdims=True), points)[0][0])]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count and distance.max() > 0.0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
