"""Gyri, sulci, vessels and pia of the open cortex, as maps over the tangent plane of the undeformed craniotomy.

The pattern is a Swift-Hohenberg field, whose stripes have one wavelength and branch like gyri. Dark fluid below the
surface in the scan attracts the troughs of the field, so that a scan with visible sulci determines their positions.
On an average brain or without a scan the pattern is random. Gyri have a natural width on every anatomy.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import numpy as np
from scipy.interpolate import griddata
from scipy.ndimage import gaussian_filter, label, map_coordinates, zoom

from sim.bodies.intensity import Intensity

from ..script.craniotomy_frame import CraniotomyFrame
from .cortex_layers import VESSELS, compute_vessel_absorption

MAP_SPACING = 0.2e-3  # Grid spacing of the maps [m].
MAP_MARGIN = 12e-3  # Margin of the maps round the craniotomy [m].
COARSE_STEP = 4  # Grid spacing of the pattern's field [grid spacings of the maps].
GROWTH = 0.6  # Growth rate of the Swift-Hohenberg equation.
TIME_STEP = 0.5  # Time step of the Swift-Hohenberg equation.
STEPS = 300  # Number of its time steps.
LINE_WIDTH = 1.3e-3  # Width of sulci and veins whose length is tested [m].
SCAN_DEPTHS = (1.5e-3, 2.5e-3, 3.5e-3)  # Depths below the surface at which the scan is read [m].
SCAN_WEIGHT = 0.15  # Weight of the scan in the pattern, per standard deviation of its grey values.
# Colours (RGB, 0 to 1).
GYRUS_COLOUR = (0.86, 0.60, 0.53)
SULCUS_COLOUR = (0.66, 0.34, 0.31)
ARTERY_COLOUR = (0.66, 0.10, 0.08)
VEIN_COLOUR = (0.31, 0.10, 0.19)


@dataclass(frozen=True)
class GyriSettings:
    """Settings of `build_cortex_maps`."""

    wavelength: float = 9.5e-3  # Distance between neighbouring sulci before they wander [m].
    meander: float = 0.7e-3  # Standard deviation of the sulci's shift by smooth noise [m].
    sulcus_depth: float = 3.4e-3  # Largest depth of a sulcus [m].
    sulcus_width: float = 0.5e-3  # Half width of a sulcus [m].
    sulcus_length: float = 16e-3  # Smallest length of a sulcus [m].
    crown_height: float = 0.9e-3  # Height of a gyrus' rounded crown [m].
    vein_radius: float = 0.65e-3  # Largest radius of a vein [m].
    vein_length: float = 12e-3  # Smallest length of a vein [m].
    artery_width: float = 0.95e-3  # Largest width of an artery [m].
    branch_width: float = 0.9e-3  # Largest width of a vein on a gyrus [m].
    roughness: float = 0.02e-3  # Standard deviation of the relief of the pia [m].


GYRI = GyriSettings()


@dataclass(frozen=True, eq=False)
class CortexMaps:
    """Maps (n, n, 4) of depth [m] and colour (RGB, 0 to 1) on a square with half side `half_width` [m]."""

    values: np.ndarray
    half_width: float

    def sample(self, site: CraniotomyFrame, points: np.ndarray) -> np.ndarray:
        """Interpolate values (m, 4) at undeformed points (m, 3) [m], projected onto the tangent plane."""
        across = np.stack([site.right, site.up]) @ (points - site.origin).T
        index = (across / self.half_width + 1.0) * 0.5 * (len(self.values) - 1)
        columns = [map_coordinates(each, index, order=1, mode="nearest") for each in np.moveaxis(self.values, 2, 0)]
        return np.stack(columns, axis=1)


@lru_cache(maxsize=2)
def build_cortex_maps(site: CraniotomyFrame, intensity: Intensity | None) -> CortexMaps:
    """Build the depth and colour maps of an open cortex; equal inputs give equal maps."""
    random = np.random.default_rng(3)
    count = COARSE_STEP * int(np.ceil(2.0 * (site.radius + MAP_MARGIN) / MAP_SPACING / COARSE_STEP))
    half = 0.5 * (count - 1) * MAP_SPACING
    here = np.stack(np.meshgrid(*[np.arange(count)] * 2, indexing="ij"))

    def smooth(length: float) -> np.ndarray:
        """Sample smooth noise (n, n) of unit standard deviation, with a length scale `length` [m]."""
        noise = gaussian_filter(random.standard_normal((count, count)), length / MAP_SPACING, mode="wrap")
        return noise / noise.std()

    def warp(image: np.ndarray, length: float, shift: float) -> np.ndarray:
        """Shift the pixels of an image (n, n) by smooth noise with length scale `length` and deviation `shift` [m]."""
        bend = np.stack([smooth(length), smooth(length)]) * shift / MAP_SPACING
        return map_coordinates(image, here + bend, order=1, mode="wrap")

    def sample_vessels(trunks: int, width: float, tortuosity: float) -> np.ndarray:
        """Sample the opacity (n, n) of branching vessels."""
        thin = replace(
            VESSELS, trunk_count=trunks, max_width=width, min_trunk_ratio=0.25, min_width=0.16e-3, turn_deviation=0.08,
            branch_probability=0.03, width_factor=0.9955, branch_width_ratio=0.62, mottle_contrast=0.0,
        )  # fmt: skip
        found = compute_vessel_absorption(np.linspace(-half, half, count), random, thin)
        return np.clip(1.5 * warp(found / thin.max_absorption, 1.6e-3, tortuosity) - 0.2, 0.0, 1.0)

    fluid = _compute_darkness(site, intensity, half, count // COARSE_STEP)
    field = _solve_swift_hohenberg(random, fluid, GYRI.wavelength / MAP_SPACING / COARSE_STEP)
    field = warp(np.asarray(zoom(field, COARSE_STEP, order=3, mode="grid-wrap", grid_mode=True)), 2.5e-3, GYRI.meander)
    field /= np.sqrt(2.0 * gaussian_filter(field**2, 0.5 * GYRI.wavelength / MAP_SPACING, mode="wrap"))
    away, strength = _find_sulci(field, GYRI.wavelength / MAP_SPACING)
    across = np.arccos(np.clip(-field, -1.0, 1.0)) / np.pi  # 0 in a sulcus, 1 on a crown
    strength *= np.clip(2.2 - 5.0 * across, 0.0, 1.0) * np.clip(0.9 + 0.2 * smooth(6e-3), 0.4, 1.0)
    away *= MAP_SPACING
    strength[_find_short_lines((strength > 0.05) & (away < 2.0 * GYRI.sulcus_width), GYRI.sulcus_length)] = 0.0
    crown = GYRI.crown_height * (1.0 - across) ** 2
    depth = crown + GYRI.sulcus_depth * strength * np.exp(-((away / GYRI.sulcus_width) ** 2))
    hollow = np.maximum(depth - 0.4 * gaussian_filter(depth, 2e-3 / MAP_SPACING), 0.0)  # ambient occlusion
    shade = 0.35 + 0.65 * np.exp(-hollow / 1.6e-3)
    depth += GYRI.roughness * smooth(0.35e-3)

    # Veins lie in some of the sulci.
    radius = GYRI.vein_radius * np.clip(0.25 + 0.6 * smooth(9e-3), 0.0, 1.0) * np.clip(3.0 * strength - 0.6, 0.0, 1.0)
    radius[_find_short_lines(away < radius, GYRI.vein_length)] = 0.0
    vein = np.clip((radius - away) / (1.5 * MAP_SPACING) + 0.5, 0.0, 1.0) * (radius > 0.15e-3)
    top = crown + 0.3e-3 - np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    depth += vein * np.minimum(top - depth, 0.0)

    artery, branch = sample_vessels(9, GYRI.artery_width, 0.6e-3), sample_vessels(4, GYRI.branch_width, 0.4e-3)
    depth = gaussian_filter(np.maximum(depth - 0.15e-3 * np.maximum(artery, branch), 0.0), 0.8)
    network = np.exp(-((smooth(0.5e-3) / 0.22) ** 2)) * np.clip(0.6 + 0.4 * smooth(4e-3), 0.0, 1.0)
    colour = GYRUS_COLOUR * (1.0 + 0.02 * smooth(5e-3) + 0.02 * smooth(0.5e-3))[..., None]
    for paint, share in (
        (SULCUS_COLOUR, 0.8 * (1.0 - across) ** 1.5), (ARTERY_COLOUR, 0.28 * network), (VEIN_COLOUR, 0.6 * branch),
        (ARTERY_COLOUR, 0.9 * artery), ((0.0, 0.0, 0.0), 1.0 - shade), (VEIN_COLOUR, 0.92 * vein),
    ):  # fmt: skip
        colour += share[..., None] * (np.array(paint) - colour)
    return CortexMaps(np.concatenate([depth[..., None], colour.clip(0.0, 1.0)], axis=2).astype(np.float32), half)


def _find_short_lines(line_mask: np.ndarray, length: float) -> np.ndarray:
    """Return the connected parts of a mask (n, n) that are shorter than `length` [m], which is estimated from area."""
    parts = np.zeros(line_mask.shape, np.int32)
    label(line_mask, output=parts)
    return line_mask & (np.bincount(parts.ravel()) < LINE_WIDTH * length / MAP_SPACING**2)[parts]


def _find_sulci(field: np.ndarray, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (n, n) from the nearest trough of a striped field [grid spacings], and its strength (n, n).

    Stripes have unit amplitude. Across a wave, slope and curvature give the phase: tan(phase) = k slope / curvature.
    """
    k, width = 2.0 * np.pi / wavelength, 0.06 * wavelength
    x, y, xx, xy, yy = (
        gaussian_filter(field, width, order=cast(Any, order), mode="wrap")
        for order in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    )
    curvature = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    slope = np.abs(x * np.cos(turn) + y * np.sin(turn))
    return np.arctan2(k * slope, curvature) / k, np.clip(1.3 * curvature / k**2, 0.0, 1.0)


