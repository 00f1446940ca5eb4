import threading

from theatres import short

from scenes.page.background_study import BackgroundStudy
from scenes.page.effect_costs import format_effect_table, measure_costs
from scenes.play.effect_ablation import ALL, AblationRow


def test_each_effect_of_a_scene_is_measured(theatre):
    shown, scene = [], short()
    costs = BackgroundStudy(lambda: measure_costs(theatre, scene), threading.Lock(), shown.append)
    costs.start()
    costs.thread.join(120.0)
    assert len(shown) == 2 + len(scene.effects)
    assert "all effects" in shown[-1] and "push of the tool" in shown[-1] and "being measured" not in shown[-1]
    assert "being measured" in shown[-2] and "always on" in shown[-1]


def test_a_table_has_time_and_motion_of_each_effect():
    rows = [AblationRow(ALL, 240.0, 1.0, 4.3, 5.0), AblationRow("Retraction", 180.0, 1.0, 4.25, 5.0)]
    said = format_effect_table(rows, 2)
    assert "<td>the spatula</td><td>+180 ms</td><td>4.25 mm</td>" in said and "1 more" in said
