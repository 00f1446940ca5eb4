"""3-D view of a page: surfaces, light, labels, camera, and the panel next to the view."""

from collections.abc import Sequence

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from .parts import SceneImage, SceneLabel, SceneSurface, SceneViewpoint

PANEL_WIDTH = 676.0  # Width of the docked panel in browsers that do not support the page's rules [CSS pixel].


def fill_scene(server: viser.ViserServer, viewpoint: SceneViewpoint, labels: Sequence[SceneLabel | SceneImage]) -> None:
    """Set up the 3-D view: theme, panel, lights, labels and images, and the initial viewpoint."""
    gui, scene = server.gui, server.scene
    gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
    gui.main_panel.dock_left()
    gui.main_panel.set_width(PANEL_WIDTH)
    # Two soft lights from both sides of the initial viewpoint, as viser's four default lights make colours pale.
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/light/ambient", intensity=0.8)
    across = np.cross(np.asarray(viewpoint.target) - viewpoint.eye, viewpoint.up)
    for name, side, strength in (("left", -1.0, 1.8), ("right", 1.0, 0.6)):
        place = np.asarray(viewpoint.eye) + side * across / np.linalg.norm(across)
        scene.add_light_directional(f"/light/{name}", intensity=strength, position=tuple(place))
    for sign in labels:
        if isinstance(sign, SceneLabel):
            scene.add_label(f"/sign/{sign.text}", sign.text, position=np.asarray(sign.position), anchor="center-center")
            continue
        sides = [float(np.linalg.norm(edge)) for edge in (sign.right, sign.down)]
        x, y = sign.right / sides[0], sign.down / sides[1]
        turn = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1)).as_quat(scalar_first=True)
        scene.add_image(f"/{sign.name}", sign.image, *sides, format="png", wxyz=turn, position=sign.centre)
    start = server.initial_camera
    start.position, start.look_at = tuple(viewpoint.eye), tuple(viewpoint.target)
    start.up, start.fov = tuple(viewpoint.up), viewpoint.fov


def add_surface(server: viser.ViserServer, surface: SceneSurface) -> viser.MeshHandle:
    """Add a surface to the 3-D view; return its handle."""
    return server.scene.add_mesh_simple(
        f"/{surface.name}",
        np.asarray(surface.vertices, np.float32),
        np.asarray(surface.triangles, np.uint32),
        color=np.asarray(surface.colour, np.float64),
        opacity=None if surface.opacity >= 1.0 else surface.opacity,
        wireframe=surface.wireframe,
        side=surface.side,
        cast_shadow=False,
        receive_shadow=False,
    )
