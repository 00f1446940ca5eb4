"""Bodies of a data set: anatomy and tissue of episodes, sampled and meshed once, with a trained model."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sim.accuracy import TRAIN
from sim.anatomy import PART_LABELS, REGION_NAMES, Anatomy
from sim.bodies.intensity import Intensity, read_intensity, to_intensity_path, write_intensity
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.discretisation.space import recommend_element
from sim.effects import SKULLS, Effect, Elasticity, Held, NodalForce, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.material import build_law
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import CREATION_KEYS, simulate
from surrogate.data.solution_rows import describe_tissue_source
from surrogate.data.tool_loads import draw as draw_loads
from surrogate.model.applicability import find_rejection
from surrogate.model.held_out import ReportedErrors
from surrogate.model.learned import Learned
from surrogate.model.store import load, read_reported_errors, save
from surrogate.training.expansion import Expansion
from surrogate.training.train import train

from ..play.deformers import PatientSetup, open_theatre, to_model_path
from ..script.shipped_files import get_template_path
from .draws import build_generator, sample_value
from .incomplete_bodies import DATA, TABLE, remove_data_set, resume_data_set
from .plan import NO_LEARNER, Bodies, EpisodePlan, compute_anatomy_digest, list_sampled_fields, to_ratio_key
from .run_folder import BODIES, get_versions

MAX_ATTEMPTS = 6  # Maximum number of sampled tumours: one may leave the brain, or its craniotomy have too few nodes.
PRESET = "palpation"  # Preset of the training loads.
BATCH_SIZE = 512
"""Number of load cases in a batch on a GPU during training, limited because other processes need its memory too."""
ANATOMY_FILE, BODY_FILE = "anatomy.vtu", "body.json"  # File names in a body's folder: mesh, sampled values.


@dataclass(frozen=True)
class EpisodeBody:
    """Body of a data set: folder of the body's files, and sampled parameters by name."""

    folder: Path
    parameters: Mapping[str, Any]

    @property
    def anatomy(self) -> Path:
        """Path of the anatomy; scan and model are in the same folder."""
        return self.folder / ANATOMY_FILE

    @property
    def tissue(self) -> Elasticity:
        """Tissue of the body."""
        return get_tissue(self.parameters)

    def build_effects(self, *extra_effects: Effect, can_separate: bool = False) -> tuple[Effect, ...]:
        """Return the effects of a scene on the body: tissue, constraints, skull, and the effects `extra_effects`.

        If `can_separate`, the brain can separate from the skull, regardless of the sampled skull model.
        """
        skull = "contact" if can_separate else self.parameters["bodies.tissue.skull"]
        return self.tissue, Held(), SKULLS[skull], *extra_effects

    def open_patient(self, device: str) -> PatientSetup:
        """Open the body's anatomy, scan and models, or the shipped models for the template without own models.

        Raises
        ------
        InputError
            See `open_theatre`.
        """
        shipped = self.parameters["bodies.anatomies"] == "template" and not to_model_path(self.anatomy).is_file()
        return open_theatre(self.anatomy, to_model_path(get_template_path()) if shipped else None, device)


def get_tissue(values: Mapping[str, Any]) -> Elasticity:
    """Build the tissue with all regions from sampled values."""
    law, young, poisson = (values[f"bodies.tissue.{name}"] for name in ("law", "young_pa", "poisson"))
    ratio = {name: values.get(_to_ratio_name(name), 1.0) for name in ("tumour", *PART_LABELS)}
    times = {**ratio, "necrosis": ratio["necrosis"] * ratio["tumour"]}
    regions = {
        REGION_NAMES[name]: build_law(law, times[name] * young, poisson) for name, one in ratio.items() if one != 1.0
    }
    return Elasticity(build_law(law, young, poisson), regions)


def _to_ratio_name(region: str) -> str:
    """Return the name of a region's relative stiffness among the sampled values."""
    return f"bodies.tissue.{to_ratio_key(region)}"


def _drop_absent_regions(values: Mapping[str, Any], anatomy: Anatomy) -> dict[str, Any]:
    """Return the sampled values without the stiffness of regions that an anatomy does not have."""
    absent = {_to_ratio_name(name) for name, part in PART_LABELS.items() if not anatomy.mesh.mark_elements(part).any()}
    return {name: value for name, value in values.items() if name not in absent}


