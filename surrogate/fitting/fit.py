"""Estimation of a patient's tissue from several frames, by the sum of their log evidence for each candidate tissue."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.special import logsumexp

from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.effects import SKULLS
from sim.errors import InputError
from sim.fem import Fem
from sim.runtime.threads import limit_to_one_thread

from ..locating.causes import SEPARATING_SKULL, YOUNG, Group
from ..locating.ensemble import ACCURACY
from ..locating.evidence import Evidence
from ..locating.locator import Locator
from ..locating.observation import to_evidence
from ..locating.regions import Region
from .frame_likelihood import (
    compute_drainage_likelihood,
    compute_pressing_likelihood,
    factorise_errors,
    find_unsupported_points,
    predict_observation,
    remove_points,
    whiten_columns,
)
from .observed_frame import FORCE_SIGMA, ObservedFrame, Tool, check_frames, find_contact_point
from .responses import POISSONS, RATIOS, TOOL_FORCE, Responses, build_drainage_loads, build_force_loads, solve_responses
from .tissue import FINE_POISSONS, FINE_RATIOS, FittedTissue

EXPONENTS = (9.5, 19.0)
"""Candidate exponents -m of Ogden's law, equally probable; tissue stiffens with depth, so a dent alone gives no E."""
YOUNGS = np.geomspace(300.0, 12000.0, 300)
"""Candidate Young's moduli [Pa] at small strain, equally probable."""
# Equally probable quantiles of a force reading's normal error [standard deviations].
READING_QUANTILES = np.array([-1.4, -0.7, 0.0, 0.7, 1.4])


@dataclass(frozen=True)
class ModulusSettings:
    """Settings of `estimate_young_moduli`."""

    # Forces to solve, as multiples of the force that linear tissue would need.
    force_multiples: tuple[float, ...] = (0.6, 1.2, 2.2, 3.6, 5.5)
    # Ratio of the force on finer or quadratic meshes to that on a command's mesh, for the same dent: 1.08 to 1.16 on
    # the template (docs/notes/fit_experiments.md).
    mesh_force_ratio: float = 1.11
    modulus_deviation: float = 0.45  # Standard deviation of the logarithm of a modulus due to further errors.
    iterations: int = 3  # Number of iterations that update the model error from the estimated dent.
    modulus_samples: int = 101  # Number of samples of a modulus.


def estimate_young_moduli(
    anatomy: Anatomy, frames: Sequence[ObservedFrame], tissue: FittedTissue, presses: Responses | None,
    device: str = "auto", progress: Callable[[int, int], object] = lambda done, total: None,
    settings: ModulusSettings = ModulusSettings(),
) -> np.ndarray:  # fmt: skip
    """Sample equally probable Young's moduli (k,) [Pa] of the brain; empty if no force was measured.

    Raises
    ------
    InputError
        FEM cannot reach a measured force.
    """
    columns = np.cumsum([0, *[3 * len(frame.tools) for frame in frames]])
    read = [number for number, frame in enumerate(frames) if any(tool.force is not None for tool in frame.tools)]
    if presses is None or not read:
        return np.zeros(0)
    total = np.zeros(len(YOUNGS))
    for done, number in enumerate(read):
        progress(done, len(read))
        evidence, own = to_evidence(anatomy, frames[number].observation), slice(columns[number], columns[number] + 3)
        tool = frames[number].tools[0]
        total += _compute_log_likelihood(anatomy, tool, evidence, tissue, presses, own, device, settings)
    progress(len(read), len(read))
    share = np.exp(total - total.max())
    step = float(np.log(YOUNGS[1] / YOUNGS[0]))
    at = np.cumsum(gaussian_filter1d(share, settings.modulus_deviation / step))
    quantiles = (np.arange(settings.modulus_samples) + 0.5) / settings.modulus_samples
    return np.exp(np.interp(quantiles, at / at[-1], np.log(YOUNGS / settings.mesh_force_ratio)))


def _compute_log_likelihood(
    anatomy: Anatomy, tool: Tool, evidence: Evidence, tissue: FittedTissue, responses: Responses, frame_rows: slice,
    device: str, settings: ModulusSettings,
) -> np.ndarray:  # fmt: skip
    """Compute the log-likelihood (len(YOUNGS),) of one force reading for each candidate modulus."""
    name = max(tissue.skulls, key=lambda skull: tissue.skulls[skull])
    skull, (_, poisson, _), (_, ratio, _) = "slide" if name == SEPARATING_SKULL else name, tissue.poisson, tissue.ratio
    nearest = int(np.abs(POISSONS - poisson).argmin()), int(np.abs(np.log(RATIOS / ratio)).argmin())
    lower, _ = factorise_errors(evidence)
    value = whiten_columns(lower, evidence.motion)
    way = np.linalg.lstsq(
        whiten_columns(lower, predict_observation(responses, skull, evidence)[nearest][frame_rows].T), value, rcond=None
    )[0]
    force, direction = TOOL_FORCE * float(np.linalg.norm(way)), way / np.linalg.norm(way)
    reading = float(tool.force or 0.0)
    sigma = FORCE_SIGMA * reading if tool.sigma is None else tool.sigma
    asked = np.log(YOUNG * np.maximum(reading + sigma * READING_QUANTILES, 0.1 * reading)[:, None] / YOUNGS)
    shapes, inside = [], []
    for exponent in EXPONENTS:
        group = Group(list(SKULLS).index(skull), skull, poisson, ratio, exponent, responses.regions)
        sizes, rows = _solve_indentations(
            anatomy, tool, group, evidence, responses, force * np.array(settings.force_multiples), direction, device
        )
        inside.append((asked >= np.log(sizes[0])) & (asked <= np.log(sizes[-1])))
        shapes.append(CubicSpline(np.log(sizes), rows)(np.clip(asked, *np.log(sizes[[0, -1]]))))
    shape, logs = np.stack(shapes), np.zeros(0)
    for _ in range(settings.iterations):
        off = whiten_columns(lower, (evidence.motion - shape).reshape(-1, len(value)).T)
        logs = -0.5 * (off**2).sum(axis=0).reshape(shape.shape[:-1])
        logs = np.where(inside, logs, logs.min() - 50.0)
        # The model error is a share of the estimated dent.
        lower, _ = factorise_errors(evidence, shape.reshape(-1, len(value))[logs.argmax()])
    return np.asarray(logsumexp(logs, axis=(0, 1)))


