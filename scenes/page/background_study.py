"""Background computations of a page that report their progress: costs of the effects, and the refined error."""

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from html import escape
from typing import Any

from ar.page.browser import Browser
from sim.errors import InputError

from ..play.deformers import PatientSetup
from ..script.scene import Scene
from .controls import REFINED_ERROR
from .effect_costs import EFFECT_COSTS, measure_costs
from .error_refinement import refine_error
from .requests import Requests


class BackgroundStudy:
    """Thread that runs `task` at each start; `show` receives each result of the task, or its failure as HTML."""

    def __init__(self, task: Callable[[], Iterator[Any]], lock: threading.Lock, show: Callable[[Any], None]) -> None:
        """Prepare the study. While the study runs, it keeps `lock`, so that no other solver is built."""
        self.work, self.lock, self.show = task, lock, show
        self.closed, self.thread = threading.Event(), threading.Thread()

    def start(self) -> None:
        """Start the study unless it is running."""
        if not self.thread.is_alive():
            self.thread = threading.Thread(target=self._run, name="study", daemon=True)
            self.thread.start()

    def close(self) -> None:
        """Stop the study after its current step, without waiting."""
        self.closed.set()

    def _run(self) -> None:
        try:
            with self.lock:
                for result in self.work():
                    if self.closed.is_set():
                        return
                    self.show(result)
        except InputError as error:
            if not self.closed.is_set():
                self.show(f'<p class="warn">{escape(str(error))}</p>')


def build_studies(
    patient: PatientSetup, scene: Scene, requests: Requests, lock: threading.Lock, get_browser: Callable[[], Browser]
) -> tuple[BackgroundStudy, ...]:
    """Build two studies, the costs of a scene's effects and the refined error of the requested load, for a page."""

    def start_refinement() -> Iterator[str]:
        number, _, touch, _ = requests.read_current()
        time = float(scene.times[number])
        registered_scene = replace(scene, registration=requests.registration or scene.registration)
        return refine_error(patient, registered_scene, touch or scene.path(time), time)

    def show_costs(texts: Mapping[str, str] | str) -> None:
        for label, text in ({EFFECT_COSTS: texts} if isinstance(texts, str) else texts).items():
            (get_browser().write if label == EFFECT_COSTS else get_browser().rename)(label, text)

    return (
        BackgroundStudy(lambda: measure_costs(patient, scene), lock, show_costs),
        BackgroundStudy(start_refinement, lock, lambda texts: get_browser().write(REFINED_ERROR, texts)),
    )
