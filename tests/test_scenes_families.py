"""Families of episodes in the shipped plans."""

from scenes.episodes.families import FAMILIES, FamilyMotions
from scenes.episodes.plan import list_shipped_plans, load_plan
from scenes.episodes.scripted import sample_episode


def test_shipped_plans_sample_all_bodies_and_families():
    assert list_shipped_plans() == ["hard", "small", "standard"]
    families = set()
    for name in list_shipped_plans():
        plan = load_plan(name)
        drawn = [sample_episode(plan.contents, 0, number) for number in range(60)]
        assert {each.body for each in drawn} == set(range(plan.contents.bodies.count))
        families |= {each.family for each in drawn}
    assert families == set(FAMILIES) == set(FamilyMotions.__struct_fields__)
