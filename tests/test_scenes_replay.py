"""Replayed frames of a scene: equal to sequential frames in any order; static scenes need no replay."""

import threading
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from theatres import sinking
from visitor import free_port

from scenes.page.demo import Demo
from scenes.page.fem_worker import FemWorker
from scenes.page.requests import HAND, SCRIPT
from scenes.page.view import move_bodies
from scenes.play.deformers import PatientSetup, RestDeformer
from scenes.play.effect_ablation import remove_effect
from scenes.play.player import Frame, Player
from scenes.play.replay import IN_ORDER, FrameCache, ReplayOrder, ReplaySession, plan_replay_order
from scenes.script.debulking import Debulking
from scenes.script.head_pose import build_drainage
from scenes.script.scene import SCENES, Scene, Viewpoint, find_scene
from scenes.script.tool_paths import Touch, lay, press
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome
from sim.effects import Elasticity, Gravity, Held, Inertia, has_history
from sim.material import Material

# Forward, back, round, again, and far.
ASKED = (0, 1, 5, 4, 12, 0, 7, 7, 3)


@pytest.fixture(scope="module")
def theatre() -> PatientSetup:
    """A coarse box: a frame takes milliseconds."""
    return PatientSetup(make_box(cells=(6, 6, 4), spacing=12e-3), None, {}, "cpu")


def hasty(name: str, **values: object) -> Scene:
    """Nineteen frames, more than are kept, of a built-in scene: tool soon 2 mm deep, few pixels, linear elements."""
    values = {"path": lay(depth=2e-3, rise=0.2), "duration": 0.6, "element": None} | values
    return replace(find_scene(name), viewpoint=Viewpoint(width=64, height=48), **values)


REMEMBERING = {
    "tissue that relaxes under a blade": hasty("retract"),
    "mass under a ball": hasty("palpate", effects=(*find_scene("palpate").effects, Inertia())),
    "cuts": hasty("resection", surgery=Debulking(times=(0.1, 0.15, 0.2)), lying=build_drainage(0.3)),
}


def same(one: Deformation, other: Deformation) -> bool:
    """Bit for bit, what is remembered too."""
    assert set(one.memory) == set(other.memory)
    pairs = [(one.displacement, other.displacement), (one.time, other.time)]
    pairs += [(np.asarray(one.memory[name]), np.asarray(other.memory[name])) for name in one.memory]
    return all(np.array_equal(a, b) for a, b in pairs)


def solved(frame: Frame) -> bool:
    """At first the page shows the body at rest."""
    return frame.deformation.outcome[0] is not Outcome.GUESSED


def straight(player: Player) -> list[Deformation]:
    """The answers of the frames one after the other."""
    last, found = None, []
    for number in range(len(player.scene.times)):
        last = player.compute_deformation(player.build_loads(number), last)
        assert last.outcome[0].good
        found.append(last)
    return found


def answer(session: ReplaySession, number: int, touch: Touch | None = None) -> Deformation:
    """What it comes to, step by step."""
    reached, found = session.approach_frame(number, touch)
    while reached < number:
        reached, found = session.approach_frame(number, touch)
    assert reached == number
    return found


