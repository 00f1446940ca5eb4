"""`sulcus solve`: compute the static equilibrium of any tetrahedral mesh."""

import argparse
import sys
import time

import numpy as np

from sim.accuracy import MIN_TOLERANCE, Accuracy
from sim.anatomy import Anatomy
from sim.bodies.meshfile import UNITS, MeshFile, read_mesh, write_mesh
from sim.deformation import Deformation, build_start
from sim.diagnostics.stretch import MAX_STRETCH, MIN_STRETCH
from sim.effects import SKULLS, Effect, Held, NodalForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Cause, Loads, Nodal, Prescribed

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_device, add_json, to_json_line
from ..options.tissue_options import add_element_argument, add_skull_argument, add_tissue_arguments, parse_elasticity


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "mesh",
        help="mesh of linear or quadratic (`tetra10`) tetrahedra with point data `fixed` (V,) or (V, 3), and "
        "`force` (V, 3) [N] or `prescribed` (V, 3) in the file's unit of length; optional: `slide_normal` (V, 3), "
        "`start` (V, 3), an initial guess in the file's unit, and cell data `region`. Mid-edge nodes in the file "
        "are fixed only where `fixed` marks them",
    )
    add_tissue_arguments(parser, with_full_help=True)
    add_element_argument(parser, "p1, the file's linear tetrahedra as every other program takes them")
    parser.add_argument("--tolerance", type=float, default=1e-6, help="tolerance of the relative residual")
    parser.add_argument(
        "--any-strain", action="store_true",
        help="accept inverted tetrahedra, and strains beyond those that were measured on brain tissue",
    )  # fmt: skip
    parser.add_argument(
        "--precision", default="float64", choices=("float32", "float64"),
        help=f"scalar type of the solver: float32 is faster, with tolerances of at least {MIN_TOLERANCE['float32']:g}",
    )  # fmt: skip
    parser.add_argument("--unit", default="m", choices=UNITS, help="unit of length in the file")
    add_device(parser)
    parser.add_argument(
        "--out", required=True,
        help="output .vtu in metres with point data `displacement` [m]; must not be the input mesh",
    )  # fmt: skip
    # The constraints of the file, for comparisons with other programs.
    add_skull_argument(parser, ("slide", "bonded", "contact"))
    add_force(parser)
    parser.add_argument("--explain", action="store_true", help="print the solvers in the order in which they are tried")
    add_json(parser, "no effect: the result is always one JSON line")


def run(args: argparse.Namespace) -> int:
    """Solve the problem in a file, write the displacement, and print one JSON line; return 0 if converged, else 1.

    Without convergence, the file gets the equilibrium under the largest solved share of the load, or the last state.
    """
    out = check_output_path(args.out, ".vtu", args.force, [args.mesh])
    accuracy = Accuracy(tolerance=args.tolerance, precision=args.precision, limit_strain=not args.any_strain)
    file = read_mesh(args.mesh, args.unit)
    tissue = parse_elasticity(args, file.mesh)
    anatomy, loads, notes = read_problem(file, args.mesh, UNITS[args.unit])
    for note in (*file.notes, *notes):
        print(f"{args.mesh}: {note}", file=sys.stderr)
    clock = time.perf_counter()
    effects: list[Effect] = [tissue, Held(), NodalForce()]
    if anatomy.slide_normal.any():
        effects.append(SKULLS[args.skull])
    # Elements of the file: a comparison with another program needs the same discretisation.
    element = args.element or ("p1" if anatomy.mesh.middles is None else "p2")
    fem = Fem(anatomy, effects, accuracy, args.device, element=element)
    plan = fem.plan.explain() if args.explain else ()
    for line in plan:
        print(line, file=sys.stderr)
    deformation = fem.deform(loads, read_initial_guess(file, args.mesh, UNITS[args.unit]))
    seconds = time.perf_counter() - clock
    write_mesh(out, anatomy.mesh, {"displacement": deformation.displacement[0]})
    outcome, reached, inverted = deformation.outcome[0], float(deformation.reached[0]), int(deformation.inverted[0])
    moved, bond = float(np.linalg.norm(deformation.displacement[0], axis=1).max()), float(deformation.bond[0])
    notes: list[str] = []
    if reached < 1.0:
        state = f"in equilibrium under {reached:.1%} of the load" if reached else "the last state, in no equilibrium"
        notes.append(f"{outcome.value}; the file has {state}")
    least, most = deformation.stretch[:, 0]
    if inverted:
        notes.append(f"{inverted} tetrahedra are inverted: the load is too strong for this mesh. Give a weaker one")
    if least < MIN_STRETCH or most > MAX_STRETCH:
        notes.append(
            f"stretches are {least:.2g} to {most:.2g}; {1e6 * deformation.strained[0]:.2g} ml leave the "
            f"range of {MIN_STRETCH} to {MAX_STRETCH} that was measured on brain tissue"
        )
    if bond > 1.0:
        notes.append(f"the bond on the skull bears {bond:.2g} times its strength: it would tear, which is not computed")
    if moved == 0.0:
        notes.append("nothing moves: no force acts on a node that is free, and no motion is prescribed")
    for note in notes:
        print(f"{args.mesh}: {note}", file=sys.stderr)
    report = {
        "outcome": outcome.name.lower(),
        "message": outcome.value,
        "iterations": int(deformation.iterations[0]),
        "residual": float(deformation.residual[0]),
        "load_fraction": reached,
        "element": fem.space.element,
        "tissue": str(tissue),
        "skull": args.skull if anatomy.slide_normal.any() else None,
        "nodes": fem.space.count,
        "seconds": round(seconds, 4),
        "inverted_tetrahedra": inverted,
        "stretch": [round(float(least), 4), round(float(most), 4)],
        "strained_ml": round(1e6 * float(deformation.strained[0]), 4),
        "leaked": float(deformation.leaked[0]),
        "bond": bond,
        "largest_displacement_mm": round(1e3 * moved, 6),
        "notes": notes,
        "out": str(out),
    }
    print(to_json_line({**report, "plan": plan} if plan else report))
    return 0 if outcome.good else 1


