"""Text of the page: error bound of a solution, tissue and elements, solver plans."""

from dataclasses import replace

import numpy as np
import pytest
from test_scenes_page import answer
from theatres import short, sinking, small

from scenes.page.text import (
    RESEARCH_ONLY,
    describe_fem,
    describe_result,
    describe_scene,
    format_caption,
    format_report,
    format_solver_list,
)
from scenes.play.deformers import GUARDED, describe_solvers
from scenes.play.player import Player
from scenes.script.scene import find_scene
from scenes.script.tool_paths import press
from sim.accuracy import LIVE
from sim.deformation import Outcome
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.material import Material


class TestTrust:
    def test_page_reports_error_bound_inside_training_range(self):
        said = describe_result(answer(Outcome.PREDICTED), "svr")
        assert "Surrogate error (95 %): at most" in said and "1.00 mm" in said and "warn" not in said

    @pytest.mark.parametrize(
        "outcome", [Outcome.EXTRAPOLATED, Outcome.BUDGET, Outcome.STALLED, Outcome.NOT_FINITE, Outcome.PIERCED]
    )
    def test_page_warns_of_unreliable_solution_without_bound(self, outcome):
        """Shown in the warning colour, with the reason."""
        said = describe_result(answer(outcome), "svr")
        assert "Surrogate error" not in said and 'class="warn"' in said and "Do not rely on this result" in said

    def test_page_states_whether_guarded_used_model_or_fem(self):
        shown = describe_result(answer(Outcome.PREDICTED), GUARDED)
        assert shown.startswith("<p><b>fast model</b>: inside the range")
        assert "because the error bound of the fast model is too large</b>: converged" in describe_result(
            answer(Outcome.CONVERGED), GUARDED
        )

    def test_page_text_has_no_names_of_the_code(self):
        for outcome in Outcome:
            said = describe_result(answer(outcome), "fem")
            assert "_" not in said and outcome.name not in said

    @pytest.mark.parametrize(("bound", "words"), [(1e-7, "0.01 mm"), (6e-6, "0.01 mm"), (1.231e-3, "1.24 mm")])
    def test_error_bound_is_rounded_up_in_page_text(self, bound, words):
        bounded = replace(answer(Outcome.PREDICTED), bound=np.full((2, 1), bound))
        assert f"Surrogate error (95 %): at most {words} at any point" in describe_result(bounded, "svr")

    def test_undeformed_brain_has_no_motion_and_error_text(self, theatre):
        scene = small(path=press(0.2), duration=1.0)
        player = Player(theatre.build_stage(scene), theatre.build_deformer("linear", scene))
        frames = [player.draw(0, time, player.scene.path(time)) for time in (0.0, 0.9)]
        said = [format_report(frame, player.stage, "linear", "", (), 2) for frame in frames]
        assert "tumour moved" not in said[0] and "Nothing moves the tumour" in said[0]
        assert "tumour moved" in said[1] and "Nothing moves" not in said[1]

    def test_page_has_no_error_bound_without_motion(self):
        still = answer(Outcome.PREDICTED)
        still = replace(still, displacement=0.0 * still.displacement)
        said = describe_result(still, "svr")
        assert "Nothing moves the tumour." in said and "Surrogate error" not in said


class TestWords:
    def test_caption_describes_lines_and_research_use(self, theatre):
        said = format_caption(theatre, short(), "the <default> brain")
        assert RESEARCH_ONLY in said and "&lt;default&gt;" in said and "<default>" not in said
        assert "predicted tumour" in said and "tumour in the scan" in said and "tip to tumour" in said
        assert "tip to tumour" not in format_caption(theatre, sinking(), "brain")

    def test_fem_description_states_tissue_and_element(self, theatre):
        default = "smoothed linear tetrahedra, neo-hookean tissue of Young's modulus 3 kPa"
        assert describe_fem(theatre, short()).startswith(default)
        stiff = Elasticity(Material("corotational", 5e3, 0.4, prony=()))
        plain = replace(theatre, models={})
        other = replace(short(), effects=(stiff, Held(), Slide(), ToolForce()), element="smoothed")
        assert describe_fem(plain, other) == (
            "smoothed linear tetrahedra, corotational tissue of Young's modulus 5 kPa and Poisson's ratio 0.4"
        )
        assert describe_fem(plain, find_scene("retract")).endswith("viscoelastic")
        assert describe_fem(plain, find_scene("sag")).endswith(
            "Young's modulus 1.8 kPa and Poisson's ratio 0.45; the tumour of neo-hookean tissue of Young's modulus "
            "3.2 kPa and Poisson's ratio 0.45"
        )
        assert "Brain: brain.vtu; " in describe_scene(theatre, short(), "brain.vtu")

    def test_solver_plan_is_an_html_list_and_only_for_fem(self, theatre):
        shown = format_solver_list(("First <this>.", "Then that."))
        assert shown == "<ul><li>First &lt;this&gt;.</li><li>Then that.</li></ul>"
        assert format_solver_list(()) == "" == format_solver_list(describe_solvers(theatre.models["linear"]))
        scene = small("resection")
        assert describe_solvers(theatre.build_fem(scene, scene.accuracy)) == ()
        assert describe_solvers(theatre.build_fem(short(), LIVE)) == theatre.build_fem(short(), LIVE).plan.explain()
