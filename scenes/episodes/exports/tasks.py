"""What is done in each family of episodes, as one sentence; and which episodes are held out."""

from __future__ import annotations

from collections.abc import Sequence

from ..reading.contents import Contents

TASKS = {
    "press": "Press on one place of the open cortex, hold, and let go.",
    "slide": "Press, slide along a straight line over the open cortex, and let go.",
    "draw": "Lay the tool on the open cortex, and draw the tissue aside.",
    "reach": "Touch several places of the open cortex in turn, by smooth motions.",
    "walk": "Wander over the open cortex at random, always in contact.",
    "palpate": "Move a ball by its pose over the open cortex, to palpate it at several places.",
    "retract": "Draw the cortex aside with a spatula, and hold it while the tissue relaxes.",
    "drain": "Drain fluid and turn the head, while the brain sinks.",
    "debulk": "Cut the tumour out in shares.",
}
# Of so many bodies, or episodes where there are fewer bodies, one is held out.
HELD_OUT = 10


def task_of(contents: Contents) -> str:
    """The sentence for an episode's family; of one that has none, its scene's name."""
    return TASKS.get(contents.family, f"Play the scene {contents.family}.")


def held_out(episodes: Sequence[Contents]) -> list[bool]:
    """Which episodes are for validation: every tenth body; of fewer than ten bodies, every tenth episode.

    Of two to nine episodes it is the last.
    """
    bodies = list(dict.fromkeys(str(one.said.get("anatomy")) for one in episodes))
    if len(bodies) < HELD_OUT:
        every = min(HELD_OUT, max(len(episodes), 2))
        return [number % every == every - 1 for number in range(len(episodes))]
    out = set(bodies[HELD_OUT - 1 :: HELD_OUT])
    return [str(one.said.get("anatomy")) in out for one in episodes]
