"""Derivatives with respect to tissue: from coefficients of elements to parameters of regions and tetrahedra."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..compile import ElasticPart
from ..errors import InputError
from ..geometry.tetmesh import EDGES, TetMesh, compute_row_keys
from ..material import IsotropicTissue, Ogden, Tissue, get_lame

STEP = 1e-6  # Relative step of the differences of coefficients by parameters.
# Fourth-order central differences: offsets in steps, and weights.
STENCIL = ((1.0, 8.0 / 12.0), (-1.0, -8.0 / 12.0), (2.0, -1.0 / 12.0), (-2.0, 1.0 / 12.0))
Change = Callable[[Tissue, float], Tissue]  # Function that returns a tissue with another value of one parameter.


def list_parameters(tissue: Tissue) -> dict[str, tuple[float, Change]]:
    """Return the value of each parameter of a tissue, and a function that replaces this value.

    `young` [Pa] and `poisson` are at small strain. Ogden's law also has "c1", "m1", ... and `bulk` [Pa], with the other
    constants unchanged. Other tissues have their fields that are numbers.
    """
    found: dict[str, tuple[float, Change]] = {}
    if isinstance(tissue, IsotropicTissue):
        found["young"] = tissue.young, _replace_young
        found["poisson"] = tissue.poisson, _replace_poisson
    if isinstance(tissue, Ogden):
        for number, (c, m) in enumerate(tissue.terms):
            found[f"c{number + 1}"] = c, partial(_replace_ogden, number=number, place=0)
            found[f"m{number + 1}"] = m, partial(_replace_ogden, number=number, place=1)
    if is_dataclass(tissue):
        for field in fields(tissue):
            value = getattr(tissue, field.name)
            if isinstance(value, float) and field.name not in (*found, "limit"):
                found[field.name] = value, partial(_replace_field, name=field.name)
    return found


def find_parameter(tissues: Mapping[int, Tissue], label: int, name: str) -> tuple[float, Change]:
    """Return the value of a parameter of a region, and the function that replaces it.

    Raises
    ------
    InputError
        The region or the parameter is unknown.
    """
    if label not in tissues or name not in list_parameters(tissues[label]):
        known = ", ".join(f"{one}: {'/'.join(list_parameters(tissue))}" for one, tissue in tissues.items())
        raise InputError(f"region {label} has no parameter {name!r}: choose from {known}.")
    return list_parameters(tissues[label])[name]


def differentiate_coefficients(part: ElasticPart, label: int, name: str) -> np.ndarray:
    """Return the derivatives (k,) of the coefficients of a region's elements with respect to a parameter."""

    def compute_coefficients(tissue: Tissue) -> np.ndarray:
        return np.array(tissue.coefficients_at(*get_lame(tissue, part.portion)))

    return _differentiate(compute_coefficients, part.tissues[label], name)


def _differentiate(compute: Callable[[Tissue], np.ndarray], tissue: Tissue, name: str) -> np.ndarray:
    """Return the derivative of a function of a tissue with respect to one of its parameters."""
    value, change = list_parameters(tissue)[name]
    step = STEP * (abs(value) or 1.0)
    return (
        np.sum([weight * compute(change(tissue, value + offset * step)) for offset, weight in STENCIL], axis=0) / step
    )


def add_barrier_work(found: dict[int, dict[str, np.ndarray]], parts: Sequence[ElasticPart], work: np.ndarray) -> None:
    """Add the derivative by the stiffness of contact, which is proportional to the smallest shear modulus, to `found`.

    `work` (b,) is the work of the adjoint solution against the contact forces.
    """
    tissues = {label: tissue for part in parts for label, tissue in part.tissues.items()}
    softest = min(tissues, key=lambda label: tissues[label].lame[0])
    for name in list_parameters(tissues[softest]):
        slope = _differentiate(lambda tissue: np.log(tissue.lame[0]), tissues[softest], name)
        found[softest][name] = found[softest][name] - slope * work


def sum_by_region(parts: Sequence[ElasticPart], work: Sequence[np.ndarray]) -> dict[int, dict[str, np.ndarray]]:
    """Return derivatives (b,) by region label and parameter, from those (T, k, b) by the coefficients of each part."""
    found: dict[int, dict[str, np.ndarray]] = {}
    for part, own in zip(parts, work, strict=True):
        for number, (label, tissue) in enumerate(part.tissues.items()):
            total, row = own[part.tissue_numbers == number].sum(axis=0), found.setdefault(label, {})
            for name in list_parameters(tissue):
                slope = differentiate_coefficients(part, label, name)
                row[name] = row.get(name, 0.0) + slope @ total[: len(slope)]
    return found


def spread_over_tetrahedra(
    parts: Sequence[ElasticPart], work: Sequence[np.ndarray], mesh: TetMesh, element: str, name: str
) -> np.ndarray:
    """Return derivatives (b, tets) with respect to a parameter of each tetrahedron; 0 where its tissue has none.

    Smoothed elements average the coefficients of their tetrahedra by volume.
    """
    out = np.zeros((work[0].shape[2], len(mesh.tets)))
    for part, own in zip(parts, work, strict=True):
        for number, (label, tissue) in enumerate(part.tissues.items()):
            if name not in list_parameters(tissue):
                continue
            slope = differentiate_coefficients(part, label, name)
            rows = np.flatnonzero(part.tissue_numbers == number)
            value = np.einsum("k,tkb->tb", slope, own[rows, : len(slope)])
            if element != "smoothed":
                out[:, part.elements.owner[rows]] += value.T
                continue
            inside = np.flatnonzero(np.isin(mesh.region, [label]))
            tet, place = _find_smoothed_elements(part, mesh, inside, rows)
            share = mesh.volumes[tet] / np.bincount(place, mesh.volumes[tet], len(rows))[place]
            for column in range(out.shape[0]):
                out[column] += np.bincount(tet, share * value[place, column], len(mesh.tets))
    return out


def _find_smoothed_elements(
    part: ElasticPart, mesh: TetMesh, tets: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of a tetrahedron of `tets` and an index into the elements `rows` of its region that contain it."""
    keys = part.elements.keys[rows, :-1].astype(np.int64)  # vertices of the edge or the node, without the region
    corners = mesh.tets[tets].astype(np.int64)
    own = np.sort(corners[:, EDGES], axis=2) if keys.shape[1] == 2 else corners[:, :, None]
    every = np.concatenate([keys, own.reshape(-1, keys.shape[1])])
    codes = compute_row_keys(every) if keys.shape[1] == 2 else every[:, 0]
    known, asked = codes[: len(keys)], codes[len(keys) :]
    order = np.argsort(known)
    place = order[np.searchsorted(known, asked, sorter=order)]
    return np.repeat(tets, own.shape[1]), place


def _replace_young(tissue: Any, value: float) -> Tissue:
    return tissue.replace_constants(young=value)


def _replace_poisson(tissue: Any, value: float) -> Tissue:
    return tissue.replace_constants(poisson=value)


def _replace_field(tissue: Any, value: float, name: str) -> Tissue:
    return replace(tissue, **{name: value})


def _replace_ogden(tissue: Any, value: float, number: int, place: int) -> Tissue:
    terms = [list(term) for term in tissue.terms]
    terms[number][place] = value
    return replace(tissue, terms=tuple((c, m) for c, m in terms))


Regions = Mapping[int, Mapping[str, np.ndarray]]
"""Derivatives (b,) by region label and parameter."""
