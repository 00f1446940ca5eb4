"""Times of a frame of the page by stage: load, deform, render, composite, encode, send."""

import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from ar.page.browser import Browser
from ar.page.elements import to_data_url
from ar.page.parts import Playback, SceneSurface, SceneViewpoint
from ar.rendering.renderer import Renderer
from scenes.page.demo import render_page_image
from scenes.play.player import Player
from scenes.play.stage import CORTEX_COLOUR, TUMOUR_COLOUR
from sim.errors import InputError

STAGES = ("load", "deform", "render", "composite", "encode", "send")
# Warm-up frames, not timed: kernels are loaded, and fixed layers are drawn.
WARM_UP = 10


@dataclass(frozen=True)
class StageTime:
    """Time of a stage over all frames [ms]: median, 95th percentile and mean."""

    stage: str
    frames: int
    median: float
    p95: float
    mean: float


def parse_image_size(text: str) -> tuple[int, int]:
    """Parse width and height [pixel] from a text such as 640x480.

    Raises
    ------
    InputError
        Another text, or an image side outside 16 to 8,192 pixels.
    """
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 16 <= int(part) <= 8192 for part in parts):
        raise InputError(f"--size {text} is no size: give WIDTHxHEIGHT such as 640x480, each from 16 to 8192.")
    return int(parts[0]), int(parts[1])


def time_frames(player: Player, count: int) -> Iterator[tuple[float, ...]]:
    """Yield the times [s] of `STAGES`, frame by frame: the scene is played in order, repeatedly.

    The page is open on this machine only, without clients.
    """
    page, last = open_page(player), None
    try:
        for done in range(-WARM_UP, count):
            number = (done + WARM_UP) % len(player.scene.times)
            begun = clock.perf_counter()
            touch = player.get_touch(number)
            loads = player.build_loads(number, touch)
            loaded = clock.perf_counter()
            last = player.compute_deformation(loads, last)
            deformed = clock.perf_counter()
            frame = player.draw_frame(number, touch, loads, last, deformed - loaded)
            picture = render_page_image(frame)
            drawn = clock.perf_counter()
            code = to_data_url(picture)
            encoded = clock.perf_counter()
            positions = player.compute_positions(last)
            stage = player.stage.select_stage(loads)
            for layer in (stage.build_visible_cortex(positions), stage.build_tumour(positions)):
                page.move(layer.name, layer.vertices, layer.triangles)
            page.send_image_element(code, f"frame {number}")
            sent = clock.perf_counter()
            if done >= 0:
                rendered = frame.seconds["render"]
                yield (
                    loaded - begun, deformed - loaded, rendered, drawn - deformed - rendered, encoded - drawn,
                    sent - encoded,
                )  # fmt: skip
    finally:
        page.close()


def measure_batch_rate(player: Player, count: int, duration: float = 2.0) -> float:
    """Measure images per second, rendered in one batch with a separate camera each: colour, depth, segmentation.

    Vertices are copied from the host; images stay on the device.
    """
    stage, scene = player.stage, player.scene
    scenes = []
    for number in np.linspace(0, len(scene.times) - 1, count).astype(int).tolist():
        touch = player.get_touch(number)
        positions = player.compute_positions(player.compute_deformation(player.build_loads(number, touch)))
        held = None if scene.tool is None else player.place_tool(scene.tool, touch, positions)
        scenes.append(stage.build_layers(positions, None if held is None else held.pose))
    moved = np.stack([np.concatenate([layer.vertices for layer in each if not layer.still]) for each in scenes])
    # Cameras within half a degree of each other.
    cameras = [player.camera.perturb(0.5 * (row - 0.5 * count) / count) for row in range(count)]
    renderer = Renderer(scenes[0], stage.lamp, stage.device)
    renderer.render_batch(moved, cameras)
    wp.synchronize()
    done, begun = 0, clock.perf_counter()
    while clock.perf_counter() - begun < duration:
        renderer.render_batch(moved, cameras)
        wp.synchronize()
        done += count
    return done / (clock.perf_counter() - begun)


def open_page(player: Player) -> Browser:
    """Open a page with the scene's moving bodies, on this machine only."""
    positions, site = player.site.anatomy.mesh.nodes, player.site
    bodies = [
        SceneSurface(layer.name, layer.vertices, layer.triangles, colour)
        for layer, colour in (
            (player.stage.build_visible_cortex(positions), CORTEX_COLOUR),
            (player.stage.build_tumour(positions), TUMOUR_COLOUR),
        )
    ]
    view = SceneViewpoint(site.origin - 0.1 * site.axis, site.origin, site.up)
    return Browser(bodies, view, Playback(2, lambda playing: None, lambda number: None))


def summarise_stages(seconds: Sequence[tuple[float, ...]]) -> list[StageTime]:
    """Summarise the times of `STAGES` and of the whole frame; `seconds` has a row for each frame."""
    each = 1e3 * np.array(seconds)
    columns = dict(zip(STAGES, each.T, strict=True)) | {"frame": each.sum(axis=1)}
    return [
        StageTime(stage, len(each), float(np.median(spent)), float(np.percentile(spent, 95.0)), float(spent.mean()))
        for stage, spent in columns.items()
    ]
