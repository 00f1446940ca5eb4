"""Cameras with lens distortion compared with OpenCV and with undistorted images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_ar_rasteriser import build_sphere
from test_ar_renderer import BALL, FLOOR, LAMP, ball, floor, scene

from ar.optics.camera import Camera, look_at, project_cv2
from ar.optics.lens import Lens
from ar.overlay.composite import composite
from ar.overlay.gauge import DistanceGauge
from ar.overlay.marks import Marks
from ar.overlay.outlines import compute_silhouette, find_colour, measure_outline_distance
from ar.rendering.layer import Layer
from ar.rendering.raycast import raycast
from ar.rendering.renderer import Renderer, render

LENSES = {
    "barrel": Lens(-0.35, 0.15, 1e-3, -2e-3, -0.02),
    "pincushion": Lens(0.4, 0.3),
    "folding": Lens(-0.5),
    "rational": Lens(-0.4, 0.12, 0.01, 0.02, 0.0, 0.1, 0.02, 0.001),
}
each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
SOME = LENSES["barrel"]


def places(lens: Lens, count: int = 5000) -> np.ndarray:
    """Normalised places within a lens' reach, or a field of view of 126 degrees."""
    found = min(lens.reach, 2.0) * np.random.default_rng(1).uniform(-1.0, 1.0, (count, 2))
    return found[np.hypot(*found.T) < min(lens.reach, 2.0)]


def by_opencv(lens: Lens, where: np.ndarray) -> np.ndarray:
    points = np.c_[where, np.ones(len(where))]
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), lens.coefficients)[0].reshape(-1, 2)


def seen_by(lens: Lens | None = SOME, width: int = 320, height: int = 240, fov: float = 60.0) -> Camera:
    """A camera that looks on the floor at the origin, its principal point off the middle."""
    here = look_at(np.array([0.02, -0.05, 0.14]), np.zeros(3), np.array([0.0, 1, 0]), np.radians(fov), width, height)
    return replace(here, K=here.K + [[0, 0, 11.0], [0, 9.0, -7.0], [0, 0, 0]], lens=lens)


def points_in_view() -> np.ndarray:
    return 0.03 * np.random.default_rng(0).standard_normal((200, 3))


@each_lens
def test_distortion_equals_opencv_and_is_inverted(lens):
    where = places(lens)
    assert len(where) > 1000 and np.abs(lens.distort(where) - by_opencv(lens, where)).max() < 1e-9
    assert np.abs(lens.undistort(lens.distort(where)) - where).max() < 1e-9
    assert lens.undistort(np.zeros((3, 4, 2))).shape == (3, 4, 2) and not lens.undistort(np.zeros(2)).any()


def test_points_beyond_the_distortion_fold_are_nan():
    """Radial polynomial r - r^3 / 2 has its maximum at r = sqrt(2 / 3); its value there is 2 / 3 of that."""
    lens, turn = LENSES["folding"], np.sqrt(2.0 / 3.0)
    assert lens.reach == pytest.approx(turn, rel=2e-3) and lens.reach < turn
    beyond = np.array([[1.2, 0.0], [0.0, -1.5], [4.0, 3.0], [np.nan, 0.0]])
    assert np.isnan(lens.distort(beyond)).all()
    assert np.abs(by_opencv(lens, beyond[:2])).max() < 0.5  # where it would be drawn, in the midst of the picture
    assert np.isnan(lens.undistort(np.array([[2.0 * turn / 3.0 + 0.01, 0.0], [0.5, 0.5]]))).all()
    assert Lens().reach > 20.0 and Lens(0.1).reach > 20.0
    # A denominator that comes to nothing throws places to infinity.
    assert Lens(k4=-1.0).reach == pytest.approx(1.0, rel=2e-3)


@each_lens
def test_distortion_is_monotonic_along_rays(lens):
    """Rays in all directions, with tangential distortion: radii keep their order."""
    angles = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    radii = np.linspace(0.0, min(0.999 * lens.reach, 5.0), 500)[:, None, None]
    assert ((np.diff(lens.distort(radii * ways), axis=0) * ways).sum(axis=-1) > 0.0).all()


def test_invalid_lens_coefficients_are_rejected():
    with pytest.raises(ValueError, match="finite"):
        Lens(np.nan)
    with pytest.raises(ValueError, match="folds"):
        Lens(k1=-1e30)


@each_lens
def test_distorted_projection_equals_opencv_and_is_inverted(lens):
    camera = seen_by(lens)
    for one in (camera, camera.perturb(3.0, (1.0, 2.0, -1.0))):
        pixels, depth = one.project(points_in_view())
        there = np.isfinite(pixels).all(axis=1)
        assert there.sum() > 100
        assert np.abs(pixels - project_cv2(one, points_in_view()))[there].max() < 1e-8
        assert np.abs(one.unproject(pixels, depth) - points_in_view())[there].max() < 1e-10
    assert np.abs(pixels - replace(one, lens=None).project(points_in_view())[0])[there].max() > 1.0