def read_initial_guess(file: MeshFile, name: str, length_unit: float) -> Deformation | None:
    """Return the initial guess in the point data `start` of a file; None without. `length_unit`: unit of the file [m].

    Raises
    ------
    InputError
        The guess has the wrong shape, or is not finite.
    """
    if "start" not in file.point_data:
        return None
    return build_start(
        length_unit * _check_field(name, "start", file.point_data["start"], {(len(file.mesh.nodes), 3)})[None]
    )


def read_problem(file: MeshFile, name: str, length_unit: float) -> tuple[Anatomy, Loads, list[str]]:
    """Read constraints and loads from a file's point data, with notes on corrections; `length_unit`: its unit [m].

    Raises
    ------
    InputError
        Point data are missing, have the wrong shape, or are not finite.
    """
    mesh, data = file.mesh, file.point_data
    count, notes = len(mesh.nodes), []
    if "fixed" not in data:
        raise InputError(f"{name}: has no point data `fixed`: mark the nodes that are held, (V,) or (V, 3).")
    fixed = _check_field(name, "fixed", data["fixed"], {(count,), (count, 1), (count, 3)})
    held = np.broadcast_to(fixed.reshape(count, -1) != 0.0, (count, 3)).copy()
    orphan = np.ones(count, bool)
    orphan[mesh.table] = False
    if orphan.any():
        notes.append(f"{orphan.sum()} nodes belong to no tetrahedron: they stay where they are")
        held[orphan] = True
    normal = np.zeros((count, 3))
    if "slide_normal" in data:
        normal = _check_field(name, "slide_normal", data["slide_normal"], {(count, 3)})
    causes: list[Cause] = []
    if "force" in data:
        force = _check_field(name, "force", data["force"], {(count, 3)})
        if force[orphan].any():
            notes.append("forces on nodes that belong to no tetrahedron are left out")
        causes.append(Nodal(np.where(orphan[:, None], 0.0, force)[None]))
    if "prescribed" in data:
        stored = np.asarray(data["prescribed"])
        if stored.shape == (count, 3):
            free = ~held & (stored != 0.0)
            if free.any():
                notes.append(f"`prescribed` is ignored on {free.sum()} components that are not `fixed`")
            stored = np.where(held & ~orphan[:, None], stored, 0.0)
        prescribed = length_unit * _check_field(name, "prescribed", stored, {(count, 3)})
        most, size = np.linalg.norm(prescribed, axis=1).max(), np.ptp(mesh.nodes[~orphan], axis=0).max()
        if most > size:
            notes.append(
                f"`prescribed` moves a node by {1e3 * most:.3g} mm, and the body is {1e3 * size:.3g} mm long: see that "
                "it is in the unit of length of the file"
            )
        if prescribed.any():
            causes.append(Prescribed(prescribed[None]))
    if not causes:
        raise InputError(
            f"{name}: nothing acts on it: give point data `force` (V, 3) [N], or `prescribed` (V, 3) that is not zero "
            "where `fixed`."
        )
    return Anatomy(mesh, held, normal, np.zeros(count, bool)), Loads(tuple(causes)), notes


def _check_field(name: str, key: str, values: np.ndarray, shapes: set[tuple[int, ...]]) -> np.ndarray:
    values = np.asarray(values)
    if values.shape not in shapes:
        allowed = " or ".join(str(shape) for shape in sorted(shapes))
        raise InputError(f"{name}: point data `{key}` has shape {values.shape}: give {allowed}.")
    try:
        values = values.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: point data `{key}` does not hold numbers.") from error
    if not np.isfinite(values).all():
        node = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])
        raise InputError(f"{name}: point data `{key}` is not finite at node {node}: every number must be finite.")
    return values
