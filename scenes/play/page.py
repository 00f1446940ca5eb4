"""The page comes alive: a scripted or hand-set tool, any deformer, and the finite elements checking it behind."""

from __future__ import annotations

import sys
import time as clock
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from ar.browser import Browser
from ar.hud import marked
from ar.page_parts import Body, Playback, Sign, Viewpoint
from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads
from surrogate.data.dataset import digest_of_loads

from ..script.scene import Scene, find_scene
from ..script.tool_paths import Touch
from .deformers import Theatre, plan_of
from .effect_ablation import without
from .page_controls import PLAN, clocked, controls
from .page_referee import Referee, Truth
from .page_requests import HAND, SCRIPT, Wish
from .page_tally import Tally
from .page_text import deformer_words, effect_words, plan_words, report, words
from .page_verdict import Judged, changed, judge, verdict_words
from .player import Frame, Player
from .replay import Session
from .stage import CORTEX_COLOUR, TOOL_COLOUR, TUMOUR_COLOUR
from .tool_holder import holding
from .waiting_notice import Busy

FEM_COLOUR = (0.95, 0.35, 0.75)
STALE_COLOUR = (0.45, 0.45, 0.45)
"""Of the finite elements' tumour while it belongs to another load than the one that is shown."""
WAITS = "The finite elements are working on this load."
# How far the patient's sides stand from the brain in the 3-D view [m].
BESIDE = 12e-3
# How long a page that plays shows why a frame is left out [s].
READING = 2.0
FIRST = Touch(force=0.15, depth=2e-3)
"""What a hand holds that takes the tool."""


@dataclass
class Moment:
    """What the page shows now: the wish, its answer, the frame, and what the finite elements said of it."""

    asked: tuple | None = None
    style: str = ""
    load: str = ""
    frame: Frame | None = None
    picture: np.ndarray | None = None
    truth: Truth | None = None
    own: Truth | None = None
    by: tuple | None = None
    judged: Judged | None = None
    stale: bool | None = None
    plan: tuple[str, ...] | None = None


