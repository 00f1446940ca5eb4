"""Triangle in homogeneous pixel coordinates, for kernels: its edges, bounding box and barycentric weights."""

import warp as wp


@wp.func
def weights_at(p: wp.vec3d, edge_b: wp.vec3d, edge_c: wp.vec3d, normal: wp.vec3d) -> wp.vec3f:
    """Compute barycentric weights e / sum e of a triangle's corners at p = (u, v, 1), by two edges and their sum."""
    scale = wp.float64(1.0) / wp.dot(p, normal)
    wb = wp.float32(wp.dot(p, edge_b) * scale)
    wc = wp.float32(wp.dot(p, edge_c) * scale)
    return wp.vec3f(1.0 - wb - wc, wb, wc)


@wp.func
def weights_of(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3f:
    """Compute barycentric weights of a triangle's corners at a pixel p = (u, v, 1)."""
    return weights_at(p, wp.cross(c, a - c), wp.cross(a, b - a), wp.cross(b - a, c - a))


@wp.func
def edge(a: wp.vec3d, b: wp.vec3d, i: wp.int32, j: wp.int32) -> wp.vec3d:
    """Compute a x b, vertices i and j, rounded equally for both neighbours: exactly edge(i, j) = -edge(j, i)."""
    if i < j:
        return wp.cross(a, b)
    return -wp.cross(b, a)


@wp.func
def around(q: wp.vec3d, box: wp.vec4d) -> wp.vec4d:
    """Extend the pixel box (u min, v min, u max, v max) to the pixel of q."""
    scale = wp.float64(1.0) / q[2]
    u = q[0] * scale
    v = q[1] * scale
    return wp.vec4d(wp.min(box[0], u), wp.min(box[1], v), wp.max(box[2], u), wp.max(box[3], v))


@wp.func
def beyond(a: wp.vec3d, b: wp.vec3d, near: wp.float64, box: wp.vec4d) -> wp.vec4d:
    """Extend the pixel box to the part of the edge a b beyond the near plane."""
    if a[2] >= near:
        box = around(a, box)
    if (a[2] < near) != (b[2] < near):
        box = around(a + (b - a) * ((near - a[2]) / (b[2] - a[2])), box)
    return box


@wp.func
def box_of(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, near: wp.float64) -> wp.vec4d:
    """Compute the pixel box (u min, v min, u max, v max) of the part of a triangle beyond the near plane."""
    far = wp.float64(1.0e30)
    box = wp.vec4d(far, far, -far, -far)
    box = beyond(a, b, near, box)
    box = beyond(b, c, near, box)
    return beyond(c, a, near, box)


@wp.func
def first_row(first: wp.int32, begin: wp.int32, part: wp.int32, parts: wp.int32) -> wp.int32:
    """Return the first row of a part from `first` on; a part has every `parts`-th row from `begin` + part on."""
    ahead = (begin + part - first) % parts
    if ahead < 0:
        ahead += parts
    return first + ahead
