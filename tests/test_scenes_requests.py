"""Wishes of visitors: who plays, seeks and holds the tool."""

import threading
import time

from scenes.page.requests import SCRIPT, Wish
from scenes.script.tool_paths import Touch


class TestWish:
    def test_playing_goes_round(self):
        wish = Wish("linear", Touch(force=0.1))
        assert [self.played(wish) for _ in range(5)] == [0, 1, 2, 0, 1]
        wish.set(plays=False)
        assert [self.played(wish) for _ in range(3)] == [2, 2, 2]

    @staticmethod
    def played(wish):
        """The frame that is shown next, of three."""
        number = wish.now()[0]
        wish.go_on(number, 3)
        return number

    def test_who_seeks_is_not_overruled_by_the_frame_that_is_being_drawn(self):
        wish = Wish("linear", Touch())
        wish.set(number=2)
        wish.go_on(0, 3)
        assert wish.now()[0] == 2

    def test_the_hand_holds_what_it_does_not_change(self):
        wish = Wish("linear", Touch(force=0.1))
        assert wish.now()[2] is None
        wish.hand(x=0.01)
        assert wish.now()[2] == Touch(x=0.01, force=0.1)
        wish.hand(force=0.3)
        assert wish.now()[2] == Touch(x=0.01, force=0.3)
        wish.set(tool=SCRIPT, deformer="fem")
        assert wish.now()[1:3] == ("fem", None)

    def test_two_sliders_at_once_both_count(self):
        """The page calls each slider on a thread of its own."""
        wish = Wish("linear", Touch(force=0.1))
        hands = [threading.Thread(target=wish.hand, kwargs=turn) for turn in ({"right": 0.2}, {"up": -0.3})]
        with wish.lock:  # both are under way before either is heard
            for hand in hands:
                hand.start()
            time.sleep(0.05)
        for hand in hands:
            hand.join()
        assert wish.now()[2] == Touch(force=0.1, tilt=(0.2, -0.3))