class Demo:
    """A scene on a page, for as long as `run` is let run; visitors change it for another built-in one."""

    def __init__(
        self,
        theatre: Theatre,
        scene: Scene,
        deformer: str,
        host: str,
        port: int,
        anatomy: str = "the default",
        find: Callable[[str], Scene] = find_scene,
    ) -> None:
        """Open the page; `anatomy` is whose brain, in words, and `find` makes the scenes that visitors choose."""
        self.theatre, self.anatomy, self.first, self.find = theatre, anatomy, scene, find
        self._cast(scene, deformer)
        size = scene.viewpoint.width, scene.viewpoint.height
        parts = self._parts(deformer)
        self.browser = Browser(
            parts[0], self._viewpoint(), *parts[1:], host=host, port=port, size=size, signs=self._signs()
        )
        self.busy = Busy(lambda line: self.browser.status(escape(line)))
        self.referee = Referee(theatre, scene)
        self.dismissed: list[Referee] = []
        self.asked, self.drawn = self.wish.now(), 0

    def run(self, seconds: float = float("inf")) -> int:
        """Play until the time is over; returns the frames drawn. What fails is said on the page, and is left out."""
        self.drawn, end = 0, clock.perf_counter() + seconds
        while (left := end - clock.perf_counter()) > 0.0:
            try:
                self._run(left)
            except Exception as error:
                self._leave_out(error, end)
        return self.drawn

    def _leave_out(self, error: Exception, end: float) -> None:
        """Say why a frame is not shown, until there is time to read it or a visitor asks for another; then go on."""
        self.busy.off()
        said = str(error)
        if not isinstance(error, InputError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            said = f"a defect: {type(error).__name__}, {error}"
            print(f"sulcus demo: {said} (line {place.lineno} of {place.filename})", file=sys.stderr)
        self.browser.report(f'<p class="warn">error: this frame is left out ({escape(said)})</p>')
        self._tell()
        until = min(end, clock.perf_counter() + READING)
        while self.wish.now() == self.asked and self.wish.scene == self.stage.scene.name:
            if clock.perf_counter() >= (until if self.wish.plays else end):
                break
            clock.sleep(1.0 / self.stage.scene.frames_per_second)
        self.wish.go_on(self.asked[0], len(self.stage.scene.times))

    def _run(self, seconds: float) -> None:
        """Play until the time is over or something fails."""
        now, end = Moment(), clock.perf_counter() + seconds
        while clock.perf_counter() < end:
            begun = clock.perf_counter()
            if self.wish.scene != self.stage.scene.name:
                self._change(self.wish.scene)
                now = Moment()
            new = self.answer(now)
            self.browser.plays(self.wish.plays)
            if new is None:
                continue
            self.drawn += new
            self._check(now)
            self._tell()
            rest = 1.0 / self.stage.scene.frames_per_second - (clock.perf_counter() - begun)
            clock.sleep(max(0.0, rest))

    def _tell(self) -> None:
        """Tell each visitor who has the tool."""
        if self.stage.scene.tool is not None:
            holder, here = self.wish.holder, self.browser.here
            self.browser.tell(lambda visitor: holding(visitor, holder, here))

    def close(self) -> None:
        """Stop the page and the referees."""
        self.busy.close()
        self.browser.close()
        for referee in (self.referee, *self.dismissed):
            referee.close()

    def _cast(self, scene: Scene, deformer: str) -> None:
        """Make a stage for a scene, and have a deformer play on it."""
        # Not on a card: there, what is drawn while the referee's thread records a CUDA graph would be recorded with it.
        stage = replace(self.theatre.stage(scene), device="cpu")
        sessions = {(deformer, frozenset[str]()): Session(Player(stage, self.theatre.deformer(deformer, scene)))}
        self.stage, self.sessions, self.tally = stage, sessions, Tally()
        self.wish = Wish(deformer, FIRST, scene.name, clocked=clocked(scene, stage.site))

    def _change(self, name: str) -> None:
        """Play another scene; where this body has none of that name, stay, and say why."""
        old = self.stage, self.sessions, self.tally, self.wish
        self.busy.on(f"nothing yet: preparing the scene {name}")
        try:
            scene = self.first if name == self.first.name else self.find(name)
            known = self.theatre.names(scene)
            deformer = self.wish.deformer if self.wish.deformer in known else self.theatre.best(scene)
            self._cast(scene, deformer)
            self.wish.set(style=old[3].style)
            parts = self._parts(deformer)
        except InputError as error:
            self.stage, self.sessions, self.tally, self.wish = old
            self.wish.set(scene=self.stage.scene.name)
            self.browser.put("scene", self.stage.scene.name)
            self.browser.report(f'<p class="warn">{escape(str(error))}</p>')
            return
        finally:
            self.busy.off()
        self.browser.fill(*parts)
        self.referee.dismiss()
        self.dismissed.append(self.referee)
        self.referee = Referee(self.theatre, scene)

    def answer(self, now: Moment) -> int | None:
        """Bring the page nearer to what is wished: 1 where a frame was drawn, 0 where all is shown, None on the way."""
        begun, scene, style = clock.perf_counter(), self.stage.scene, self.wish.style
        number, name, touch, off = asked = self.asked = self.wish.now()
        name = "fem" if off else name  # no model was trained without
        if asked == now.asked and now.frame is not None:
            if style != now.style:
                self._restyle(now, name)
            self.wish.go_on(number, len(scene.times))  # after a pause
            return 0
        self.busy.on(self._work(number, name, touch))
        session = self._session(name, off)
        reached, answer = session.towards(number, touch)
        if reached != number:
            self.busy.on(f"frame {number}, which depends on those before it: {reached + 1} of them are done")
            return None
        self.busy.off()
        player, hand = session.player, touch or session.player.touch(number)
        loads, took = player.loads(number, touch), clock.perf_counter() - begun
        now.asked, now.style, now.own = asked, style, None
        now.load = digest_of_loads(self._whole(number, touch) if off else loads)
        now.frame = frame = replace(player, style=style).drawn(number, hand, loads, answer, took)
        self.wish.go_on(number, len(scene.times))
        if name == "fem" and not off:
            now.own = Truth(number, loads, answer, frame.seconds["deform"])
        else:
            self.referee.ask(number, touch)
        if not off:
            self.tally.took(name, now.load, answer.cost.total)
        now.picture = pictured(frame)
        self.show(frame, player)
        return 1

    def _work(self, number: int, name: str, touch: Touch | None) -> str:
        """What is being solved, in words."""
        if touch is None:
            return f"frame {number} ({deformer_words(name)})"
        how = f"{1e3 * touch.depth:.1f} mm deep" if self.stage.scene.posed else f"{touch.force:.2f} N"
        return f"the tool in your hand, {how} ({deformer_words(name)})"

    def _restyle(self, now: Moment, name: str) -> None:
        """Draw the same answer with another overlay."""
        assert now.frame is not None
        frame, style = now.frame, self.wish.style
        player = self._session(name, self.wish.off).player
        seconds = frame.seconds["deform"]
        now.style = style
        now.frame = replace(player, style=style).drawn(
            frame.number, frame.touch, frame.loads, frame.deformation, seconds
        )
        now.picture = pictured(now.frame)

    def _check(self, now: Moment) -> None:
        """Show what the finite elements say of what is shown, and whether it is of the same load."""
        assert now.frame is not None and now.asked is not None
        _, name, _, off = now.asked
        name = "fem" if off else name
        truth = now.own or self.referee.truth
        fresh = truth is not None and digest_of_loads(truth.loads) == now.load
        whole = self._session(name).player
        if truth is not None and (truth is not now.truth or now.by != (name, off)):
            self._wire(truth, whole)
            if not off:
                now.judged = judge(truth, whole, name == "fem")
                if now.judged.mean is not None:
                    self.tally.missed(name, digest_of_loads(truth.loads), now.judged.mean)
            now.truth, now.by = truth, (name, off)
        if now.stale is not (not fresh):
            now.stale = not fresh
            self.browser.tint("finite elements", FEM_COLOUR if fresh else STALE_COLOUR)
        gone = [effect_words(effect) for effect in sorted(off)]
        if self.referee.failure is not None:
            what = "this" if self.referee.thread.is_alive() else "any more"
            why = escape(str(self.referee.failure))
            verdict = f'<p class="warn">error: the finite elements do not answer {what} ({why})</p>'
        elif off and truth is not None:
            answer: Deformation = now.frame.deformation
            verdict = changed(truth, whole, answer, gone) if fresh else verdict_words(None, True, WAITS)
        else:
            verdict = verdict_words(now.judged if truth is not None else None, not fresh, WAITS)
        plan = plan_of(self._session(name, off).player.deformer) or self.referee.plan
        if plan != now.plan:
            now.plan = plan
            self.browser.write(PLAN, plan_words(plan))
        scene = self.stage.scene
        said = report(now.frame, self.stage, name, verdict, self.tally.rows, len(scene.times), gone)
        assert now.picture is not None
        self.browser.show(now.frame.number, now.picture, said)

    def _whole(self, number: int, touch: Touch | None) -> Loads:
        """What acts in a frame under all effects of the scene."""
        scene, time = self.stage.scene, float(self.stage.scene.times[number])
        return scene.loads(self.stage.site, touch or scene.path(time), time)

    def _session(self, name: str, off: frozenset[str] = frozenset()) -> Session:
        """Of who plays the scene without some effects, of the tissue that it has with them."""
        if (name, off) not in self.sessions:
            scene, theatre = self.stage.scene, self.theatre
            for effect in scene.effects_on(theatre.anatomy) if off else ():
                scene = without(scene, effect) if type(effect).__name__ in off else scene
            stage = replace(self.stage, scene=scene) if off else self.stage
            self.sessions[name, off] = Session(Player(stage, theatre.deformer(name, scene)))
        return self.sessions[name, off]

    def _parts(self, deformer: str) -> tuple:
        """What the page is filled with: bodies, playback, controls, title, words."""
        scene, site = self.stage.scene, self.stage.site
        wish, names = self.wish, self.theatre.names(scene)
        playback = Playback(len(scene.times), self._play, lambda number: self._give(SCRIPT, number=number))
        given = controls(scene, site, names, wish, self._give, self._take)
        return self._bodies(), playback, given, f"sulcus: {scene.name}", words(self.theatre, scene, self.anatomy)

    def _play(self, plays: bool) -> None:
        """The button: where nothing moves by itself, playing gives the tool to the script."""
        self.wish.play(plays)
        if self.wish.tool == SCRIPT:
            self.wish.set(holder=None)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", self.wish.tool)

    def _give(self, tool: str, **wishes: int) -> None:
        """The menu, or the frame slider, gave the tool away; the menu says so after whatever is on its way to it."""
        self.wish.set(tool=tool, holder=self._visitor() if tool == HAND else None, **wishes)
        if self.stage.scene.tool is not None:
            self.browser.put("tool", tool)

    def _take(self, **values: float) -> None:
        """A slider was moved: the tool is in the visitor's hand."""
        self.wish.set(holder=self._visitor())
        self.wish.hand(**values)
        self.browser.put("tool", HAND)

    def _visitor(self) -> int | None:
        """Who set what is heard now."""
        return None if self.browser.deed is None else self.browser.deed.visitor

    def _bodies(self) -> list[Body]:
        positions = self.stage.site.anatomy.mesh.nodes
        tool, site = self.stage.scene.tool, self.stage.site
        brain, cortex, tumour = self.stage.brain, self.stage.cortex(positions), self.stage.tumour(positions)
        bodies = [
            Body("brain", brain.vertices, brain.triangles, (0.80, 0.62, 0.58), opacity=0.25),
            Body("cortex", cortex.vertices, cortex.triangles, CORTEX_COLOUR, opacity=0.4),
            Body("tumour", tumour.vertices, tumour.triangles, TUMOUR_COLOUR),
            Body("finite elements", tumour.vertices, tumour.triangles, STALE_COLOUR, wireframe=True),
        ]
        if tool is not None:
            pose = tool.pose(site.origin - 0.02 * site.axis, site.axis, site.right)
            at = tool.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            bodies.append(Body("tool", at, tool.mesh.faces, TOOL_COLOUR))
        return bodies

    def _signs(self) -> list[Sign]:
        """The patient's sides round the brain in the 3-D view."""
        nodes = self.stage.site.anatomy.mesh.nodes
        middle, half = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0)), 0.5 * np.ptp(nodes, axis=0) + BESIDE
        ways = zip(("RL", "AP", "SI"), np.diag(half), strict=True)
        return [Sign(word, middle + way) for (plus, minus), arm in ways for word, way in ((plus, arm), (minus, -arm))]

    def _viewpoint(self) -> Viewpoint:
        site = self.stage.site
        eye = site.origin - 0.10 * site.axis + 0.13 * site.right + 0.05 * site.up
        return Viewpoint(eye, site.origin + 0.03 * site.axis - 0.01 * site.right, site.up, fov=np.radians(44.0))

    def show(self, frame: Frame, player: Player) -> None:
        """Put the bodies of the 3-D view where a frame has them."""
        positions = player.positions(frame.deformation)
        stage = self.stage.at(frame.loads)
        for layer in (stage.cortex(positions), stage.tumour(positions)):
            self.browser.move(layer.name, layer.vertices, layer.triangles)
        tool = self.stage.scene.tool
        if tool is not None and frame.pose is not None:
            self.browser.move("tool", tool.mesh.vertices @ frame.pose[:3, :3].T + frame.pose[:3, 3])

    def _wire(self, truth: Truth, player: Player) -> None:
        """Show in the 3-D view where the finite elements, under all effects, have the tumour."""
        seen = self.stage.at(truth.loads).tumour(player.positions(truth.deformation))
        self.browser.move("finite elements", seen.vertices, seen.triangles)


def pictured(frame: Frame) -> np.ndarray:
    """A frame's picture (H, W, 3) uint8 with the patient's sides."""
    return marked(frame.shown, frame.camera.T_camera_world[:3, :3], frame.taken)
