"""Plan of a data set: distributions from which episodes and bodies are sampled."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path, PurePath
from typing import Annotated, get_args, get_origin, get_type_hints

import msgspec

from sim.anatomy import PART_LABELS
from sim.bodies.intensity import to_intensity_path
from sim.bodies.template import SITES
from sim.effects import SKULLS
from sim.errors import InputError
from sim.material import BRAIN, LAWS, Ogden
from sim.runtime.outside_files import wrap_errors
from surrogate.training.train import LEARNERS, check_learner_names

from ..script.camera_paths import PATHS
from .draws import Distribution, Number, ValueLimits, Word, check_distribution
from .families import FamilyMotions

TYPE_NAMES = {
    "object": "a table", "array": "a list", "str": "text in quotation marks", "float": "a number",
    "int": "a whole number", "bool": "true or false", "null": "nothing",
}  # fmt: skip
"""Descriptions of types for users, by their names in msgspec."""
SHIPPED_PLANS = Path(__file__).parent.parent / "data" / "plans"
"""Folder of the plans in the package."""
NO_LEARNER = "none"
"""Name of the learner that trains no model, so that FEM computes the deformation."""
MAX_PLAN_BYTES = 200_000
"""Maximum size of a plan's text [bytes], which every episode contains."""
FIXED = "fixed"
"""Name of the camera path of a static camera."""


def format_msgspec_error(error: str) -> str:
    """Format an error message of msgspec as a sentence that begins with the key in question.

    A message of an unknown form is unchanged apart from this.
    """
    words, _, place = error.partition(" - at `$.")
    table = place.rstrip("`")
    strange, missing = (re.search(rf"{kind} field `(.*?)`", words) for kind in ("unknown", "required"))
    if strange is not None:
        return f"{_join_key(table, strange[1])}: there is no such key: look how it is spelled."
    if missing is not None:
        return f"{_join_key(table, missing[1])}: is missing. Give it."
    if table and words.startswith("Expected"):
        return f"{table}: {_format_types(words)}."
    return f"{table and f'{table}: '}{words}."


def _join_key(table: str, key: str) -> str:
    return f"{table}.{key}" if table else key


def _format_types(message: str) -> str:
    """Replace the names of types in a message of msgspec by descriptions for users."""

    def describe_types(match: re.Match) -> str:
        names = [one.strip() for one in str(match[1]).split("|")]
        return " or ".join(TYPE_NAMES.get(name, name) for name in names)

    plain = re.sub(r"`(.*?)`", describe_types, message)
    return plain.replace("Expected ", "give ").replace(", got ", ", and not ")


class TumourPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions of tumour and craniotomy of synthetic anatomies, named like the options of `sulcus anatomy`."""

    radius_mm: Annotated[Number, ValueLimits(3, 35, "mm")] = (9.0, 16.0)
    cover_mm: Annotated[Number, ValueLimits(1, 60, "mm")] = (3.0, 12.0)
    shape: Annotated[Word, ("sphere", "lobed")] = msgspec.field(default_factory=lambda: ["sphere", "lobed"])
    site: Annotated[Word, tuple(SITES)] = msgspec.field(default_factory=lambda: list(SITES))
    opening_mm: Annotated[Number, ValueLimits(25, 90, "mm")] = (40.0, 60.0)
    nodes: Annotated[Number, ValueLimits(2000, 250_000)] = 5300.0


class TissuePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions of tissue and skull model of a body; ratios are stiffnesses relative to the brain."""

    law: Annotated[Word, (*LAWS, Ogden.law)] = BRAIN.law
    young_pa: Annotated[Number, ValueLimits(100, 50_000, "Pa")] = 3000.0
    poisson: Annotated[Number, ValueLimits(0.3, 0.495)] = 0.49
    tumour_ratio: Annotated[Number, ValueLimits(0.1, 10)] = 1.0
    necrosis_ratio: Annotated[Number, ValueLimits(0.01, 10)] = 1.0
    oedema_ratio: Annotated[Number, ValueLimits(0.01, 10)] = 1.0
    ventricles_ratio: Annotated[Number, ValueLimits(0.01, 10)] = 1.0
    skull: Annotated[Word, tuple(SKULLS)] = "bonded"


class LearnerPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Training of a body's model: model type `name` ("none": FEM is used), and number of training loads."""

    name: Annotated[str, (NO_LEARNER, *LEARNERS)] = "series-gp"
    loads: Annotated[int, ValueLimits(40, 100_000)] = 200


