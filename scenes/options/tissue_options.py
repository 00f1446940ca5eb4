"""Command-line options of tissue, skull and element type, shared by all commands that solve."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from sim.anatomy import PART_LABELS, REGION_NAMES, describe_missing_region, name_region
from sim.effects import SKULLS, Elasticity
from sim.elements import ELEMENTS, RECOMMENDED
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh
from sim.material import BRAIN, LAWS, IsotropicTissue, Ogden, Tissue, build_law
from sim.named_tissues import MATERIALS

if TYPE_CHECKING:
    from ..play.deformers import PatientSetup
    from ..script.scene import Scene

NON_BRAIN_REGIONS = tuple(name for name in REGION_NAMES if name != "brain")
"""Names of the regions that can have their own stiffness."""
PLAUSIBLE_YOUNG = 100.0, 1e6
"""Young's moduli [Pa] below and above which no tissue in a skull was measured, by far.

Operated brains have 7.3 kPa, and their tumours 11.4 to 33.1 kPa in the mean of each kind: Chauvet et al. 2016,
Ultraschall Med. 37:584-590. The laws of brain in `MATERIALS` have 2.0 to 3.3 kPa.
"""
AS_BRAIN = "the tissue of the brain"  # Default tissue of a region.
AS_LEARNED = f"as in the models' training data, or {AS_BRAIN}"  # Default tissue of a region with models.


def add_tissue_arguments(
    parser: argparse.ArgumentParser, with_full_help: bool = False, default_regions: str = AS_BRAIN
) -> None:
    """Add --material, the constants of its laws, and --region to a parser.

    `default_regions` describes the default of --region. If `with_full_help`, the help describes each named tissue.
    """
    sets = f"{', '.join(MATERIALS)}; see docs/notes/tissue.md"
    if with_full_help:
        each = (f"{name} holds for {preset.time_scale}. Source: {preset.source}" for name, preset in MATERIALS.items())
        sets = ". ".join(each)
    parser.add_argument(
        "--material", default="default", choices=(*MATERIALS, *LAWS, Ogden.law), metavar="TISSUE",
        help=f"tissue law ({', '.join((*LAWS, Ogden.law))}), or named tissue: {sets}",
    )  # fmt: skip
    parser.add_argument(
        "--young", type=float, metavar="PA", help=f"Young's modulus [Pa] (default: the material's, or {BRAIN.young:g})"
    )
    parser.add_argument(
        "--poisson", type=float, metavar="NU", help=f"Poisson's ratio (default: the material's, or {BRAIN.poisson:g})"
    )
    parser.add_argument(
        "--ogden", metavar="C1,M1;C2,M2",
        help="terms of --material ogden, psi = sum of C/M^2 (l1^M + l2^M + l3^M - 3) + K/2 (ln J)^2 [Pa], as in FEBio; "
        "C is 2 mu of the form with 2 mu/alpha^2",
    )  # fmt: skip
    parser.add_argument("--bulk", type=float, metavar="K", help="bulk modulus of --material ogden [Pa]")
    parser.add_argument(
        "--prony", metavar="G1,TAU1;G2,TAU2",
        help="Prony series of the shear modulus: fractions G and relaxation times TAU [s], such as "
        '"0.45,0.5;0.365,50" in the scene retract',
    )  # fmt: skip
    add_region_argument(parser, default_regions)


def add_model_tissue(parser: argparse.ArgumentParser, skull: bool = False) -> None:
    """Add the options of tissue, --skull if `skull`, and --element to the parser of a command with trained models."""
    add_tissue_arguments(parser, default_regions=AS_LEARNED)
    if skull:
        add_skull_argument(parser)
    add_element_argument(parser)


def add_region_argument(parser: argparse.ArgumentParser, default: str = AS_BRAIN) -> None:
    """Add the option --region to a parser; `default` describes its default in the help."""
    parser.add_argument(
        "--region", action="append", default=[], metavar="REGION:YOUNG[,POISSON]",
        help=f"Young's modulus [Pa] and, optionally, Poisson's ratio of a region, by number or name "
        f"({', '.join(NON_BRAIN_REGIONS)}), such as oedema:2000 or 3:2000,0.45, or for Ogden's law its constants, "
        f"REGION:C1,M1;C2,M2;K; repeatable (default: {default}; necrosis as the tumour)",
    )  # fmt: skip


def add_skull_argument(parser: argparse.ArgumentParser, choices: Sequence[str] = tuple(SKULLS)) -> None:
    """Add the option --skull with these `choices` to a parser; the first choice is the default."""
    words = {
        "bonded": "fixed by the meninges",
        "slide": "frictionless sliding without separation",
        "contact": "frictionless sliding with separation",
    }
    meanings = "; ".join(f"{name}: {words[name]}" for name in choices)
    parser.add_argument("--skull", choices=choices, default=choices[0], help=f"boundary condition at skull; {meanings}")


def add_element_argument(parser: argparse.ArgumentParser, default_element: str = RECOMMENDED) -> None:
    """Add the option --element to a parser; its default None means `default_element`, or p2 with mid-edge nodes."""
    parser.add_argument(
        "--element", choices=ELEMENTS,
        help=". ".join(f"{name}, {text}" for name, text in ELEMENTS.items())
        + f" (default: {default_element}; p2 for meshes with mid-edge nodes)",
    )  # fmt: skip


def parse_tissue(args: argparse.Namespace) -> Tissue:
    """Return the tissue that the options request.

    Raises
    ------
    InputError
        Constants of the law are missing, unknown or invalid, or a text has another format.
    """
    tissue = _parse_tissue(args)
    if args.young is not None:
        _warn_of_stiffness(f"--young {args.young:g}", tissue)
    if args.prony is None:
        return tissue
    try:
        series = parse_terms(args.prony.split(";"))
    except ValueError as error:
        raise InputError(
            f'--prony {args.prony}: write pairs G,TAU with ; between, as in "0.45,0.5;0.365,50".'
        ) from error
    return replace(tissue, prony=tuple(series))


def _parse_tissue(args: argparse.Namespace) -> IsotropicTissue:
    """Return the requested tissue without --prony; a named tissue keeps its own Prony series."""
    ours = {"--ogden": args.ogden, "--bulk": args.bulk}
    if args.material == Ogden.law:
        given = {"--young": args.young, "--poisson": args.poisson}
        reject_option(given, args.material, f"named tissues and the laws {', '.join(LAWS)}")
        missing = [name for name, value in ours.items() if value is None]
        if missing:
            raise InputError(f'--material ogden lacks {missing[0]}: give --ogden "C1,M1;C2,M2" and --bulk K [Pa].')
        try:
            terms = parse_terms(args.ogden.split(";"))
        except ValueError as error:
            raise InputError(
                f'--ogden {args.ogden}: write pairs C,M with ; between, as in "1340,-19;200,2".'
            ) from error
        return Ogden(terms, args.bulk)
    reject_option(ours, args.material, "--material ogden")
    if args.material in MATERIALS:
        return MATERIALS[args.material].tissue.replace_constants(args.young, args.poisson)
    return build_law(args.material, BRAIN.young, BRAIN.poisson).replace_constants(args.young, args.poisson)


def parse_elasticity(args: argparse.Namespace, mesh: TetMesh) -> Elasticity:
    """Return the requested tissue of a mesh, with the tissues of its regions.

    Raises
    ------
    InputError
        See `parse_tissue` and `parse_region_tissues`.
    """
    tissue = parse_tissue(args)
    return Elasticity(tissue, parse_region_tissues(args.region, tissue, mesh))


def parse_optional_tissue(args: argparse.Namespace) -> Tissue | None:
    """Return the requested tissue; None if no option of the tissue is given."""
    constants = (args.young, args.poisson, args.ogden, args.bulk, args.prony)
    given = args.material != "default" or any(value is not None for value in constants)
    return parse_tissue(args) if given else None


def reject_option(given_values: Mapping[str, object], material: str, owner: str) -> None:
    """Raise InputError if one of `given_values` is not None: only `owner`, not `material`, has these options."""
    for name, value in given_values.items():
        if value is not None:
            raise InputError(
                f"{name} says nothing to --material {material}: it belongs to {owner}. Leave one of them out."
            )


def apply_tissue_options(args: argparse.Namespace, scene: Scene, patient: PatientSetup) -> Scene:
    """Return a scene with the requested tissue and element type.

    Regions that --region does not set have the tissue of the scene, or that of `find_trained_regions` (see there).

    Raises
    ------
    InputError
        See `parse_tissue`, `parse_region_tissues` and `Scene.replace_tissue`.
    """
    from ..play.learned_regions import find_trained_regions

    made = scene.replace_tissue(parse_optional_tissue(args), args.element)
    here = made.elasticity
    own = parse_region_tissues(args.region, here.default or BRAIN, patient.anatomy.mesh)
    kept = find_trained_regions(here, patient.learned_tissue, own)
    if own and kept:
        print(
            f"{scene.name} keeps the tissue from the models' training data: {Elasticity(None, kept)}", file=sys.stderr
        )
    return made.replace_regions(dict(sorted({**own, **kept}.items())))


def parse_region_tissues(texts: Sequence[str], tissue: Tissue, mesh: TetMesh | None = None) -> dict[int, Tissue]:
    """Parse texts of --region; return tissues by region label, with the law of `tissue`.

    Raises
    ------
    InputError
        See `parse_region`; also if a region is given twice, or is missing in `mesh`.
    """
    pairs = [parse_region(text, tissue) for text in texts]
    labels = [label for label, _ in pairs]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"--region {label} is given twice: give each region once.")
        if mesh is not None and (missing := describe_missing_region(mesh, label)):
            marks = f" `sulcus patient --{name}` marks it." if (name := name_region(label)) in PART_LABELS else ""
            raise InputError(f"--region {label}: {missing}{marks}")
    for text, (_, one) in zip(texts, pairs, strict=True):
        _warn_of_stiffness(f"--region {text}", one)
    return dict(sorted(pairs))


def check_stiffness(tissue: Tissue) -> str:
    """Describe why the Young's modulus of a tissue at small strain is implausible; empty if plausible."""
    mu, lame = tissue.lame
    young, (least, most) = mu * (3.0 * lame + 2.0 * mu) / (lame + mu), PLAUSIBLE_YOUNG
    if least <= young <= most:
        return ""
    if young > most:
        return (
            f"a Young's modulus of {young:.3g} Pa is above {most:g}, stiffer than any brain or tumour. The unit is Pa"
        )
    return (
        f"a Young's modulus of {young:.3g} Pa is below {least:g}, softer than any brain or tumour. "
        f"The unit is Pa: for {young:.3g} kPa give {1e3 * young:g}"
    )


