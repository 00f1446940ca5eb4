"""Structs and status codes of the kernel for contact forces."""

import warp as wp

OPEN, SOLVED, NO_EQUILIBRIUM, TOO_MANY_TOUCHED, UNKNOWN = (wp.constant(number) for number in range(5))
"""Status of a load case: open; solved; no equilibrium; too many touched nodes; compliance columns missing."""


@wp.struct
class ComplianceModel:
    """Compliance of n nodes: compliance of the undeformed mesh, transposed (3n, 3n), and updates of b load cases.

    `has_columns` (n,) is 1 if the columns of a node are computed. `history` (b, p, 3n) and `middle_matrix` (b, p, p)
    are the L-BFGS update. `strain_change` (b, 3n, 3n) is the change by strained tissue, or (b, 0, 0). `diagonal_shift`,
    relative to the mean diagonal of the matrix of touched nodes, makes this matrix positive definite.
    """

    undeformed: wp.array2d(dtype=wp.float64)
    has_columns: wp.array(dtype=wp.int32)
    history: wp.array3d(dtype=wp.float64)
    middle_matrix: wp.array3d(dtype=wp.float64)
    strain_change: wp.array3d(dtype=wp.float32)
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

    `force`, .., `proximal` have shape (3n, b). `touched_index` and `acting_index` (n, b) are indices of a node in
    `touched_nodes` and `acting_nodes` (b, n), or -1; `counts` (b, 2): lengths. Matrices (b, 3m, 3m), vectors (b, 3m).
    """

    force: wp.array2d(dtype=wp.float64)
    w: wp.array2d(dtype=wp.float64)
    trial: wp.array2d(dtype=wp.float64)
    gradient: wp.array2d(dtype=wp.float64)
    force_change: wp.array2d(dtype=wp.float64)
    direction: wp.array2d(dtype=wp.float64)
    proximal: wp.array2d(dtype=wp.float64)
    touched_index: wp.array2d(dtype=wp.int32)
    acting_index: wp.array2d(dtype=wp.int32)
    touched_nodes: wp.array2d(dtype=wp.int32)
    acting_nodes: wp.array2d(dtype=wp.int32)
    counts: wp.array2d(dtype=wp.int32)
    middle_history: wp.array3d(dtype=wp.float64)
    compliance: wp.array3d(dtype=wp.float64)
    stiffness: wp.array3d(dtype=wp.float64)
    product: wp.array3d(dtype=wp.float64)
    system: wp.array3d(dtype=wp.float64)
    x: wp.array2d(dtype=wp.float64)
    y: wp.array2d(dtype=wp.float64)
