"""Causes of brain motion that a locator considers: tools, drained CSF and swelling, in tissue of unknown stiffness."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.bodies.fluid_level import compute_fluid_level
from sim.bodies.open_cortex import open_cortex
from sim.effects import SKULLS, Effect, Gravity, Held, Pulsation, ToolForce, Wave
from sim.fem import Fem
from sim.loads import Loads, Posture, Pushed
from sim.material import Material, Ogden

from ..data.tool_loads import draw
from .regions import Region, build_tissue

KINDS = ("tool", "drainage", "swelling", "tumour swelling", "oedema")
"""Names of the causes in an ensemble."""
TOOL, DRAINAGE, SWELLING, TUMOUR_SWELLING, OEDEMA = range(len(KINDS))  # Numbers of the causes in `KINDS`.
SWELLING_WAVE = Wave(0.25, 0.0)  # Wave that gives each volume change at some time; the second wave is zero.
TOOL_POINTS = 70  # Number of points on the open cortex where a tool acts.
# Candidate tissues: Poisson's ratio of the brain, ratio of tumour to brain stiffness.
TISSUES = ((0.45, 2.0), (0.49, 0.7))
ACCURACY = Accuracy(tolerance=1e-3)  # Accuracy of the FEM results for tools.


@dataclass(frozen=True)
class Causes:
    """Sampling configuration of an ensemble; its ranges are those of the brain-shift literature.

    Parameters
    ----------
    poisson
        Candidate Poisson's ratios; drained tissue has 0.45, brain within seconds 0.49 (`sim.MATERIALS`).
    poisson_let_go
        Largest Poisson's ratio for a separating skull: larger values take minutes with swelling, and explain no more.
    stiffness
        Smallest and largest ratio of tumour to brain stiffness, sampled log-uniformly.
    exponent
        Smallest and largest -m of Ogden's law, log-uniform: 4.7 of Miller, Chinzei 2002; 19 of `sim.MATERIALS`.
    tools
        Number of tool loads in a group; the second number is for a separating skull, which is solved load by load.
    drainages
        Number of gravity directions in a group.
    levels
        Shares of the fluid that remain in each drainage, in order.
    cone
        Largest angle [rad] between gravity and the open cortex's inward axis; surgeons turn the craniotomy upwards.
    swellings, tumour_swellings, oedema
        Relative volume changes in each group: of the brain, of the tumour alone, and of the brain round the tumour.
    reach
        Smallest and largest distance [m] up to which oedema surrounds the tumour, log-uniform.
    reaches
        Number of such distances in a group; the second number is for a separating skull, as in `tools`.
    regions
        Regions of known stiffness, which is not sampled.
    """

    poisson: tuple[float, ...] = (0.45, 0.47, 0.49)
    poisson_let_go: float = 0.48
    stiffness: tuple[float, float] = (0.5, 3.0)
    exponent: tuple[float, float] = (4.7, 19.0)
    tools: tuple[int, int] = (12, 4)
    drainages: int = 6
    levels: tuple[float, ...] = (0.75, 0.55, 0.35, 0.15)
    cone: float = np.radians(60.0)
    swellings: tuple[float, ...] = (0.06, 0.04, 0.02, -0.02, -0.04)
    tumour_swellings: tuple[float, ...] = (0.2, -0.15)
    oedema: tuple[float, ...] = (0.2, -0.1)
    reach: tuple[float, float] = (8e-3, 40e-3)
    reaches: tuple[int, int] = (2, 1)
    regions: tuple[Region, ...] = ()


USUAL_CAUSES = Causes()  # Default causes.
YOUNG = 3000.0  # Young's modulus at small strain [Pa]; motions are normalised in magnitude, so it hardly matters.
FORCE_RADIUS = 7e-3  # Radius of the disc on which a force acts on the cortex [m].
SEPARATING_SKULL = "contact"  # Skull model that separates from the brain.
SUPINE = np.array(Gravity().direction)  # Direction of gravity in the scan, as in `Gravity`.


def build_linear_tissue(stiffness_ratio: float, poisson: float) -> Material:
    """Build linear tissue with `stiffness_ratio` times the brain's stiffness at small strain."""
    return Material("linear", YOUNG * stiffness_ratio, poisson)


