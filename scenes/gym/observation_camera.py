"""Colour and depth images of environments; images with the same resection cavity are rendered in one batch."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ar.optics.camera import Camera
from ar.rendering.renderer import Renderer

from .setting import TaskSetting
from .tissue_requests import Response

Seen = tuple[Response, np.ndarray, int]
"""Rendered state: response of the tissue, T_world_tool (4, 4), and number of completed resection steps."""


class ObservationCamera:
    """Renderer of the camera images of a task on a body."""

    def __init__(self, setting: TaskSetting):
        self.setting = setting
        self._renderers: dict[int, Renderer] = {}

    @cached_property
    def camera(self) -> Camera:
        """Static camera of the setting."""
        return self.setting.scene.viewpoint.build_camera(self.setting.site)

    def render(self, views: Sequence[Seen]) -> tuple[np.ndarray, np.ndarray]:
        """Render states; return colours (B, H, W, 3) uint8 and depths (B, H, W) float32 [m], 0 in the background."""
        shape = len(views), self.camera.height, self.camera.width
        colour, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
        for done in sorted({each[2] for each in views}):
            rows = [row for row, each in enumerate(views) if each[2] == done]
            stage = self.setting.get_stage(done)
            scenes = [
                stage.build_layers(self._compute_positions(touched), pose)
                for touched, pose, _ in (views[row] for row in rows)
            ]
            if done not in self._renderers:
                self._renderers[done] = Renderer(scenes[0], stage.lamp, stage.device)
            moved = [np.concatenate([each.vertices for each in layers if not each.still]) for layers in scenes]
            pictures = self._renderers[done].render_batch(np.stack(moved), [self.camera])
            colour[rows], depth[rows] = pictures.colour.numpy(), pictures.depth.numpy()
        return colour, depth

    def _compute_positions(self, response: Response) -> np.ndarray:
        positions = self.setting.site.anatomy.mesh.nodes.copy()
        positions[response.nodes] += response.motion
        return positions
