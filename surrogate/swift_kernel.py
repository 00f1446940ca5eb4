"""One load through a model of series and process in one kernel: the arithmetic of `Learned.deform`, nothing else.

The formulas are those of the functions named at each, which say why; here they are written for one load, so that no
time goes into calls. Coefficients lie side by side in vectors, over which the compiler works in wide registers.
"""

import warp as wp

from .bound import FARTHEST, GROWTH
from .envelope import SLACK
from .remainder import FEATURES
from .series import BESIDE, STENCIL, TERMS

# So many coefficients, or taught loads, lie side by side; so many places interpolate on a triangle; what tells a bound.
LANES, PLACES, TOLD = 64, 6, 7

wide = wp.types.vector(length=LANES, dtype=wp.float32)
wide_double = wp.types.vector(length=LANES, dtype=wp.float64)
shares = wp.types.vector(length=PLACES, dtype=wp.float64)
weights = wp.types.vector(length=STENCIL, dtype=wp.float64)
products = wp.types.vector(length=TERMS, dtype=wp.float64)
features = wp.types.vector(length=FEATURES, dtype=wp.float64)
telling = wp.types.vector(length=TOLD, dtype=wp.float64)


def double(number: float) -> wp.constant:
    """A constant of double precision: what stands in a kernel without a type is single."""
    return wp.constant(wp.float64(number))


ZERO, ONE, TWO, THREE, FOUR = (double(number) for number in range(5))
MILLI, ROOT_5 = double(1e3), double(5.0**0.5)
BESIDE_, SLACK_, FARTHEST_, GROWTH_ = (double(number) for number in (BESIDE, SLACK, FARTHEST, GROWTH))
# exp(-s) = exp(-s / 2^6)^(2^6): Taylor's series of so many orders; where s is greater than 2^6 nothing is left.
ORDERS, SQUARINGS = 9, 6
VANISHED = double(2.0**SQUARINGS)


@wp.struct
class Load:
    """Point [m], force [N], its size and direction, footprint radius [m]; and the size, brought within the taught."""

    point: wp.vec3d
    size: wp.float64
    direction: wp.vec3d
    radius: wp.float64
    within: wp.float64


@wp.struct
class Table:
    """`Series` and the basis: frames (S,), triangles (S, 6), logarithms of radii (R,), rows (places R 19,), modes.

    Modes (blocks, r) hold `LANES` components of the response at a time.
    """

    frame: wp.array(dtype=wp.mat44d)
    triangle: wp.array2d(dtype=wp.int32)
    radius: wp.array(dtype=wp.float64)
    row: wp.array(dtype=wide)
    modes: wp.array2d(dtype=wide)


@wp.struct
class Process:
    """`Remainder`: rows seen (blocks, 9) in lengths, dual coefficients (blocks, `LANES`), offset; units of features.

    A block of rows holds `LANES` of them side by side.
    """

    seen: wp.array2d(dtype=wide_double)
    dual: wp.array2d(dtype=wide_double)
    offset: wide_double
    mean: features
    unit: features
    faint: wp.float64


@wp.struct
class Limits:
    """`Envelope`, the `Patch` that it is measured on (nodes, inward normals, rim as start and way), and `Bound`."""

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
def place_of(table: Table, point: wp.vec3d):
    """The nearest triangle, and the shares of its corners: `Series._located`."""
    at = wp.vec4d(point[0], point[1], point[2], ONE)
    least = wp.float64(wp.inf)
    which = wp.int32(0)
    found = wp.vec4d()
    for j in range(table.frame.shape[0]):
        local = table.frame[j] @ at
        miss = wp.abs(local[3]) - BESIDE_ * wp.min(wp.min(local[0], local[1]), wp.min(local[2], ZERO))
        if miss < least:
            least = miss
            which = j
            found = local
    corner = wp.vec3d(wp.max(found[0], ZERO), wp.max(found[1], ZERO), wp.max(found[2], ZERO))
    return which, corner / (corner[0] + corner[1] + corner[2])


@wp.func
def parabola(corner: wp.vec3d) -> shares:
    """The shares of a triangle's six places: of the corners, then of the middles opposite."""
    share = shares()
    for c in range(3):
        share[c] = corner[c] * (TWO * corner[c] - ONE)
        share[3 + c] = FOUR * corner[(c + 1) % 3] * corner[(c + 2) % 3]
    return share


