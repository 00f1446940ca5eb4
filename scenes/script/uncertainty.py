"""Error bounds of the displayed tumour position, from ensembles of solutions, stored next to the anatomy."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import parse_json, wrap_errors

from .craniotomy_frame import CraniotomyFrame
from .priors import REGISTRATION, SEGMENTATION, list_priors
from .registration import REGISTRATIONS, Registration, describe_registration
from .scene import Scene

FORMAT = "sulcus uncertainty 1"  # Name and version of the file format.
LEVEL = 0.95
"""Probability level of every printed bound."""
SUFFIX = ".uncertainty.json"  # Ending of the file, next to the anatomy.
REMEDY = "Delete it, and compute it again by `sulcus uncertainty`."  # Remedy for a file that cannot be read.
SURROGATE = "surrogate"  # Name of a contributor.
LISTS = ("times", "worst", "middle", "moved")  # Fields that are lists over the times, in every file.
MIN_MOTION = 0.1e-3  # Smallest motion of a scene that an error is in proportion to [m].
MIN_MOTION_RATIO = 0.2  # Smallest motion of a time that counts, as a share of the scene's largest.
BOUND_DEVIATIONS = 1.96  # Bound at 95 % of a Gaussian [standard deviations].


@dataclass(frozen=True)
class TumourError:
    """Expected error of the tumour position that a frame shows.

    Parameters
    ----------
    prior
        95 % bound on the maximum error over the tumour's surface [m], without observation; None: not known.
    main_source
        Name of the largest contributor to `prior`.
    observed
        95 % bound [m] with observations of the brain; None without observations.
    moved
        95 % bound on the error of the tumour's mean displacement since the scan [m], without observation.
    is_rough
        True if `prior` is a rough estimate: see `Uncertainty.is_rough` and `MotionError`.
    registration
        Standard deviation along each axis [m] of the registration error in the bound; None: not available.
    """

    prior: float | None
    main_source: str = ""
    observed: float | None = None
    moved: float | None = None
    is_rough: bool = False
    registration: float | None = field(default=None, compare=False)

    @property
    def registration_text(self) -> str:
        """Description of the registration's standard deviation along each axis; empty if not available."""
        if self.registration is None or self.bound is None:
            return ""
        return describe_registration(self.registration)

    @property
    def bound(self) -> float | None:
        """95 % bound [m] that applies: `observed` if there is an observation, else `prior`."""
        return self.prior if self.observed is None else self.observed


NOT_KNOWN = TumourError(None)  # Error that is not available.