@dataclass(frozen=True)
class Group:
    """Group of ensemble members with the same tissue and skull.

    Parameters
    ----------
    number
        Number from 0; samples depend only on this number and the seed.
    skull
        Skull model, one of `sim.effects.SKULLS`.
    poisson, ratio, exponent
        Poisson's ratio of the brain, ratio of tumour to brain stiffness, and -m of Ogden's law for both tissues.
    regions
        Other regions of known stiffness.
    reach
        Distances [m] up to which oedema surrounds the tumour, each solved separately.
    """

    number: int
    skull: str
    poisson: float
    ratio: float
    exponent: float
    regions: tuple[Region, ...] = ()
    reach: tuple[float, ...] = ()

    def build_effects(
        self, volume_changes: tuple[float, ...], regions: tuple[int, ...] | None = None
    ) -> tuple[Effect, ...]:
        """Build the FEM effects, with volume changes up to `volume_changes` in the labelled `regions` (None: all)."""
        swells = Pulsation(Wave(SWELLING_WAVE.frequency, max(map(abs, volume_changes))), SWELLING_WAVE, regions)
        tissue = build_tissue(self._build_tissue, self.poisson, self.ratio, self.regions)
        return (tissue, Held(), SKULLS[self.skull], ToolForce(), Gravity(), swells)

    def _build_tissue(self, times: float, poisson: float) -> Ogden:
        """Build Ogden tissue with `times` the brain's stiffness at small strain."""
        mu, lam = Material("neo-hookean", YOUNG * times, poisson).lame
        return Ogden(((2.0 * mu, -self.exponent),), lam + 2.0 * mu / 3.0)


def build_groups(anatomy: Anatomy, seed: int = 0, causes: Causes = USUAL_CAUSES) -> tuple[Group, ...]:
    """Build groups with each skull and each Poisson's ratio; () if the anatomy has no skull.

    For each skull, tumour stiffness, exponent and oedema distance are stratified: one group in every part of a range.
    """
    made: list[Group] = []
    for number, skull in enumerate(SKULLS if anatomy.slide_normal.any() else ()):
        some = [poisson for poisson in causes.poisson if skull != SEPARATING_SKULL or poisson <= causes.poisson_let_go]
        random = np.random.default_rng([seed, number])
        ratio, exponent = (
            _sample_stratified(random, len(some), limits) for limits in (causes.stiffness, causes.exponent)
        )
        count = causes.reaches[skull == SEPARATING_SKULL]
        reach = np.reshape(_sample_stratified(random, count * len(some), causes.reach), (len(some), count)).tolist()
        for poisson, own_ratio, own_exponent, distances in zip(some, ratio, exponent, reach, strict=True):
            made.append(Group(len(made), skull, poisson, own_ratio, own_exponent, causes.regions, tuple(distances)))
    return tuple(made)


def _sample_stratified(rng: np.random.Generator, count: int, limits: tuple[float, float]) -> list[float]:
    """Sample one number in each of `count` log-equal parts of a range; return the numbers in random order."""
    low, high = np.log(limits)
    share = (rng.permutation(count) + rng.uniform(size=count)) / max(count, 1)
    return np.exp(low + share * (high - low)).tolist()


def build_pushes(group: Group, anatomy: Anatomy, seed: int = 0, causes: Causes = USUAL_CAUSES) -> Loads:
    """Sample the tool loads of a group, with gravity as in the scan."""
    count = causes.tools[group.skull == SEPARATING_SKULL]
    pushed = draw("mixed", anatomy, count, seed * 1000 + group.number).get(Pushed)
    assert pushed is not None
    return Loads((pushed, _build_posture(anatomy, np.tile(SUPINE, (count, 1)), 1.0)), np.zeros(count))


def build_swellings(anatomy: Anatomy, volume_changes: tuple[float, ...]) -> Loads:
    """Build loads with these relative volume changes; pass the same changes to `Group.build_effects`."""
    # The wave gives the time at which each volume change is reached.
    time = np.arcsin(np.array(volume_changes) / max(map(abs, volume_changes))) / (2.0 * np.pi * SWELLING_WAVE.frequency)
    return Loads((_build_idle(anatomy, len(time)), _build_posture(anatomy, np.tile(SUPINE, (len(time), 1)), 1.0)), time)


