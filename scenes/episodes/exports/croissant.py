"""Croissant 1.1 metadata of a data set, as JSON-LD for catalogues of data sets.

Akhtar et al. (2024), "Croissant: A Metadata Format for ML-Ready Datasets", DEEM; version 1.1 of the specification.
"""

from collections.abc import Mapping
from typing import Any

# Standards that the file conforms to.
STANDARDS = ("http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0")
LICENCE = "https://creativecommons.org/licenses/by/4.0/"  # Address of the licence.
# Terms of the Croissant vocabulary without a type.
UNTYPED_TERMS = (
    "arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field", "fileProperty",
    "fileObject", "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath", "key", "md5", "parentField",
    "path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate", "separator", "source",
    "subField", "transform",
)  # fmt: skip
CONTEXT: Mapping[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
    **{name: f"cr:{name}" for name in UNTYPED_TERMS},
}
"""JSON-LD context of the Croissant specification."""
COLUMNS: Mapping[str, tuple[str, str]] = {
    "file": ("sc:Text", "The episode's HDF5 file."),
    "family": ("sc:Text", "Scenario of the episode."),
    "task": ("sc:Text", "Description of the scenario."),
    "frames": ("sc:Integer", "Number of frames."),
    "solved": ("sc:Integer", "Number of frames that FEM solved."),
    "seconds": ("sc:Float", "Duration [s]."),
    "width": ("sc:Integer", "Width of the images [pixel]."),
    "height": ("sc:Integer", "Height of the images [pixel]."),
    "seed": ("sc:Text", "Seed of the sampled parameters; empty if nothing was sampled."),
    "anatomy": ("sc:Text", "Digest of the anatomy."),
    "deformer": ("sc:Text", "Model that deformed the tissue in the images."),
    "largest_error_mm": (
        "sc:Float",
        "Maximum error of the predicted tumour relative to FEM in solved frames [mm]; empty if FEM was displayed.",
    ),
    "bytes": ("sc:Integer", "Size of the file."),
    "sha256": ("sc:Text", "Checksum in the file of its arrays; empty if there is none."),
}
"""Type and meaning of each column of the table of episodes."""


def build_croissant_metadata(
    name: str, description: str, date: str, table: str, sha256: str, folder: str
) -> dict[str, Any]:
    """Build the metadata as a JSON object.

    Parameters
    ----------
    table, sha256
        Name and checksum of the file with a row for each episode.
    folder
        Pattern of the paths of the episodes' files.
    """
    return {
        "@context": dict(CONTEXT),
        "@type": "sc:Dataset",
        "name": name,
        "description": description,
        "conformsTo": list(STANDARDS),
        "license": LICENCE,
        "version": "1.0.0",
        "citeAs": f"{name}: simulated surgery, made by its authors with sulcus, {date}. CC BY 4.0.",
        "datePublished": date,
        "creator": {"@type": "sc:Organization", "name": "The maker of this data set, with sulcus"},
        "keywords": ["simulated surgery", "brain tumour", "finite elements", "augmented reality"],
        "rai:dataCollection": "Simulated by sulcus: no patient, no measurement.",
        "rai:dataLimitations": "DATASHEET.md names what is not known.",
        "rai:personalSensitiveInformation": "None, unless the anatomy is of a person: DATASHEET.md says which it is.",
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": table,
                "name": table,
                "description": "A row for each episode.",
                "contentUrl": table,
                "encodingFormat": "text/csv",
                "sha256": sha256,
            },
            {
                "@type": "cr:FileSet",
                "@id": "episode-files",
                "name": "episode-files",
                "description": "One HDF5 file for each episode; attributes say what each array is.",
                "encodingFormat": "application/x-hdf5",
                "includes": folder,
            },
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "episodes",
                "name": "episodes",
                "description": "The episodes.",
                "key": {"@id": "episodes/file"},
                "field": [_build_field(column, table) for column in COLUMNS],
            }
        ],
    }


def _build_field(column: str, table: str) -> dict[str, Any]:
    kind, meaning = COLUMNS[column]
    return {
        "@type": "cr:Field",
        "@id": f"episodes/{column}",
        "name": column,
        "description": meaning,
        "dataType": kind,
        "source": {"fileObject": {"@id": table}, "extract": {"column": column}},
    }
