"""A prediction inside an OpenCV program: the tumour's outline in a camera's picture.

Your program brings a picture and a calibrated camera in the scan's frame. The model that ships says where the tumour's
vertices are under a load, and `Camera.project` says where they are in the picture; the rest is OpenCV.
"""

import cv2
import numpy as np

from ar import Camera, look_at
from scenes import open_theatre
from sim import open_cortex, push

GREY, GREEN = (160, 160, 160), (80, 220, 80)

theatre = open_theatre(device="cpu")
anatomy, cortex = theatre.anatomy, open_cortex(theatre.anatomy)
place = cortex.place(right_mm=0, up_mm=0)
# Yours: K of cv2.calibrateCamera, the pose of cv2.solvePnP. Here the camera looks from the side, 20 cm away.
K = np.array([[2000.0, 0.0, 319.5], [0.0, 2000.0, 239.5], [0.0, 0.0, 1.0]])
target = cortex.origin + 0.015 * cortex.axis
eye = target - 0.14 * cortex.axis - 0.14 * cortex.up
camera = Camera(K, look_at(eye, target, cortex.up).T_camera_world, width=640, height=480)
picture = np.full((480, 640, 3), 90, np.uint8)  # as cv2.VideoCapture reads it: BGR


def compute_silhouette(vertices: np.ndarray) -> np.ndarray:
    """Mask (480, 640) of the tumour's surface with vertices (V, 3) [m]."""
    pixels, _ = camera.project(vertices)
    mask = np.zeros(picture.shape[:2], np.uint8)
    for triangle in np.rint(pixels[anatomy.tumour_surface]).astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, 255)
    return mask


model = theatre.models["series-gp"]
answer = model.deform(push(place.point, 0.3 * place.inward, footprint=7e-3), at=anatomy.tumour_nodes)
scan, now = anatomy.mesh.nodes, anatomy.mesh.nodes.copy()
now[answer.nodes] += answer.displacement[0]
for vertices, colour in ((scan, GREY), (now, GREEN)):
    outline, _ = cv2.findContours(compute_silhouette(vertices), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, colour, 1, cv2.LINE_AA)
cv2.imwrite("tumour.png", picture)

middles = [np.argwhere(compute_silhouette(vertices))[:, ::-1].mean(axis=0) for vertices in (scan, now)]
moved = float(np.linalg.norm(middles[1] - middles[0]))
print(f"the outline moves {moved:.1f} pixels; {answer.outcome[0].value}")
assert 4.0 < moved < 6.0
