"""Structs and status codes of the kernel for contact forces."""

import warp as wp

OPEN, SOLVED, NO_EQUILIBRIUM, TOO_MANY_TOUCHED, UNKNOWN = (wp.constant(number) for number in range(5))
"""Status of a load case: open; solved; no equilibrium; too many touched nodes; compliance columns missing."""


@wp.struct
class ComplianceModel:
    """Compliance of n nodes: compliance of the undeformed mesh, transposed (3n, 3n), and updates of b load cases.

    `known` (n,) is 1 if the columns of a node are computed. `history` (b, p, 3n) and `middle` (b, p, p) are the L-BFGS
    update. `own` (b, 3n, 3n) is the change by strained tissue, or (b, 0, 0). `diagonal_shift` is a shift of the matrix
    of touched nodes, relative to its mean diagonal, which makes the matrix positive definite.
    """

    rest: wp.array2d(dtype=wp.float64)
    known: wp.array(dtype=wp.int32)
    history: wp.array3d(dtype=wp.float64)
    middle: wp.array3d(dtype=wp.float64)
    own: wp.array3d(dtype=wp.float32)
    diagonal_shift: wp.float64


@wp.struct
class Limits:
    """Limits of the iteration, as in `contact_forces.ForceLimits`; `capacity` is that for touched nodes."""

    max_iterations: wp.int32
    max_backtracks: wp.int32
    nonconvex_iterations: wp.int32
    capacity: wp.int32


@wp.struct
class Scratch:
    """Scratch arrays of b load cases, with n nodes and at most m touched nodes.

    `force`, .., `held` have shape (3n, b). `place` and `acts` (n, b) are indices of a node in `touched` and `acting`
    (b, n), or -1; `counts` (b, 2) are the lengths of these two lists. Matrices (b, 3m, 3m), vectors (b, 3m).
    """

    force: wp.array2d(dtype=wp.float64)
    w: wp.array2d(dtype=wp.float64)
    at: wp.array2d(dtype=wp.float64)
    slope: wp.array2d(dtype=wp.float64)
    change: wp.array2d(dtype=wp.float64)
    way: wp.array2d(dtype=wp.float64)
    held: wp.array2d(dtype=wp.float64)
    place: wp.array2d(dtype=wp.int32)
    acts: wp.array2d(dtype=wp.int32)
    touched: wp.array2d(dtype=wp.int32)
    acting: wp.array2d(dtype=wp.int32)
    counts: wp.array2d(dtype=wp.int32)
    middle_history: wp.array3d(dtype=wp.float64)
    soft: wp.array3d(dtype=wp.float64)
    stiff: wp.array3d(dtype=wp.float64)
    both: wp.array3d(dtype=wp.float64)
    system: wp.array3d(dtype=wp.float64)
    x: wp.array2d(dtype=wp.float64)
    y: wp.array2d(dtype=wp.float64)