class Bodies(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bodies on which episodes are played: number of bodies, and distributions of their properties.

    `anatomies`: "drawn" (the template's brain with a sampled tumour and craniotomy), "template" (the shipped anatomy),
    or the name of a custom .vtu file next to the plan.
    """

    count: Annotated[int, ValueLimits(1, 100_000)] = 1
    anatomies: Word = "template"
    tumour: TumourPlan = TumourPlan()
    tissue: TissuePlan = TissuePlan()
    learner: LearnerPlan = LearnerPlan()


class AppearancePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions of camera, light, texture and occluders."""

    distance_mm: Annotated[Number, ValueLimits(80, 800, "mm")] = 200.0
    tilt_deg: Annotated[Number, ValueLimits(-75, 75, "°")] = -46.0
    fov_deg: Annotated[Number, ValueLimits(4, 60, "°")] = 16.0
    path: Annotated[Word, (FIXED, *PATHS)] = FIXED
    bent: Annotated[Number, ValueLimits(-0.6, 0.6)] = 0.0
    stereo: Annotated[Number, ValueLimits(0, 1)] = 0.0
    lamp: Annotated[Number, ValueLimits(0.2, 3)] = 1.0
    ambient: Annotated[Number, ValueLimits(0, 1)] = 0.16
    lamp_turn_deg: Annotated[Number, ValueLimits(-180, 180, "°")] = 0.0
    vessels: Annotated[Number, ValueLimits(0, 1)] = 0.0
    tint: Annotated[Number, ValueLimits(0, 0.5)] = 0.0
    cottonoids: Annotated[Number, ValueLimits(0, 5)] = 0.0
    glove: Annotated[Number, ValueLimits(0, 1)] = 0.0


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions of the standard deviations of sensor noise, one value for each episode."""

    grey_levels: Annotated[Number, ValueLimits(0, 40, "grey levels")] = 0.0
    force_n: Annotated[Number, ValueLimits(0, 1, "N")] = 0.0
    tool_mm: Annotated[Number, ValueLimits(0, 20, "mm")] = 0.0
    tool_deg: Annotated[Number, ValueLimits(0, 20, "°")] = 0.0
    camera_mm: Annotated[Number, ValueLimits(0, 20, "mm")] = 0.0
    camera_deg: Annotated[Number, ValueLimits(0, 20, "°")] = 0.0


class HandTremor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions of the standard deviations of hand tremor, which is added to the intended motion."""

    tremor_mm: Annotated[Number, ValueLimits(0, 3, "mm")] = 0.0
    tremor_n: Annotated[Number, ValueLimits(0, 0.1, "N")] = 0.0


class PlanContents(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parsed contents of the file of a plan."""

    title: str
    motion: FamilyMotions
    seconds: Annotated[Number, ValueLimits(0.1, 600, "s")] = 4.0
    frames_per_second: Annotated[float, ValueLimits(1, 240, "1/s")] = 30.0
    size: Annotated[tuple[int, int], ValueLimits(32, 4096, "pixel")] = (640, 480)
    solved_every: Annotated[int, ValueLimits(1, 100_000, "frames")] = 15
    overlay: bool = False
    bodies: Bodies = Bodies()
    look: AppearancePlan = AppearancePlan()
    hand: HandTremor = HandTremor()
    noise: Noise = Noise()


@dataclass(frozen=True)
class EpisodePlan:
    """Plan of episodes, as read from a file.

    Parameters
    ----------
    name
        Name of the file without its ending.
    text
        TOML text of the file.
    contents
        Parsed contents of the file.
    folder
        Folder that contains custom anatomies.
    own
        Digests of the custom anatomies with their scans, by name of the anatomy.
    """

    name: str
    text: str
    contents: PlanContents
    folder: Path
    own: Mapping[str, str] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Digest (16 hexadecimal digits) of the plan's text and its custom anatomies."""
        return sha256("".join((self.text, *self.own.values())).encode()).hexdigest()[:16]


def list_shipped_plans() -> list[str]:
    """List the names of the shipped plans."""
    return sorted(path.stem for path in SHIPPED_PLANS.glob("*.toml"))


def load_plan(name: str) -> EpisodePlan:
    """Load a shipped plan by name, or a custom plan by the path of its .toml file.

    Raises
    ------
    InputError
        The plan is unknown, its TOML is invalid or has unknown keys, a range is impossible, or a custom anatomy is
        missing.
    """
    path = Path(name) if name.endswith(".toml") else SHIPPED_PLANS / f"{name}.toml"
    if not os.path.isfile(path):  # accepts any name
        raise InputError(
            f"there is no plan {name!r}: choose {', '.join(list_shipped_plans())}, or give the path of a .toml file."
        )
    with wrap_errors(path, "a plan", "A plan is text in UTF-8."):
        if path.stat().st_size > MAX_PLAN_BYTES:
            raise InputError(f"is longer than a plan may be, {MAX_PLAN_BYTES:,} bytes. Leave out what is no plan.")
        text = path.read_text(encoding="utf-8-sig")
    plan = parse_plan(text, path.stem, path.parent)
    return replace(plan, own={each: compute_anatomy_digest(plan, each) for each in _list_own_anatomies(plan.contents)})


def compute_anatomy_digest(plan: EpisodePlan, anatomy: str) -> str:
    """Compute the digest (16 hexadecimal digits) of the current files of a custom anatomy and its scan.

    Raises
    ------
    InputError
        The file is missing or unreadable.
    """
    found, path = sha256(), plan.folder / anatomy
    with wrap_errors(path, "an anatomy", "Put it next to the plan."):
        for file in (path, *filter(Path.is_file, [to_intensity_path(path)])):
            found.update(sha256(file.read_bytes()).digest())
    return found.hexdigest()[:16]


def parse_plan(text: str, name: str, folder: Path = Path()) -> EpisodePlan:
    """Parse a plan from TOML text.

    Raises
    ------
    InputError
        See `load_plan`.
    """
    try:
        contents = msgspec.toml.decode(text, type=PlanContents)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        said = format_msgspec_error(str(error))
        raise InputError(f"the plan {name}: {said} docs/datasets_make.md says what a plan holds.") from error
    plan = EpisodePlan(name, text, contents, folder)
    try:
        _check(contents)
    except InputError as error:
        raise InputError(f"the plan {name}: {error}") from error
    return plan


def list_sampled_fields(table: msgspec.Struct) -> list[tuple[str, object, ValueLimits | None, tuple[str, ...]]]:
    """List the sampled fields of a table: name, value, limits (None for words), and allowed words."""
    found = []
    for name, (kind, about) in _list_field_types(type(table)).items():
        if kind in (Number, Word):
            limits, words = (about, ()) if isinstance(about, ValueLimits) else (None, about or ())
            found.append((name, getattr(table, name), limits, words))
    return found


def list_fixed_numbers(table: msgspec.Struct) -> list[tuple[str, float, ValueLimits]]:
    """List the fixed numbers of a table: name, value and limits, with one entry for each number of a pair."""
    found = []
    for name, (kind, about) in _list_field_types(type(table)).items():
        if kind != Number and isinstance(about, ValueLimits):
            value = getattr(table, name)
            found += [(name, each, about) for each in (value if isinstance(value, tuple) else (value,))]
    return found


def _list_field_types(table: type[msgspec.Struct]) -> dict[str, tuple[object, ValueLimits | tuple[str, ...] | None]]:
    """Return the type and the limits or allowed words of each field of a table, by name."""
    hints = get_type_hints(table, include_extras=True)
    return {name: get_args(kind)[:2] if get_origin(kind) is Annotated else (kind, None) for name, kind in hints.items()}


def list_tables(contents: PlanContents) -> dict[str, msgspec.Struct]:
    """Return all tables of a plan by name, for episodes and for bodies."""
    bodies, motion = contents.bodies, {f"motion.{name}": each for name, each in contents.motion.named.items()}
    of_bodies = {f"bodies.{name}": getattr(bodies, name) for name in ("tumour", "tissue", "learner")}
    seen = {"look": contents.look, "hand": contents.hand, "noise": contents.noise}
    return {"": contents, "bodies": bodies, **of_bodies, **seen, **motion}


def _check(contents: PlanContents) -> None:
    for table, values in list_tables(contents).items():
        for name, value, limits, words in list_sampled_fields(values):
            check_distribution(value, f"{table}.{name}".lstrip("."), limits, words)
        for name, value, limits in list_fixed_numbers(values):
            if not limits.low <= value <= limits.high:
                raise InputError(f"{f'{table}.{name}'.lstrip('.')}: {value} is outside {limits}.")
    if contents.bodies.learner.name != NO_LEARNER:
        check_learner_names([contents.bodies.learner.name], False, "bodies.learner.name")
    if not any(each.weight > 0.0 for each in contents.motion.named.values()):
        raise InputError("motion: give one family or more, with a weight above 0.")
    if contents.bodies.tumour != TumourPlan() and "drawn" not in _list_anatomies(contents):
        raise InputError(
            'bodies.tumour: only drawn anatomies have such a tumour. Say anatomies = "drawn", or leave it out.'
        )
    for name in PART_LABELS:
        key = to_ratio_key(name)
        if getattr(contents.bodies.tissue, key) != 1.0 and not _list_own_anatomies(contents):
            raise InputError(
                f"bodies.tissue.{key}: only an own anatomy may have {name}. Name one in bodies.anatomies, or leave "
                "it out."
            )
    for each in _list_own_anatomies(contents):
        path = PurePath(each)
        if path.suffix != ".vtu":
            raise InputError(f"bodies.anatomies: {each!r} is invalid: give drawn, template or a .vtu next to the plan.")
        if path.is_absolute() or ".." in path.parts:
            raise InputError(f"bodies.anatomies: {each!r} is outside the plan's folder: put the file next to the plan.")


def to_ratio_key(region: str) -> str:
    """Return the key of a region's relative stiffness in `bodies.tissue`, given the name of the region."""
    return f"{region}_ratio"


def _list_own_anatomies(contents: PlanContents) -> list[str]:
    """List the file names of custom anatomies in a plan."""
    return sorted(_list_anatomies(contents) - {"drawn", "template"})


def _list_anatomies(contents: PlanContents) -> set[str]:
    """Return the names of all anatomies that bodies can have."""
    choices = contents.bodies.anatomies
    named = choices.choice if isinstance(choices, Distribution) else [choices] if isinstance(choices, str) else choices
    return {str(each) for each in named or ()}
