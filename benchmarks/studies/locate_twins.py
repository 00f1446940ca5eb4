"""Synthetic test cases of `locate`, with mesh, law, stiffness and skull other than the estimator's."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.bodies.fluid_level import compute_fluid_level
from sim.bodies.open_cortex import open_cortex
from sim.effects import Bonded, Effect, Elasticity, Gravity, Held, Pulsation, SkullContact, Slide, ToolForce, Wave
from sim.elements import RECOMMENDED
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.locate import locate
from sim.loads import Loads, Posture, Pushed
from sim.material import Ogden
from sim.named_tissues import MATERIALS
from surrogate.data.tool_loads import draw as drawn_loads
from surrogate.model.kept_arrays import get_cache_path, load_cached_arrays

CAUSES = ("tool", "drainage", "swelling", "drainage and tool")
"""Causes of motion, used in turn: each one acts in a quarter or in half of the test cases."""
SKULLS = {"contact": SkullContact(2e-4), "bonded": Bonded(), "slide": Slide()}
"""Skull models of the test cases."""
# Probability of each skull; with drained fluid alone the brain sinks, which only the first skull permits.
PROBABLE = (0.2, 0.4, 0.4)
# Ranges of the stiffness over that of `MATERIALS["minutes"]`, and of the tumour's over the brain's; log-uniform.
STIFFNESS, RATIO, POISSON = (0.5, 1.3), (0.5, 3.0), 0.49
# Change of the brain's volume, and probability of growth; remaining share of fluid; deviation of gravity from the
# opening's axis, as a standard deviation along each axis.
SWELLING, SWOLLEN, LEFT, TILT = (0.02, 0.06), 0.7, (0.1, 0.5), 0.35
TOOLS = ("palpation", "spatula")
ACCURACY = Accuracy(tolerance=1e-3)
# Maximum distance [m] between the tumour's centres in two meshes of one brain.
SAME = 3e-3


@dataclass(frozen=True)
class Draw:
    """Parameters of a test case.

    Parameters
    ----------
    number
        Number of the test case, from 0.
    cause, skull, tool
        One of `CAUSES`, a name of `SKULLS`, one of `TOOLS`.
    stiffness, ratio
        Stiffness of the brain over `MATERIALS["minutes"]`, and of the tumour over the brain.
    swelling
        Change of the brain's volume, if it is the cause.
    left
        Remaining share of the fluid, if some drains.
    tilt
        (3,): added to the opening's inward axis for the direction of gravity.
    push
        Random seed of the tool's load.
    """

    number: int
    cause: str
    skull: str
    tool: str
    stiffness: float
    ratio: float
    swelling: float
    left: float
    tilt: tuple[float, ...]
    push: int


@dataclass(frozen=True, eq=False)
class SyntheticCase:
    """Test case: its parameters, and the motion (V, 3) [m] of the vertices of the estimator's mesh."""

    parameters: Draw
    motion: np.ndarray


def sample_parameters(seed: int, number: int) -> Draw:
    """Sample the parameters of a test case; they depend on its number and the seed alone."""
    random = np.random.default_rng([seed, number])
    cause = CAUSES[number % len(CAUSES)]
    stiffness, ratio = (float(np.exp(random.uniform(*np.log(limits)))) for limits in (STIFFNESS, RATIO))
    skull = str(random.choice(list(SKULLS), p=PROBABLE))
    swelling = float(random.uniform(*SWELLING)) * (1.0 if random.uniform() < SWOLLEN else -1.0)
    left, tilt = float(random.uniform(*LEFT)), tuple((TILT * random.standard_normal(3)).tolist())
    tool, push = str(random.choice(TOOLS)), int(random.integers(2**31))
    return Draw(
        number=number,
        cause=cause,
        skull="contact" if cause == "drainage" else skull,
        tool=tool,
        stiffness=stiffness,
        ratio=ratio,
        swelling=swelling,
        left=left,
        tilt=tilt,
        push=push,
    )


def build_effects(draw: Draw) -> tuple[Effect, ...]:
    """Build the effects of a test case's FEM."""
    tumour = {TUMOUR_LABEL: build_ogden_tissue(draw.stiffness * draw.ratio)}
    swells = Pulsation(Wave(0.25, abs(draw.swelling)), Wave(0.25, 0.0))
    skull = SKULLS[draw.skull]
    return Elasticity(build_ogden_tissue(draw.stiffness), tumour), Held(), skull, ToolForce(), Gravity(), swells