class TestReel:
    def test_frame_cache_replays_few_frames(self) -> None:
        ran: Counter[int] = Counter()

        def step(number: int, before: tuple[int, ...] | None) -> tuple[int, ...]:
            ran[number] += 1
            return (*(before or ()), number)

        reel = FrameCache(100, step)
        for number in (99, *np.random.default_rng(0).integers(0, 100, 300).tolist()):
            before, reached = ran.total(), -1
            while reached != number:
                reached, found = reel.approach_frame(number)
                assert found == tuple(range(reached + 1)) and reached <= number
            assert ran.total() - before < (101 if number == 99 else -(-100 // IN_ORDER.max_stored))
        assert len(ran) == 100 and len(reel.kept) <= IN_ORDER.max_stored

    def test_frame_cache_computes_at_most_one_frame_per_call(self) -> None:
        ran: list[int] = []
        reel = FrameCache(50, lambda number, before: ran.append(number))
        for calls in range(1, 20):
            assert reel.approach_frame(40)[0] == calls - 1 and ran == list(range(calls))

    def test_long_jump_starts_at_the_nearest_cached_frame(self) -> None:
        ran: list[tuple[int, int | None]] = []
        reel = FrameCache(50, lambda number, before: ran.append((number, before)) or number, ReplayOrder(6, True, 64))

        def way(number: int) -> list[tuple[int, int | None]]:
            ran.clear()
            while reel.approach_frame(number)[0] != number:
                pass
            return ran.copy()

        assert way(14) == [(0, None), (6, 0), (12, 6), (14, 12)]
        assert way(15) == [(15, 14)] and way(17) == [(17, 15)] and way(12) == []
        assert way(40) == [(18, 12), (24, 18), (30, 24), (36, 30), (40, 36)]
        assert way(20) == [(20, 18)] and way(5) == [(5, 6)]
        reel = FrameCache(50, lambda number, before: ran.append((number, before)) or number, ReplayOrder(6, True, 1))
        assert way(48)[-1] == (48, 42) and way(29) == [(42, 48), (36, 42), (30, 36), (29, 30)]
        assert list(reel.kept) == [0]


def test_replay_order_depends_on_contact_and_history(theatre) -> None:
    """And nowhere else; tissue that relaxes is answered in order."""
    box = theatre.anatomy
    sides = box.fixed.any(axis=1) & (box.mesh.nodes[:, 2] > box.mesh.nodes[:, 2].min() + 1e-9)
    normal = np.where(sides[:, None], [1.0, 0.0, 0.0], 0.0)
    sliding = replace(box, fixed=box.fixed & ~sides[:, None], slide_normal=normal)

    def course(name: str, anatomy: Anatomy, **values: object) -> ReplayOrder | None:
        scene = replace(find_scene(name), **values)
        stage = PatientSetup(anatomy, None, {}, "cpu").build_stage(scene)
        return plan_replay_order(Player(stage, RestDeformer(anatomy)))

    assert course("brain_shift", sliding) == ReplayOrder(6, True, 64)
    assert course("brain_shift", sliding, frames_per_second=10.0) == ReplayOrder(2, backward=True, max_stored=64)
    assert course("brain_shift", box) is course("press", box) is None
    assert course("retract", box) is course("pulsation", sliding) is IN_ORDER


@pytest.mark.parametrize("name", REMEMBERING)
def test_frames_in_any_order_equal_sequential_frames(theatre, name):
    """Two visitors take turns on one solver, with manual control in between."""
    player = theatre.build_player("fem", REMEMBERING[name])
    assert player.remembers
    run = straight(player)
    one, other = ReplaySession(player), ReplaySession(player)
    for number in ASKED:
        for session, wanted in ((one, number), (other, 12 - number)):
            assert same(answer(session, wanted), run[wanted])
        if player.scene.tool is not None:
            answer(one, number, Touch(0.003, 0.0, depth=2e-3))
    assert np.abs(run[12].displacement).max() > 1e-4


def test_frame_of_relaxing_tissue_depends_on_its_history(theatre):
    """Control: solutions from rest or from a later frame differ."""
    player = theatre.build_player("fem", REMEMBERING["tissue that relaxes under a blade"])
    run = straight(player)
    alone = player.compute_deformation(player.build_loads(12))
    assert np.abs(alone.reaction - run[12].reaction)[0, 0, 2] > 0.015 * np.abs(run[12].reaction[0, 0, 2])


def test_manual_tool_continues_from_the_last_solution(theatre):
    """For any frame number: held tissue continues to relax below the tool, and never reverses.

    Within the tolerance of its start a frame keeps its solution.
    """
    player = theatre.build_player("fem", REMEMBERING["tissue that relaxes under a blade"])
    session = ReplaySession(player)
    run = answer(session, 12)
    held, reads = player.get_touch(12), [np.linalg.norm(run.reaction[0, 0, :3])]
    for number in (12, 12, 3, 0, 9):
        found = answer(session, number, held)
        assert found.outcome[0].good
        reads.append(np.linalg.norm(found.reaction[0, 0, :3]))
    assert (np.diff(reads) <= 0.0).all() and reads[-1] < 0.97 * reads[0]
    once = replace(run, time=run.time - 1.0 / player.scene.frames_per_second)
    assert same(answer(ReplaySession(player), 12), run)
    first = player.compute_deformation(player.build_loads(12, held), once)
    assert np.linalg.norm(first.reaction[0, 0, :3]) == reads[1]


def test_static_scene_solves_each_frame_once(theatre, monkeypatch):
    """One solve per frame, started from the last displayed solution."""
    player = theatre.build_player("fem", hasty("press", path=press(0.2, rise=0.2, hold=0.1)))
    asked: list[Deformation | None] = []
    solve = player.deformer.deform
    monkeypatch.setattr(player.deformer, "deform", lambda loads, start=None: asked.append(start) or solve(loads, start))
    session, last = ReplaySession(player), None
    assert not player.remembers
    for number in ASKED:
        reached, found = session.approach_frame(number)
        assert reached == number and asked[-1] is last and found.outcome[0].good
        last = found
    assert len(asked) == len(ASKED)


def test_remember_is_true_for_history_dependent_scenes() -> None:
    found = {name: has_history(find_scene(name).effects) or bool(find_scene(name).surgery) for name in SCENES}
    assert {name for name, does in found.items() if does} == {"spatula", "palpate", "retract", "resection", "pulsation"}
    relaxing = Material("neo-hookean", 3000.0, 0.45, prony=((0.4, 1.0),))
    assert has_history((Elasticity(None, {1: relaxing}), Held())) and not has_history((Elasticity(None), Held()))
    assert not has_history(sinking().effects)


class TestPages:
    @pytest.fixture
    def pages(self, theatre):
        effects = (*find_scene("retract").effects, Gravity())
        scene = hasty("retract", effects=effects, lying=build_drainage(0.3))
        pages = [Demo(theatre, scene, "fem", "127.0.0.1", free_port()) for _ in range(2)]
        for page in pages:
            page.wish.set(plays=False)
        yield pages
        for page in pages:
            page.close()

    def test_two_pages_show_sequential_frames(self, theatre, pages, monkeypatch):
        scene = pages[0].stage.scene
        full = straight(theatre.build_player("fem", scene))
        less = straight(theatre.build_player("fem", remove_effect(scene, Gravity())))
        assert not same(full[6], less[6])
        shown: dict[Demo, list] = {page: [] for page in pages}
        owners = {page.browser: page for page in pages}

        def moved(browser, frame, player):
            shown[owners[browser]].append(frame)
            move_bodies(browser, frame, player)

        monkeypatch.setattr("scenes.page.demo.move_bodies", moved)

        def seen(page: Demo, **wishes: object) -> Deformation:
            shown[page].clear()
            page.wish.set(**wishes)
            number, _, hand, off = page.wish.read_current()
            while not shown[page] or shown[page][-1].number != number or not solved(shown[page][-1]):
                page.run(0.05)
            run = less if off else full
            assert hand or all(same(frame.deformation, run[frame.number]) for frame in filter(solved, shown[page]))
            return shown[page][-1].deformation

        first, second = pages
        for number in (5, 2, 12, 0):
            assert same(seen(first, number=number), full[number])
            assert same(seen(second, number=12 - number, off=frozenset({"Gravity"})), less[12 - number])
        seen(first, touch=Touch(depth=3e-3), tool=HAND)
        assert same(seen(first, tool=SCRIPT, number=12), full[12])
        assert same(seen(second, number=9, off=frozenset()), full[9])
        shown[first].clear()
        first.wish.set(plays=True)
        while len(shown[first]) < 20:
            first.run(0.1)
        assert all(same(frame.deformation, full[frame.number]) for frame in shown[first])
        assert [frame.number for frame in shown[first][:9]] == [*range(12, 19), 0, 1]


def test_fem_worker_solutions_equal_sequential_frames(theatre):
    scene = REMEMBERING["tissue that relaxes under a blade"]
    full = straight(theatre.build_player("fem", scene))
    referee = FemWorker(theatre, scene, threading.Lock())
    for number in (12, 3, 8):
        referee.request_frame(number, None)
        while referee.truth is None or referee.truth.number != number:
            assert referee.failure is None and not time.sleep(0.01)
        assert same(referee.truth.deformation, full[number])
    referee.close()
