"""The camera's view of a row's worst case: the tumour as predicted, and where the reference has it."""

from dataclasses import replace

import numpy as np

from ar.optics.camera import look_at
from ar.overlay.composite import MARGIN_STROKES, composite
from ar.overlay.hud import draw_text_panel
from ar.overlay.marks import Cover
from ar.overlay.outlines import compute_silhouette, draw_dashes, find_outlines
from sim.bodies.intensity import read_intensity, to_intensity_path
from sim.geometry.first_contact import find_resting_tip
from sim.loads import Pushed

from ..play.stage import TOOL, Stage
from ..script.craniotomy_frame import CraniotomyFrame, build_craniotomy_frame
from ..script.scene import find_scene
from ..script.shipped_files import get_template_path
from ..script.tool import Probe
from ..script.viewpoint import OBLIQUE_VIEWPOINT
from .reference import get_reference
from .study import ReportStudy

FIELD = float(np.radians(9.0))  # Field of view so narrow that a pixel is a tenth of a millimetre [rad].
VIEW = replace(OBLIQUE_VIEWPOINT, fov=FIELD, width=400, height=300)
YELLOW = (255, 215, 50)  # Colour of the reference's outline (RGB).


def render_worst(study: ReportStudy, result: np.ndarray) -> np.ndarray:
    """Render the test load with the largest error, (H, W, 3) uint8.

    `result` (n, k, 3) [m]: displacements of the tumour's vertices by a row.
    """
    truth, anatomy = get_reference(study), study.anatomy
    tumour = np.isin(study.drawn, anatomy.tumour_nodes)
    distance = np.linalg.norm(result - truth.displacement[:, tumour], axis=2).max(axis=1) * truth.good
    worst = int(distance.argmax())
    there = anatomy.mesh.nodes.copy()
    there[study.drawn] += truth.displacement[worst]
    predicted = there.copy()
    predicted[anatomy.tumour_nodes] = anatomy.mesh.nodes[anatomy.tumour_nodes] + result[worst]
    (pushed,) = study.played.get_all(Pushed)
    site = build_craniotomy_frame(anatomy)
    scan = read_intensity(to_intensity_path(get_template_path())) if study.of_template else None
    middle = there[anatomy.tumour_nodes].mean(axis=0)
    camera = look_at(VIEW.build_camera(site).centre, middle, site.up, FIELD, VIEW.width, VIEW.height)
    radius = float(pushed.footprint[worst])
    tip = find_rested_tip(site, pushed.point[worst], there, radius)
    tool = Probe(radius)
    stage = Stage(replace(find_scene("press"), viewpoint=VIEW, tool=tool), site, scan)
    picture = stage.render(camera, there, tool.pose(tip, site.axis, site.right))
    shown = composite(picture, camera, stage.build_tumour(predicted), style="window", cover=Cover((TOOL,))).colour
    reference = stage.build_tumour(there)
    draw_dashes(
        shown,
        find_outlines(compute_silhouette(camera, reference.vertices, reference.triangles)),
        YELLOW,
        MARGIN_STROKES,
        1,
    )
    force = float(np.linalg.norm(pushed.force[worst]))
    lines = [f"{force:.2f} N on {1e3 * radius:.1f} mm", f"maximum error {1e3 * distance[worst]:.3f} mm"]
    return draw_text_panel(shown, lines)


def find_rested_tip(site: CraniotomyFrame, point: np.ndarray, positions: np.ndarray, radius: float) -> np.ndarray:
    """Return the tip (3,) [m] of a ball that pushes at a point: it touches the deformed cortex, and pierces it nowhere.

    point (3,): at rest [m]; positions (V, 3): of all mesh vertices now [m]; radius of the ball [m].
    """
    place = point - site.origin
    carried = site.find_contact(float(place @ site.right), float(place @ site.up), radius).locate(positions)
    return find_resting_tip(positions, site.anatomy.open_surface, carried, site.axis, radius)
