"""Rasteriser compared with ray casting and analytic planes, with degenerate meshes."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ar.optics.camera import Camera, look_at
from ar.rendering.rasteriser import find_covered_rows, rasterise
from ar.rendering.raycast import raycast

NO_TRIANGLES = np.zeros((0, 3), int)


def camera(width: int = 160, height: int = 120) -> Camera:
    return look_at(np.array([0.0, 0.0, -0.3]), np.zeros(3), np.array([0.0, -1.0, 0.0]), np.radians(30.0), width, height)


def build_sphere(rings: int = 40, segments: int = 60, radius: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere, its poles shared vertices."""
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1, None]
    turn = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)[None]
    body = np.stack(np.broadcast_arrays(np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)), -1)
    vertices = np.concatenate([body.reshape(-1, 3), [[0, 0, 1.0], [0, 0, -1.0]]]) * radius
    index = np.arange(body[..., 0].size).reshape(rings - 1, segments)
    right = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], index[1:], right[1:], right[:-1]], -1).reshape(-1, 4)
    top, bottom = np.full(segments, len(vertices) - 2), np.full(segments, len(vertices) - 1)
    caps = [np.stack([top, index[0], right[0]], 1), np.stack([bottom, right[-1], index[-1]], 1)]
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *caps])


@pytest.mark.parametrize("seed", range(4))
def test_rasteriser_matches_ray_casting(seed):
    random = np.random.default_rng(seed)
    vertices = random.uniform(-0.08, 0.08, (400, 3))
    vertices[:200] = vertices[200:] + 0.015 * random.standard_normal((200, 3))
    triangles = random.integers(0, 400, (600, 3))
    triangles[:300, 1] = (triangles[:300, 0] + 200) % 400
    here = camera()
    drawn, cast = rasterise(here, vertices, triangles), raycast(here, vertices, triangles)
    # Thin slivers: float32 rays and float64 edges may differ at a pixel that an edge runs through.
    agree = drawn.face == cast.face
    assert np.mean(~agree) < 2e-3
    seen = agree & drawn.mask
    assert seen.sum() > 5000
    assert np.abs(drawn.depth - cast.depth)[seen].max() < 1e-6
    near_edge = drawn.weights.min(axis=-1) < 1e-3
    assert np.abs(drawn.weights - cast.weights)[seen & ~near_edge].max() < 2e-3


@pytest.mark.parametrize("depth", [5e-4, 0.0, -5e-4, -0.2])
def test_triangle_crossing_near_plane_reaches_all_rows(depth):
    """The projected row of a corner nearer than the near plane is no bound."""
    here = camera(height=41)
    corners = np.array([[-0.1, 0.02, 0.3], [0.1, 0.02, 0.3], [0.0, 0.02, depth]])
    assert find_covered_rows(corners @ here.K.T, 1e-3, here.height) == (0, here.height)
    behind = corners @ here.T_camera_world[:3, :3] + here.centre
    drawn = rasterise(here, behind, np.array([[0, 1, 2]]))
    assert drawn.mask[-1].any() and not drawn.mask[: here.height // 2].any()


def test_closed_surface_has_no_cracks_and_ray_cast_depth():
    smooth, triangles = build_sphere()
    here = camera(640, 480)
    # A crack would show the far wall, behind the sphere's middle.
    assert rasterise(here, smooth, triangles).depth.max() < 0.29
    vertices = smooth * (1.0 + 0.05 * np.sin(150.0 * smooth).sum(axis=1, keepdims=True))
    drawn, cast = rasterise(here, vertices, triangles), raycast(here, vertices, triangles)
    assert np.count_nonzero(drawn.mask != cast.mask) <= 2
    both = drawn.mask & cast.mask
    assert np.abs(drawn.depth - cast.depth)[both].max() < 1e-6


def test_pixel_centres_on_shared_edges_and_vertices_are_covered():
    """Grid whose edges and vertices lie exactly on pixel centres."""
    K = np.array([[8.0, 0.0, 16.0], [0.0, 8.0, 16.0], [0.0, 0.0, 1.0]])
    here = Camera(K, np.eye(4), 33, 33)
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 9), np.linspace(-2.0, 2.0, 9), indexing="ij")
    vertices = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    index = np.arange(81).reshape(9, 9)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    fragments = rasterise(here, vertices, triangles)
    assert fragments.mask.all()
    assert (fragments.depth == 1.0).all()


def test_nearer_surface_is_visible_in_any_order():
    front = np.array([[-0.05, -0.05, -0.02], [0.05, -0.05, -0.02], [0.0, 0.05, -0.02]])
    back = front * [3.0, 3.0, -1.0]
    here = camera()
    for first, second, wanted in ((front, back, 0), (back, front, 1)):
        fragments = rasterise(here, np.concatenate([first, second]), np.array([[0, 1, 2], [3, 4, 5]]))
        assert fragments.face[60, 80] == wanted
        assert fragments.depth[60, 80] == pytest.approx(0.28, abs=1e-7)


