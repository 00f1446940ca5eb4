"""Stereo depth and point tracking compared with the rendered positions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from test_ar_lens import SOME

from ar.optics.camera import Camera, build_stereo_pair, look_at
from ar.rendering.layer import Layer, Solid
from ar.rendering.renderer import Lamp, Picture, Renderer
from ar.stereo.disparity import (
    StereoCloud,
    compute_stereo_view,
    find_consistent_motions,
    track_pixels,
    triangulate_cloud,
)
from ar.stereo.rectified import RectifiedPair, build_rectification

TARGET, REACH, FINE = np.array([0.04, 0.03, 0.02]), 15e-3, 6000.0
LAMP = Lamp(TARGET + [0.05, 0.05, 0.3], TARGET, radius=0.06)


def eyes(lens=SOME) -> tuple[Camera, Camera]:
    """They look at the target from 0.3 m, slanting, with lenses that bend and axes that meet there."""
    middle = look_at(TARGET + [0.0, -0.1, 0.28], TARGET, np.array([0.0, 1.0, 0.0]), np.radians(8.0), 320, 240)
    return build_stereo_pair(replace(middle, lens=lens), working_distance=0.3)


def bulge(texture: float = 1.0) -> Layer:
    """A sheet of 50 mm that bulges by 4 mm, with a mottle of half a millimetre."""
    across = np.linspace(-25e-3, 25e-3, 30)
    x, y = (each.ravel() for each in np.meshgrid(across, across))
    rest = np.stack([x, y, np.zeros_like(x)], axis=1)
    sheet = TARGET + rest - np.outer((x**2 + y**2) / 0.15, [0.0, 0.0, 1.0])
    corner = np.arange(900).reshape(30, 30)
    a, b, c, d = (each.ravel() for each in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    mottle = gaussian_filter(np.random.default_rng(0).standard_normal((150, 150)), 1.3)
    grey = np.clip(0.5 + texture * 0.2 * mottle / mottle.std(), 0.0, 1.0)
    T = np.diag([3000.0, 3000.0, 1000.0, 1.0])
    T[:2, 3] = 75.0
    solid = Solid(np.repeat(grey[:, :, None], 2, axis=2), T)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Layer("sheet", 1, sheet, faces, (0.86, 0.6, 0.54), gloss=0.0, solid=solid, rest=rest)


SHEET = bulge()
RENDERER = Renderer([SHEET], LAMP, "cpu")


def shot(pair: tuple[Camera, Camera], moved: np.ndarray | float = 0.0, renderer: Renderer = RENDERER) -> list[Picture]:
    return [renderer.render(eye, [SHEET.vertices + moved]) for eye in pair]


def taken(picture: Picture, seed: int, darker: float = 1.0) -> np.ndarray:
    """Its colours with a camera's noise."""
    noisy = darker * picture.colour + 2.0 * np.random.default_rng(seed).standard_normal(picture.colour.shape)
    return np.clip(noisy.round(), 0.0, 255.0).astype(np.uint8)


def window_of(pair: tuple[Camera, Camera]) -> RectifiedPair:
    return build_rectification(*pair, tuple(TARGET.tolist()), REACH, FINE)


def grid(size: int) -> np.ndarray:
    at = np.arange(15.0, size - 15.0, 6.0)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def off(found: StereoCloud, pixels: np.ndarray, geometry: RectifiedPair, left: Camera, picture: Picture) -> np.ndarray:
    """How far off depths are (k,) [m], by the depth that was drawn."""
    here = geometry.compute_points(pixels[found.indices], np.zeros(len(found.indices)))
    at = left.project(here)[0].round().astype(int)
    true = left.unproject(left.project(here)[0], picture.depth[at[:, 1], at[:, 0]].astype(float))
    return (found.points - true) @ geometry.T_window_world[2, :3]


@pytest.fixture(scope="module")
def pair():
    return eyes()


@pytest.fixture(scope="module")
def geometry(pair):
    return window_of(pair)


@pytest.fixture(scope="module")
def pictures(pair):
    return shot(pair)