def _solve_indentations(
    anatomy: Anatomy, tool: Tool, group: Group, evidence: Evidence, responses: Responses, sizes: np.ndarray,
    direction: np.ndarray, device: str,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Solve forces on tissue of modulus `YOUNG`; return the converged forces (k,) [N] and observed dents (k, m) [m]."""
    loads = build_force_loads(
        anatomy, find_contact_point(anatomy, tool)[None], np.array([tool.radius]), sizes[:, None] * direction
    )
    result = Fem(anatomy, group.build_effects((0.01,)), ACCURACY, device).deform(loads)
    good = np.array([outcome.good for outcome in result.outcome])
    if good.sum() < 3:
        raise InputError(f"a force of {tool.force:g} N cannot be what dents this brain so: check its unit and frame.")
    motion = Responses(responses.nodes, {group.skull: result.displacement[good][None, None][..., responses.nodes, :]})
    return sizes[good], predict_observation(motion, group.skull, evidence)[0, 0]


def fit_tissue(
    locator: Locator, frames: Sequence[ObservedFrame], device: str = "auto", folder: Path | None = None,
    progress: Callable[[str, int, int], object] = lambda stage, done, total: None,
    left_out: Sequence[np.ndarray] | None = None,
) -> FittedTissue:  # fmt: skip
    """Estimate the tissue of a locator's anatomy from observed frames.

    Outliers are removed: the points in `left_out` (one array per frame), or those of `find_unsupported_points`. FEM
    responses stored in `folder` are reused. `progress` receives a stage, the number of its parts done, and their total.

    Raises
    ------
    InputError
        See `check_frames` and `find_unsupported_points`.
    """
    anatomy = locator.anatomy
    check_frames(anatomy, frames)
    frames = remove_points(frames, find_unsupported_points(locator, frames) if left_out is None else left_out)
    drained, pressed, regions = None, None, list_fitted_regions(locator)
    if any(not frame.tools for frame in frames):
        loads = build_drainage_loads(anatomy)
        drained = solve_responses(anatomy, loads, device, folder, partial(progress, "drained fluid"), regions)
    tools = [tool for frame in frames for tool in frame.tools]
    if tools:
        at, radius = (
            np.array([find_contact_point(anatomy, tool) for tool in tools]),
            np.array([tool.radius for tool in tools]),
        )
        loads = build_force_loads(anatomy, at, radius)
        pressed = solve_responses(anatomy, loads, device, folder, partial(progress, "tools"), regions)
    return fit_tissue_from_responses(locator, frames, drained, pressed, device, partial(progress, "forces"))


def fit_tissue_from_responses(
    locator: Locator, frames: Sequence[ObservedFrame], drainages: Responses | None, presses: Responses | None,
    device: str = "auto", progress: Callable[[int, int], object] = lambda done, total: None,
) -> FittedTissue:  # fmt: skip
    """Estimate the tissue as `fit_tissue`, from given FEM responses; `progress` receives the number of forces done."""
    with limit_to_one_thread():  # matrix products are small
        probability = compute_probability(compute_tissue_likelihood(locator, frames, drainages, presses))
    tissue = FittedTissue(locator.anatomy.digest, len(frames), probability, np.zeros(0))
    return replace(tissue, young=estimate_young_moduli(locator.anatomy, frames, tissue, presses, device, progress))


def list_fitted_regions(locator: Locator) -> tuple[Region, ...]:
    """Return the locator's regions of known stiffness, without the tumour, whose stiffness is estimated."""
    return tuple(one for one in locator.regions if one.label != TUMOUR_LABEL)


def compute_tissue_likelihood(
    locator: Locator, frames: Sequence[ObservedFrame], drainages: Responses | None, presses: Responses | None
) -> np.ndarray:
    """Compute the log-likelihood (skulls, poissons, ratios) of all frames for each candidate tissue."""
    total, first = np.zeros((1, len(POISSONS), len(RATIOS))), 0
    for frame in frames:
        evidence, last = to_evidence(locator.anatomy, frame.observation), first + 3 * len(frame.tools)
        if presses is not None and frame.tools:
            total = total + compute_pressing_likelihood(presses, np.arange(first, last), evidence)
        elif drainages is not None:
            total = total + compute_drainage_likelihood(drainages, locator.prior, evidence)
        first = last
    return total


def compute_probability(log_likelihood: np.ndarray) -> np.ndarray:
    """Interpolate log-likelihoods to `FINE_POISSONS` and `FINE_RATIOS`; return probabilities with sum 1."""
    fine = CubicSpline(np.log(RATIOS), log_likelihood, axis=2)(np.log(FINE_RATIOS))
    order = np.argsort(1.0 - 2.0 * POISSONS)
    x, want = (1.0 - 2.0 * POISSONS)[order], 1.0 - 2.0 * FINE_POISSONS
    share = [np.prod([(want - x[k]) / (x[j] - x[k]) for k in range(3) if k != j], axis=0) for j in range(3)]
    fine = np.einsum("jp,sjr->spr", np.array(share), fine[:, order])
    weight = np.exp(fine - fine.max())
    return weight / weight.sum()
