"""Measured errors and times of model families on an anatomy, read from a `sulcus report` file next to its mesh."""

from pathlib import Path
from typing import Annotated

import msgspec

from ar.overlay.hud import format_bound
from sim.families.registry import FAMILIES
from sim.runtime.outside_files import wrap_errors

# Sentence that says how the file is made.
REMEDY = "`sulcus report --anatomy MESH.vtu` measures them under forces: copy its report.json to MESH.report.json."
Figure = Annotated[float, msgspec.Meta(ge=0.0, lt=1e7)]  # Number in a report [mm, ms, s].


class FamilyFigures(msgspec.Struct, array_like=True, frozen=True):
    """Error and times of a model family over `loads` palpation loads, on `tissue` fixed to bone, timed on `machine`.

    `p95_mm`: 95th percentile of the maximum error at the tumour relative to quadratic FEM (p2). `median_ms`: time per
    load. `preparation_s`: time before the first load.
    """

    tissue: str
    machine: str
    loads: Annotated[int, msgspec.Meta(ge=1, lt=10**7)]
    p95_mm: Figure
    median_ms: Figure
    preparation_s: Figure

    def describe_error(self, brief: bool) -> str:
        """Format the error bound for an image; `brief` selects the short form."""
        bound = format_bound(1e-3 * self.p95_mm, 2)
        return f"model <= {bound}" if brief else f"model error <= {bound} (95 % of {self.loads} pushes, relative to p2)"


def read_family_figures(mesh_path: Path, anatomy_digest: str) -> dict[str, FamilyFigures]:
    """Read the figures by family in MESH.report.json for the anatomy with this digest; empty if there is no file.

    Raises
    ------
    InputError
        The file is invalid or not readable.
    """
    if not (path := mesh_path.with_suffix(".report.json")).is_file():
        return {}
    with wrap_errors(path, "a report", f"Delete it. {REMEDY}"):
        report = msgspec.json.decode(path.read_bytes())
        found = {}
        for part in report["sections"]:
            for row in part["rows"] if part["anatomy"] == anatomy_digest else ():
                if row["name"] in FAMILIES and row["reference"]:
                    errors = row["reference"]["loads"], row["reference"]["worst"]["p95"]
                    found[row["name"]] = part["tissue"], report["machine"], *errors, row["median"], row["set_up"]
        return msgspec.convert(found, dict[str, FamilyFigures])
