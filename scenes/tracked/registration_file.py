"""JSON files of the registration of the scan to the patient's reference, in millimetres and radians."""

import json
from pathlib import Path

import numpy as np

from ar.tracking.registration import RegisteredScan, Registration
from ar.tracking.rigid import is_rigid
from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.file_limits import MAX_COORDINATE
from sim.runtime.outside_files import parse_json, to_path, wrap_errors

FORMAT = "sulcus registration 1"  # Name and version of the file format.
REMEDY = "Make one by `sulcus register`."  # Remedy in error messages.
MAX_FILE_BYTES = 1 << 16  # Maximum size of a valid file [bytes].
ROTATION_TOLERANCE = 1e-4  # Tolerance of a rotation's columns from length 1 and right angles.
# Rounding tolerance of a covariance's smallest eigenvalue below 0, relative to its largest eigenvalue.
EIGENVALUE_TOLERANCE = 1e-9
SCAN_TOLERANCE = 5e-3  # Largest difference of bounds and tumour between two meshes of one scan [m].
_UNITS = np.repeat([1e3, 1.0], 3)  # Conversion of the covariance from metres and radians to millimetres and radians.


def read_registration(path: str | Path) -> Registration:
    """Read the registration in a file of `sulcus register`.

    `T_patient_scan_mm` (4 x 4) maps scan coordinates (RAS) to coordinates of the patient's reference. `covariance`
    (6 x 6): translation [mm] in the reference's axes, and small rotation [rad] about `centre_mm` in the scan.

    Raises
    ------
    InputError
        The file is missing or has another format, the transform is not rigid, or the covariance is invalid.
    """
    path = to_path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file. {REMEDY}")
    with wrap_errors(path, "a registration", REMEDY):
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"is larger than a registration. {REMEDY}")
        stored = parse_json(path, FORMAT, REMEDY)
        T, covariance, centre = (
            np.array(stored[name], float) for name in ("T_patient_scan_mm", "covariance", "centre_mm")
        )
        if T.shape != (4, 4) or covariance.shape != (6, 6) or centre.shape != (3,):
            raise InputError("its numbers have other shapes than 4 x 4, 6 x 6 and 3.")
        T[:3, 3], centre, covariance = 1e-3 * T[:3, 3], 1e-3 * centre, covariance / np.outer(_UNITS, _UNITS)
        if not is_rigid(T, ROTATION_TOLERANCE):
            raise InputError("T_patient_scan_mm is no rigid motion: rows of a rotation, and a shift in millimetres.")
        _check_covariance(covariance)
        if not (np.abs([*T[:3, 3], *centre]) <= MAX_COORDINATE).all():
            raise InputError(f"its shift or its centre is not within {MAX_COORDINATE:g} m: numbers are in millimetres.")
        counts = int(stored["pairs"]), int(stored["surface"])
        scanned = _read_registered_scan(stored["scanned"]) if "scanned" in stored else None
        return Registration(T, covariance, centre, 1e-3 * float(stored["rms_mm"]), *counts, scanned)


def _read_registered_scan(stored_scan: dict) -> RegisteredScan:
    bounds, target = 1e-3 * np.array(stored_scan["bounds_mm"], float), 1e-3 * np.array(stored_scan["tumour_mm"], float)
    if bounds.shape != (2, 3) or target.shape != (3,) or not (np.abs([*bounds, target]) <= MAX_COORDINATE).all():
        raise InputError("what it was made for has other numbers than bounds 2 x 3 and a tumour's middle of 3.")
    return RegisteredScan(str(stored_scan["anatomy"]), bounds, target)


def describe_scan(anatomy: Anatomy) -> RegisteredScan:
    """Return the data of an anatomy that a registration stores: digest, bounds, and tumour or box centre."""
    nodes = anatomy.mesh.nodes
    bounds = np.stack([nodes.min(axis=0), nodes.max(axis=0)])
    tumour = nodes[anatomy.tumour_nodes] if len(anatomy.tumour_nodes) else bounds
    return RegisteredScan(anatomy.digest, bounds, tumour.mean(axis=0))


def describe_other_mesh(registration: Registration, anatomy: Anatomy, path: str | Path) -> str:
    """Describe that a registration was made for another mesh of the same scan, or has no record of its mesh.

    Returns an empty text if the registration was made for this mesh.

    Raises
    ------
    InputError
        The registration is of another anatomy, whose bounds or tumour differ by more than 5 mm from this anatomy.
    """
    made, here = registration.scan, describe_scan(anatomy)
    if made is None:
        return (
            f"{path} does not say of which anatomy it is: whether it is this patient's is not checked. "
            "`sulcus register --anatomy` writes it"
        )
    if made.digest == here.digest:
        return ""
    if made.compute_distance(here) > SCAN_TOLERANCE:
        raise InputError(
            f"{path}: was made for another anatomy: bounds or tumour are {1e3 * made.compute_distance(here):.0f} mm "
            "from those of this one. Give the --anatomy that was registered, or register this one."
        )
    return f"{path} was made for another mesh of what seems to be the same scan"


def _check_covariance(covariance: np.ndarray) -> None:
    finite = (np.abs(covariance) <= MAX_COORDINATE**2).all()
    values = np.linalg.eigvalsh(covariance) if finite else np.array([-1.0])
    if (
        not finite
        or not np.allclose(covariance, covariance.T)
        or values[0] < -EIGENVALUE_TOLERANCE * max(values[-1], 0.0)
    ):
        raise InputError("covariance is no covariance: it is symmetric, finite, and nowhere negative.")


def to_json(registration: Registration) -> dict[str, object]:
    """Convert a registration to the JSON object of its file."""
    T = registration.T_patient_scan.copy()
    T[:3, 3] *= 1e3
    made = registration.scan
    scanned = (
        {}
        if made is None
        else {
            "anatomy": made.digest,
            "bounds_mm": (1e3 * made.bounds).tolist(),
            "tumour_mm": (1e3 * made.target).tolist(),
        }
    )
    return {
        "format": FORMAT,
        "spaces": {"scan": "RAS [mm]", "patient": "the frame of the patient's reference [mm]"},
        "T_patient_scan_mm": T.tolist(),
        "covariance": (registration.covariance * np.outer(_UNITS, _UNITS)).tolist(),
        "centre_mm": (1e3 * registration.centre).tolist(),
        "rms_mm": 1e3 * registration.rms,
        "pairs": registration.pair_count,
        "surface": registration.surface_count,
        **({} if made is None else {"scanned": scanned}),
    }


def write_registration(path: str | Path, registration: Registration) -> None:
    """Write a registration as a .json file, atomically.

    Raises
    ------
    InputError
        The file cannot be written, or the file ending is wrong.
    """
    with write_atomically(to_path(path), ".json") as partial:
        partial.write_text(json.dumps(to_json(registration), indent=1) + "\n", encoding="utf-8")
