"""Fitted tissue in files: JSON beside an anatomy, read where an ensemble is drawn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sim.effects import SKULLS
from sim.errors import InputError
from sim.runtime.atomic_files import written_whole
from sim.runtime.outside_files import read_as

from .tissue import FINE_POISSONS, FINE_RATIOS, FittedTissue

FORMAT = "sulcus tissue 1"
SUFFIX = ".tissue.json"


def tissue_path(anatomy: str | Path) -> Path:
    """Where the fitted tissue of an anatomy file is looked for: MESH.tissue.json beside MESH.vtu."""
    return Path(anatomy).with_suffix(SUFFIX)


def save_tissue(path: str | Path, tissue: FittedTissue) -> None:
    """Write fitted tissue; the file appears whole or not at all."""
    stored = {
        "format": FORMAT, "anatomy": tissue.anatomy, "frames": tissue.frames, "skull": list(SKULLS),
        "poisson": FINE_POISSONS.tolist(), "ratio": FINE_RATIOS.tolist(),
        "probability": tissue.probability.tolist(), "young": tissue.young.tolist(),
    }  # fmt: skip
    with written_whole(path, ".json") as unfinished:
        unfinished.write_text(json.dumps(stored) + "\n")


def load_tissue(path: str | Path, digest: str) -> FittedTissue:
    """Read the fitted tissue of the anatomy of a `digest`.

    Raises
    ------
    InputError
        A file that is missing, none of this version, damaged, or of another anatomy.
    """
    with read_as(path, "fitted tissue", "Make it anew by `sulcus fit`."):
        stored = json.loads(Path(path).read_text(encoding="utf-8-sig"))
        if stored["format"] != FORMAT or stored["skull"] != list(SKULLS):
            raise InputError(f"{path}: is no fitted tissue of this version: make it anew by `sulcus fit`.")
        if stored["anatomy"] != digest:
            raise InputError(f"{path}: was fitted to another anatomy: give that one, or fit tissue to this one.")
        probability, young = (np.array(stored[name], float) for name in ("probability", "young"))
        fits = probability.shape == (len(SKULLS), len(FINE_POISSONS), len(FINE_RATIOS)) and young.ndim == 1
        if not fits or not (probability >= 0.0).all() or abs(probability.sum() - 1.0) > 1e-6 or not (young > 0.0).all():
            raise InputError(f"{path}: holds no probabilities: make it anew by `sulcus fit`.")
        return FittedTissue(stored["anatomy"], int(stored["frames"]), probability, young)