def test_scaled_cropped_and_padded_cameras_project_equally():
    camera, points = seen_by(), points_in_view()
    pixels, _ = camera.project(points)
    assert np.allclose(camera.scale(2.0).project(points)[0] + 0.5, 2.0 * (pixels + 0.5))
    assert np.allclose(camera.crop_to(slice(20, 150), slice(30, 290)).project(points)[0] + [30, 20], pixels)
    wide = camera.pad(2.0)
    assert np.allclose(wide.project(points)[0] - pixels, [(wide.width - 320) // 2, 0.0])


@each_lens
def test_undistorted_pixels_project_to_their_own_pixel(lens):
    camera = seen_by(lens)
    rows, columns = np.mgrid[:240, :320]
    points = replace(camera, lens=None).unproject(camera.straight, np.ones((240, 320)))
    back, seen = camera.project(points)[0], np.isfinite(camera.straight).all(axis=2)
    assert seen.mean() > 0.5 and np.abs(back - np.stack([columns, rows], axis=-1))[seen].max() < 1e-6
    part = camera.crop_to(slice(20, 150), slice(30, 290))
    again = Camera(part.K, part.T_camera_world, part.width, part.height, lens)
    assert np.allclose(part.straight, again.straight, atol=1e-6, equal_nan=True)


def test_small_spheres_are_drawn_at_opencv_projection():
    camera = seen_by(SOME, 640, 480, 75.0)
    spread = np.linspace(-0.105, 0.11, 4)
    for x in spread:
        for y in 0.8 * spread:
            (at,) = project_cv2(camera, np.array([[x, y, 0.0]]))
            if (at > 8).all() and (at < [631, 471]).all():
                vertices, triangles = build_sphere(12, 16, 1e-3)
                mask = compute_silhouette(camera.scale(3.0), vertices + [x, y, 0.0], triangles)
                found = (np.argwhere(mask)[:, ::-1].mean(axis=0) + 0.5) / 3.0 - 0.5
                assert np.abs(found - at).max() < 0.05, (x, y)


def test_image_layers_match_a_large_undistorted_image():
    camera, layers = seen_by(), scene()
    picture = render(camera, layers, LAMP)
    wide = replace(camera, lens=None, K=camera.K + [[0, 0, 200.0], [0, 0, 200.0], [0, 0, 0]], width=720, height=640)
    straight = render(wide.scale(3.0), layers, LAMP)
    u, v = (3.0 * (camera.straight + 200.5) - 0.5).astype(np.float32).transpose(2, 0, 1)
    wanted = cv2.remap(straight.colour, u, v, cv2.INTER_LINEAR).astype(int)
    ids = cv2.remap(straight.segmentation, u, v, cv2.INTER_NEAREST)
    depth = cv2.remap(straight.depth, u, v, cv2.INTER_NEAREST)
    same = picture.segmentation == ids
    assert same.mean() > 0.995 and {FLOOR, BALL} <= set(np.unique(ids))
    on = same & (ids > 0)
    assert np.percentile(np.abs(wanted - picture.colour).max(axis=2)[on], 99) <= 3
    assert np.percentile(np.abs(depth - picture.depth)[on], 99) < 2e-4


def test_static_and_batched_images_agree_through_lens():
    renderer, still = Renderer(scene(still=True), LAMP), scene()
    cameras = [seen_by(), seen_by(None), seen_by(LENSES["folding"])]
    together = renderer.render_batch(np.stack([ball().vertices] * 3), cameras)
    for row, camera in enumerate(cameras):
        one, other = renderer.render(camera, [ball().vertices]), render(camera, still, LAMP)
        for name in ("colour", "depth", "segmentation"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
            assert np.array_equal(getattr(together, name).numpy()[row], getattr(other, name))


def test_identity_lens_renders_the_same_as_no_lens():
    assert seen_by(Lens()).lens is None
    one, other = (render(seen_by(lens), scene(), LAMP) for lens in (None, Lens(k3=1e-15)))
    assert (one.segmentation == other.segmentation).mean() > 0.9999
    assert np.abs(one.depth - other.depth).max() < 1e-5 or (one.depth != other.depth).mean() < 1e-4


@each_lens
def test_overlay_outline_is_registered_through_lens(lens):
    camera, ground = seen_by(lens, 640, 480), [floor()]
    hidden = replace(ball((0.04, 0.02, -0.03)), colour=(0.3, 0.95, 0.55))
    picture = render(camera, ground, LAMP)
    before = replace(hidden, vertices=hidden.vertices - [0.01, 0.0, 0.0])
    gauge = DistanceGauge(np.array([-0.03, -0.03, 0.0]), hidden.vertices[0])
    shown = composite(picture, camera, hidden, marks=Marks(gauge=gauge, initial=before)).colour
    mask = raycast(camera, hidden.vertices, hidden.triangles).mask
    ink = tuple(np.rint(255.0 * np.array([0.3, 0.95, 0.55])))
    clear = np.zeros(mask.shape, bool)
    assert find_colour(shown, ink).sum() > 200 and measure_outline_distance(shown, ink, mask, clear) < 1.5
    off = raycast(replace(camera, lens=None), hidden.vertices, hidden.triangles).mask
    assert measure_outline_distance(shown, ink, off, clear) > 2.0


def test_objects_beyond_the_distortion_limit_are_not_drawn():
    """OpenCV's polynomial would project them into the image."""
    camera = replace(look_at(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 1, 0])), lens=LENSES["folding"])
    vertices, triangles = build_sphere(20, 30, 0.05)
    aside = Layer("ball", BALL, vertices + [1.2, 0.0, 1.0], triangles)
    assert np.abs(project_cv2(camera, aside.vertices) - camera.K[:2, 2]).max() < 0.5 * camera.K[0, 0]
    picture = render(camera, [aside], LAMP)
    assert not picture.segmentation.any() and np.isnan(camera.project(aside.vertices)[0]).all()
    assert np.array_equal(composite(picture, camera, aside, marks=Marks(initial=aside)).colour, picture.colour)
    gauge = DistanceGauge(
        np.array([0.0, 0.0, 1.0]), aside.vertices[0]
    )  # its tip is in sight: the number alone stands there
    rows, columns = np.nonzero(composite(picture, camera, aside, marks=Marks(gauge=gauge, initial=aside)).taken)
    assert np.ptp(rows) < 30 and np.ptp(columns) < 140
