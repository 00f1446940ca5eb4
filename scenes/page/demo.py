"""The page comes alive: a scripted or hand-set tool, any deformer, and the finite elements checking it behind."""

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

from ..play.deformers import AtRest, PatientSetup
from ..play.player import Frame, Player
from ..play.stage import Stage
from ..play.waiting_notice import Busy
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
from .effect_costs import build_effect_fold
from .fem_worker import FemResult, FemWorker
from .requests import HAND, SCRIPT, Look, Requests, describe_holder
from .scene_solvers import SceneSolvers
from .side_panels import list_lines, render_slices, sample_of
from .text import describe_effect, describe_work, format_caption, format_pending, plan_words, report
from .view import (
    FEM_COLOUR,
    STALE_COLOUR,
    build_page_bodies,
    build_surroundings,
    choose_viewpoint,
    move_bodies,
    move_wire,
    render_page_image,
)

WAITING_TEXT = "The finite elements are working on this load."  # Text while FEM solves.
UNDEFORMED_TEXT = '<p class="stale">The undeformed body, as in the scan. The first result is being computed.</p>'
MIN_REST = 0.007  # Shortest pause after an image, for FEM in the background [s].
MESSAGE_TIME = 2.0  # Time for which a playing page shows why a frame is skipped [s].


class Demo:
    """A scene on a page, for as long as `run` is let run; visitors change it for another built-in one."""

    def __init__(
        self,
        theatre: PatientSetup,
        scene: Scene,
        deformer: str,
        host: str,
        port: int,
        anatomy: str = "the default",
        find: Callable[[str], Scene] = find_scene,
        style: Style = "window",
        origins: tuple[str, ...] = (),
    ) -> None:
        """Open the page; `anatomy` is whose brain, in words, and `find` makes the scenes that visitors choose."""
        self.theatre, self.anatomy, self.first, self.find = theatre, anatomy, scene, find
        self.turn = threading.Lock()
        self._cast(scene, deformer)
        self.wish.set(style=style)
        size, site = (scene.viewpoint.width, scene.viewpoint.height), theatre.site
        parts = self._build_contents(deformer)
        self.browser = Browser(
            parts[0], choose_viewpoint(site), *parts[1:],
            host=host, port=port, size=size, signs=build_surroundings(self.stage), origins=origins,
        )  # fmt: skip
        self.busy = Busy(lambda line: self.browser.show_status(escape(line)))
        self.dismissed: list[FemWorker] = []
        self.asked, self.drawn = self.wish.read_current(), 0

    def run(self, seconds: float = float("inf")) -> int:
        """Play for the given time; return the number of frames drawn. Failures are reported on the page and skipped.

        Raises
        ------
        InputError
            FEM of the first scene is not available, and no other deformer was requested.
        """
        self.drawn, end = 0, clock.perf_counter() + seconds
        while (left := end - clock.perf_counter()) > 0.0:
            try:
                self._run(left)
            except Exception as error:
                if isinstance(error, InputError) and not self.cast.playable:
                    raise
                self._leave_out(error, end)
        return self.drawn

    def _leave_out(self, error: Exception, end: float) -> None:
        """Say why a frame is not shown, until there is time to read it or a visitor asks for another; then go on."""
        self.busy.end_work()
        said = str(error)
        if not isinstance(error, InputError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            said = f"a defect: {type(error).__name__}, {error}"
            print(f"sulcus demo: {said} (line {place.lineno} of {place.filename})", file=sys.stderr)
        self.browser.report(f'<p class="warn">error: this frame is left out ({escape(said)})</p>')
        self._tell()
        until = min(end, clock.perf_counter() + MESSAGE_TIME)
        while self.wish.read_current() == self.asked and self.wish.scene == self.stage.scene.name:
            if clock.perf_counter() >= (until if self.wish.plays else end):
                break
            clock.sleep(1.0 / self.stage.scene.frames_per_second)
        self.wish.go_on(self.asked[0], len(self.stage.scene.times))

    def _run(self, seconds: float) -> None:
        """Play until the time is over or something fails."""
        now, end = PageState(), clock.perf_counter() + seconds
        while clock.perf_counter() < end:
            begun = clock.perf_counter()
            if self.wish.scene != self.stage.scene.name:
                self._change(self.wish.scene)
                now = PageState()
            self.drawn += self.update_page(now)
            self.browser.show_playback(self.wish.plays)
            self._tell()
            if now.frame is None:
                continue
            self._check(now)
            rest = 1.0 / self.stage.scene.frames_per_second - (clock.perf_counter() - begun)
            clock.sleep(max(MIN_REST, rest))

    def _tell(self) -> None:
        """Tell each visitor who has the tool, and who leads."""
        tool, holder, here = self.stage.scene.tool, self.wish.holder, self.browser.here
        self.browser.tell(lambda visitor: "" if tool is None else describe_holder(visitor, holder, here))

    def close(self) -> None:
        """Stop the page and the finite elements."""
        self.busy.close()
        for study in self.studies:
            study.close()
        self.browser.close()
        for solver in (*self.cast.solvers.values(), *self.dismissed):
            solver.close()

    @property
    def stage(self) -> Stage:
        """Drawn stage, with all effects."""
        return self.cast.get_stage()

    @property
    def referee(self) -> FemWorker:
        """The finite elements under all effects, which judge the models."""
        return self.cast.get_worker()

    def _cast(self, scene: Scene, deformer: str) -> None:
        """Have a deformer play a scene."""
        self.cast, self.tally = SceneSolvers(self.theatre, scene, deformer, self.turn), AccuracyTimeTable()
        self.history = History(list_lines(scene))
        # The frame that is shown.
        self.reached: int | None = None
        self.wish = Requests(deformer, scene.path(0.0), scene.name, clocked=is_animated(scene, self.theatre.site))
        self.studies = build_studies(self.theatre, scene, self.wish, self.turn, lambda: self.browser)  # opens later

    def _change(self, name: str) -> None:
        """Play another scene; where this body has none of that name, stay, and say why."""
        old = self.cast, self.tally, self.wish, self.history, self.studies
        self.busy.begin_work(f"preparing the scene {name}")
        try:
            scene = self.first if name == self.first.name else self.find(name)
            deformer = self.theatre.select_default(scene)
            self._cast(scene, deformer)
            kept = old[2].look
            self.wish.set(style=kept.style, path=kept.path, through=kept.through, registration=kept.registration)
            parts = self._build_contents(deformer)
        except InputError as error:
            self.cast, self.tally, self.wish, self.history, self.studies = old
            self.wish.set(scene=self.stage.scene.name)
            self.browser.put("scene", self.stage.scene.name)
            self.browser.report(f'<p class="warn">{escape(str(error))}</p>')
            return
        finally:
            self.busy.end_work()
        for study in old[4]:
            study.close()
        self.browser.fill(*parts)
        self.dismissed = [solver for solver in self.dismissed if solver.thread.is_alive()] + old[0].stop_soon()

    def update_page(self, now: PageState) -> int:
        """Update the page towards the requested state; return the number of rendered frames, 0 or 1."""
        self.asked = self.wish.read_current()
        if self.asked == now.asked:
            self._mark_shown()
        elif (found := self._find_result(now)) is not None:
            with run_in_foreground():
                self._draw(now, found)
            return 1
        if now.frame is not None and (self.wish.look != now.look or (now.coarse and now.is_still)):
            self._draw_in_style(now)
        return 0

    def _mark_shown(self) -> None:
        """Mark the request as shown: nothing is pending, and playback continues."""
        self.busy.end_work()
        self.cast.stop_all()
        self.wish.go_on(self.asked[0], len(self.stage.scene.times))

    def _find_result(self, now: PageState) -> FemResult | None:
        """Return the solution of the request, or of a frame on the way to it; None until there is one."""
        number, name, touch, off = self.asked
        question, scene = (number, touch), self.stage.scene
        if name != "fem" and not off:  # no model was trained without
            self.busy.begin_work(describe_work(scene, name, *question))
            return self.cast.predict(name, question)
        found = self.cast.solve(off, question, now.shown, 0.0)
        if found is not None:
            return found
        if self.cast.get_worker(off).player is None:
            self.busy.begin_work("preparing the finite elements")
            if now.frame is None and not now.rests:
                self._show_undeformed(now)
        elif now.goal == self.asked and now.frame is not None:
            self.busy.begin_work(f"on the way to frame {number}: frame {now.frame.number} is solved")
        else:
            self.busy.begin_work(describe_work(scene, "fem", *question))
        return self.cast.solve(off, question, now.shown, 1.0 / scene.frames_per_second)

    def _show_undeformed(self, now: PageState) -> None:
        """Show the body at rest while nothing else can be shown."""
        number, _, touch, _ = self.asked
        stage = replace(self.stage, observer=None)  # there is no truth yet to be seen
        player = Player(stage, AtRest(stage.site.anatomy), self.wish.style)
        frame = player.draw(number, float(self.stage.scene.times[number]), touch or player.get_touch(number))
        move_bodies(self.browser, frame, player)
        self.browser.show(number, render_page_image(frame), UNDEFORMED_TEXT)
        self._show_side_panels(frame, player)
        now.rests = True

    def _draw(self, now: PageState, found: FemResult) -> None:
        """Draw a solution, and have it compared with FEM unless it is by FEM."""
        number, name, touch, off = self.asked
        look = self.wish.look
        player = replace(self._get_player(self.asked, look), coarse=now.choose_resolution())
        hand = touch or player.get_touch(found.number)
        self.reached, now.goal, now.asked = found.number, self.asked, (found.number, name, touch, off)
        now.look, now.shown, now.own = look, found, None
        now.load = compute_loads_digest(self._build_loads(found.number, touch) if off else found.loads)
        now.frame = frame = player.draw_frame(found.number, hand, found.loads, found.deformation, found.seconds)
        now.record_rendering(frame.seconds["render"])
        self.history.add(sample_of(frame, self.stage.scene, clock.monotonic()))
        if found.number == number:
            self._mark_shown()
        if name == "fem" and not off:
            now.own = found
        elif found.number == number:
            self.referee.ask(number, touch)
        if not off:
            self.tally.record_time(name, now.load, found.deformation.cost.total)
        now.picture = render_page_image(frame)
        move_bodies(self.browser, frame, player)
        self._show_side_panels(frame, player)
        if touch is None:
            self._show_touch(hand, lambda: self.wish.tool == SCRIPT)

    def _show_touch(self, touch: Touch, wanted: Callable[[], bool]) -> None:
        """Set the tool's sliders to a touch, so that a hand that takes the tool starts there."""
        if self.stage.scene.tool is not None:
            for label, value in to_slider_values(self.stage.scene, touch).items():
                self.browser.put(label, value, wanted)

    def _draw_in_style(self, now: PageState) -> None:
        """Render the same solution in another style."""
        assert now.frame is not None and now.asked is not None
        frame, now.look, now.coarse = now.frame, self.wish.look, False
        player, seconds = self._get_player(now.asked, now.look), frame.seconds["deform"]
        now.frame = player.draw_frame(frame.number, frame.touch, frame.loads, frame.deformation, seconds)
        now.picture = render_page_image(now.frame)
        self._show_side_panels(now.frame, player)

    def _get_player(self, asked: tuple, look: Look) -> Player:
        """Return the player of a request, in the given style."""
        _, name, _, off = asked
        return replace(self.cast.get_player_with_camera("fem" if off else name, off, look), style=look.style)

    def _show_side_panels(self, frame: Frame, player: Player) -> None:
        """Show slices of a frame, and the chart of recent values, when there is time for it."""
        through, history = self.wish.through, self.history
        self.browser.show_beside(lambda: (render_slices(frame, player, through), history.draw_chart()))

    def _check(self, now: PageState) -> None:
        """Show the FEM solution for the displayed frame, and whether it belongs to the same load."""
        assert now.frame is not None and now.asked is not None
        _, name, _, off = now.asked
        name = "fem" if off else name
        truth = now.own or self.referee.truth
        fresh = truth is not None and compute_loads_digest(truth.loads) == now.load
        if truth is not None and (truth is not now.truth or now.by != (name, off)):
            whole = self.cast.get_player(name)
            move_wire(self.browser, self.stage, truth, whole)
            if whole.follows and not fresh:
                now.judged = None
            elif not off:
                shown = now.frame.deformation if whole.follows else None
                now.judged = compare_with_fem(truth, whole, name == "fem", shown)
                if now.judged.motion > MIN_COMPARED_MOTION:
                    if now.judged.mean is not None:
                        self.tally.record_error(name, compute_loads_digest(truth.loads), now.judged.mean)
                    self.cast.compare_models(truth, self.tally, skip=name)
            now.truth, now.by = truth, (name, off)
        if now.stale is not (not fresh):
            now.stale = not fresh
            self.browser.tint("finite elements", FEM_COLOUR if fresh else STALE_COLOUR)
        gone = [describe_effect(effect) for effect in sorted(off)]
        if self.referee.failure is not None:
            rest, reason = "this" if self.referee.thread.is_alive() else "any more", escape(str(self.referee.failure))
            verdict = f'<p class="warn">error: the finite elements do not solve {rest} ({reason})</p>'
        elif off and truth is not None:
            verdict = format_comparison(None, True, WAITING_TEXT)
            if fresh:
                verdict = describe_change(truth, self.cast.get_player(name), now.frame.deformation, gone)
        else:
            own = FEM_SHOWN if now.frame.estimate is None else FEM_REFERENCE
            verdict = format_comparison(now.judged if truth is not None else None, not fresh, WAITING_TEXT, own)
        if (plan := self.cast.get_worker(off).plan or self.referee.plan) != now.plan:
            now.plan = plan
            self.browser.write(PLAN, plan_words(plan))
        scene = self.stage.scene
        said = report(now.frame, self.stage, name, verdict, self.tally.rows, len(scene.times), gone)
        if now.asked != self.asked and self.busy.noticed:
            said = format_pending(now.frame.number, self.asked[0], len(scene.times)) + said
        assert now.picture is not None
        self.browser.show(now.frame.number, now.picture, said, self.asked[0])

    def _build_loads(self, number: int, touch: Touch | None) -> Loads:
        """Return the loads of a frame under all effects of the scene."""
        scene, time = self.stage.scene, float(self.stage.scene.times[number])
        return scene.build_loads(self.stage.site, touch or scene.path(time), time)

    def _build_contents(self, deformer: str) -> tuple:
        """Build the contents of the page: bodies, playback, controls, title, text."""
        scene, names = self.stage.scene, self.theatre.list_deformers(self.stage.scene)
        effects = build_effect_fold(self.theatre, scene, self.wish, self.studies[0].start)
        actions = self._give, self._take, effects, self.studies[1].start
        return (
            build_page_bodies(self.stage),
            Playback(len(scene.times), self._play, lambda number: self._give(SCRIPT, number=number)),
            build_controls(scene, self.stage.site, names, self.wish, *actions),
            f"sulcus: {scene.name}",
            format_caption(self.theatre, scene, self.anatomy),
        )

    def _play(self, plays: bool) -> None:
        """Handle the play button: in a static scene the script takes the tool. A pause stops on the way."""
        self.wish.play(plays)
        if not plays and self.reached is not None:
            self.wish.set(number=self.reached)
        if self.wish.tool == SCRIPT:
            self.wish.set(holder=None)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", self.wish.tool)

    def _give(self, tool: str, **wishes: int) -> None:
        """Change the tool control by the menu or the frame slider; the menu is updated after pending messages."""
        if tool == HAND:
            self._start_hand()
        self.wish.set(tool=tool, holder=self._get_user() if tool == HAND else None, **wishes)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", tool)

    def _take(self, **values: float) -> None:
        """Switch to manual control after a slider was moved."""
        self._start_hand()
        self.wish.set(holder=self._get_user())
        self.wish.take_over(**values)
        self._show_touch(self.wish.touch, lambda: True)
        self.browser.put("tool", HAND)

    def _start_hand(self) -> None:
        """Initialise manual control, when the script has the tool, from the touch of the frame shown."""
        if self.wish.tool == SCRIPT:
            number = self.wish.number if self.reached is None else self.reached
            scene = self.stage.scene
            self.wish.set(touch=scene.path(float(scene.times[number])))

    def _get_user(self) -> int | None:
        """Return the user whose change is processed now."""
        return None if self.browser.deed is None else self.browser.deed.visitor
