"""The page comes alive: a scripted or hand-set tool, any deformer, and the finite elements checking it behind."""

from __future__ import annotations

import sys
import threading
import time as clock
import traceback
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ar.browser import Body, Browser, Choice, Playback, Slider, Toggle, Viewpoint
from sim.effects import Elasticity, Held, Slide
from sim.errors import InputError

from .ablation import without
from .holding import holding
from .paths import AIR, Touch
from .play import Frame, Player
from .reel import Session
from .referee import Referee, Truth
from .scene import Scene
from .stage import CORTEX_COLOUR, TOOL_COLOUR, TUMOUR_COLOUR, Stage
from .tally import Tally
from .theatre import Theatre
from .told import told

SCRIPT, HAND = "script", "hand"
FEM_COLOUR = (0.95, 0.35, 0.75)
CAPTION = """Left: the camera picture with the predicted tumour in register. Right: the same in 3-D, the tumour of the
finite elements as a pink wire. Research only."""
# How long a page that plays shows why a frame is left out [s].
READING = 2.0
HANDS = "Moving a slider takes the tool over; **tool: script** gives it back."


@dataclass
class Wish:
    """What the visitors ask for, written by the page's threads and read by the loop, under its lock."""

    deformer: str
    touch: Touch
    tool: str = SCRIPT
    holder: int | None = None
    plays: bool = True
    number: int = 0
    off: frozenset[str] = frozenset()
    lock: threading.Lock = field(default_factory=threading.Lock)

    def set(self, **values: object) -> None:
        """Change some wishes at once."""
        with self.lock:
            for name, value in values.items():
                setattr(self, name, value)

    def hand(self, right: float | None = None, up: float | None = None, **values: float) -> None:
        """Take the tool over with some numbers of its touch changed; `right` and `up` tilt its force [rad]."""
        with self.lock:
            tilt = self.touch.tilt[0] if right is None else right, self.touch.tilt[1] if up is None else up
            self.touch, self.tool = replace(self.touch, tilt=tilt, **values), HAND

    def switch(self, effect: str, on: bool) -> None:
        """Switch an effect on or off."""
        with self.lock:
            self.off = self.off - {effect} if on else self.off | {effect}

    def now(self) -> tuple[int, str, Touch | None, frozenset[str]]:
        """Frame number, deformer, hand-set touch (None: the script's) and effects that are off."""
        with self.lock:
            return self.number, self.deformer, self.touch if self.tool == HAND else None, self.off

    def go_on(self, number: int, frames: int) -> None:
        """A frame was shown: playing goes on to the next, unless a visitor has sought another meanwhile."""
        with self.lock:
            if self.plays and self.number == number:
                self.number = (number + 1) % frames


