"""Main loop of the demo page: scripted or manual tool, any deformer, and comparison with FEM in the background."""

import sys
import threading
import time as clock
import traceback
from collections.abc import Callable
from dataclasses import replace
from html import escape

from ar.overlay.styles import Style
from ar.page.browser import Browser
from ar.page.history import History
from ar.page.parts import Playback
from sim.errors import InputError
from sim.loads import Loads
from sim.runtime.threads import run_in_foreground
from surrogate.data.dataset import compute_loads_digest

from ..play.deformers import PatientSetup, RestDeformer
from ..play.player import Frame, Player
from ..play.stage import Stage
from ..play.waiting_notice import WaitingNotice
from ..script.scene import Scene, find_scene
from ..script.tool_paths import Touch
from .background_study import build_studies
from .comparison import (
    FEM_REFERENCE,
    FEM_SHOWN,
    MIN_COMPARED_MOTION,
    AccuracyTimeTable,
    PageState,
    compare_with_fem,
    describe_change,
    format_comparison,
)
from .controls import PLAN, build_controls, is_animated, to_slider_values
from .effect_costs import build_effect_switches
from .fem_worker import COMPARISON_REST, FemResult, FemWorker
from .requests import HAND, SCRIPT, Display, Requests, describe_tool_control
from .scene_solvers import SceneSolvers
from .side_panels import build_history_sample, list_plot_lines, render_slices
from .text import describe_effect, describe_solve, format_caption, format_pending, format_report, format_solver_list
from .view import (
    FEM_COLOUR,
    STALE_COLOUR,
    build_page_bodies,
    build_static_bodies,
    choose_viewpoint,
    move_bodies,
    move_fem_tumour,
    render_page_image,
)

WAITING_TEXT = "The finite elements are working on this load."  # Text while FEM solves.
UNDEFORMED_TEXT = '<p class="stale">The undeformed body, as in the scan. The first result is being computed.</p>'
MIN_REST = 0.007  # Shortest pause after an image, for FEM in the background [s].
MESSAGE_TIME = 2.0  # Time for which a playing page shows why a frame is skipped [s].


