"""What the kernel that finds tools' forces is given, and what it needs meanwhile."""

import warp as wp

OPEN, FOUND, NONE, CROWDED, UNKNOWN = (wp.constant(number) for number in range(5))
"""What a column is: to be done, found, without an equilibrium, with too many touched nodes, or lacking a compliance."""


@wp.struct
class ComplianceModel:
    """How nodes give way: the compliance at rest, transposed (3n, 3n), and what b columns have learnt since.

    `known` (n,): whether a node's column is; `learnt` (b, p, 3n), `middle` (b, p, p). `own` (b, 3n, 3n) is what
    strained tissue changes of the compliance, or (b, 0, 0). One between touched nodes is `rounded`: that share of its
    mean makes it definite.
    """

    rest: wp.array2d(dtype=wp.float64)
    known: wp.array(dtype=wp.int32)
    learnt: wp.array3d(dtype=wp.float64)
    middle: wp.array3d(dtype=wp.float64)
    own: wp.array3d(dtype=wp.float32)
    rounded: wp.float64


@wp.struct
class Ends:
    """When it ends: as `contact_forces.ForceLimits`, and with room for so many touched nodes."""

    iterations: wp.int32
    cuts: wp.int32
    late: wp.int32
    room: wp.int32


@wp.struct
class Scratch:
    """What b columns need meanwhile; n nodes, m touched ones at most.

    `forces`, .., `held`: (3n, b). `place`, `acts` (n, b): where a node stands in `touched`, `acting` (b, n).
    `counts` (b, 2): of both lists. Matrices (b, 3m, 3m), vectors (b, 3m).
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
    learnt: wp.array3d(dtype=wp.float64)
    soft: wp.array3d(dtype=wp.float64)
    stiff: wp.array3d(dtype=wp.float64)
    both: wp.array3d(dtype=wp.float64)
    system: wp.array3d(dtype=wp.float64)
    x: wp.array2d(dtype=wp.float64)
    y: wp.array2d(dtype=wp.float64)
