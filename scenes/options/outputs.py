"""What a command may write, and what it must not write over: asked before the work, for all commands in one place."""

from __future__ import annotations

import argparse
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import check_output

FRAME = re.compile(r"frame_\d{4,}\.png")
HEAD = 1 << 16
Kinds = Mapping[str, Callable[[Path], object]]


def add_force(parser: argparse.ArgumentParser) -> None:
    """Declare --force: shared by every command that writes."""
    parser.add_argument("--force", action="store_true", help="replace an existing file even if sulcus did not make it")


def claimed(
    path: str | Path,
    suffix: str,
    kind: str,
    force: bool = False,
    inputs: Sequence[str | Path | None] = (),
    kinds: Kinds | None = None,
) -> Path:
    """The path of an output that can be written and may be replaced; nothing is left behind by asking.

    An existing file is replaced only if it is recognised as one of the same `kind`, or by `force`. A `kind` is a
    key of `kinds` (default: `KINDS`). What the command reads, its `inputs`, is never replaced.

    Raises
    ------
    InputError
        As `check_output`; a file that the command reads; an existing file of another kind.
    """
    with _without_trace(Path(path)):
        path = check_output(path, suffix)
    if not path.exists():
        return path
    if any(one is not None and Path(one).exists() and path.samefile(one) for one in inputs):
        raise InputError(f"{path}: is what this command reads, and would be lost. Choose another name.")
    if not force and not recognised(path, kind, kinds):
        raise InputError(
            f"{path}: exists, and is not recognised as {kind}. Choose another name, or give --force to replace it."
        )
    return path


def claimed_folder(folder: Path, what: str) -> Path:
    """A folder in which pictures can be written; nothing is left behind by asking. `what` names them in the plural.

    Raises
    ------
    InputError
        A file of that name, or a place where nothing can be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, but the {what} need a folder. Choose another name.")
    try:
        with _without_trace(folder / "any.png"):
            check_output(folder / "any.png", ".png")
    except InputError as error:
        raise InputError(f"{folder}: the {what} cannot be written there. Choose another folder.") from error
    return folder


def claimed_frames(folder: Path, source: str, force: bool) -> list[Path]:
    """Frames of other runs than `source` in a folder, which `force` allows to remove; other files are left alone.

    Raises
    ------
    InputError
        Without `force`, frames of another run; and always, a picture of a frame's name that sulcus did not write.
    """
    from ar.screen import signature

    frames = sorted(path for path in folder.glob("frame_*.png") if FRAME.fullmatch(path.name))
    signed = {path: signature(path) for path in frames}
    foreign = [path for path, found in signed.items() if found is None]
    if foreign:
        raise InputError(
            f"{foreign[0]}: is named as a frame, but this version of sulcus did not write it: choose another folder."
        )
    others = [path for path, found in signed.items() if found != source]
    if others and not force:
        raise InputError(
            f"{folder}: holds {len(others)} frames of another run. Choose another folder, or give --force to remove "
            "those frames."
        )
    return others


def recognised(path: Path, kind: str, kinds: Kinds | None = None) -> bool:
    """Return True if a file is of a kind that sulcus writes; what cannot be read is not."""
    try:
        return bool((kinds or KINDS)[kind](path))
    except (OSError, ValueError, LookupError, zipfile.BadZipFile):
        return False


@contextmanager
def _without_trace(path: Path) -> Iterator[None]:
    """Remove the folders of `path` that were made meanwhile."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        yield
    finally:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


def _names(path: Path) -> set[bytes]:
    """Names of the arrays of a `.vtu` file; none of any other file."""
    return set(re.findall(rb'Name="([^"]*)"', path.read_bytes())) if b"<VTKFile" in head_of(path) else set()


def _is_solution(path: Path) -> bool:
    names = _names(path)
    others = {b"fixed", b"force", b"prescribed", b"held", b"deviation"}
    return {b"region", b"displacement"} <= names and not names & others