@pytest.fixture(scope="module")
def view(geometry, pictures):
    return compute_stereo_view(geometry, *(taken(picture, seed) for seed, picture in enumerate(pictures)))


def test_rectified_windows_match_distorted_projection(pair, geometry):
    columns, rows = np.meshgrid(np.arange(320, dtype=np.float32), np.arange(240, dtype=np.float32))
    points = TARGET + 5e-3 * np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    pixels, disparity = geometry.project_points(points)
    there = pixels - np.stack([disparity, np.zeros_like(disparity)], axis=1)
    assert np.allclose(geometry.compute_points(pixels, disparity), points, atol=1e-9)
    assert np.abs(disparity).max() > 2.0 and geometry.size == 180
    assert (
        np.allclose(geometry.project_points(TARGET[None])[0], 89.5)
        and abs(geometry.project_points(TARGET[None])[1][0]) < 1e-9
    )
    for eye, where, number in zip(pair, (pixels, there), (0, 1), strict=True):
        shown = [geometry.rectify(each, each)[number] for each in (columns, rows)]
        near = np.round(where).astype(int)
        found = np.stack([each[near[:, 1], near[:, 0]] for each in shown], axis=1)
        step = (where - near) * eye.K[0, 0] / geometry.focal
        assert np.abs(found + step - eye.project(points)[0]).max() < 0.15


@pytest.mark.parametrize("darker", [1.0, 0.85])
def test_depth_errors_match_their_standard_deviation(pair, geometry, pictures, darker):
    pixels = grid(geometry.size)
    view = compute_stereo_view(geometry, taken(pictures[0], 0), taken(pictures[1], 1, darker))
    found = triangulate_cloud(view, pixels)
    error = off(found, pixels, geometry, pair[0], pictures[0])
    assert len(found.indices) > 0.9 * len(pixels)
    assert np.sqrt((error**2).mean()) < 0.35e-3 and abs(error.mean()) < 0.1e-3
    assert 0.4 < np.sqrt(((error / found.sigma) ** 2).mean()) < 1.6


def test_image_noise_increases_depth_standard_deviation(geometry, pictures):
    pixels, random = grid(geometry.size), np.random.default_rng(0)
    sigma = []
    for noise in (0.0, 10.0):
        noisy = [picture.colour + noise * random.standard_normal(picture.colour.shape) for picture in pictures]
        found = triangulate_cloud(
            compute_stereo_view(geometry, *(np.clip(each, 0.0, 255.0).astype(np.uint8) for each in noisy)), pixels
        )
        sigma.append(np.median(found.sigma))
    assert sigma[1] > 1.25 * sigma[0]


def test_saturated_pixels_are_excluded_from_the_cloud(pair, geometry, pictures):
    lit, random = [taken(picture, seed) for seed, picture in enumerate(pictures)], np.random.default_rng(3)
    for picture in lit:
        for column, row in random.integers((100, 60), (220, 180), (20, 2)).tolist():
            picture[row - 1 : row + 2, column - 1 : column + 2] = 255
    pixels, view = grid(geometry.size), compute_stereo_view(geometry, *lit)
    white = [window.min(axis=2) > 250 for window in geometry.rectify(*lit)]
    assert white[0].any() and view.invalid[white[0]].all() and view.invalid_right[white[1]].all()
    found = triangulate_cloud(view, pixels)
    assert 0.3 * len(pixels) < len(found.indices) < 0.9 * len(pixels)
    error = off(found, pixels, geometry, pair[0], pictures[0])
    assert np.sqrt((error**2).mean()) < 0.6e-3 and np.median(np.abs(error)) < 0.25e-3


def test_pixels_hidden_in_either_image_give_no_point(geometry, pictures, view):
    pixels, none = grid(geometry.size), np.zeros((240, 320), bool)
    left, right = none.copy(), none.copy()
    left[:, :140], right[:, 180:] = True, True
    colours = [taken(picture, seed) for seed, picture in enumerate(pictures)]
    found = triangulate_cloud(compute_stereo_view(geometry, *colours, (left, right)), pixels)
    disparity = geometry.project_points(found.points)[1]
    at = [pixels[found.indices], pixels[found.indices] - np.stack([disparity, np.zeros_like(disparity)], axis=1)]
    assert len(found.indices) > 20 and len(found.indices) < 0.6 * len(triangulate_cloud(view, pixels).indices)
    for mask, place in zip(geometry.rectify(left.astype(np.uint8), right.astype(np.uint8)), at, strict=True):
        column, row = place.round().astype(int).T
        assert mask.any() and not mask[row, column].any()


