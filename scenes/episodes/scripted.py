"""Sampling of a plan's episodes from the seed and the episode number only, and conversion to scenes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from ar.optics.calibration import Calibration
from ar.optics.lens import Lens
from sim.effects import Elasticity
from sim.errors import InputError

from ..script.camera_paths import PATHS
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.scene import Scene
from ..script.viewpoint import Appearance, Cottonoid, Viewpoint
from .bodies import EpisodeBody
from .draws import build_generator, sample_value
from .families import FAMILIES, PRONY, ScenarioInputs, add_tremor
from .plan import FIXED, EpisodePlan, PlanContents, list_sampled_fields, list_tables

# Largest deviation of the cortex's red, green and blue from the default, in units of the tint.
MAX_TINTS = np.array([0.3, 1.0, 1.0])
SECOND_RADIAL_RATIO = -0.3  # Ratio of the second to the first radial coefficient: lenses bend less towards their edge.


@dataclass(frozen=True)
class EpisodeSample:
    """Sampled values of an episode.

    Parameters
    ----------
    body
        Number of the body on which the episode is played.
    family
        Name of the family of the tool motion.
    values
        All sampled numbers and words, by their names in the plan.
    """

    body: int
    family: str
    values: Mapping[str, Any]

    def group(self, table: str) -> dict[str, Any]:
        """Return the values of one table of the plan, by name within the table."""
        head = f"{table}."
        return {name.removeprefix(head): value for name, value in self.values.items() if name.startswith(head)}


def sample_body_number(contents: PlanContents, seed: int, number: int) -> int:
    """Sample the number of the body on which episode `number` is played."""
    return int(build_generator(seed, number, "body").integers(contents.bodies.count))


def sample_episode(contents: PlanContents, seed: int, number: int) -> EpisodeSample:
    """Sample the values of episode `number` from the seed; each name has its own independent random generator."""
    named = contents.motion.named
    weights = np.array([motion.weight for motion in named.values()])
    family = list(named)[int(build_generator(seed, number, "family").choice(len(named), p=weights / weights.sum()))]
    values: dict[str, Any] = {}
    for table, struct in list_tables(contents).items():
        if table.startswith("bodies") or (table.startswith("motion") and table != f"motion.{family}"):
            continue
        for name, value, *_ in list_sampled_fields(struct):
            full = f"{table}.{name}".lstrip(".")
            values[full] = sample_value(value, build_generator(seed, number, full))
    return EpisodeSample(sample_body_number(contents, seed, number), family, values)


def build_scene(
    plan: EpisodePlan, body: EpisodeBody, site: CraniotomyFrame, sample: EpisodeSample, seed: int, number: int
) -> Scene:
    """Build the scene of an episode on a body.

    Raises
    ------
    InputError
        The scene is impossible, for example due to too few tetrahedra in the tumour, or a lens that folds the image.
    """
    contents, seconds = plan.contents, sample.values["seconds"]
    chance = ScenarioInputs(
        sample.group(f"motion.{sample.family}"), build_generator(seed, number, "motion"), seconds, site.compute_reach
    )
    act = FAMILIES[sample.family](chance)
    hand = sample.group("hand")
    path = act.path
    if act.tool is not None and (hand["tremor_mm"] > 0.0 or hand["tremor_n"] > 0.0):
        first = int(build_generator(seed, number, "hand").integers(2**31))
        path = add_tremor(path, first, 1e-3 * hand["tremor_mm"], hand["tremor_n"])
    effects = body.build_effects(*act.effects, can_separate=act.skull_separates)
    if act.is_viscoelastic:
        effects = tuple(make_viscoelastic(each) if isinstance(each, Elasticity) else each for each in effects)
    title = f"{FAMILIES[sample.family].__doc__ or ''} Episode {number} of the plan {plan.name}, seed {seed}."
    return Scene(
        sample.family, title, path, seconds, effects, act.tool, act.lying, act.surgery,
        viewpoint=_build_viewpoint(contents, sample.group("look"), seed, number),
        look=_build_appearance(sample.group("look"), site, seed, number), frames_per_second=contents.frames_per_second,
    )  # fmt: skip


def make_viscoelastic(tissue: Elasticity) -> Elasticity:
    """Return the tissue with all regions relaxing by the Prony series `PRONY`."""

    def add_prony(law: object) -> Any:
        return replace(cast(Any, law), prony=PRONY)

    regions = {label: add_prony(each) for label, each in tissue.regions.items()}
    return Elasticity(None if tissue.default is None else add_prony(tissue.default), regions)


def _build_viewpoint(contents: PlanContents, appearance: Mapping[str, Any], seed: int, number: int) -> Viewpoint:
    """Build the viewpoint of an episode from the sampled values of the table `appearance`."""
    random = build_generator(seed, number, "look.camera")
    width, height = contents.size
    path = None if appearance["path"] == FIXED else PATHS[appearance["path"]](int(random.integers(2**31)))
    field = float(np.radians(appearance["fov_deg"]))
    view = Viewpoint(
        1e-3 * appearance["distance_mm"], float(np.radians(appearance["tilt_deg"])), field, width, height, path=path,
        eye="left" if random.random() < appearance["stereo"] else None,
    )  # fmt: skip
    if appearance["bent"] == 0.0:
        return view
    focal = 0.5 * height / np.tan(0.5 * field)
    # Distortion at the image corners, relative to half its diagonal, for any field of view.
    corner = float(np.hypot(width, height) / (2.0 * focal)) ** 2
    bent = appearance["bent"] / corner
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    try:
        lens = Lens(k1=0.3 * bent, k2=0.3 * SECOND_RADIAL_RATIO * bent / corner)
        return view.calibrate(Calibration((focal, focal), middle, width, height, lens))
    except ValueError as error:
        raise InputError(f"look.bent {appearance['bent']:g}: {error}") from error


def _build_appearance(look: Mapping[str, Any], site: CraniotomyFrame, seed: int, number: int) -> Appearance:
    """Build light, colour and occluders of an episode from the sampled values of the table `look`."""
    random = build_generator(seed, number, "look.covers")
    vessels = int(random.integers(2**31)) if random.random() < look["vessels"] else None
    tint = 1.0 - look["tint"] * MAX_TINTS * random.random(3)
    finger = float(random.uniform(0.0, 2.0 * np.pi)) if random.random() < look["glove"] else None
    lain = []
    for _ in range(round(look["cottonoids"])):
        far, angle, turn = site.clearance * np.sqrt(random.random()), *random.uniform(0.0, 2.0 * np.pi, 2)
        lain.append(Cottonoid(float(far * np.cos(angle)), float(far * np.sin(angle)), angle=float(turn)))
    turned = float(np.radians(look["lamp_turn_deg"]))
    return Appearance(look["lamp"], look["ambient"], turned, tuple(tint.tolist()), vessels, tuple(lain), finger)
