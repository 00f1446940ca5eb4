"""Whether a film is of the camera that is stated."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.detection import Detector
from ar.tracking.focal_fit import focal_fit
from ar.tracking.pictures import film_of
from ar.tracking.targets import all_targets
from sim.errors import InputError

# Of the first pictures of a film one in so many is looked at.
LOOKED, EACH = 120, 10


def demand_focal_length(film: Path, rate: float, calibration: Calibration, camera: str) -> None:
    """Refuse a camera whose focal lengths no pose of the film's markers fits; without markers nothing is known.

    Parameters
    ----------
    film, rate
        Readable, of the calibration's size; pictures a second of a folder.
    camera
        Name of its file.

    Raises
    ------
    InputError
        Focal lengths that are surely off by more than 5 %.
    """
    targets = {target.name: target for target in all_targets()}
    detector = Detector(tuple(targets.values()))
    seen = [
        (targets[name], corners)
        for picture in islice(film_of(film, rate), 0, LOOKED, EACH)
        for name, corners in detector.seen(picture.grey).items()
    ]
    fit = focal_fit(calibration.camera(np.eye(4)), seen)
    if fit is not None and fit.differs:
        way = "longer" if fit.factor > 1.0 else "shorter"
        raise InputError(
            f"{camera}: the markers in {film} are seen with focal lengths that are {abs(fit.factor - 1.0):.0%} {way} "
            f"(+- {fit.deviation:.1%}). It is of another camera or zoom: calibrate this one by `sulcus calibrate`."
        )
