import re
from html import unescape

from theatres import short

from scenes.page.error_refinement import refine_error
from scenes.script.tool_paths import Touch


def test_larger_force_gives_larger_motion_and_error(theatre):
    found = []
    for force in (0.05, 0.2):
        *progress, last = refine_error(theatre, short(), Touch(force=force), 0.1, count=8)
        assert len(progress) == 9 and "8 of 8 sampled patients" in progress[-1]
        moved, off, bound = map(float, re.findall(r"[\d.]+(?=\smm|\s\N{PLUS-MINUS SIGN})", unescape(last))[:3])
        assert moved > 0.0 and 0.0 < off <= bound and "perfect registration" in last
        found.append((moved, off, bound))
    assert all(less < more for less, more in zip(*found, strict=True))