def sample_body(bodies: Bodies, seed: int, number: int, attempt: int = 0) -> dict[str, Any]:
    """Sample the values of body `number`, by name; another `attempt` samples another tumour for the same body."""
    found: dict[str, Any] = {}
    for table, values, again in (
        ("bodies", bodies, 0), ("bodies.tissue", bodies.tissue, 0), ("bodies.tumour", bodies.tumour, attempt),
    ):  # fmt: skip
        for name, value, *_ in list_sampled_fields(values):
            found[f"{table}.{name}"] = sample_value(value, build_generator(seed, number, f"{table}.{name}/{again}"))
    found["bodies.tumour.seed"] = int(build_generator(seed, number, f"bodies.tumour.seed/{attempt}").integers(2**31))
    return found


def write_body(
    folder: Path, plan: EpisodePlan, seed: int, number: int, device: str, other_folders: Sequence[Path] = ()
) -> bool:
    """Make a body in its own folder: anatomy, scan, trained model, and at last `body.json`.

    Returns True if solved loads of an earlier run, in the folder or in `other_folders`, were reused. The files have
    the same bytes in both cases.

    Parameters
    ----------
    other_folders
        Folders in which other processes have partly made the same body, or are making it.

    Raises
    ------
    InputError
        No anatomy could be meshed in `MAX_ATTEMPTS` attempts, a custom anatomy cannot be read, or training fails.
    """
    bodies = plan.contents.bodies
    anatomy, scan, values = _sample_anatomy(plan, seed, number)
    body = EpisodeBody(folder, values)
    write_anatomy(body.anatomy, anatomy)
    if scan is not None:
        write_intensity(to_intensity_path(body.anatomy), scan)
    before = False
    if bodies.learner.name != NO_LEARNER and not _can_use_shipped_model(body, anatomy):
        before = _train_model(body, anatomy, plan, seed, number, device, other_folders)
    (folder / BODY_FILE).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    return before


