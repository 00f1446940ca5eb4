"""Reference for tests of the rasteriser: fragments computed by casting one ray per pixel into a BVH."""

import numpy as np
import warp as wp

from ..optics.camera import Camera
from .parallel import forward_kernel
from .rasteriser import Fragments, check_mesh


def raycast(camera: Camera, vertices: np.ndarray, triangles: np.ndarray, near: float = 1e-3) -> Fragments:
    """Find the nearest triangle at every pixel centre, as `rasterise`, but on the CPU and several times slower."""
    vertices, triangles = check_mesh(vertices, triangles)
    shape = camera.height, camera.width
    if not len(triangles):
        return Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    pixels = np.concatenate([camera.straight, np.ones((*shape, 1))], axis=-1)
    with wp.ScopedDevice("cpu"):
        # In the camera frame a ray with z = 1 has its depth as parameter.
        mesh = wp.Mesh(
            wp.array(camera.to_camera_frame(vertices), dtype=wp.vec3f), wp.array(triangles.reshape(-1), dtype=wp.int32)
        )
        rays = wp.array(pixels @ np.linalg.inv(camera.K).T, dtype=wp.vec3f)
        face = wp.empty(shape, dtype=wp.int32)
        weights = wp.empty(shape, dtype=wp.vec3f)
        depth = wp.empty(shape, dtype=wp.float32)
        wp.launch(cast_rays, shape, [mesh.id, rays, near], [face, weights, depth])
        return Fragments(face.numpy(), weights.numpy(), depth.numpy())


@forward_kernel
def cast_rays(
    mesh: wp.uint64, rays: wp.array2d(dtype=wp.vec3f), near: wp.float32,
    # outputs
    face: wp.array2d(dtype=wp.int32), weights: wp.array2d(dtype=wp.vec3f), depth: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Cast the ray of one pixel, starting at the near plane; write face, weights and depth."""
    row, column = wp.tid()
    ray = rays[row, column]
    length = wp.length(ray)
    hit = wp.mesh_query_ray(mesh, ray * near, ray / length, 1.0e6)
    face[row, column] = -1
    weights[row, column] = wp.vec3f(0.0)
    depth[row, column] = 0.0
    if hit.result:
        face[row, column] = hit.face
        weights[row, column] = wp.vec3f(hit.u, hit.v, 1.0 - hit.u - hit.v)
        depth[row, column] = near + hit.t / length