@dataclass(frozen=True)
class Uncertainty:
    """Ensemble results for one scene on one anatomy; lists are indexed like `times`.

    Parameters
    ----------
    scene, mark
        Name of the scene, and its fingerprint, see `compute_scene_mark`.
    draws, failed
        Number of samples, and number of samples without equilibrium, which are excluded.
    times
        Times [s].
    worst, middle
        95th percentiles [m], with a clinical registration, of the maximum surface error and of the centroid's error.
    registered
        `worst` with a perfect registration [m].
    moved, motion
        Mean displacement of the tumour's surface [m], and 95th percentile of the error of the mean displacement [m],
        without registration and segmentation.
    parts
        Root mean square over samples of the maximum surface error [m], by contributor.
    frames
        Number of frames to which the samples' tissue was fitted; 0: tissue sampled from priors.
    folded
        Number of samples with inverted tetrahedra (unphysical, for example under a tool on a soft tumour). 0 in files
        without this entry.
    numbers
        Number of parameters that were fitted to the samples to obtain `parts`; 0 in files without this entry.
    patients
        Number of synthetic test patients, not among the samples, on which the bound was tested.
    covered, deviation
        Empirical coverage: share of the test patients' errors below the bound, over all times except the first; and
        standard deviation of this share due to the number of patients. None: not tested.
    """

    scene: str
    mark: str
    draws: int
    failed: int
    times: tuple[float, ...]
    worst: tuple[float, ...]
    middle: tuple[float, ...]
    registered: tuple[float, ...]
    moved: tuple[float, ...]
    motion: tuple[float, ...]
    parts: Mapping[str, tuple[float, ...]]
    frames: int = 0
    folded: int = 0
    numbers: int = 0
    patients: int = 0
    covered: float | None = None
    deviation: float | None = None

    @property
    def has_few_draws(self) -> bool:
        """True if fewer than two samples were solved per fitted parameter."""
        return self.draws - self.failed < 2 * self.numbers

    @property
    def is_rough(self) -> bool:
        """True if the bound is only a rough estimate: few samples, or samples with inverted tetrahedra."""
        return self.has_few_draws or self.folded > 0

    def evaluate(self, time: float, model_bound: float = 0.0, registration: Registration = "clinical") -> TumourError:
        """Return the error at a time [s], including the error bound [m] of a trained model."""
        deviation = REGISTRATIONS[registration]
        parts = {name: self.interpolate(values, time) for name, values in self.parts.items()}
        parts[SURROGATE] = model_bound / BOUND_DEVIATIONS
        if not deviation:
            parts.pop(REGISTRATION, None)
        worst = float(np.hypot(self.interpolate(self.worst if deviation else self.registered, time), model_bound))
        moved = float(np.hypot(self.interpolate(self.motion, time), model_bound))
        largest = max(parts, key=lambda name: parts[name])
        return TumourError(worst, largest, moved=moved, is_rough=self.is_rough, registration=deviation)

    def interpolate(self, values: tuple[float, ...], time: float) -> float:
        """Interpolate a list of values linearly at a time [s]."""
        return float(np.interp(time, self.times, values))


@dataclass(frozen=True)
class MotionError:
    """Rough error estimate in proportion to the motion, for loads without an ensemble, fitted to a similar ensemble.

    Parameters
    ----------
    rest
        95 % bound on the error of the undeformed tumour [m], by registration.
    surface, mean
        Ratios to the mean motion, maximum over the ensemble's times: of the bound on the surface error due to
        deformation (`surface`), and of the bound on the error of the mean displacement (`mean`).
    """

    rest: Mapping[Registration, float]
    surface: float
    mean: float

    def evaluate(self, motion: float, model_bound: float, registration: Registration) -> TumourError:
        """Return the error at a mean motion [m], including the error bound [m] of a trained model."""
        worst = float(np.linalg.norm([self.rest[registration], self.surface * motion, model_bound]))
        moved = float(np.hypot(self.mean * motion, model_bound))
        return TumourError(worst, moved=moved, is_rough=True, registration=REGISTRATIONS[registration])


def fit_motion_error(ensemble: Uncertainty) -> MotionError | None:
    """Fit the error in proportion to the motion to an ensemble; None if the tumour hardly moves in its scene."""
    moved, worst, mean = (np.array(values) for values in (ensemble.moved, ensemble.registered, ensemble.motion))
    if moved.max() < MIN_MOTION:
        return None
    enough = moved > MIN_MOTION_RATIO * moved.max()
    rest: dict[Registration, float] = {"perfect": ensemble.registered[0], "clinical": ensemble.worst[0]}
    surface = np.sqrt(np.maximum(worst**2 - worst[0] ** 2, 0.0))[enough] / moved[enough]
    return MotionError(rest, float(surface.max()), float((mean[enough] / moved[enough]).max()))


def compute_scene_mark(scene: Scene, site: CraniotomyFrame, element: str) -> str:
    """Compute the fingerprint (16 hexadecimal digits) of a scene's loads and effects, its anatomy and the priors."""
    times = np.linspace(0.0, scene.duration, 25).tolist()
    # Rounded, because sines differ between machines in the last digit.
    acts = [np.round(_list_parameters(scene, time), 6).tolist() for time in times]
    priors = [(prior.law, prior.range) for prior in list_priors(scene.elasticity.default)]
    whole = (scene.effects, scene.surgery, scene.tool, scene.duration, element, acts, priors, site.anatomy.digest)
    return sha256(repr(whole).encode()).hexdigest()[:16]


