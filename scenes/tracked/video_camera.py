"""Check that a video was recorded by the calibrated camera."""

from itertools import islice
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.focal_fit import fit_focal_length
from ar.tracking.image_sequences import REMEDY, read_video
from ar.tracking.pose import check_image_size
from ar.tracking.targets import Detector, list_targets
from sim.errors import InputError
from sim.runtime.outside_files import wrap_errors

FIRST_IMAGES = 120  # Number of first images of a video among which some are examined.
IMAGE_STRIDE = 10  # Stride of the examined images.


def check_video(path: Path, frame_rate: float, calibration: Calibration, camera: str) -> None:
    """Check in its first images that a video is valid and was recorded by the calibrated camera.

    The focal length is checked only if markers are visible.

    Parameters
    ----------
    path, frame_rate
        Video, or folder of images with this frame rate [1/s].
    camera
        Name of the calibration file, for messages.

    Raises
    ------
    InputError
        The video is missing or unreadable, its images do not have the size of the calibration, or the focal length has
        a significant error of more than 5 %.
    """
    targets = {target.name: target for target in list_targets()}
    detector, seen, count = Detector(tuple(targets.values())), [], 0
    with wrap_errors(path, "a video", REMEDY):
        try:
            for picture in islice(read_video(path, frame_rate), 0, FIRST_IMAGES, IMAGE_STRIDE):
                check_image_size(picture.grey, calibration.width, calibration.height)
                seen += [(targets[name], corners) for name, corners in detector.detect(picture.grey).items()]
                count += 1
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{path}: holds no image. {REMEDY}")
    fit = fit_focal_length(calibration.build_camera(np.eye(4)), seen)
    if fit is not None and fit.is_significant:
        way = "longer" if fit.factor > 1.0 else "shorter"
        raise InputError(
            f"{path}: its markers are seen with focal lengths that are {abs(fit.factor - 1.0):.0%} {way} "
            f"(+- {fit.deviation:.1%}) than {camera} states. It is of another camera or zoom: calibrate this one by "
            "`sulcus calibrate`."
        )