def build_ogden_tissue(stiffness_ratio: float, poisson: float = POISSON) -> Ogden:
    """Build Ogden tissue of one exponent, `stiffness_ratio` times as stiff as `MATERIALS["minutes"]`."""
    minutes = MATERIALS["minutes"].tissue
    assert isinstance(minutes, Ogden)
    (c, m), *_ = minutes.terms
    bulk = stiffness_ratio * c * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson))
    return Ogden(((stiffness_ratio * c, m),), bulk)


def build_loads(anatomy: Anatomy, draw: Draw) -> Loads:
    """Build the loads of a test case on this body."""
    pushed = drawn_loads(draw.tool, anatomy, 1, draw.push).get(Pushed)
    assert pushed is not None
    if "tool" not in draw.cause:
        pushed = Pushed(pushed.point, 0.0 * pushed.force, pushed.footprint)
    # Posture of the scan, supine with a full skull: no change of weight acts.
    down, left = np.array(Gravity().direction), 1.0
    if "drainage" in draw.cause:
        down, left = open_cortex(anatomy).axis + draw.tilt, draw.left
        down /= np.linalg.norm(down)
    level = compute_fluid_level(anatomy.mesh.nodes, down, left)
    # The wave has its maximum at 1 s, and its minimum at -1 s.
    time = float(np.sign(draw.swelling)) if draw.cause == "swelling" else 0.0
    return Loads((pushed, Posture(down[None], np.array([level]), np.ones(1))), np.array([time]))


def solve_case(anatomy: Anatomy, draw: Draw, device: str = "auto", element: str = RECOMMENDED) -> np.ndarray | None:
    """Solve for the motion (V, 3) [m] of a test case's own mesh; None without equilibrium."""
    answer = Fem(anatomy, build_effects(draw), ACCURACY, device, element=element).deform(build_loads(anatomy, draw))
    return answer.displacement[0] if answer.outcome[0].good else None


def solve_cases(
    anatomy: Anatomy, finer_mesh: Anatomy, count: int, seed: int = 0, device: str = "auto", element: str = RECOMMENDED,
    folder: Path | None = None, progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[SyntheticCase | None]:  # fmt: skip
    """Solve test cases on `finer_mesh`, interpolated at the vertices of `anatomy`; None for one without equilibrium.

    Cases in `folder`, from an interrupted run, are read. `progress` receives the number done and the total.

    Raises
    ------
    InputError
        Meshes of two brains; meshes without tumour or open cortex.
    """
    check_same_brain(anatomy, finer_mesh)
    place = locate(finer_mesh.mesh, anatomy.mesh.nodes)
    for number in range(count):
        draw = sample_parameters(seed, number)
        motion = _kept(finer_mesh, draw, device, element, folder)
        progress(number + 1, count)
        yield None if motion is None else SyntheticCase(draw, place.interpolate(motion[None].astype(float))[0])


def check_same_brain(anatomy: Anatomy, finer_mesh: Anatomy) -> None:
    """Check that two meshes are of one brain.

    Raises
    ------
    InputError
        A mesh without a tumour; tumours at different positions.
    """
    for one in (anatomy, finer_mesh):
        if not len(one.tumour_nodes):
            raise InputError("an anatomy has no tumour to locate: make one that has.")
        open_cortex(one)
    middles = [one.mesh.nodes[one.tumour_nodes].mean(axis=0) for one in (anatomy, finer_mesh)]
    apart = float(np.linalg.norm(middles[0] - middles[1]))
    if apart > SAME:
        raise InputError(
            f"the tumours of both meshes lie {1e3 * apart:.0f} mm apart: make both of one brain, with --nodes alone "
            "different."
        )


def _kept(anatomy: Anatomy, draw: Draw, device: str, element: str, folder: Path | None) -> np.ndarray | None:
    """Read the motion of a test case's own mesh from the folder, or solve and store it."""
    path = get_cache_path(folder, f"twin-{draw.number:04d}-", device, anatomy.digest, element, draw)

    def made() -> dict[str, np.ndarray]:
        found = solve_case(anatomy, draw, device, element)
        return {"motion": np.zeros((0, 3)) if found is None else found}

    def check(arrays: Mapping[str, np.ndarray]) -> None:
        count, *rest = arrays["motion"].shape
        if (count, *rest) not in (anatomy.mesh.nodes.shape, (0, 3)):
            raise InputError(f"holds motions of {count} vertices: delete it, and it is made anew.")

    motion = load_cached_arrays(path, "a twin", ["motion"], made, check)["motion"]
    return motion if len(motion) else None