def _is_located(path: Path) -> bool:
    return {b"region", b"displacement", b"deviation"} <= _names(path)


def _hdf5(words: str) -> Callable[[Path], bool]:
    def check(path: Path) -> bool:
        import h5py

        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).startswith(words)

    return check


def _is_robomimic(path: Path) -> bool:
    import h5py

    with h5py.File(path, "r") as file:
        return '"env_name": "sulcus"' in str(file["data"].attrs["env_args"])


def model_header(path: Path) -> dict:
    """The JSON header of a model file.

    Raises
    ------
    OSError, ValueError, LookupError, zipfile.BadZipFile
        A file that is none.
    """
    from surrogate.model.npz_archive import Archive

    with path.open("rb") as raw:
        return dict(json.loads(Archive(raw).text("header")))


def head_of(path: Path) -> bytes:
    """The first bytes of a file; no more are read."""
    with path.open("rb") as file:
        return file.read(HEAD)


def _begins(words: bytes) -> Callable[[Path], bool]:
    return lambda path: words in head_of(path)


def _is_picture(path: Path) -> bool:
    from ar.screen import signature

    return signature(path) is not None


def _is_film(path: Path) -> bool:
    from ar.screen import is_our_film

    return is_our_film(path)


def _is_printed(path: Path) -> bool:
    from ar.tracking.pages import is_page

    return is_page(path.read_bytes())


def _is_scan(path: Path) -> bool:
    from sim.bodies.intensity import is_sidecar

    return is_sidecar(path)


KINDS: Kinds = {
    "an anatomy of sulcus": lambda path: {b"region", b"held", b"slide_normal", b"craniotomy"} <= _names(path),
    "a scan that sulcus put beside an anatomy": _is_scan,
    "a result of `sulcus solve`": _is_solution,
    "a result of `sulcus locate`": _is_located,
    "a locator of `sulcus locate`": lambda path: str(model_header(path)["format"]).startswith("sulcus locator"),
    "fitted tissue of `sulcus fit`": _begins(b'"format": "sulcus tissue'),
    "a data set of `sulcus simulate`": _hdf5("sulcus data"),
    "an episode of `sulcus collect`": _hdf5("sulcus episode"),
    "a robomimic file of `sulcus convert`": _is_robomimic,
    "a card of `sulcus convert`": _begins(b"sulcus card"),
    "a model of `sulcus train`": lambda path: str(model_header(path)["format"]).startswith("sulcus model"),
    "a graph of `sulcus export`": lambda path: b"sulcus onnx" in path.read_bytes(),
    "a table of `sulcus sensitivity`": _begins(b"what,default,now,"),
    "a table of `sulcus sensitivity --factorial`": _begins(b"opening [mm],depth [mm],"),
    "a page of `sulcus report`": _begins(b"<title>What accuracy costs in time</title>"),
    "a picture of sulcus": _is_picture,
    "a film of `sulcus render`": _is_film,
    "a calibration of `sulcus calibrate`": _begins(b"sulcus calibrate"),
    "a covariance of `sulcus calibrate`": _begins(b'"format": "sulcus intrinsics'),
    "a registration of `sulcus register`": _begins(b'"format": "sulcus registration'),
    "a camera of `sulcus film`": _begins(b"sulcus film"),
    "a tool of `sulcus film`": _begins(b'"format": "sulcus tool'),
    "what is true of a film of `sulcus film`": lambda path: str(model_header(path)["format"]).startswith("sulcus film"),
    "a table of `sulcus film`": _begins(b"time_s,tumour_x_mm,"),
    "a table of `sulcus overlay`": _begins(b"time_s,state,tumour_x_mm,"),
    "figures of `sulcus warp`": _begins(b'"format": "sulcus warp'),
    "a page of `sulcus markers`": _is_printed,
    "a list of `sulcus markers`": _begins(b'"format": "sulcus targets'),
}
"""What may be replaced by the same: in words, and how it is recognised."""
