"""Full factorial study of the tumour's motion: skull, Poisson's ratio, craniotomy, depth and tumour stiffness."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.open_cortex import open_cortex
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.fem import Fem
from sim.loads import Loads, push, stack
from sim.material import BRAIN

from .loglog_chart import ChartPanel, Curve
from .sensitivity import BodyVariant, SensitivityStudy, match_motion

Levels = Mapping[str, Sequence[str | float]]
LEVELS: Levels = {
    "opening [mm]": (30.0, 50.0, 110.0),
    "depth [mm]": (3.0, 10.0, 25.0),
    "skull": ("bonded", "slide", "contact"),
    "nu": (0.45, 0.49, 0.499),
    "tumour's stiffness": (1.0, 3.0),
}
"""Levels by factor; depth is that of the tumour's top below the cortex, stiffness is relative to the brain."""
DEFAULT = {"skull": "bonded", "nu": 0.49, "tumour's stiffness": 1.0}  # Default values of a body's factors.
FORCE = 0.2  # Force of the tool [N].
FOOTPRINT = 7e-3  # Radius of the tool [m].
# Positions of the tool, to the right of and above the centre of the craniotomy [mm].
PLACES = ((0.0, 0.0), (6.0, 0.0), (0.0, 6.0))


@dataclass(frozen=True)
class FactorCombination:
    """Combination of levels, with the tumour's mean motion [mm] under a prescribed tool force or tool motion.

    The prescribed motion is the tool's motion under the force in the default body with the same craniotomy and depth.
    A value is NaN if a load did not converge.
    """

    levels: Mapping[str, str | float]
    force: float
    motion: float


def solve_levels(levels: Levels = LEVELS, nodes: int = 5300, device: str = "auto") -> Iterator[FactorCombination]:
    """Yield the solved combinations, on template meshes of about `nodes` nodes, with the tool at three positions."""
    for opening, depth in product(levels["opening [mm]"], levels["depth [mm]"]):
        subject = build_template_subject(Tumour(cover=1e-3 * float(depth)))
        anatomy = make_anatomy(subject, MeshPlan(nodes, 1e-3 * float(opening)))
        cortex = open_cortex(anatomy)
        places = [cortex.place(*place) for place in PLACES]
        forces = stack([push(place.point, FORCE * place.inward, FOOTPRINT) for place in places])
        study = SensitivityStudy(anatomy, forces, _build_body_variant(DEFAULT), device=device)
        default = study.build_fem(study.body).deform(forces)
        motions = match_motion(anatomy, forces, default)
        for combination in product(*(levels[name] for name in DEFAULT)):
            chosen = dict(zip(DEFAULT, combination, strict=True))
            fem = study.build_fem(_build_body_variant(chosen))
            moved = [_compute_mean_motion(fem, anatomy, loads) for loads in (forces, motions)]
            yield FactorCombination({"opening [mm]": opening, "depth [mm]": depth, **chosen}, *moved)


def _build_body_variant(chosen: Mapping[str, str | float]) -> BodyVariant:
    tissue = BRAIN.replace_constants(poisson=float(chosen["nu"]))
    return BodyVariant(tissue, float(chosen["tumour's stiffness"]), str(chosen["skull"]))


def _compute_mean_motion(fem: Fem, anatomy: Anatomy, loads: Loads) -> float:
    result = fem.deform(loads, at=anatomy.tumour_nodes)
    if not all(outcome.good for outcome in result.outcome):
        return float("nan")
    return 1e3 * float(np.linalg.norm(result.displacement, axis=2).mean())


def compute_variance_shares(cells: Sequence[FactorCombination], response: str = "force") -> dict[str, float]:
    """Return the shares of the variance of log(motion) that each factor and each interaction of two factors explain.

    The shares are sums of squares of a balanced analysis of variance, the largest first. Combinations that did not
    converge are excluded. The remainder to 1 is due to interactions of three and more factors.
    """
    values = np.log([getattr(cell, response) for cell in cells])
    good = np.isfinite(values)
    values = values[good] - values[good].mean()
    kept = [cell.levels for cell, one in zip(cells, good, strict=True) if one]
    names = [name for name in kept[0] if len({levels[name] for levels in kept}) > 1]

    def compute_share(*factors: str) -> float:
        keys = [tuple(levels[name] for name in factors) for levels in kept]
        means = {key: np.mean([v for v, k in zip(values, keys, strict=True) if k == key]) for key in set(keys)}
        return float(sum(means[key] ** 2 for key in keys) / np.square(values).sum())

    own = {name: compute_share(name) for name in names}
    pairs = {f"{a} x {b}": compute_share(a, b) - own[a] - own[b] for a, b in combinations(names, 2)}
    return dict(sorted({**own, **pairs}.items(), key=lambda item: -item[1]))


def build_panels(combinations: Sequence[FactorCombination]) -> list[ChartPanel]:
    """Build charts of motion against tumour depth, one per craniotomy, with a curve per skull and Poisson's ratio."""
    chosen = [{**DEFAULT, "nu": nu} for nu in _list_levels(combinations, "nu")]
    skulls = [skull for skull in _list_levels(combinations, "skull") if skull != DEFAULT["skull"]]
    chosen += [{**DEFAULT, "skull": skull} for skull in skulls]
    motions = [cell.force for cell in combinations if np.isfinite(cell.force)]
    span = 0.8 * min(motions), 1.5 * max(motions)  # the same for all openings
    out = []
    for opening in _list_levels(combinations, "opening [mm]"):
        curves = []
        for body in chosen:
            here = {**body, "opening [mm]": opening}
            mine = [cell for cell in combinations if here.items() <= cell.levels.items() and np.isfinite(cell.force)]
            points = tuple((float(cell.levels["depth [mm]"]), cell.force) for cell in mine)
            curves.append(Curve(f"{body['skull']}, nu {body['nu']:g}", points))
        title = f"Opening of {opening:g} mm: how far {FORCE:g} N move the tumour"
        out.append(
            ChartPanel(title, "depth of the tumour under the cortex [mm]", "motion [mm]", tuple(curves), y_range=span)
        )
    return out


def _list_levels(cells: Sequence[FactorCombination], name: str) -> list[str | float]:
    return list(dict.fromkeys(cell.levels[name] for cell in cells))
