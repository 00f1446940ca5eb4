"""Young's modulus from forces that were read: which force dents tissue of a known stiffness as deep as was seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.special import logsumexp

from sim.anatomy import Anatomy
from sim.effects import SKULLS
from sim.errors import InputError
from sim.fem import Fem

from ..locating.causes import LETS_GO, YOUNG, Group
from ..locating.ensemble import ACCURACY
from ..locating.evidence import Evidence
from ..locating.observation import placed
from .frame import FORCE_SIGMA, Frame, Tool, foot
from .responses import FORCE, POISSONS, RATIOS, Responses, force_loads
from .tissue import FittedTissue
from .weighing import errors, seen_of, white

EXPONENTS = (9.5, 19.0)
"""-m of Ogden's law, as probable each: tissue stiffens as it is dented, so that a dent alone tells no modulus."""
YOUNGS = np.geomspace(300.0, 12000.0, 300)
"""Young's moduli [Pa] that are as probable, at small strain."""
# Forces that are solved, over what linear tissue would need.
TIMES = (0.6, 1.2, 2.2, 3.6, 5.5)
# A command's mesh and elements are dented as deep as finer or quadratic ones by a force that is so many times less: on
# the template 1.08 to 1.16 times (docs/fit.md).
SOFT = 1.11
# What the logarithm of a modulus is off by beside that.
OFF = 0.45
# How often errors are made anew, by the dent that is believed.
ROUNDS = 3
# Of a reading: normal numbers, as probable each. Samples of a modulus.
READINGS, SAMPLES = np.array([-1.4, -0.7, 0.0, 0.7, 1.4]), 101


def young_moduli(
    anatomy: Anatomy,
    frames: Sequence[Frame],
    tissue: FittedTissue,
    pressed: Responses | None,
    device: str = "auto",
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> np.ndarray:
    """Young's moduli (k,) [Pa] of the brain, as probable each; none where no force was read.

    Raises
    ------
    InputError
        A force that no answer of the finite elements reaches.
    """
    columns = np.cumsum([0, *[3 * len(frame.tools) for frame in frames]])
    read = [number for number, frame in enumerate(frames) if any(tool.force is not None for tool in frame.tools)]
    if pressed is None or not read:
        return np.zeros(0)
    total = np.zeros(len(YOUNGS))
    for done, number in enumerate(read):
        progress(done, len(read))
        evidence, own = placed(anatomy, frames[number].observation), slice(columns[number], columns[number] + 3)
        total += _weighed(anatomy, frames[number].tools[0], evidence, tissue, pressed, own, device)
    progress(len(read), len(read))
    share = np.exp(total - total.max())
    step = float(np.log(YOUNGS[1] / YOUNGS[0]))
    at = np.cumsum(gaussian_filter1d(share, OFF / step))
    return np.exp(np.interp((np.arange(SAMPLES) + 0.5) / SAMPLES, at / at[-1], np.log(YOUNGS / SOFT)))


def _weighed(
    anatomy: Anatomy, tool: Tool, evidence: Evidence, tissue: FittedTissue, pressed: Responses, own: slice, device: str
) -> np.ndarray:
    """Logarithms of how probable one reading is by each of `YOUNGS`."""
    name = max(tissue.skulls, key=lambda skull: tissue.skulls[skull])
    skull, (_, poisson, _), (_, ratio, _) = "slide" if name == LETS_GO else name, tissue.poisson, tissue.ratio
    nearest = int(np.abs(POISSONS - poisson).argmin()), int(np.abs(np.log(RATIOS / ratio)).argmin())
    lower, _ = errors(evidence)
    value = white(lower, evidence.value)
    way = np.linalg.lstsq(white(lower, seen_of(pressed, skull, evidence)[nearest][own].T), value, rcond=None)[0]
    force, direction = FORCE * float(np.linalg.norm(way)), way / np.linalg.norm(way)
    reading = float(tool.force or 0.0)
    sigma = FORCE_SIGMA * reading if tool.sigma is None else tool.sigma
    asked = np.log(YOUNG * np.maximum(reading + sigma * READINGS, 0.1 * reading)[:, None] / YOUNGS)
    shapes, inside = [], []
    for exponent in EXPONENTS:
        group = Group(list(SKULLS).index(skull), skull, poisson, ratio, exponent, pressed.regions)
        sizes, rows = _dents(anatomy, tool, group, evidence, pressed, force * np.array(TIMES), direction, device)
        inside.append((asked >= np.log(sizes[0])) & (asked <= np.log(sizes[-1])))
        shapes.append(CubicSpline(np.log(sizes), rows)(np.clip(asked, *np.log(sizes[[0, -1]]))))
    shape, logs = np.stack(shapes), np.zeros(0)
    for _ in range(ROUNDS):
        off = white(lower, (evidence.value - shape).reshape(-1, len(value)).T)
        logs = -0.5 * (off**2).sum(axis=0).reshape(shape.shape[:-1])
        logs = np.where(inside, logs, logs.min() - 50.0)
        # What tissue lacks is a share of the dent that is now believed.
        lower, _ = errors(evidence, shape.reshape(-1, len(value))[logs.argmax()])
    return np.asarray(logsumexp(logs, axis=(0, 1)))


def _dents(
    anatomy: Anatomy, tool: Tool, group: Group, evidence: Evidence, pressed: Responses, sizes: np.ndarray,
    direction: np.ndarray, device: str,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Forces (k,) [N] that have an equilibrium in tissue of modulus `YOUNG`, and what is seen of each (k, m) [m]."""
    loads = force_loads(anatomy, foot(anatomy, tool)[None], np.array([tool.radius]), sizes[:, None] * direction)
    answer = Fem(anatomy, group.effects((0.01,)), ACCURACY, device).deform(loads)
    good = np.array([outcome.good for outcome in answer.outcome])
    if good.sum() < 3:
        raise InputError(f"a force of {tool.force:g} N cannot be what dents this brain so: check its unit and frame.")
    motion = Responses(pressed.nodes, {group.skull: answer.displacement[good][None, None][..., pressed.nodes, :]})
    return sizes[good], seen_of(motion, group.skull, evidence)[0, 0]
