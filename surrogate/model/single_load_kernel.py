"""One load through a model of series and process in one kernel: the arithmetic of `Learned.deform`, nothing else.

The formulas are those of the functions named at each, which say why; here they are written for one load, so that no
time goes into calls. Coefficients lie side by side in vectors, over which the compiler works in wide registers.
"""

import warp as wp

from sim.runtime.device import forward_kernel

from ..regressors.force_series import BESIDE, STENCIL, TERMS
from ..regressors.series_residual import FEATURES
from .single_load_bound import ONE, ZERO, Limits, Load, angle_of, double, excess_of, overhang_of, promised

# So many coefficients, or taught loads, lie side by side; so many places interpolate on a triangle.
LANES, PLACES = 64, 6
# exp(-s) = exp(-s / 2^6)^(2^6): Taylor's series to the ninth order; where s is greater than 2^6 nothing is left.
TAYLOR, SQUARINGS = 9, 6
VANISHED = double(2.0**SQUARINGS)
TWO, THREE, FOUR = double(2.0), double(3.0), double(4.0)
ROOT_5, BESIDE_ = double(5.0**0.5), double(BESIDE)

wide = wp.types.vector(length=LANES, dtype=wp.float32)
wide_double = wp.types.vector(length=LANES, dtype=wp.float64)
shares = wp.types.vector(length=PLACES, dtype=wp.float64)
weights = wp.types.vector(length=STENCIL, dtype=wp.float64)
products = wp.types.vector(length=TERMS, dtype=wp.float64)
features = wp.types.vector(length=FEATURES, dtype=wp.float64)


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
    """`Remainder`: rows seen (blocks, 9), `LANES` of them side by side, and dual coefficients (blocks, `LANES`).

    Offset, mean and unit (deviation times length) of the features, and faint^3 [N^3].
    """

    seen: wp.array2d(dtype=wide_double)
    dual: wp.array2d(dtype=wide_double)
    offset: wide_double
    mean: features
    unit: features
    faint: wp.float64


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
    """d_i, then d_i d_j F, then d_i d_j d_k F^2: `force_series.forms`."""
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
    for k in range(TAYLOR):
        power = ONE + x * power / wp.float64(TAYLOR - k)
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


@forward_kernel(module="unique", module_options={"max_unroll": 0})
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