class Demo:
    """Page that plays a scene with `run`; users can select another built-in scene."""

    def __init__(
        self,
        patient: PatientSetup,
        scene: Scene,
        deformer: str,
        host: str,
        port: int,
        anatomy: str = "the default",
        get_scene: Callable[[str], Scene] = find_scene,
        style: Style = "window",
        origins: tuple[str, ...] = (),
    ) -> None:
        """Open the page at `host` and `port`; `anatomy` describes the brain, and `get_scene` finds a scene by name."""
        self.patient, self.anatomy, self.first, self.find = patient, anatomy, scene, get_scene
        self.build_lock = threading.Lock()
        self._set_scene(scene, deformer)
        self.wish.set(style=style)
        size, site = (scene.viewpoint.width, scene.viewpoint.height), patient.site
        parts = self._build_contents(deformer)
        self.browser = Browser(
            parts[0], choose_viewpoint(site), *parts[1:],
            host=host, port=port, size=size, signs=build_static_bodies(self.stage), origins=origins,
        )  # fmt: skip
        self.busy = WaitingNotice(lambda line: self.browser.show_status(escape(line)))
        self.dismissed: list[FemWorker] = []
        self.asked, self.drawn = self.wish.read_current(), 0

    def run(self, seconds: float = float("inf")) -> int:
        """Play for `seconds` and return the number of drawn frames. The page reports a failed frame, and skips it.

        Raises
        ------
        InputError
            The FEM solver of the first scene cannot be built, and no other deformer was requested.
        """
        self.drawn, end = 0, clock.perf_counter() + seconds
        while (remaining := end - clock.perf_counter()) > 0.0:
            try:
                self._run(remaining)
            except Exception as error:
                if isinstance(error, InputError) and not self.cast.playable:
                    raise
                self._report_skipped_frame(error, end)
        return self.drawn

    def _report_skipped_frame(self, error: Exception, end: float) -> None:
        """Show why a frame is skipped, until a user requests another frame or `MESSAGE_TIME` is over; then resume."""
        self.busy.end_work()
        message = str(error)
        if not isinstance(error, InputError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            message = f"a defect: {type(error).__name__}, {error}"
            print(f"sulcus demo: {message} (line {place.lineno} of {place.filename})", file=sys.stderr)
        self.browser.report(f'<p class="warn">error: this frame is left out ({escape(message)})</p>')
        self._show_tool_holder()
        deadline = min(end, clock.perf_counter() + MESSAGE_TIME)
        while self.wish.read_current() == self.asked and self.wish.scene == self.stage.scene.name:
            if clock.perf_counter() >= (deadline if self.wish.plays else end):
                break
            clock.sleep(1.0 / self.stage.scene.frames_per_second)
        self.wish.step_playback(self.asked[0], len(self.stage.scene.times))

    def _run(self, seconds: float) -> None:
        """Play for `seconds`, or until an exception is raised."""
        state, end = PageState(), clock.perf_counter() + seconds
        while clock.perf_counter() < end:
            start = clock.perf_counter()
            if self.wish.scene != self.stage.scene.name:
                self._change_scene(self.wish.scene)
                state = PageState()
            self.drawn += self.update_page(state)
            self.browser.show_playback(self.wish.plays)
            self._show_tool_holder()
            if state.frame is None:
                continue
            self._update_comparison(state)
            pause = 1.0 / self.stage.scene.frames_per_second - (clock.perf_counter() - start)
            clock.sleep(max(MIN_REST, pause))

    def _show_tool_holder(self) -> None:
        """Show on the page of each user which user controls the tool."""
        tool, holder, connected = self.stage.scene.tool, self.wish.holder, self.browser.here
        self.browser.show_line(lambda client: "" if tool is None else describe_tool_control(client, holder, connected))

    def close(self) -> None:
        """Stop the page, its background studies and the FEM threads."""
        self.busy.close()
        for study in self.studies:
            study.close()
        self.browser.close()
        for solver in (*self.cast.solvers.values(), *self.dismissed):
            solver.close()

    @property
    def stage(self) -> Stage:
        """Rendered parts of the scene, with all effects."""
        return self.cast.get_stage()

    @property
    def fem_worker(self) -> FemWorker:
        """FEM worker that solves with all effects; its solution is the reference for the models."""
        return self.cast.get_worker()

    def _set_scene(self, scene: Scene, deformer: str) -> None:
        """Set the scene and the deformer, with new solvers, requests and recorded values."""
        self.cast, self.tally = SceneSolvers(self.patient, scene, deformer, self.build_lock), AccuracyTimeTable()
        self.history = History(list_plot_lines(scene))
        # Number of the shown frame.
        self.reached: int | None = None
        self.wish = Requests(deformer, scene.path(0.0), scene.name, clocked=is_animated(scene, self.patient.site))
        self.studies = build_studies(self.patient, scene, self.wish, self.build_lock, lambda: self.browser)  # not open

    def _change_scene(self, name: str) -> None:
        """Play the scene `name`; if this anatomy does not support it, keep the current scene and show the reason."""
        previous = self.cast, self.tally, self.wish, self.history, self.studies
        self.busy.begin_work(f"preparing the scene {name}")
        try:
            scene = self.first if name == self.first.name else self.find(name)
            deformer = self.patient.select_default(scene)
            self._set_scene(scene, deformer)
            look = previous[2].display
            self.wish.set(style=look.style, path=look.path, through=look.through, registration=look.registration)
            parts = self._build_contents(deformer)
        except InputError as error:
            self.cast, self.tally, self.wish, self.history, self.studies = previous
            self.wish.set(scene=self.stage.scene.name)
            self.browser.put("scene", self.stage.scene.name)
            self.browser.report(f'<p class="warn">{escape(str(error))}</p>')
            return
        finally:
            self.busy.end_work()
        for study in previous[4]:
            study.close()
        self.browser.fill(*parts)
        self.dismissed = [solver for solver in self.dismissed if solver.thread.is_alive()] + previous[0].stop_soon()

    def update_page(self, state: PageState) -> int:
        """Perform one step of the page towards the requested state; return the number of rendered frames, 0 or 1."""
        self.asked = self.wish.read_current()
        if self.asked == state.request:
            self._mark_shown()
        elif (solution := self._find_result(state)) is not None:
            with run_in_foreground():
                self._draw(state, solution)
            return 1
        if state.frame is not None and (self.wish.display != state.look or (state.coarse and state.is_still)):
            self._draw_in_style(state)
        return 0

    def _mark_shown(self) -> None:
        """Mark the request as shown: clear the notice, withdraw pending solves, and advance the playback."""
        self.busy.end_work()
        self.cast.stop_all()
        self.wish.step_playback(self.asked[0], len(self.stage.scene.times))

    def _find_result(self, state: PageState) -> FemResult | None:
        """Return the solution of the requested frame or of a frame in between; None while no solution is available."""
        number, name, touch, disabled = self.asked
        request, scene = (number, touch), self.stage.scene
        if name != "fem" and not disabled:  # no model was trained with effects disabled
            self.busy.begin_work(describe_solve(scene, name, *request))
            return self.cast.predict(name, request)
        if (solution := self.cast.solve(disabled, request, state.shown, 0.0)) is not None:
            return solution
        if self.cast.get_worker(disabled).player is None:
            self.busy.begin_work("preparing the finite elements")
            if state.frame is None and not state.shows_undeformed:
                self._show_undeformed(state)
        elif state.goal == self.asked and state.frame is not None:
            self.busy.begin_work(f"on the way to frame {number}: frame {state.frame.number} is solved")
        else:
            self.busy.begin_work(describe_solve(scene, "fem", *request))
        return self.cast.solve(disabled, request, state.shown, 1.0 / scene.frames_per_second)

    def _show_undeformed(self, state: PageState) -> None:
        """Show the undeformed brain while no solution is available."""
        number, _, touch, _ = self.asked
        stage = replace(self.stage, observer=None)  # no ground truth is available yet
        player = Player(stage, RestDeformer(stage.site.anatomy), self.wish.style)
        frame = player.draw(number, float(self.stage.scene.times[number]), touch or player.get_touch(number))
        move_bodies(self.browser, frame, player)
        self.browser.show(number, render_page_image(frame), UNDEFORMED_TEXT)
        self._show_side_panels(frame, player)
        state.shows_undeformed = True

    def _draw(self, state: PageState, solution: FemResult) -> None:
        """Draw a solution on the page, and request the FEM solution for comparison unless FEM computed the solution."""
        number, name, touch, disabled = self.asked
        look = self.wish.display
        player = replace(self._get_player(self.asked, look), coarse=state.choose_resolution())
        tool_touch = touch or player.get_touch(solution.number)
        self.reached, state.goal, state.request = solution.number, self.asked, (solution.number, name, touch, disabled)
        state.look, state.shown, state.shown_fem = look, solution, None
        state.load = compute_loads_digest(self._build_loads(solution.number, touch) if disabled else solution.loads)
        frame = player.draw_frame(solution.number, tool_touch, solution.loads, solution.deformation, solution.seconds)
        state.frame = frame
        state.record_rendering(frame.seconds["render"])
        self.history.add(build_history_sample(frame, self.stage.scene, clock.monotonic()))
        if solution.number == number:
            self._mark_shown()
        if name == "fem" and not disabled:
            state.shown_fem = solution
        elif solution.number == number:
            self.fem_worker.request_frame(number, touch, COMPARISON_REST if self.wish.plays else 0.0)
        if not disabled:
            self.tally.record_time(name, state.load, solution.deformation.cost.total)
        state.image = render_page_image(frame)
        move_bodies(self.browser, frame, player)
        self._show_side_panels(frame, player)
        if touch is None:
            self._show_touch(tool_touch, lambda: self.wish.tool == SCRIPT)

    def _show_touch(self, touch: Touch, condition: Callable[[], bool]) -> None:
        """Set the tool's sliders to the values of `touch`, from which manual control starts, if `condition` is true."""
        if self.stage.scene.tool is not None:
            for label, value in to_slider_values(self.stage.scene, touch).items():
                self.browser.put(label, value, condition)

    def _draw_in_style(self, state: PageState) -> None:
        """Render the shown solution again with the current display settings."""
        assert state.frame is not None and state.request is not None
        frame, state.look, state.coarse = state.frame, self.wish.display, False
        player, seconds = self._get_player(state.request, state.look), frame.seconds["deform"]
        state.frame = player.draw_frame(frame.number, frame.touch, frame.loads, frame.deformation, seconds)
        state.image = render_page_image(state.frame)
        self._show_side_panels(state.frame, player)

    def _get_player(self, request: tuple, look: Display) -> Player:
        """Return the player of a request, with the display settings `look`."""
        _, name, _, disabled = request
        return replace(self.cast.get_player_with_camera("fem" if disabled else name, disabled, look), style=look.style)

    def _show_side_panels(self, frame: Frame, player: Player) -> None:
        """Show slices of a frame and the chart of recent values, as soon as the browser has time."""
        through, history = self.wish.through, self.history
        self.browser.show_side_panels(lambda: (render_slices(frame, player, through), history.draw_chart()))

    def _update_comparison(self, state: PageState) -> None:
        """Compare the displayed frame with the newest FEM solution; show the result, marked if the loads differ."""
        assert state.frame is not None and state.request is not None
        _, name, _, disabled = state.request
        name = "fem" if disabled else name
        reference = state.shown_fem or self.fem_worker.truth
        is_current = reference is not None and compute_loads_digest(reference.loads) == state.load
        if reference is not None and (reference is not state.reference or state.compared_deformer != (name, disabled)):
            player = self.cast.get_player(name)
            move_fem_tumour(self.browser, self.stage, reference, player)
            if player.follows and not is_current:
                state.comparison = None
            elif not disabled:
                own = state.frame.deformation if player.follows else None
                state.comparison = compare_with_fem(reference, player, name == "fem", own)
                if state.comparison.motion > MIN_COMPARED_MOTION:
                    if state.comparison.mean is not None:
                        self.tally.record_error(name, compute_loads_digest(reference.loads), state.comparison.mean)
                    self.cast.compare_models(reference, self.tally, excluded_model=name)
            state.reference, state.compared_deformer = reference, (name, disabled)
        if state.stale is not (not is_current):
            state.stale = not is_current
            self.browser.tint("finite elements", FEM_COLOUR if is_current else STALE_COLOUR)
        without = [describe_effect(effect) for effect in sorted(disabled)]
        if (worker := self.fem_worker).failure is not None:
            scope, reason = "this" if worker.thread.is_alive() else "any more", escape(str(worker.failure))
            comparison = f'<p class="warn">error: the finite elements do not solve {scope} ({reason})</p>'
        elif disabled and reference is not None:
            comparison = format_comparison(None, True, WAITING_TEXT)
            if is_current:
                comparison = describe_change(reference, self.cast.get_player(name), state.frame.deformation, without)
        else:
            fem_text = FEM_SHOWN if state.frame.estimate is None else FEM_REFERENCE
            shown = state.comparison if reference is not None else None
            comparison = format_comparison(shown, not is_current, WAITING_TEXT, fem_text)
        if (plan := self.cast.get_worker(disabled).plan or self.fem_worker.plan) != state.plan:
            state.plan = plan
            self.browser.write(PLAN, format_solver_list(plan))
        scene = self.stage.scene
        text = format_report(state.frame, self.stage, name, comparison, self.tally.rows, len(scene.times), without)
        if state.request != self.asked and self.busy.noticed:
            text = format_pending(state.frame.number, self.asked[0], len(scene.times)) + text
        assert state.image is not None
        self.browser.show(state.frame.number, state.image, text, self.asked[0])

    def _build_loads(self, number: int, touch: Touch | None) -> Loads:
        """Return the loads of frame `number` under all effects of the scene; `touch` replaces the scripted input."""
        scene, time = self.stage.scene, float(self.stage.scene.times[number])
        return scene.build_loads(self.stage.site, touch or scene.path(time), time)

    def _build_contents(self, deformer: str) -> tuple:
        """Build the contents of the page: surfaces, playback, controls, title and caption."""
        scene, names = self.stage.scene, self.patient.list_deformers(self.stage.scene)
        effects = build_effect_switches(self.patient, scene, self.wish, self.studies[0].start)
        actions = self._set_control, self._take_control, effects, self.studies[1].start
        return (
            build_page_bodies(self.stage),
            Playback(len(scene.times), self._play, lambda number: self._set_control(SCRIPT, number=number)),
            build_controls(scene, self.stage.site, names, self.wish, *actions),
            f"sulcus: {scene.name}",
            format_caption(self.patient, scene, self.anatomy),
        )

    def _play(self, plays: bool) -> None:
        """Handle the play button: playing a static scene returns the tool to the script; a pause keeps the frame."""
        self.wish.play(plays)
        if not plays and self.reached is not None:
            self.wish.set(number=self.reached)
        if self.wish.tool == SCRIPT:
            self.wish.set(holder=None)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", self.wish.tool)

    def _set_control(self, tool: str, **values: int) -> None:
        """Change the tool control after use of the menu or the frame slider, and update the menu."""
        if tool == HAND:
            self._start_manual_control()
        self.wish.set(tool=tool, holder=self._get_user() if tool == HAND else None, **values)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", tool)

    def _take_control(self, **values: float) -> None:
        """Switch to manual control with the values of a moved slider."""
        self._start_manual_control()
        self.wish.set(holder=self._get_user())
        self.wish.set_manual_input(**values)
        self._show_touch(self.wish.touch, lambda: True)
        self.browser.put("tool", HAND)

    def _start_manual_control(self) -> None:
        """Initialise manual control from the shown frame's tool input, if the script controls the tool."""
        if self.wish.tool == SCRIPT:
            number = self.wish.number if self.reached is None else self.reached
            scene = self.stage.scene
            self.wish.set(touch=scene.path(float(scene.times[number])))

    def _get_user(self) -> int | None:
        """Return the number of the user whose change is being processed; None outside of such a change."""
        return None if self.browser.deed is None else self.browser.deed.client