def read_body(folder: Path) -> EpisodeBody:
    """Read a body that `write_body` has made.

    Raises
    ------
    InputError
        The file `body.json` is missing or invalid.
    """
    path = folder / BODY_FILE
    try:
        return EpisodeBody(folder, json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is not a body of a data set ({error}). Make the episodes again.") from error


def _sample_anatomy(plan: EpisodePlan, seed: int, number: int) -> tuple[Anatomy, Intensity | None, dict[str, Any]]:
    """Sample the anatomy of a body; return the anatomy, its scan (None: no scan) and the sampled values."""
    bodies = plan.contents.bodies
    values = sample_body(bodies, seed, number)
    kind = str(values["bodies.anatomies"])
    if kind != "drawn":
        path = get_template_path() if kind == "template" else plan.folder / kind
        scan = to_intensity_path(path)
        if kind in plan.own and compute_anatomy_digest(plan, kind) != plan.own[kind]:
            raise InputError(f"{path}: has changed since the plan was read. Begin another folder with it.")
        known = {name: value for name, value in values.items() if not name.startswith("bodies.tumour.")}
        anatomy = read_anatomy(path)
        return anatomy, read_intensity(scan) if scan.is_file() else None, _drop_absent_regions(known, anatomy)
    refused: list[str] = []
    for attempt in range(MAX_ATTEMPTS):
        values = sample_body(bodies, seed, number, attempt)
        about = {name: values[f"bodies.tumour.{name}"] for name in ("shape", "site", "seed")}
        radius, cover, opening = (1e-3 * values[f"bodies.tumour.{each}_mm"] for each in ("radius", "cover", "opening"))
        try:
            subject = build_template_subject(Tumour(radius, cover, about["shape"], about["site"], about["seed"]))
            anatomy = make_anatomy(subject, MeshPlan(round(values["bodies.tumour.nodes"]), opening))
        except InputError as error:
            refused.append(str(error))
            continue
        scan = subject.intensity and subject.intensity.crop(anatomy.mesh.nodes[anatomy.craniotomy], anatomy.mesh)
        return anatomy, scan, _drop_absent_regions(values, anatomy)
    raise InputError(f"none of {MAX_ATTEMPTS} anatomies that were drawn can be meshed; the last: {refused[-1]}")


def _can_use_shipped_model(body: EpisodeBody, anatomy: Anatomy) -> bool:
    """Return True if a shipped model supports the tissue and skull of this body."""
    if body.parameters["bodies.anatomies"] != "template":
        return False
    models = load(to_model_path(get_template_path()), anatomy)
    effects = build_push_effects(anatomy, body.tissue, body.parameters["bodies.tissue.skull"])
    return any(find_rejection(model, effects, recommend_element(anatomy.mesh)) is None for model in models.values())


def _train_model(
    body: EpisodeBody, anatomy: Anatomy, plan: EpisodePlan, seed: int, number: int, device: str, others: Sequence[Path]
) -> bool:
    """Train a model on simulated loads, which are removed afterwards; return True if earlier loads were reused."""
    learner = plan.contents.bodies.learner
    effects = (*build_push_effects(anatomy, body.tissue, body.parameters["bodies.tissue.skull"]), NodalForce())
    fem = Fem(anatomy, effects, TRAIN, device, 64)
    first = int(build_generator(seed, number, "bodies.learner").integers(2**31))
    stated = {
        "effects": repr(effects), **describe_tissue_source(body.tissue), "element": fem.space.element,
        "accuracy": repr(TRAIN),
        "preset": PRESET, "seed": str(first),
    }  # fmt: skip
    data = body.folder / DATA
    all_stated = {**stated, **get_versions(), "anatomy": anatomy.digest, "loads": str(learner.loads)}
    before = resume_data_set(data, all_stated, others)
    simulate(data, fem, draw_loads(PRESET, anatomy, learner.loads, first), stated)
    known = read_dataset(data)
    batch = BATCH_SIZE if fem.problem.device.on_cuda else None
    expansion = Expansion(known, device, table_path=data.with_suffix(TABLE), batch=batch)
    trained = train(known, [learner.name], expansion=expansion)
    save(to_model_path(body.anatomy), {name: _remove_training_dates(model) for name, model in trained.models.items()})
    remove_data_set(data)
    return before


def _remove_training_dates(model: Learned) -> Learned:
    """Return a model without training metadata that differ between runs, such as dates."""
    return replace(model, training={key: text for key, text in model.training.items() if key not in CREATION_KEYS})


MAX_LISTED_BODIES = 10
"""Maximum number of bodies that a message lists individually."""


def list_model_errors(folder: Path) -> dict[int, ReportedErrors]:
    """Read the reported errors of the best model of each body in a folder, by body number, for bodies with a model."""
    found = {}
    for path in sorted((folder / BODIES).glob("[0-9]*")):
        with suppress(InputError, ValueError):  # bodies without a readable model are skipped
            found[int(path.name)] = min(
                read_reported_errors(to_model_path(path / ANATOMY_FILE)).values(), key=lambda one: one.bound
            )
    return found


def select_weak(models: Mapping[int, ReportedErrors]) -> dict[int, ReportedErrors]:
    """Select the bodies with a weak model, in order of decreasing error bound."""
    return dict(
        sorted(((number, one) for number, one in models.items() if one.is_weak), key=lambda each: -each[1].bound)
    )


def describe_weak(models: Mapping[int, ReportedErrors]) -> list[str]:
    """Describe the weak models and their errors in sentences; empty if no model is weak."""
    weak = select_weak(models)
    if not weak:
        return []
    return [
        f"{len(weak)} of {len(models)} bodies with a model have a weak one, by loads on cortex that it was not trained "
        "on. More `bodies.learner.loads`, or another learner, make better ones: in a new plan and folder.",
        *(f"- body {number}: {one}" for number, one in list(weak.items())[:MAX_LISTED_BODIES]),
        *([f"- and {len(weak) - MAX_LISTED_BODIES} more"] if len(weak) > MAX_LISTED_BODIES else []),
    ]


def to_weak_json(models: Mapping[int, ReportedErrors]) -> list[dict[str, float | int | None]]:
    """Convert the weak models to a JSON list: body number, error bound [mm] and relative mean error."""
    return [
        {
            "body": number,
            "bound_mm": 1e3 * one.bound,
            "mean_share_of_motion": None if one.held_out is None else one.held_out.mean,
        }
        for number, one in select_weak(models).items()
    ]