@wp.func
def between_radii(table: Table, radius: wp.float64):
    """The first of the radii that carry a parabola, and their weights: `Series._between_radii`."""
    last = table.radius.shape[0] - 1
    x = wp.clamp(wp.log(radius), table.radius[0], table.radius[last])
    below = wp.int32(0)
    while below < last and table.radius[below] < x:
        below += 1
    first = wp.clamp(below - 2, 0, wp.max(last + 1 - STENCIL, 0))
    weight = weights()
    for i in range(wp.min(STENCIL, last + 1)):
        weight[i] = ONE
        for k in range(wp.min(STENCIL, last + 1)):
            if k != i:
                beside = table.radius[first + k]
                weight[i] *= (x - beside) / (table.radius[first + i] - beside)
    return first, weight


@wp.func
def forms(d: wp.vec3d, force: wp.float64) -> products:
    """d_i, then d_i d_j F, then d_i d_j d_k F^2: `series.forms`."""
    form = products()
    second = wp.int32(3)
    third = wp.int32(9)
    for i in range(3):
        form[i] = d[i]
        for j in range(i, 3):
            form[second] = d[i] * d[j] * force
            second += 1
            for k in range(j, 3):
                form[third] = d[i] * d[j] * d[k] * force * force
                third += 1
    return form


@wp.func
def expanded(table: Table, load: Load) -> wide:
    """Coefficients of the response to one newton by the finite elements' series: `Series.predict`."""
    which, corner = place_of(table, load.point)
    share = parabola(corner)
    first, weight = between_radii(table, load.radius)
    form = forms(load.direction, load.within)
    radii = table.radius.shape[0]
    total = wide()
    for c in range(PLACES):
        for r in range(wp.min(STENCIL, radii)):
            row = (table.triangle[which, c] * radii + first + r) * TERMS
            for t in range(TERMS):
                total += wp.float32(share[c] * weight[r] * form[t]) * table.row[row + t]
    return total


@wp.func
def matern(square: wp.float64) -> wp.float64:
    """(1 + s + s^2/3) exp(-s), s = sqrt(5 square): `gp.matern`, to 1e-15.

    The same steps for every number, which the compiler takes for many of them at once: three times as fast as `exp`.
    """
    s = ROOT_5 * wp.sqrt(square)
    x = -wp.min(s, VANISHED) / VANISHED
    power = ONE
    for k in range(ORDERS):
        power = ONE + x * power / wp.float64(ORDERS - k)
    for _ in range(SQUARINGS):
        power *= power
    return (ONE + s + s * s / THREE) * power


@wp.func
def left_over(process: Process, load: Load) -> wide_double:
    """Coefficients of what the series leaves: `Remainder.predict`, `Gp.predict`."""
    x = features()
    for k in range(3):
        x[k] = load.point[k]
        x[3 + k] = load.direction[k]
    x[6] = load.within
    x[7] = load.radius
    x[8] = load.within / load.radius
    x = wp.cw_div(x - process.mean, process.unit)
    total = process.offset
    for block in range(process.seen.shape[0]):
        near = wide_double()
        for k in range(FEATURES):
            way = process.seen[block, k] - wide_double(x[k])
            near += wp.cw_mul(way, way)
        for lane in range(LANES):
            near[lane] = matern(near[lane])
        for lane in range(LANES):
            total += near[lane] * process.dual[block, lane]
    return (load.within * load.within * load.within + process.faint) * total


@wp.func
def angle_of(limits: Limits, load: Load) -> wp.float64:
    """Between force and inward normal at the nearest node [rad]: `envelope.measured`."""
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


@wp.kernel(module="unique", module_options={"max_unroll": 0})
def answer(
    asked: wp.array(dtype=wp.float64),
    table: Table,
    process: Process,
    limits: Limits,
    # outputs
    displacement: wp.array(dtype=wide_double),
    told: wp.array(dtype=wp.float64),
):
    """u = F (series(load) + remainder(load)) modes; told: excess, bounds at 0.95 and 0.99.

    `asked` (7,): point [m], force [N], radius [m]. Displacement in blocks of `LANES` components [m].
    """
    load = Load()
    load.point = wp.vec3d(asked[0], asked[1], asked[2])
    load.direction = wp.vec3d(asked[3], asked[4], asked[5])
    load.size = wp.length(load.direction)
    if load.size > ZERO:
        load.direction = load.direction / load.size
    load.within = wp.clamp(load.size, limits.force[0], limits.force[1])
    load.radius = asked[6]
    coefficient = expanded(table, load) + wide(left_over(process, load))
    for block in range(table.modes.shape[0]):
        response = wide()
        for mode in range(table.modes.shape[1]):
            response += coefficient[mode] * table.modes[block, mode]
        displacement[block] = load.size * wide_double(response)
    angle = angle_of(limits, load)
    overhang = overhang_of(limits, load)
    excess = excess_of(limits, load, angle, overhang)
    bound = promised(limits, load, angle, overhang, excess)
    told[0] = excess
    told[1] = bound[0]
    told[2] = bound[1]