def test_textureless_surface_gives_no_points(pair, geometry):
    plain = Renderer([bulge(texture=0.0)], LAMP, "cpu")
    view = compute_stereo_view(
        geometry, *(taken(picture, seed) for seed, picture in enumerate(shot(pair, renderer=plain)))
    )
    assert not len(triangulate_cloud(view, grid(geometry.size)).indices)


def test_invalid_stereo_inputs_are_rejected(pair, geometry, pictures):
    left, right = (taken(picture, seed) for seed, picture in enumerate(pictures))
    with pytest.raises(ValueError, match="the right eye sees nothing"):
        compute_stereo_view(geometry, left, np.zeros_like(right))
    with pytest.raises(ValueError, match="which is which"):
        window_of(pair[::-1])
    with pytest.raises(ValueError, match="ahead of the eyes"):
        build_rectification(*pair, tuple(2.0 * pair[0].centre - TARGET), REACH, FINE)
    turned = pair[0], pair[1].perturb(0.06, (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="pixels apart: calibrate the pair again"):
        triangulate_cloud(compute_stereo_view(window_of(turned), left, right), grid(geometry.size))


def test_points_are_tracked_over_30_pixels(pair, geometry, view):
    """Displacements of 5 mm (30 pixels) in two directions are measured in three dimensions."""
    pixels = grid(geometry.size)
    known = triangulate_cloud(view, pixels)
    for seed, motion in enumerate(np.array([[5e-3, 0.0, 0.0], [-2e-3, 4e-3, -2e-3]]), start=5):
        later = compute_stereo_view(geometry, *(taken(picture, seed) for picture in shot(pair, motion)))
        which, there = track_pixels(view, later, pixels[known.indices])
        found = triangulate_cloud(later, there)
        moved = found.points - known.points[which[found.indices]]
        good = find_consistent_motions(found.points, moved)
        assert good.sum() > 0.5 * len(known.indices) and good.mean() > 0.9
        error = np.linalg.norm(moved - motion, axis=1)[good]
        assert np.median(error) < 0.25e-3 and np.quantile(error, 0.95) < 0.8e-3


def test_points_are_not_tracked_into_unrelated_image(geometry, view):
    random = np.random.default_rng(0)
    other = replace(view, left=random.integers(0, 255, view.left.shape, dtype=np.uint8))
    which, there = track_pixels(view, other, grid(geometry.size))
    assert len(which) == len(there) < 3


def test_point_with_inconsistent_backward_flow_is_dropped(geometry, view, monkeypatch):
    """Simulates a repeating texture: the backward flow of every second point ends 5 pixels from its start."""
    pixels = grid(geometry.size)
    ends = []

    def matched(one, other, start, guess, **settings):
        ends.append(start if not ends else start + [[0.0 if row % 2 else 5.0, 0.0] for row in range(len(start))])
        return (
            (start if len(ends) == 1 else guess + (ends[1] - start)).astype(np.float32),
            np.ones((len(start), 1)),
            None,
        )

    monkeypatch.setattr("cv2.calcOpticalFlowPyrLK", matched)
    which, _ = track_pixels(view, replace(view, invalid=np.zeros_like(view.invalid)), pixels)
    assert len(ends) == 2 and len(which) == len(ends[0]) // 2


def test_motion_unlike_its_neighbours_is_unsupported():
    random = np.random.default_rng(0)
    places, motions = random.uniform(0.0, 0.02, (60, 3)), 1e-4 * random.standard_normal((60, 3)) + 3e-3
    motions[[4, 30]] += [2e-3, 0.0, 0.0]
    assert np.flatnonzero(~find_consistent_motions(places, motions)).tolist() == [4, 30]
    assert find_consistent_motions(places[:8], motions[:8]).all()  # too few to judge