def _warn_of_stiffness(option: str, tissue: Tissue) -> None:
    doubt = check_stiffness(tissue)
    if doubt:
        warnings.warn(f"{option}: {doubt}", stacklevel=1)


def parse_region_label(text: str) -> int:
    """Return the label of a region that is given by number or name.

    Raises
    ------
    ValueError
        The text is neither a number nor the name of a region.
    """
    return REGION_NAMES[text] if text in NON_BRAIN_REGIONS else int(text)


def parse_region(text: str, tissue: Tissue) -> tuple[int, Tissue]:
    """Parse "REGION:YOUNG[,POISSON]", or "REGION:C1,M1;C2,M2;K" for Ogden's law; return label and tissue.

    With Young's modulus, the region has the law and exponents of `tissue`.

    Raises
    ------
    InputError
        The text has another format, or constants are invalid.
    """
    ogden = isinstance(tissue, Ogden)
    try:
        label, constants = text.split(":")
        if ogden and ";" in constants:
            *terms, bulk = constants.split(";")
            return parse_region_label(label), Ogden(parse_terms(terms), float(bulk), tissue.prony)
        if not isinstance(tissue, IsotropicTissue):
            raise InputError(f"tissue of the law {tissue.law} has no Young's modulus.")
        young, *poisson = map(float, constants.split(","))
        (ratio,) = poisson or (None,)
        return parse_region_label(label), tissue.replace_constants(young, ratio)
    except InputError as error:
        raise InputError(f"--region {text}: {error}") from error
    except ValueError as error:
        form = "REGION:YOUNG, as in oedema:2000" + (", or 2:1340,-19;148000" if ogden else "")
        raise InputError(
            f"--region {text}: write {form}. REGION is a number, or one of {', '.join(NON_BRAIN_REGIONS)}."
        ) from error


def parse_terms(texts: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Parse texts "A,B" into pairs of numbers, for example Ogden's (c [Pa], m).

    Raises
    ------
    ValueError
        A text has another format.
    """
    pairs = [text.split(",") for text in texts]
    return tuple((float(c), float(m)) for c, m in pairs)
