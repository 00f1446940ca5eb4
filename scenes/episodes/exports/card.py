"""Card of a data set, written into its folder: table of episodes, Croissant metadata, data sheet and licence."""

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence, Set
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically

from ..bodies import describe_weak, list_model_errors
from ..reading.contents import EpisodeContents, open_episode, read_contents
from ..reading.validation import count_solved_frames
from ..reading.windows import list_episode_paths, read_numbers
from ..run_folder import RunSettings, list_failed, read_run, to_episode_name
from .columns import LICENCE as LICENCE_NAME
from .columns import SHEET, describe_task
from .croissant import COLUMNS, build_croissant_metadata
from .datasheet import MARK, NAME, get_template_notice, has_template, write_datasheet

TABLE = "episodes.csv"  # File name of the table of episodes.
NAMES = (TABLE, "croissant.json", SHEET, LICENCE_NAME)
"""File names of a card."""
MAX_COMPARED_EPISODES = 5000
"""Maximum number of episodes for which a run writes the card automatically; an episode takes 20 to 50 ms."""
# Text of the licence file.
LICENCE = f"""# Licence of this data set

{MARK}

These data are licensed under the Creative Commons Attribution 4.0 International licence (CC BY 4.0).
Its text: https://creativecommons.org/licenses/by/4.0/legalcode

Summary, which does not replace that text:

- You may copy, share and change these data, also to earn money with them.
- You must name the authors, link to the licence, and indicate whether you changed anything.
- You may not suggest that the authors endorse you or your use.
- There is no warranty. They are simulated, and are not fit for decisions about patients.

If an anatomy in `bodies` was made from a person's scan, this licence gives no right to that scan. Ask its owner.
The program that made the data, sulcus, has its own licence: Apache 2.0.
"""


def write_card(
    folder: Path,
    contents: Sequence[EpisodeContents] | None = None,
    progress: Callable[[Iterable], Iterable] = iter,
    force: bool = False,
) -> dict[str, Any]:
    """Write `episodes.csv`, `croissant.json`, `DATASHEET.md` and `LICENSE.md` into a data set's folder.

    Files are written atomically, and replace an earlier card. `contents`: contents of the episodes if already read.

    Raises
    ------
    InputError
        The folder has no episodes, an episode is damaged, or (unless `force`) a file of this name is not a card's.
    """
    for name in NAMES:
        if not force and (folder / name).exists() and not is_card(folder / name):
            raise InputError(f"{folder / name}: is not of a card. Move it away, or give --force to replace it.")
    episodes, rows = [], []
    for one in progress(contents or list_episode_paths(folder)):
        episodes.append(read_contents(one) if isinstance(one, Path) else one)
        rows.append(build_row(episodes[-1], folder))
    inside = "episodes/*.h5" if (folder / "episodes").is_dir() else "*.h5"
    table = format_table(rows)
    gone = len(list_failed(folder))
    missing = [f"Of those asked for {gone} could not be made and are missing: `failed` says why."] if gone else []
    notes = [*missing, *describe_weak(list_model_errors(folder))]
    sheet = write_datasheet(folder.resolve().name, episodes, rows, notes, read_run_settings(folder))
    description = (
        f"{len(rows)} episodes of scripted surgery on simulated brains with a tumour: images, depth, poses of camera "
        "and tool, forces, and tumour positions by FEM."
    )
    date = max(str(one.attributes.get("date", ""))[:10] for one in episodes) or datetime.now(UTC).date().isoformat()
    described = build_croissant_metadata(
        folder.resolve().name, description, date, TABLE, sha256(table.encode()).hexdigest(), inside
    )
    licence = LICENCE + (get_template_notice() if has_template(episodes) else "")
    texts = (table, json.dumps(described, indent=1) + "\n", sheet, licence)
    for name, text in zip(NAMES, texts, strict=True):
        with write_atomically(folder / name, Path(name).suffix) as partial:
            partial.write_text(text, encoding="utf-8")
    return {"out": str(folder), "episodes": len(rows), "frames": sum(one.frames for one in episodes), "files": NAMES}


def update_card(
    folder: Path, numbers: Set[int], has_changes: bool, progress: Callable[[Iterable], Iterable] = iter
) -> str | None:
    """Rewrite the card of a run's folder if the card does not match the episodes; return the reason if this failed.

    Nothing is written if there are no episodes. Files that do not belong to a card are kept. None: no failure.

    Parameters
    ----------
    numbers
        Numbers of the existing episodes.
    has_changes
        True if episodes were made or failed since the card was written.
    """
    if not numbers or not (has_changes or _is_outdated(folder, {to_episode_name(number) for number in numbers})):
        return None
    if len(numbers) > MAX_COMPARED_EPISODES:
        return (
            f"No data sheet of more than {MAX_COMPARED_EPISODES} episodes: `sulcus convert {folder} --to card` "
            "writes it."
        )
    try:
        write_card(folder, progress=progress)
    except (InputError, OSError) as error:  # the episodes of the run are unaffected
        return f"No data sheet was written: {error}"
    return None


def _is_outdated(folder: Path, names: set[str]) -> bool:
    """Return True if the card of a folder does not list exactly the files `names`, with their sizes unless too many."""
    listed = list_card_files(folder) if all((folder / name).is_file() for name in NAMES) else {}
    if listed.keys() != names or len(names) > MAX_COMPARED_EPISODES:
        return listed.keys() != names
    return any((folder / name).stat().st_size != size for name, size in listed.items())


def list_card_files(folder: Path) -> dict[str, int]:
    """Read the names and sizes [bytes] of the episodes that the card of a folder lists; empty without a card."""
    try:
        with (folder / TABLE).open(newline="", encoding="utf-8") as file:
            return {row["file"]: int(row["bytes"]) for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        return {}


def read_run_settings(folder: Path) -> RunSettings | None:
    """Read the settings of the run in a folder; None if there is no run or its settings cannot be read."""
    try:
        return read_run(folder)
    except InputError:
        return None


def is_card(path: Path) -> bool:
    """Return True if a file was generated as part of a card."""
    head = path.read_text(encoding="utf-8", errors="replace")[:4096]
    return MARK in head or head.startswith(",".join(COLUMNS)) or ("mlcommons.org/croissant" in head and NAME in head)


def build_row(contents: EpisodeContents, folder: Path) -> dict[str, object]:
    """Build the row of an episode in the table of episodes."""
    with open_episode(contents.path) as file:
        times = read_numbers(file, contents, "time")
        solved, _, error = count_solved_frames(file, contents)
    width, height = contents.size
    path = contents.path.resolve()
    return {
        "file": path.relative_to(folder.resolve()).as_posix(),
        "family": contents.family,
        "task": describe_task(contents),
        "frames": contents.frames,
        "solved": solved,
        "seconds": round(float(times[-1] - times[0]), 6),
        "width": width,
        "height": height,
        "seed": contents.attributes.get("seed", ""),
        "anatomy": contents.attributes.get("anatomy", ""),
        "deformer": contents.attributes.get("deformer", ""),
        "largest_error_mm": "" if error is None else round(error[1], 6),
        "bytes": path.stat().st_size,
        "sha256": contents.attributes.get("sha256", ""),
    }


def format_table(rows: Sequence[dict[str, object]]) -> str:
    """Format the table of episodes as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