def test_interpolation_is_perspective_correct():
    """Tilted plane: the value at a pixel is the linear function at the point hit by its ray."""
    vertices = np.array([[-0.2, -0.2, -0.1], [0.2, -0.2, -0.1], [0.2, 0.25, 0.4], [-0.2, 0.25, 0.4]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    here = camera()
    fragments = rasterise(here, vertices, triangles)
    rows, columns = np.nonzero(fragments.mask)
    met = here.unproject(np.stack([columns, rows], -1), fragments.depth[rows, columns])
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
    assert np.abs((met - vertices[0]) @ normal).max() / np.linalg.norm(normal) < 1e-7
    values = vertices @ [[1.0], [2.0], [3.0]] + 0.5
    wanted = met @ [1.0, 2.0, 3.0] + 0.5
    got = fragments.interpolate(triangles, values)[rows, columns, 0]
    assert np.abs(got - wanted).max() < 1e-6
    assert fragments.interpolate(triangles, values)[~fragments.mask].max(initial=0.0) == 0.0


def test_triangles_are_clipped_at_the_near_plane():
    """Floor that starts far behind the camera: only its part beyond the near plane is drawn, as by ray casting."""
    vertices = np.array([[-1.0, 0.05, -2.0], [1.0, 0.05, -2.0], [0.0, 0.05, 3.0], [0.0, 0.0, -0.4], [0.1, 0.1, -0.5]])
    triangles = np.array([[0, 1, 2], [3, 4, 0]])
    here = camera()
    drawn, cast = rasterise(here, vertices, triangles, near=0.05), raycast(here, vertices, triangles, near=0.05)
    assert np.array_equal(drawn.face, cast.face)
    assert (drawn.face == 0).any() and not (drawn.face == 1).any()
    assert drawn.depth[drawn.mask].min() >= 0.05
    assert np.abs(1.0 / drawn.depth[drawn.mask] - 1.0 / cast.depth[drawn.mask]).max() < 1e-4


def test_triangle_larger_than_the_image_covers_all_pixels():
    vertices = np.array([[-50.0, -50.0, 1.0], [50.0, -50.0, 1.0], [0.0, 80.0, 1.0]])
    assert rasterise(camera(), vertices, np.array([[0, 1, 2]])).mask.all()
    assert not rasterise(camera(), vertices + [200.0, 0.0, 0.0], np.array([[0, 1, 2]])).mask.any()


def test_triangles_without_area_cover_no_pixel():
    line = np.array([[-0.05, 0.0, 0.0], [0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.03, 0.0]])
    assert not rasterise(camera(), line, np.array([[0, 1, 2], [0, 0, 3], [1, 1, 1]])).mask.any()
    edge_on = np.array([[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
    assert not rasterise(camera(), edge_on, np.array([[0, 1, 2]])).mask.any()


def test_empty_mesh_gives_an_empty_image():
    fragments = rasterise(camera(), np.zeros((0, 3)), NO_TRIANGLES)
    assert not fragments.mask.any() and (fragments.depth == 0.0).all() and (fragments.face == -1).all()
    assert not raycast(camera(), np.zeros((0, 3)), NO_TRIANGLES).mask.any()


@pytest.mark.parametrize(
    ("vertices", "triangles", "reason"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "vertices"),
        (np.zeros((3, 3)), [[0, 1, 3]], "names a vertex"),
        (np.zeros((3, 3)), [[0, 1, -1]], "names a vertex"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "finite"),
    ],
)
def test_invalid_mesh_arrays_are_rejected(vertices, triangles, reason):
    with pytest.raises(ValueError, match=reason):
        rasterise(camera(), vertices, np.array(triangles))


def test_near_plane_at_zero_distance_is_rejected():
    with pytest.raises(ValueError, match="near"):
        rasterise(camera(), *build_sphere(), near=0.0)


@pytest.mark.gpu
def test_gpu_rasteriser_matches_cpu_rasteriser():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    vertices, triangles = build_sphere()
    here, there = rasterise(camera(), vertices, triangles), rasterise(camera(), vertices, triangles, device="cuda:0")
    assert np.mean(here.face != there.face) < 1e-3
    same = here.face == there.face
    assert np.abs(here.depth - there.depth)[same].max() < 1e-6


def test_threads_draw_the_same_image_as_one(monkeypatch):
    """4,680 triangles upon 19,200 pixels are shared by the threads, each with its own z-buffer."""
    images = []
    for cores in (1, 3):
        with ThreadPoolExecutor(cores) as pool:
            monkeypatch.setattr("ar.rendering.rasteriser.get_workers", lambda: (pool, cores))  # noqa: B023
            images.append(rasterise(camera(), *build_sphere()))
    for name in ("face", "weights", "depth"):
        assert np.array_equal(*(getattr(image, name) for image in images))
