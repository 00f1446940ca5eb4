"""What colour a seen point has under the lamp: deferred shading in Warp, one launch per layer."""

from __future__ import annotations

import warp as wp

from .parallel import forward_kernel

# A caster must be this much nearer to the lamp [m] than what it shades.
BIAS = wp.constant(0.0002)
# Half the width of the shadow's soft rim [shadow-map pixel].
SOFT = wp.constant(3)
# Scene-linear light that is white.
BRIGHTEST = wp.constant(4.0)


@wp.struct
class Light:
    """The lamp as the kernel sees it.

    It has a position [m], a unit axis, the cosine of the lit cone's angle, how fast its rim fades in, a strength and an
    ambient share. `P` takes a world point to (u w, v w, w) in the shadow map, which is read `offset` [m] above the
    surface.
    """

    position: wp.vec3f
    axis: wp.vec3f
    outer: wp.float32
    steepness: wp.float32
    strength: wp.float32
    ambient: wp.float32
    P: wp.mat44f
    offset: wp.float32


@wp.struct
class Look:
    """A layer's look: its number, highlight, solid texture (transform, dark end, relief [m])."""

    id: wp.uint8
    gloss: wp.float32
    shininess: wp.float32
    textured: wp.bool
    T_index_world: wp.mat44f
    dark: wp.vec3f
    relief: wp.float32


@wp.func
def unit(v: wp.vec3f) -> wp.vec3f:
    """v / |v| with one division; the library's has three, and this is half of the work at a pixel."""
    return v * (1.0 / wp.sqrt(wp.dot(v, v) + 1.0e-30))


@wp.func
def blend(w: wp.vec3f, t: wp.vec3i, values: wp.array(dtype=wp.vec3f)) -> wp.vec3f:
    """The value at barycentric weights w of triangle t."""
    return w[0] * values[t[0]] + w[1] * values[t[1]] + w[2] * values[t[2]]


@wp.func
def sample(texels: wp.array3d(dtype=wp.vec4f), index: wp.vec3f) -> wp.vec4f:
    """Trilinear value (value, gradient) at a voxel index, held to the border outside."""
    x = wp.clamp(index[0], 0.0, wp.float32(texels.shape[0] - 1))
    y = wp.clamp(index[1], 0.0, wp.float32(texels.shape[1] - 1))
    z = wp.clamp(index[2], 0.0, wp.float32(texels.shape[2] - 1))
    i = wp.min(wp.int32(x), texels.shape[0] - 2)
    j = wp.min(wp.int32(y), texels.shape[1] - 2)
    k = wp.min(wp.int32(z), texels.shape[2] - 2)
    a = x - wp.float32(i)
    b = y - wp.float32(j)
    c = z - wp.float32(k)
    low = (1.0 - b) * ((1.0 - c) * texels[i, j, k] + c * texels[i, j, k + 1]) + b * (
        (1.0 - c) * texels[i, j + 1, k] + c * texels[i, j + 1, k + 1]
    )
    high = (1.0 - b) * ((1.0 - c) * texels[i + 1, j, k] + c * texels[i + 1, j, k + 1]) + b * (
        (1.0 - c) * texels[i + 1, j + 1, k] + c * texels[i + 1, j + 1, k + 1]
    )
    return (1.0 - a) * low + a * high


@wp.func
def lit(
    point: wp.vec3f,
    light: Light,
    shadow: wp.array2d(dtype=wp.float32),
    bounds: wp.array2d(dtype=wp.vec2f),
) -> wp.float32:
    """Share of the lamp that reaches a point: percentage-closer filter of the shadow map (Reeves et al. 1987).

    `bounds` holds the least and the greatest depth under the filter and settles most points at once.
    """
    q = light.P * wp.vec4f(point[0], point[1], point[2], 1.0)
    if q[2] <= 0.0:
        return 1.0
    scale = 1.0 / q[2]
    u = q[0] * scale
    v = q[1] * scale
    column = wp.int32(u + 0.5)
    row = wp.int32(v + 0.5)
    if row < SOFT or column < SOFT or row >= shadow.shape[0] - SOFT or column >= shadow.shape[1] - SOFT:
        return 1.0
    z = q[2] - BIAS
    if z <= bounds[row, column][0]:
        return 1.0
    if z > bounds[row, column][1]:
        return 0.0
    # A box 2 SOFT wide about (u, v): taps at its border count by the part of them inside, so that no steps show.
    reach = wp.float32(SOFT) + 0.5
    hidden = wp.float32(0.0)
    for i in range(row - SOFT, row + SOFT + 1):
        for j in range(column - SOFT, column + SOFT + 1):
            if z > shadow[i, j]:
                across = wp.min(reach - wp.abs(wp.float32(i) - v), 1.0)
                hidden += across * wp.min(reach - wp.abs(wp.float32(j) - u), 1.0)
    return 1.0 - hidden / wp.float32(4 * SOFT * SOFT)


