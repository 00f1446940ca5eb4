"""Text of the page: values of the frame, and the digest of loads."""

from dataclasses import replace

import numpy as np
from theatres import short

from scenes.page.text import format_report
from scenes.script.tool_paths import Touch
from scenes.script.uncertainty import TumourError
from sim.deformation import Outcome, build_start
from surrogate.data.dataset import compute_loads_digest


def answer(outcome: Outcome, bound: float = 1e-3):
    return replace(build_start(np.full((1, 3, 3), 1e-3)), outcome=(outcome,), bound=np.array([[bound], [2.0 * bound]]))


class TestDigestOfLoads:
    def test_loads_digest_depends_on_load_and_not_on_frame(self, theatre):
        scene, site = short(), theatre.site
        one = compute_loads_digest(scene.build_loads(site, Touch(force=0.2), 0.1))
        assert one == compute_loads_digest(scene.build_loads(site, Touch(force=0.2), 0.1))
        others = [Touch(force=0.21), Touch(force=0.2, x=0.004), Touch(force=0.2, tilt=(0.3, 0.0))]
        assert one not in {compute_loads_digest(scene.build_loads(site, touch, 0.1)) for touch in others}
        assert one != compute_loads_digest(scene.build_loads(site, Touch(force=0.2), 0.2))


def test_page_text_has_the_values_of_the_frame(theatre):
    """Distance, motion, force, milliseconds and errors in readable units."""
    player = theatre.build_player("linear", short())
    seconds = {"deform": 12.3e-3, "render": 4.5e-3, "overlay": 0.7e-3}
    known = {
        "distance": 12.34e-3,
        "distance_error": 2.46e-3,
        "moved": 1.234e-3,
        "model_error": 11e-6,
        "seconds": seconds,
    }
    frame = replace(player.draw(3, 0.1, Touch(force=0.25)), tumour_error=TumourError(None), moved_error=None, **known)
    said = format_report(frame, player.stage, "linear", "", (), 7)
    for line in (
        ">tip to tumour 12.3&nbsp;mm<",
        "<p>tumour moved 1.23 mm (surrogate error 0.02 mm, motion error not known)</p><label ",
        "0.25 N; error of the tip-to-tumour distance &lt;= 2.5 mm (95 %, relative to FEM)</p>",
        "<p>Tumour position error: not known.",
        "time [ms]: deformation 12.3, rendering 4.5, overlay 0.7<",
    ):
        assert line in said
    plain = format_report(replace(frame, distance_error=None), player.stage, "linear", "", (), 7)
    assert "tip to tumour 12.3&nbsp;mm<" in plain and "tip to tumour within" not in plain
    within = format_report(replace(frame, inside=True), player.stage, "linear", "", (), 7)
    assert ">tip inside the tumour, 12.3&nbsp;mm below its surface<" in within and ">tip to tumour" not in within
    known = TumourError(4.61e-3, "E"), TumourError(4.61e-3, "E", 1.11e-3)
    prior, seen = (format_report(replace(frame, tumour_error=one), player.stage, "linear", "", (), 7) for one in known)
    where, whole = "at most", "at any point of its surface"
    assert f"<p>Tumour position error (95 %): {where} 4.7 mm {whole}; the largest part is E.</p>" in prior
    assert f"<p>Tumour position error (95 %): {where} 1.2 mm {whole}; without cortex observation: 4.7 mm.</p>" in seen
    rough = replace(frame, tumour_error=replace(known[0], is_rough=True))
    guess = format_report(rough, player.stage, "linear", "", (), 7)
    assert f"{where} 4.7 mm {whole}: rough estimate (few samples," in guess and "largest part" not in guess
    for said, off in ((prior, "4.7"), (seen, "1.2")):
        assert f"tip to tumour 12.3&nbsp;±&nbsp;{off}&nbsp;mm<" in said
    surely = format_report(replace(frame, moved_error=5.31e-3, model_error=None), player.stage, "fem", "", (), 7)
    assert "<p>tumour moved 1.23 mm (motion error 5.4 mm)</p>" in surely
    failed = format_report(frame, player.stage, "linear", '<p class="warn">no FEM</p>', (), 7)
    assert failed.index("no FEM") < failed.index("details") < failed.index("frame 3 of 6")
    doubted = replace(frame, tumour_error=known[0], doubt="why", model_error=None)
    assert "(error not known)" in format_report(doubted, player.stage, "linear", "", (), 7)
    assert "tip to tumour 12.3&nbsp;mm<" in format_report(doubted, player.stage, "linear", "", (), 7)
