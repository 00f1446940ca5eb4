"""Images of many cameras and frames compared with ray casting, formulas and single images, on any device."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp
from test_ar_rasteriser import build_sphere

from ar.optics.camera import Camera, look_at
from ar.overlay.composite import composite
from ar.overlay.marks import Occluders
from ar.rendering.layer import Layer, Solid, compute_vertex_normals
from ar.rendering.rasteriser import EMPTY_PIXEL, allocate_z_buffer, keep_nearest, rasterise_surface
from ar.rendering.raycast import raycast
from ar.rendering.renderer import Lamp, Picture, Pictures, Renderer, build_tone_curve, render, to_light
from ar.rendering.shade import WHITE_LEVEL

FLOOR, BALL, EGG = 1, 2, 3
LAMP = Lamp(np.array([-0.15, 0.1, 0.3]), np.zeros(3), 0.08)


def camera(turn: float = 0.0, width: int = 160, height: int = 120) -> Camera:
    eye = 0.3 * np.array([np.sin(turn), -0.3, np.cos(turn)])
    return look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]), np.radians(30.0), width, height)


def floor(**look) -> Layer:
    x, y = np.meshgrid(*[np.linspace(-0.08, 0.08, 12)] * 2, indexing="ij")
    vertices = np.stack([x, y, 0.01 * np.sin(40.0 * x)], -1).reshape(-1, 3)
    index = np.arange(144).reshape(12, 12)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    return Layer("floor", FLOOR, vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), **look)


def ball(centre=(0.0, 0.0, 0.03), **look) -> Layer:
    vertices, triangles = build_sphere(20, 30, 0.02)
    return Layer("ball", BALL, vertices + centre, triangles, (0.3, 0.7, 0.9), **look)


def striped() -> Layer:
    values = np.indices((9, 9, 9)).sum(axis=0) % 3 / 2.0
    T = np.diag([20.0, 20.0, 20.0, 1.0])
    T[:3, 3] = 4.0
    layer = floor(colour=(0.9, 0.6, 0.5))
    return replace(layer, solid=Solid(values, T, (0.2, 0.1, 0.1), 1e-3), rest=layer.vertices)


def scene(still: bool = False) -> list[Layer]:
    """A floor, and a ball above it that throws its shadow on it."""
    return [replace(striped(), still=still), ball(casts_shadow=True, gloss=0.8)]


def agree(one: np.ndarray, other: np.ndarray) -> float:
    """The share of pixels (..., 3) that are at most one grey level apart."""
    return float((np.abs(one.astype(int) - other).max(axis=-1) <= 1).mean())


def test_depth_and_segmentation_match_ray_casting():
    layers = scene()
    picture, here = render(camera(), layers, LAMP), camera()
    vertices = np.concatenate([layer.vertices for layer in layers])
    cast = raycast(here, vertices, np.concatenate([layers[0].triangles, layers[1].triangles + len(layers[0].vertices)]))
    ids = np.where(cast.face < 0, 0, np.where(cast.face < len(layers[0].triangles), FLOOR, BALL))
    same = picture.segmentation == ids
    assert same.mean() > 0.999 and set(np.unique(ids)) == {0, FLOOR, BALL}
    assert np.abs(picture.depth - cast.depth)[same].max() < 1e-6


def test_colours_follow_the_shading_formulas():
    """NumPy formula without texture and shadow: base (ambient + wrapped Lambert) + Fresnel x lobe."""
    here, layer, light = camera(0.0, 320, 240), ball(gloss=0.4, shininess=30.0), to_light(LAMP)
    picture, cast = render(here, [layer], LAMP), raycast(here, layer.vertices, layer.triangles)
    normals, on = compute_vertex_normals(layer.vertices, layer.triangles), cast.mask

    def unit(v):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    def dot(a, b):
        return (a * b).sum(axis=-1, keepdims=True)

    place = cast.interpolate(layer.triangles, layer.vertices)[on]
    n, view = unit(cast.interpolate(layer.triangles, normals)[on]), unit(here.centre - place)
    n = np.where(dot(n, view) < 0.0, -n, n)
    ray = unit(LAMP.position - place)
    rim = np.clip((dot(-ray, np.array(light.axis)) - light.outer) * light.steepness, 0.0, 1.0)
    arriving = rim * rim * (3.0 - 2.0 * rim) * light.strength
    middle = unit(ray + view)
    fresnel = 0.04 + 0.96 * (1.0 - dot(view, middle).clip(0.0)) ** 5
    lobe = np.exp(30.0 * (dot(n, middle) - 1.0)) * 38.0 * 0.12
    base = np.square((0.3, 0.7, 0.9))
    out = base * (
        light.ambient * (0.35 + 0.65 * dot(n, view).clip(0.0)) + arriving * (dot(n, ray) + 0.2).clip(0.0) * 0.83333
    )
    out = out + 0.4 * arriving * fresnel * lobe
    wanted = build_tone_curve()[(np.clip(out / float(WHITE_LEVEL), 0.0, 1.0) * 4095.0).astype(int)]
    inside = cv2.erode(on.astype(np.uint8), np.ones((3, 3), np.uint8))[on] > 0
    assert inside.sum() > 1000 and agree(picture.colour[on][inside], wanted[inside]) > 0.999


def test_cached_static_layers_render_identically():
    """Cases: a moving layer's shadow falls on the static one, and the camera changes."""
    renderer, backdrops = Renderer(scene(still=True), LAMP), []
    here, there = camera(), camera(0.4)
    aside, middle = (0.02, 0.01, 0.02), (0.0, 0.0, 0.03)
    for eye, centre in ((here, middle), (here, aside), (here, middle), (there, middle), (there, aside)):
        moved = replace(scene()[1], vertices=ball(centre).vertices)
        one, other = renderer.render(eye, [moved.vertices]), render(eye, [striped(), moved], LAMP)
        backdrops.append(renderer.backdrop)
        for name in ("colour", "depth", "segmentation"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        lit = render(eye, [striped(), replace(moved, casts_shadow=False)], LAMP)
        shaded = (lit.colour.astype(int) - other.colour).sum(axis=2) > 60
        assert (shaded & (other.segmentation == FLOOR)).sum() > 100
    none, first, again, moving, last = backdrops
    assert none is None and again is first is moving and first.camera is here and last.camera is there


def test_static_scene_without_shadows_renders_identically():
    for layers, moved in (([striped(), ball()], [ball().vertices]), ([striped()], [])):
        still = [replace(layers[0], still=True), *layers[1:]]
        one, other = Renderer(still, LAMP).render(camera(), moved), render(camera(), layers, LAMP)
        assert np.array_equal(one.colour, other.colour) and np.array_equal(one.depth, other.depth)


def test_batched_images_equal_single_images():
    """Several cameras or one, several frames, and a static layer."""
    renderer = Renderer(scene(still=True), LAMP)
    centres = [(0.0, 0.0, 0.03), (0.03, 0.0, 0.02), (-0.02, 0.02, 0.04)]
    moved = np.stack([ball(centre).vertices for centre in centres])
    for cameras in ([camera(turn) for turn in (0.0, 0.3, -0.5)], [camera(0.2)]):
        together = renderer.render_batch(moved, cameras)
        on_device = renderer.render_batch(wp.array(moved, dtype=wp.vec3d, device="cpu"), cameras)
        assert together.colour.shape == (3, 120, 160)
        for row, vertices in enumerate(moved):
            alone = renderer.render(cameras[row % len(cameras)], [vertices])
            for name in ("colour", "depth", "segmentation"):
                assert np.array_equal(getattr(together, name).numpy()[row], getattr(alone, name))
                assert np.array_equal(getattr(on_device, name).numpy()[row], getattr(alone, name))
    assert not np.array_equal(together.colour.numpy()[0], together.colour.numpy()[1])


def test_triangles_split_over_threads_render_equal_depth():
    """Same partition as on a GPU, with several threads per triangle."""
    here, layer = camera(), scene()[0]
    whole = rasterise_surface(here, layer.vertices, layer.triangles)
    for parts, begin, end in ((3, 0, 120), (8, 0, 120), (7, 31, 90)):
        shared = allocate_z_buffer(1, 120, 160, "cpu")
        size = 1, -(-len(layer.triangles) // 64), parts
        inputs = [whole.points, whole.triangles, 0, wp.float64(1e-3), begin, end, parts, 64, whole.undistortion]
        wp.launch(keep_nearest, size, inputs, [shared], device="cpu")
        assert np.array_equal(shared.numpy()[0, begin:end], whole.z_buffer.numpy()[0, begin:end])
        assert (shared.numpy()[0, :begin] == np.uint64(EMPTY_PIXEL)).all()


@pytest.mark.parametrize(
    ("attempt", "reason"),
    [
        (lambda it: it.render(camera(), [ball().vertices[1:]]), "vertices"),
        (lambda it: it.render_batch(ball().vertices, [camera()]), "vertices"),
        (lambda it: it.render_batch(np.full((1, *ball().vertices.shape), np.nan), [camera()]), "finite"),
        (lambda it: it.render_batch(wp.zeros((1, 4), dtype=wp.vec3d, device="cpu"), [camera()]), "vec3d"),
        (lambda it: it.render_batch(np.stack([ball().vertices] * 3), [camera()] * 2), "cameras"),
        (lambda it: it.render_batch(np.stack([ball().vertices] * 2), [camera(), camera(width=80)]), "sizes"),
        (lambda it: it.render_batch(np.stack([ball().vertices] * 2), [camera(width=40000, height=40000)]), "too many"),
    ],
)
def test_invalid_batch_inputs_are_rejected(attempt, reason):
    with pytest.raises(ValueError, match=reason):
        attempt(Renderer(scene(still=True), LAMP))


def drawn_on(device: str) -> tuple[Pictures, Picture, np.ndarray]:
    """Pictures together and alone, and one with an overlay, all drawn by a device."""
    renderer = Renderer(scene(still=True), LAMP, device)
    moved = np.stack([ball((0.01 * row, 0.0, 0.03)).vertices for row in range(4)])
    together = renderer.render_batch(moved, [camera(0.1 * row, 640, 480) for row in range(4)])
    alone = renderer.render(camera(0.0, 640, 480), [moved[0]])
    hidden = replace(ball((0.02, 0.0, -0.03)), id=EGG, colour=(0.2, 0.9, 0.3))
    return together, alone, composite(alone, camera(0.0, 640, 480), hidden, cover=Occluders((BALL,))).colour


@pytest.mark.gpu
def test_gpu_images_match_cpu_images():
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    (many, one, shown), (many_there, one_there, shown_there) = drawn_on("cpu"), drawn_on("cuda:0")
    assert agree(many.colour.numpy(), many_there.colour.numpy()) > 0.999
    same = many.segmentation.numpy() == many_there.segmentation.numpy()
    assert same.mean() > 0.999
    assert np.abs(many.depth.numpy() - many_there.depth.numpy())[same].max() < 1e-5
    assert agree(one.colour, one_there.colour) > 0.999 and agree(shown, shown_there) > 0.999