@wp.func
def tone(x: wp.float32, curve: wp.array(dtype=wp.uint8)) -> wp.uint8:
    """Scene-linear light to an 8-bit value by the table `curve`, which spans 0 .. BRIGHTEST."""
    return curve[wp.int32(wp.min(x * (1.0 / BRIGHTEST), 1.0) * wp.float32(curve.shape[0] - 1))]


@forward_kernel
def shade(
    begin: wp.int32,
    end: wp.int32,
    run: wp.int32,
    pixels: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3f),
    first: wp.int32,
    triangles: wp.array(dtype=wp.vec3i),
    vertices: wp.array(dtype=wp.vec3f),
    normals: wp.array(dtype=wp.vec3f),
    colours: wp.array(dtype=wp.vec3f),
    rest: wp.array(dtype=wp.vec3f),
    texels: wp.array3d(dtype=wp.vec4f),
    look: Look,
    eye: wp.vec3f,
    light: Light,
    shadow: wp.array2d(dtype=wp.float32),
    bounds: wp.array2d(dtype=wp.vec2f),
    curve: wp.array(dtype=wp.uint8),
    # outputs
    colour: wp.array2d(dtype=wp.uint8),
    normal: wp.array(dtype=wp.vec3f),
    segmentation: wp.array(dtype=wp.uint8),
):
    """A run of the `pixels` begin .. end - 1, which see this layer (faces from `first` on); pictures are flat, (H W).

    Light = base (ambient + wrapped Lambert) + Schlick's Fresnel x a Gaussian lobe, inside a lit circle with a soft rim.
    """
    start = begin + wp.tid() * run
    for index in range(start, wp.min(start + run, end)):
        pixel = pixels[index]
        t = triangles[face[pixel] - first]
        w = weights[pixel]
        point = blend(w, t, vertices)
        view = unit(eye - point)
        n = unit(blend(w, t, normals))
        # Towards the viewer by the flat side that is seen: near a silhouette the smooth normal may point away.
        flat = wp.cross(vertices[t[1]] - vertices[t[0]], vertices[t[2]] - vertices[t[0]])
        if wp.dot(flat, n) * wp.dot(flat, view) < 0.0:
            n = -n
        normal[pixel] = n
        segmentation[pixel] = look.id
        base = blend(w, t, colours)
        if look.textured:
            x = blend(w, t, rest)
            s = sample(texels, wp.transform_point(look.T_index_world, x))
            base = wp.cw_mul(base, look.dark + (wp.vec3f(1.0) - look.dark) * s[0])
            slope = wp.vec3f(s[1], s[2], s[3])
            n = unit(n - look.relief * (slope - wp.dot(slope, n) * n))
        ray = unit(light.position - point)
        rim = wp.clamp((-wp.dot(ray, light.axis) - light.outer) * light.steepness, 0.0, 1.0)
        arriving = light.strength * rim * rim * (3.0 - 2.0 * rim)
        if arriving > 0.0:
            arriving *= lit(point + light.offset * n, light, shadow, bounds)
        wrapped = wp.max(0.0, (wp.dot(n, ray) + 0.2) * 0.83333)
        # The lamp sits near the viewer: what faces away from both lies in the wound's shade.
        ambient = light.ambient * (0.35 + 0.65 * wp.max(0.0, wp.dot(n, view)))
        out = base * (ambient + arriving * wrapped)
        glow = arriving * look.gloss
        if glow > 0.0:
            middle = unit(ray + view)
            grazing = 1.0 - wp.max(0.0, wp.dot(view, middle))
            fresnel = 0.04 + 0.96 * grazing * grazing * grazing * grazing * grazing
            lobe = wp.exp(look.shininess * (wp.dot(n, middle) - 1.0)) * (look.shininess + 8.0) * 0.12
            out += wp.vec3f(glow * fresnel * lobe)
        colour[pixel, 0] = tone(out[0], curve)
        colour[pixel, 1] = tone(out[1], curve)
        colour[pixel, 2] = tone(out[2], curve)