def build_drainages(group: Group, anatomy: Anatomy, seed: int = 0, causes: Causes = USUAL_CAUSES) -> tuple[Loads, ...]:
    """Build loads of drained fluid for sampled gravity directions: one `Loads` for each level, in order."""
    random = np.random.default_rng([seed, group.number, 1])
    down = sample_gravity_directions(random, open_cortex(anatomy).axis, causes)
    idle = _build_idle(anatomy, len(down))
    return tuple(Loads((idle, _build_posture(anatomy, down, left)), np.zeros(len(down))) for left in causes.levels)


def _build_idle(anatomy: Anatomy, count: int) -> Pushed:
    """Build `count` zero-force pushes, for loads without a tool."""
    return Pushed(np.tile(open_cortex(anatomy).origin, (count, 1)), np.zeros((count, 3)), np.full(count, FORCE_RADIUS))


def _build_posture(anatomy: Anatomy, directions: np.ndarray, fluid_share: float) -> Posture:
    """Build postures with gravity along `directions` (n, 3) and a share `fluid_share` of the fluid."""
    level = np.array([compute_fluid_level(anatomy.mesh.nodes, one, fluid_share) for one in directions])
    return Posture(directions, level, np.ones(len(directions)))


def sample_gravity_directions(rng: np.random.Generator, axis: np.ndarray, causes: Causes) -> np.ndarray:
    """Sample gravity directions (n, 3), uniform by solid angle in a cone round the inward `axis` (3,)."""
    cosine = rng.uniform(np.cos(causes.cone), 1.0, causes.drainages)
    angle = rng.uniform(0.0, 2.0 * np.pi, causes.drainages)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    other, sine = np.cross(axis, side), np.sqrt(1.0 - cosine**2)
    return cosine[:, None] * axis + (sine * np.cos(angle))[:, None] * side + (sine * np.sin(angle))[:, None] * other


@dataclass(frozen=True, eq=False)
class PressResponses:
    """Responses of linear tissue to forces of equal magnitude on the open cortex.

    Parameters
    ----------
    points
        Positions (p, 3) [m] on the open cortex.
    motion
        Displacements (tissues, p, 3, V, 3) float32 [m] by skull name, for a force along each axis at each point.
    """

    points: np.ndarray
    motion: dict[str, np.ndarray]


def solve_presses(
    anatomy: Anatomy, skulls: tuple[str, ...], device: str = "auto", regions: tuple[Region, ...] = ()
) -> PressResponses:
    """Solve linear tissue under forces of 0.01 N on discs of 7 mm radius, for each skull; return the responses."""
    nodes = anatomy.mesh.nodes[np.unique(anatomy.open_surface)]
    points = nodes[select_spaced_points(nodes, TOOL_POINTS)]
    force = np.tile(0.01 * np.eye(3), (len(points), 1))
    loads = Loads((Pushed(np.repeat(points, 3, axis=0), force, np.full(len(force), FORCE_RADIUS)),))
    found: dict[str, list[np.ndarray]] = {name: [] for name in skulls}
    for name, (poisson, ratio) in product(skulls, TISSUES):
        effects = (build_tissue(build_linear_tissue, poisson, ratio, regions), Held(), SKULLS[name], ToolForce())
        motion = Fem(anatomy, effects, ACCURACY, device).deform(loads).displacement
        found[name].append(motion.reshape(len(points), 3, -1, 3).astype(np.float32))
    return PressResponses(points, {name: np.stack(parts) for name, parts in found.items()})


def select_spaced_points(points: np.ndarray, count: int) -> np.ndarray:
    """Select `count` of the points (n, 3) by farthest-point sampling, the most central first; return their indices."""
    found = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    away = np.full(len(points), np.inf)
    while len(found) < min(count, len(points)):
        away = np.minimum(away, ((points - points[found[-1]]) ** 2).sum(axis=1))
        found.append(int(away.argmax()))
    return np.array(found)