def _compute_darkness(site: CraniotomyFrame, intensity: Intensity | None, half_width: float, count: int) -> np.ndarray:
    """Compute the darkness (n, n) of the scan below the surface [standard deviations]; zero without a scan."""
    if intensity is None:
        return np.zeros((count, count))
    mesh = site.anatomy.mesh
    nodes = mesh.nodes[np.unique(mesh.surface)] - site.origin
    nodes = nodes[np.linalg.norm(nodes, axis=1) < 2.0 * half_width]
    x, y = np.meshgrid(*[np.linspace(-half_width, half_width, count)] * 2, indexing="ij")
    depth = griddata(np.stack([nodes @ site.right, nodes @ site.up], axis=1), nodes @ site.axis, (x, y), fill_value=0.0)
    grey, T = intensity.apply_window(mesh), np.linalg.inv(intensity.affine)
    total = np.zeros((count, count))
    for below in SCAN_DEPTHS:
        at = site.origin + np.stack([x, y, depth + below], axis=-1) @ np.stack([site.right, site.up, site.axis])
        total -= map_coordinates(grey, np.moveaxis(at @ T[:3, :3].T + T[:3, 3], -1, 0), order=1, mode="nearest")
    total -= gaussian_filter(total, 0.1 * count)
    return total / max(float(total.std()), 1e-3)


def _solve_swift_hohenberg(random: np.random.Generator, fluid: np.ndarray, wavelength: float) -> np.ndarray:
    """Compute a striped field (n, n) of a wavelength [grid spacings] from noise; `fluid` (n, n) attracts troughs."""
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(len(fluid)), np.fft.rfftfreq(len(fluid)), indexing="ij")) * wavelength
    implicit = 1.0 / (1.0 - TIME_STEP * (GROWTH - (1.0 - k**2) ** 2))
    field = 0.3 * random.standard_normal(fluid.shape)
    for _ in range(STEPS):
        now = np.fft.rfft2(field - TIME_STEP * (field**3 + SCAN_WEIGHT * fluid))
        field = np.fft.irfft2(implicit * now, fluid.shape)
    return field
