"""One row of the report, measured in a process of its own: what it takes of memory is its own too."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.device import find_device
from sim.runtime.threads import one_thread

from ..analysis.process_memory import peak_memory, watched_card
from .finite_elements import Elements, measure_elements
from .learner import Learner, measure_learner
from .row import Row
from .study import Study

Spec = Elements | Learner
FAMILY = {Elements: "finite elements", Learner: "learnt"}


def ready(device: str, study: Study) -> Study:
    """Import all that rows need, and start Warp without its notes; on a card also PyTorch, and what draws."""
    find_device("auto", "float32")
    if study.on_card:
        for name in ("torch", "scenes.report.picture"):
            import_module(name)
    return study


def measured(study: Study, spec: Spec, picture: Path) -> Row:
    """The row of a deformer, and the picture of its worst case; what cannot be had says why in `Row.state`."""
    try:
        if isinstance(spec, Elements):
            with watched_card(study.device) as taken:
                row, field = measure_elements(study, spec)
            row = replace(row, card=max(taken) / 2**30 or None)
        else:
            row, field = _on_one_core(study, spec)
    except InputError as error:
        return Row(spec.name, FAMILY[type(spec)], state=str(error))
    row = replace(row, memory=peak_memory())
    # What pictures take is not the row's.
    from ar.screen import write_png

    from .picture import worst_picture

    picture.parent.mkdir(parents=True, exist_ok=True)
    write_png(picture, worst_picture(study, field))
    return replace(row, picture=picture.name)


def _on_one_core(study: Study, spec: Learner) -> tuple[Row, np.ndarray]:
    """Products this small take longer on several, and say less."""
    with one_thread():
        return measure_learner(study, spec)