def _list_parameters(scene: Scene, time: float) -> list[float]:
    """List the parameters of tool input and head pose at a time [s]."""
    touch, lying = scene.path(time), scene.lying(time)
    return [touch.x, touch.y, touch.force, *touch.tilt, touch.depth, *lying.direction, lying.fluid]


def to_uncertainty_path(anatomy: Path) -> Path:
    """Return the path of an anatomy's uncertainties: MESH.uncertainty.json next to MESH.vtu."""
    return anatomy.with_suffix(SUFFIX)


def read_uncertainties(path: Path) -> dict[str, Uncertainty]:
    """Read the uncertainties of a file, by scene name; empty if the file does not exist.

    Raises
    ------
    InputError
        An invalid or unreadable file.
    """
    if not path.is_file():
        return {}
    with wrap_errors(path, "uncertainties", REMEDY):
        return {name: _read(row) for name, row in parse_json(path, FORMAT, REMEDY)["scenes"].items()}


def _read(row: dict) -> Uncertainty:
    """Convert one entry of a file to an `Uncertainty`; check that lists are finite and as long as the times.

    If `registered` or `motion` is missing, an upper estimate is computed from the parts.
    """
    lists = {name: tuple(map(float, row[name])) for name in LISTS}
    parts = {str(name): tuple(map(float, values)) for name, values in row["parts"].items()}
    for name, excluded in (("registered", {REGISTRATION}), ("motion", {REGISTRATION, SEGMENTATION})):
        sizes = BOUND_DEVIATIONS * np.linalg.norm([parts[one] for one in parts if one not in excluded], axis=0)
        lists[name] = tuple(map(float, row.get(name, np.minimum(sizes, lists["worst"]))))
    for name, values in (lists | parts).items():
        if len(values) != len(lists["times"]) or not np.isfinite(values).all():
            raise InputError(f"{name} are not {len(lists['times'])} finite numbers.")
    frames, folded, numbers, patients = (int(row.get(key, 0)) for key in ("frames", "folded", "numbers", "patients"))
    covered, deviation = (None if row.get(name) is None else float(row[name]) for name in ("covered", "deviation"))
    if not all(share is None or 0.0 <= share <= 1.0 for share in (covered, deviation)):
        raise InputError("covered and deviation are not shares from 0 to 1.")
    return Uncertainty(
        scene=str(row["scene"]), mark=str(row["mark"]), draws=int(row["draws"]), failed=int(row["failed"]),
        **lists, parts=parts, frames=frames, folded=folded, numbers=numbers, patients=patients, covered=covered,
        deviation=deviation,
    )  # fmt: skip


def write_uncertainties(path: Path, uncertainties: Iterable[Uncertainty]) -> None:
    """Add the uncertainties of scenes to a file; entries of the same scenes are replaced."""
    scenes = read_uncertainties(path) | {one.scene: one for one in uncertainties}
    rows = {name: asdict(scenes[name]) for name in sorted(scenes)}
    stored = {"format": FORMAT, "unit": "m", "level": LEVEL, "scenes": rows}
    with write_atomically(path, ".json") as unfinished:
        unfinished.write_text(json.dumps(_round_numbers(stored), indent=1) + "\n")


def _round_numbers(value: object) -> object:
    """Round all numbers in nested lists and dicts to a micrometre; the sampling error of an ensemble is larger."""
    match value:
        case dict():
            return {name: _round_numbers(one) for name, one in value.items()}
        case list() | tuple():
            return [_round_numbers(one) for one in value]
        case float():
            return round(value, 6)
        case _:
            return value