class Demo:
    """A scene on a page, for as long as `run` is let run."""

    def __init__(self, theatre: Theatre, scene: Scene, deformer: str, host: str, port: int) -> None:
        self.stage = Stage(scene, theatre.site, theatre.intensity)
        self.theatre = theatre
        player = Player(self.stage, theatre.deformer(deformer, scene))
        self.sessions = {(deformer, frozenset[str]()): Session(player)}
        self.wish = Wish(deformer, Touch(force=0.15, depth=2e-3))
        self.browser = Browser(
            self._bodies(),
            self._viewpoint(),
            Playback(
                len(scene.times),
                lambda plays: self.wish.set(plays=plays),
                lambda number: self._give(SCRIPT, number=number),
            ),
            self._controls(),
            title=f"sulcus: {scene.name}",
            caption=CAPTION if scene.tool is None else f"{CAPTION} {HANDS}",
            host=host,
            port=port,
            size=(scene.viewpoint.width, scene.viewpoint.height),
        )
        self.referee = Referee(theatre, scene)
        self.tally = Tally()
        self.asked, self.drawn = self.wish.now(), 0

    def run(self, seconds: float = float("inf")) -> int:
        """Play until the time is over; returns the frames drawn. What fails is said on the page, and is left out."""
        self.drawn, end = 0, clock.perf_counter() + seconds
        while (left := end - clock.perf_counter()) > 0.0:
            try:
                self._play(left)
            except Exception as error:
                self._leave_out(error, end)
        return self.drawn

    def _leave_out(self, error: Exception, end: float) -> None:
        """Say why a frame is not shown, until there is time to read it or a visitor asks for another; then go on."""
        said = str(error)
        if not isinstance(error, InputError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            said = f"a defect: {type(error).__name__}, {error}"
            print(f"sulcus demo: {said} (line {place.lineno} of {place.filename})", file=sys.stderr)
        self.browser.report(f"error: this frame is left out ({said})")
        self._tell()
        until = min(end, clock.perf_counter() + READING)
        while self.wish.now() == self.asked and (clock.perf_counter() < until or not self.wish.plays):
            if clock.perf_counter() >= end:
                return
            clock.sleep(1.0 / self.stage.scene.frames_per_second)
        self.wish.go_on(self.asked[0], len(self.stage.scene.times))

    def _play(self, seconds: float) -> None:
        """Play until the time is over or something fails."""
        scene = self.stage.scene
        frame: Frame | None = None
        own: Truth | None = None
        end = clock.perf_counter() + seconds
        shown: tuple | None = None
        judged: tuple | None = None
        verdict = "error: the finite elements are being prepared"
        while clock.perf_counter() < end:
            begun = clock.perf_counter()
            number, name, touch, off = asked = self.asked = self.wish.now()
            name = "fem" if off else name  # nobody else was taught without
            session = self._session(name, off)
            player = session.player
            if asked != shown or frame is None:
                reached, answer = session.towards(number, touch)
                if reached != number:
                    self.browser.report(f"frame {number} depends on those before it: {reached + 1} of them are done")
                    continue
                loads, hand = player.loads(number, touch), touch or player.touch(number)
                frame, shown = player.drawn(number, hand, loads, answer, clock.perf_counter() - begun), asked
                self.wish.go_on(number, len(scene.times))
                own = None
                if name == "fem" and not off:
                    own = Truth(number, loads, answer, frame.seconds["deform"])
                else:
                    self.referee.ask(number, touch)
                if not off:
                    self.tally.took(name, answer.cost.total)
                self._show(frame, player)
                self.drawn += 1
            truth = own or self.referee.truth
            if truth is not None and (truth, name, off) != judged and (not off or truth.number == frame.number):
                self._wire(truth, player)
                verdict = changed(self.stage, truth, frame, off) if off else self._judge(truth, name)
                judged = (truth, name, off)
            if self.referee.failure is not None:
                what = "this" if self.referee.thread.is_alive() else "any more"
                verdict = f"error: the finite elements do not answer {what} ({self.referee.failure})"
            self.browser.report(self._report(frame, name, verdict))
            self._tell()
            clock.sleep(max(0.0, 1.0 / scene.frames_per_second - (clock.perf_counter() - begun)))

    def _tell(self) -> None:
        """Tell each visitor who has the tool."""
        if self.stage.scene.tool is not None:
            holder, here = self.wish.holder, self.browser.here
            self.browser.tell(lambda visitor: holding(visitor, holder, here))

    def close(self) -> None:
        """Stop the page and the referee."""
        self.browser.close()
        self.referee.close()

    def _session(self, name: str, off: frozenset[str] = frozenset()) -> Session:
        """Of who plays the scene without some effects, of the tissue that it has with them."""
        if (name, off) not in self.sessions:
            scene, theatre = self.stage.scene, self.theatre
            for effect in scene.effects_on(theatre.anatomy) if off else ():
                scene = without(scene, effect) if type(effect).__name__ in off else scene
            stage = replace(self.stage, scene=scene) if off else self.stage
            self.sessions[name, off] = Session(Player(stage, theatre.deformer(name, scene)))
        return self.sessions[name, off]

    def _controls(self) -> list[Slider | Choice | Toggle]:
        wish, names = self.wish, self.theatre.names(self.stage.scene)
        return [
            Choice("deformer", names, wish.deformer, lambda name: wish.set(deformer=name)),
            *(Toggle(effect, True, partial(wish.switch, effect)) for effect in self._switched()),
            *(self._hand() if self.stage.scene.tool is not None else []),
        ]

    def _switched(self) -> list[str]:
        """Effects that a scene can be without: all but those that make it a body at rest."""
        kinds = (type(effect) for effect in self.stage.scene.effects_on(self.theatre.anatomy))
        return [kind.__name__ for kind in kinds if kind not in (Elasticity, Held, Slide)]

    def _hand(self) -> list[Slider | Choice]:
        """Who has the tool, and where."""
        return [
            Choice("tool", (SCRIPT, HAND), SCRIPT, self._give),
            self._strength(),
            Slider("direction right [deg]", -40.0, 40.0, 1.0, 0.0, lambda value: self._take(right=np.radians(value))),
            Slider("direction up [deg]", -40.0, 40.0, 1.0, 0.0, lambda value: self._take(up=np.radians(value))),
            Slider("place right [mm]", -14.0, 14.0, 0.5, 0.0, lambda value: self._take(x=1e-3 * value)),
            Slider("place up [mm]", -14.0, 14.0, 0.5, 0.0, lambda value: self._take(y=1e-3 * value)),
        ]

    def _strength(self) -> Slider:
        """How hard the hand pushes, or how deep it goes."""
        touch = self.wish.touch
        if self.stage.scene.posed:
            low, high, now = -1e3 * AIR, 8.0, 1e3 * touch.depth
            return Slider("depth [mm]", low, high, 0.1, now, lambda value: self._take(depth=1e-3 * value))
        return Slider("force [N]", 0.0, 0.4, 0.01, touch.force, lambda value: self._take(force=value))

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
        tool = self.stage.scene.tool
        brain, cortex, tumour = self.stage.brain, self.stage.cortex(positions), self.stage.tumour(positions)
        return [
            Body("brain", brain.vertices, brain.triangles, (0.80, 0.62, 0.58), opacity=0.14),
            Body("cortex", cortex.vertices, cortex.triangles, CORTEX_COLOUR, opacity=0.4),
            Body("tumour", tumour.vertices, tumour.triangles, TUMOUR_COLOUR),
            Body("finite elements", tumour.vertices, tumour.triangles, FEM_COLOUR, wireframe=True),
            *([] if tool is None else [Body("tool", tool.mesh.vertices, tool.mesh.faces, TOOL_COLOUR)]),
        ]

    def _viewpoint(self) -> Viewpoint:
        site = self.stage.site
        eye = site.origin - 0.10 * site.axis + 0.13 * site.right + 0.05 * site.up
        return Viewpoint(eye, site.origin + 0.015 * site.axis, site.up)

    def _show(self, frame: Frame, player: Player) -> None:
        positions = player.positions(frame.deformation)
        self.browser.show(frame.number, frame.shown)
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

    def _judge(self, truth: Truth, name: str) -> str:
        """Say how far off a deformer is under the loads that the finite elements answered."""
        player = self._session(name).player
        nodes = self.stage.at(truth.loads).anatomy.tumour_nodes
        right = truth.deformation.at(nodes).displacement[0]
        said = "this is the finite elements' own answer"
        if name != "fem":
            guess = player.deformer.deform(truth.loads, at=nodes).displacement[0]
            error = 1e3 * np.linalg.norm(guess - right, axis=1)
            self.tally.missed(name, 1e-3 * float(error.mean()))
            said = f"error against FEM: mean {error.mean():.3f}, largest {error.max():.3f} mm"
        motion = 1e3 * float(np.linalg.norm(right, axis=1).mean())
        return (
            f"{said}; tumour moved {motion:.2f} mm (frame {truth.number}, FEM {1e3 * truth.seconds:.0f} ms, "
            f"{truth.deformation.outcome[0].name.lower()})"
        )

    def _report(self, frame: Frame, name: str, verdict: str) -> str:
        """The outcome, milliseconds a stage, and the verdict on the frame that the finite elements answered last."""
        left = self.stage.at(frame.loads).left
        acts = [told(frame.loads, frame.deformation)] if frame.loads.causes else [f"time {frame.time:.2f} s"]
        acts += [] if frame.distance is None else [f"tip to tumour {1e3 * frame.distance:.1f} mm"]
        stages = " · ".join(f"{stage} {1e3 * seconds:.1f}" for stage, seconds in frame.seconds.items())
        lines = [
            f"**{name}**: {frame.deformation.outcome[0].value}",
            f"frame {frame.number}: {', '.join(acts)}",
            *([] if left is None else [str(left)]),
            f"ms a stage: {stages}",
            verdict,
        ]
        bound = frame.deformation.bound[0, 0]
        if np.isfinite(bound):
            lines.insert(1, f"in 95 of 100 loads no vertex of the tumour is off by more than {1e3 * bound:.2f} mm")
        return "\n\n".join([*lines, str(self.tally)])


def changed(stage: Stage, truth: Truth, frame: Frame, off: frozenset[str]) -> str:
    """How far from where all effects together have it a frame without some has the tumour."""
    nodes = stage.at(truth.loads).anatomy.tumour_nodes
    apart = truth.deformation.at(nodes).displacement[0] - frame.deformation.at(nodes).displacement[0]
    mean = 1e3 * float(np.linalg.norm(apart, axis=1).mean())
    return f"without {', '.join(sorted(off))} the tumour is {mean:.2f} mm from where all effects together have it"
