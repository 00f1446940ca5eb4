"""What a half-made body has solved of its loads: whoever makes it next goes on with that.

Each process makes a body in a hidden folder of its own, and copies what others have of the same body. So there are no
locks: records of loads prove themselves (`surrogate.data.journal`), those of who is at work just now, too.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from sim.runtime.atomic_files import unfinished_path, written_whole

DATA = "training.h5"
"""The loads that a body's model is trained on, until it is trained."""
NOTE = ".json"
"""The ending of what says beside it of which loads it is."""


def gone_on(data: Path, stated: Mapping[str, str], others: Sequence[Path]) -> bool:
    """See that a data set goes on with the most that it, or one like it in other folders, has; tell if that is any.

    Parameters
    ----------
    stated
        All that decides its bytes: what states something else is none.

    Raises
    ------
    InputError
        A file that cannot be written.
    """
    said = json.dumps(dict(stated), sort_keys=True)
    if not _is_of(data, said):
        forget(data)
        with written_whole(data.with_suffix(NOTE), NOTE, sweep=False) as partial:
            partial.write_text(said, encoding="utf-8")
    alike = [data, *(other / data.name for other in others if other != data.parent)]
    found = sorted(max(_kept(each), default=(False, 0, each)) for each in alike if _is_of(each, said))
    whole, size, best = found[-1]
    target = data if whole else unfinished_path(data)
    if size and best != target:
        with (
            suppress(FileNotFoundError),  # of a maker who is done with it by now
            best.open("rb") as source,
            written_whole(target, target.suffix, sweep=False) as partial,
            partial.open("wb") as copy,
        ):
            shutil.copyfileobj(source, copy)
    return begun(data.parent)


def begun(folder: Path) -> bool:
    """Whether a folder holds loads that were solved for a body."""
    return any(path.exists() for path in _files(folder / DATA)[1:])


def emptied(folder: Path) -> None:
    """Make a folder, or empty it of all but the loads that were solved for a body."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in set(folder.iterdir()) - set(_files(folder / DATA)):
        path.unlink()


def forget(data: Path) -> None:
    """Remove a data set, or what there is of it."""
    for path in _files(data):
        path.unlink(missing_ok=True)


def _files(data: Path) -> tuple[Path, Path, Path]:
    """What says of which loads a data set is; the part of it that is solved; the whole."""
    return data.with_suffix(NOTE), unfinished_path(data), data


def _is_of(data: Path, said: str) -> bool:
    with suppress(OSError, ValueError):
        return data.with_suffix(NOTE).read_text(encoding="utf-8") == said
    return False


def _kept(data: Path) -> Iterator[tuple[bool, int, Path]]:
    """Whether a file of a data set is all of it, its bytes, and its name."""
    for path in _files(data)[1:]:
        with suppress(OSError):
            yield path == data, path.stat().st_size, path
