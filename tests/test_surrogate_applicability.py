"""Applicability of a trained model: effects, causes, bodies and tissue of its training."""

from dataclasses import replace

import numpy as np
import pytest
from test_scenes_effects import EFFECTS
from theatres import short, sinking

from scenes.builtin.retract import RELAXING_BRAIN
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch
from sim.accuracy import LIVE
from sim.effects import Elasticity, Gravity, Held, NodalForce, ToolForce
from sim.errors import InputError
from sim.loads import Loads
from sim.material import Material, to_tissue_json
from surrogate.model.applicability import find_rejection, read_trained_effects


class TestLearnt:
    def test_model_rejects_effects_outside_its_training(self, theatre):
        model = theatre.models["linear"]
        assert find_rejection(model, short().effects) is None
        why = find_rejection(model, (*short().effects, Gravity()))
        assert why is not None and "not under Gravity" in why
        with pytest.raises(InputError, match=r"svr does not know the scene sinking.*but Gravity. Choose one of fem"):
            theatre.build_player("svr", sinking())
        # No force at all: it has nothing to say of that either.
        assert "here is none" in (find_rejection(model, EFFECTS) or "") and theatre.list_deformers(
            replace(short(), effects=EFFECTS)
        ) == ("fem",)
        assert theatre.list_deformers(short()) == ("linear", "svr", "guarded", "fem") and theatre.list_deformers(
            sinking()
        ) == ("fem",)
        assert theatre.select_best(sinking()) == "fem"

    def test_model_rejects_loads_of_unsupported_causes(self, theatre):
        model, scene = theatre.models["linear"], sinking()
        with pytest.raises(InputError, match="causes Posture"):
            model.deform(scene.build_loads(theatre.site, Touch(), 0.0))
        with pytest.raises(InputError, match="causes none"):
            model.deform(Loads((), np.zeros(2)))

    def test_training_record_lists_the_trained_effects(self, theatre):
        model = theatre.models["linear"]
        assert read_trained_effects(model.training) == {
            "Elasticity",
            "Held",
            "Slide",
            "ToolForce",
        }  # its file does not say
        effects = (Elasticity(regions={2: Elasticity().default}), Held(), ToolForce(), NodalForce())  # type: ignore
        stated = replace(model, training={"effects": repr(effects)})
        assert read_trained_effects(stated.training) == {"Elasticity", "Held", "ToolForce", "NodalForce"}
        # Nothing slides in this body, and nodal forces act where loads hold some.
        assert find_rejection(stated, short().effects) is None
        why = find_rejection(stated, (Elasticity(), ToolForce()))
        assert why is not None and "never without Held" in why

    def test_model_of_sliding_skull_requires_slide_effect(self, theatre, box):
        normal = np.zeros_like(box.slide_normal)
        normal[0, 0] = 1.0
        model = replace(theatre.models["linear"], anatomy=replace(box, slide_normal=normal))
        why = find_rejection(model, (Elasticity(), Held(), ToolForce()))
        assert why is not None and "never without Slide" in why

    def test_fem_physics_is_independent_of_stored_models(self, theatre):
        training = {"element": "p1", "tissue": to_tissue_json(Material("neo-hookean", 9000.0, 0.3))}
        other = replace(theatre, models={"linear": replace(theatre.models["linear"], training=training)})
        assert other.build_fem(short(), LIVE).description == "finite elements (smoothed; neo-hookean, E 3 kPa, nu 0.49)"
        for scene in (short(), sinking()):
            found, alone = (each.build_fem(scene, LIVE) for each in (other, replace(theatre, models={})))
            assert (found.space.element, found.effects) == (alone.space.element, alone.effects)

    @pytest.mark.parametrize(
        ("training", "reason"),
        [
            ({"element": "p1"}, "learned from p1 elements, and here they are smoothed"),
            ({"tissue": to_tissue_json(Material("neo-hookean", 9000.0, 0.3))}, "E 9 kPa, nu 0.3, and here it is .*E 3"),
        ],
    )
    def test_model_of_other_tissue_or_element_is_rejected(self, theatre, training, reason):
        model = replace(theatre.models["linear"], training=training)
        other = replace(theatre, models={"linear": model})
        assert other.list_deformers(short()) == ("fem",)
        with pytest.raises(InputError, match=reason):
            other.build_deformer("linear", short())
        tissue, element = (Material("neo-hookean", 9000.0, 0.3), None) if "tissue" in training else (None, "p1")
        assert other.build_deformer("linear", short().replace_tissue(tissue, element)) is model

    def test_replaced_tissue_keeps_its_relaxation(self):
        scene = find_scene("retract").replace_tissue(Material("neo-hookean", 9000.0, 0.3), "p2")
        (effect,) = (each for each in scene.effects if isinstance(each, Elasticity))
        assert scene.element == "p2" and effect.default == Material("neo-hookean", 9000.0, 0.3, RELAXING_BRAIN.prony)
        with pytest.raises(InputError, match="does not support relaxation"):
            find_scene("retract").replace_tissue(Material("linear", 9000.0, 0.3), None)
