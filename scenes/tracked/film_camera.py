"""Whether a film is of the camera that is stated."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.focal_fit import focal_fit
from ar.tracking.pictures import GIVE, film_of
from ar.tracking.pose import demand_picture
from ar.tracking.targets import Detector, all_targets
from sim.errors import InputError
from sim.runtime.outside_files import read_as

# Of the first pictures of a film one in so many is looked at.
LOOKED, EACH = 120, 10


def demand_film(film: Path, rate: float, calibration: Calibration, camera: str) -> None:
    """Refuse what is no film, or one of another camera, by its first pictures: before anything that takes long.

    Without markers nothing is known of its focal length.

    Parameters
    ----------
    film, rate
        A video, or a folder of pictures with so many a second.
    camera
        Name of the calibration's file.

    Raises
    ------
    InputError
        No such film, none that can be read, pictures of another size than the camera's, and focal lengths that are
        surely off by more than 5 %.
    """
    targets = {target.name: target for target in all_targets()}
    detector, seen, count = Detector(tuple(targets.values())), [], 0
    with read_as(film, "a film", GIVE):
        try:
            for picture in islice(film_of(film, rate), 0, LOOKED, EACH):
                demand_picture(picture.grey, calibration.width, calibration.height)
                seen += [(targets[name], corners) for name, corners in detector.seen(picture.grey).items()]
                count += 1
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{film}: holds no picture. {GIVE}")
    fit = focal_fit(calibration.camera(np.eye(4)), seen)
    if fit is not None and fit.differs:
        way = "longer" if fit.factor > 1.0 else "shorter"
        raise InputError(
            f"{film}: its markers are seen with focal lengths that are {abs(fit.factor - 1.0):.0%} {way} "
            f"(+- {fit.deviation:.1%}) than {camera} states. It is of another camera or zoom: calibrate this one by "
            "`sulcus calibrate`."
        )
