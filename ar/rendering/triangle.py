"""Kernel functions of a triangle in homogeneous pixel coordinates: edges, bounding box, barycentric weights."""

import warp as wp


@wp.func
def compute_weights_from_edges(p: wp.vec3d, edge_b: wp.vec3d, edge_c: wp.vec3d, normal: wp.vec3d) -> wp.vec3f:
    """Compute the barycentric weights e / sum e at p = (u, v, 1) from two edges and `normal`, the sum of all three."""
    scale = wp.float64(1.0) / wp.dot(p, normal)
    wb = wp.float32(wp.dot(p, edge_b) * scale)
    wc = wp.float32(wp.dot(p, edge_c) * scale)
    return wp.vec3f(1.0 - wb - wc, wb, wc)


@wp.func
def compute_weights_from_corners(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3f:
    """Compute the barycentric weights of a triangle's corners a, b, c at a pixel p = (u, v, 1)."""
    return compute_weights_from_edges(p, wp.cross(c, a - c), wp.cross(a, b - a), wp.cross(b - a, c - a))


@wp.func
def compute_edge(a: wp.vec3d, b: wp.vec3d, i: wp.int32, j: wp.int32) -> wp.vec3d:
    """Compute the normal a x b of an edge from vertex i at a to j at b, so that exactly edge(i, j) = -edge(j, i)."""
    if i < j:
        return wp.cross(a, b)
    return -wp.cross(b, a)


@wp.func
def extend_box_to_point(q: wp.vec3d, box: wp.vec4d) -> wp.vec4d:
    """Extend the pixel box (u min, v min, u max, v max) to include the pixel of the point q."""
    scale = wp.float64(1.0) / q[2]
    u = q[0] * scale
    v = q[1] * scale
    return wp.vec4d(wp.min(box[0], u), wp.min(box[1], v), wp.max(box[2], u), wp.max(box[3], v))


@wp.func
def extend_box_to_edge(a: wp.vec3d, b: wp.vec3d, near: wp.float64, box: wp.vec4d) -> wp.vec4d:
    """Extend the pixel box to include the part of the edge from a to b that is beyond the near plane."""
    if a[2] >= near:
        box = extend_box_to_point(a, box)
    if (a[2] < near) != (b[2] < near):
        box = extend_box_to_point(a + (b - a) * ((near - a[2]) / (b[2] - a[2])), box)
    return box


@wp.func
def compute_triangle_box(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, near: wp.float64) -> wp.vec4d:
    """Compute the pixel box (u min, v min, u max, v max) of the triangle's part beyond the near plane."""
    far = wp.float64(1.0e30)
    box = wp.vec4d(far, far, -far, -far)
    box = extend_box_to_edge(a, b, near, box)
    box = extend_box_to_edge(b, c, near, box)
    return extend_box_to_edge(c, a, near, box)


@wp.func
def find_first_row(first: wp.int32, begin: wp.int32, part: wp.int32, part_count: wp.int32) -> wp.int32:
    """Return the first row >= `first` of a part; its rows are `begin` + `part` + k `part_count`, with k = 0, 1, ..."""
    ahead = (begin + part - first) % part_count
    if ahead < 0:
        ahead += part_count
    return first + ahead
