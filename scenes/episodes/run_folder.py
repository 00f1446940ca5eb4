"""State of a run on disk: settings, finished and failed episodes.

The folder is the only state: an episode is complete if its file exists, because files are written atomically.
Processes that work in the folder do not communicate. Processes that make the same episode write the same bytes.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import explain_error, write_atomically
from sim.runtime.partial_files import remove_partial_files
from sim.runtime.versions import get_version

FORMAT = "sulcus run 1"  # Name and version of the folder format.
PLAN, RUN, FAILED, BODIES, RATES = "plan.toml", "run.json", "failed", "bodies", "rates"
"""Names of the files and folders of a run other than the episodes."""
EPISODE = re.compile(r"episode_(\d{6,})\.(?:h5|json)")  # Pattern of an episode's file name.
PACKAGES = ("h5py", "numpy", "scipy", "sulcus", "warp-lang")
"""Packages whose versions influence the bytes of an episode."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run, which together with an episode's number determine the episode's bytes.

    Parameters
    ----------
    plan, digest
        Name of the plan, and digest of its text and custom anatomies.
    device
        "cpu" or "cuda", whose solutions differ in the last digits.
    versions
        Versions of the packages in `PACKAGES`.
    """

    plan: str
    digest: str
    seed: int
    device: str
    versions: Mapping[str, str]


@dataclass(frozen=True)
class Failure:
    """Failed episode with the reason; `lost` is True if the next run makes another attempt."""

    number: int
    reason: str
    lost: bool


@cache
def get_versions() -> Mapping[str, str]:
    """Return the versions of the `PACKAGES` in this process, by name."""
    return {name: get_version(name) for name in PACKAGES}


def to_episode_name(number: int) -> str:
    """Return the file name of episode `number`."""
    return f"episode_{number:06d}.h5"


def begin_run(folder: Path, run: RunSettings, plan_text: str, force: bool = False) -> bool:
    """Initialise the folder of a run, or check an existing folder; return True if the folder is new.

    Partial files of ended processes are removed, except those of unfinished bodies, which can be resumed.

    Parameters
    ----------
    plan_text
        Text of the plan, which is stored next to the episodes.
    force
        True to accept a folder with other files, or with episodes of other package versions.

    Raises
    ------
    InputError
        The folder has another plan, seed or device; or, unless `force`, other versions, or files but no run.
    """
    for inner in (folder, folder / FAILED, folder / RATES):
        remove_partial_files(inner)
    remove_partial_files(folder / BODIES, is_kept=lambda name: not (folder / BODIES / name).exists())
    found = read_run(folder)
    if found is None:
        _check_empty(folder, force)
    else:
        _check_same_run(folder, found, run, force)
    if found is None or found.versions != run.versions:
        _write_json(folder / RUN, {"format": FORMAT, **asdict(run)})
    if not (folder / PLAN).exists():
        with write_atomically(folder / PLAN, ".toml") as partial:
            partial.write_text(plan_text)
    try:  # the first of simultaneous clients wins
        (folder / RATES).mkdir()
    except FileExistsError:
        return False
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({explain_error(error)}). Choose another folder.") from error
    return True


def read_run(folder: Path) -> RunSettings | None:
    """Read the settings of the run in a folder; None if there is no run.

    Raises
    ------
    InputError
        A file of this name was not written by a run, or cannot be read.
    """
    path = folder / RUN
    try:
        found = json.loads(path.read_text())
        if found.pop("format") != FORMAT:
            raise ValueError
        return RunSettings(**found)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({explain_error(error)}). Choose another folder.") from error
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{path}: is not what `sulcus episodes` writes. Choose another folder.") from error


def list_finished(folder: Path) -> set[int]:
    """Return the numbers of the finished episodes in a folder."""
    return {number for number, ending in _find_episodes(folder) if ending == ".h5"}


def list_failures(folder: Path) -> dict[int, Failure]:
    """Read the failures in a folder, by episode number."""
    return {number: one for number in list_failed(folder) if (one := read_failure(folder, number)) is not None}


def list_failed(folder: Path) -> set[int]:
    """Return the numbers of the failed episodes in a folder, from file names only."""
    return {number for number, _ in _find_episodes(folder / FAILED)}


def read_failure(folder: Path, number: int) -> Failure | None:
    """Read the recorded failure of episode `number`; None if no failure is recorded or readable."""
    with suppress(OSError, ValueError, TypeError):  # another client is removing it
        return Failure(**json.loads(_to_failed_path(folder, number).read_text()))
    return None


def mark_failed(folder: Path, failure: Failure) -> None:
    """Record the failure of an episode in the folder of the run."""
    _write_json(_to_failed_path(folder, failure.number), asdict(failure))


def remove_failure(folder: Path, number: int) -> None:
    """Remove the recorded failure of an episode that was completed later."""
    _to_failed_path(folder, number).unlink(missing_ok=True)


def _to_failed_path(folder: Path, number: int) -> Path:
    return (folder / FAILED / to_episode_name(number)).with_suffix(".json")


def _find_episodes(folder: Path) -> Iterator[tuple[int, str]]:
    """Yield numbers and file endings of the episodes in a folder, from file names only, as there may be a million."""
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        for entry in entries:
            found = EPISODE.fullmatch(entry.name)
            if found:
                yield int(found[1]), os.path.splitext(entry.name)[1]


def _write_json(path: Path, value: Mapping) -> None:
    with write_atomically(path, ".json") as partial:
        partial.write_text(json.dumps(value) + "\n")


def _check_empty(folder: Path, force: bool) -> None:
    other = next((path.name for path in sorted(folder.glob("*")) if not path.name.startswith(".")), None)
    if other and not force:
        raise InputError(
            f"{folder}: holds {other}, and no run was begun there. Choose another folder, or give --force to work in "
            "it all the same."
        )


def _check_same_run(folder: Path, stored: RunSettings, run: RunSettings, force: bool) -> None:
    if stored.digest != run.digest:
        changed = f"of another text or other anatomies of the plan {run.plan}"
        other = changed if stored.plan == run.plan else f"of the plan {stored.plan}"
        raise InputError(
            f"{folder}: holds episodes {other}; its {PLAN} has what they were made by. Choose another folder."
        )
    if stored.seed != run.seed:
        raise InputError(
            f"{folder}: holds episodes of the seed {stored.seed}. Give --seed {stored.seed}, or choose another folder."
        )
    if stored.device != run.device:
        raise InputError(
            f"{folder}: holds episodes that were made on {stored.device}, whose last digits differ. Give --device "
            f"{stored.device}, or choose another folder."
        )
    other = describe_other_versions(stored.versions, run.versions)
    if other and not force:
        raise InputError(
            f"{folder}: was begun with {other}: episodes may differ. Choose another folder, or give --force to go on."
        )


def describe_other_versions(other_versions: Mapping[str, str], own: Mapping[str, str]) -> str:
    """Describe the packages whose versions differ; empty if all versions agree."""
    names = [name for name in sorted({*other_versions, *own}) if other_versions.get(name) != own.get(name)]
    return ", ".join(f"{name} {other_versions.get(name, 'none')} and not {own.get(name, 'none')}" for name in names)
