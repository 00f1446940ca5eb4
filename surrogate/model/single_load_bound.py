"""How far outside of what was trained one load lies, and what is promised of its answer: functions of a kernel."""

import warp as wp

from .conformal import FARTHEST, GROWTH
from .training_range import SLACK

# So many features tell a bound.
TOLD = 7
telling = wp.types.vector(length=TOLD, dtype=wp.float64)


def double(number: float) -> wp.float64:
    """A constant of double precision: what stands in a kernel without a type is single."""
    return wp.constant(wp.float64(number))


ZERO, ONE, MILLI = double(0.0), double(1.0), double(1e3)
SLACK_, FARTHEST_, GROWTH_ = double(SLACK), double(FARTHEST), double(GROWTH)


@wp.struct
class Load:
    """Point [m], force's size [N] and unit direction, footprint radius [m]; size brought within what was taught."""

    point: wp.vec3d
    size: wp.float64
    direction: wp.vec3d
    radius: wp.float64
    within: wp.float64


@wp.struct
class Limits:
    """`Envelope`, `Bound`, and the `Patch` on which loads are measured.

    Points taught (n,) [m]; nodes (m,) [m] and their inward normals; edges of the rim, start and way (E,) [m]. Numbers
    as in `Envelope` and `Bound`, quantiles (k,) for both levels; where there are none, nothing is promised.
    """

    taught: wp.array(dtype=wp.vec3d)
    node: wp.array(dtype=wp.vec3d)
    inward: wp.array(dtype=wp.vec3d)
    start: wp.array(dtype=wp.vec3d)
    along: wp.array(dtype=wp.vec3d)
    reach: wp.float64
    overhang: wp.float64
    angle: wp.float64
    line_force: wp.float64
    force: wp.vec2d
    footprint: wp.vec2d
    mean: telling
    deviation: telling
    weight: wp.array(dtype=wp.float64)
    edge: wp.array(dtype=wp.float64)
    quantile: wp.array(dtype=wp.vec2d)


@wp.func
def angle_of(limits: Limits, load: Load) -> wp.float64:
    """Between force and inward normal at the nearest node [rad]: `training_range.measured`."""
    least = wp.float64(wp.inf)
    cosine = ZERO
    for j in range(limits.node.shape[0]):
        square = wp.length_sq(limits.node[j] - load.point)
        if square < least:
            least = square
            cosine = wp.dot(limits.inward[j], load.direction)
    return wp.acos(wp.clamp(cosine, -ONE, ONE))


@wp.func
def overhang_of(limits: Limits, load: Load) -> wp.float64:
    """Footprint beyond the rim [m]: `Patch.rim_distance`."""
    least = wp.float64(wp.inf)
    for j in range(limits.start.shape[0]):
        offset, along = load.point - limits.start[j], limits.along[j]
        share = wp.clamp(wp.dot(offset, along) / wp.dot(along, along), ZERO, ONE)
        least = wp.min(least, wp.length_sq(offset - share * along))
    return load.radius - wp.sqrt(least)


@wp.func
def excess_of(limits: Limits, load: Load, angle: wp.float64, overhang: wp.float64) -> wp.float64:
    """How far outside of what was taught: `Envelope.excess`."""
    least = wp.float64(wp.inf)
    for j in range(limits.taught.shape[0]):
        least = wp.min(least, wp.length_sq(limits.taught[j] - load.point))
        if least <= limits.reach * limits.reach:
            break  # whichever is nearest, it is near enough
    excess = wp.max(ZERO, MILLI * (wp.sqrt(least) - limits.reach - SLACK_))
    excess = wp.max(excess, MILLI * (overhang - limits.overhang - SLACK_))
    if load.size > ZERO:
        excess = wp.max(excess, angle - limits.angle - SLACK_)
    excess = wp.max(excess, load.size / limits.force[1] - ONE - SLACK_)
    excess = wp.max(excess, load.size / (limits.line_force * load.radius) - ONE - SLACK_)
    excess = wp.max(excess, limits.footprint[0] / load.radius - ONE - SLACK_)
    return wp.max(excess, load.radius / limits.footprint[1] - ONE - SLACK_)


@wp.func
def promised(limits: Limits, load: Load, angle: wp.float64, overhang: wp.float64, excess: wp.float64) -> wp.vec2d:
    """Bounds [m] at 0.95 and 0.99: `Bound.of` and what `Learned.deform` makes of it for weak forces."""
    if limits.quantile.shape[0] == 0:
        return wp.vec2d(wp.float64(wp.nan), wp.float64(wp.nan))
    if load.size == ZERO:
        return wp.vec2d()
    weaker = wp.min(load.size / limits.force[0], ONE)
    x = telling(
        wp.log(load.within),
        wp.log(load.radius),
        angle,
        MILLI * overhang,
        MILLI * load.point[0],
        MILLI * load.point[1],
        MILLI * load.point[2],
    )
    x = wp.cw_div(x - limits.mean, limits.deviation)
    for i in range(TOLD):
        x[i] = wp.clamp(x[i], -FARTHEST_, FARTHEST_)
    total = limits.weight[0]
    pair = wp.int32(1 + TOLD)
    for i in range(TOLD):
        total += limits.weight[1 + i] * x[i]
        for j in range(i, TOLD):
            total += limits.weight[pair] * x[i] * x[j]
            pair += 1
    member = wp.int32(0)
    while member < limits.edge.shape[0] and limits.edge[member] < load.size:
        member += 1
    return weaker * wp.exp(total) * (ONE + GROWTH_ * excess) * limits.quantile[member]
