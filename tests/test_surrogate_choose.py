"""Choice among learners: the Pareto front."""

from surrogate.evaluation.choose import find_pareto_front


def test_pareto_front_excludes_dominated_learners():
    places = {"a": (1.0, 5.0), "b": (2.0, 2.0), "c": (2.5, 2.0), "d": (9.0, 1.0), "e": (2.0, 2.0)}
    assert find_pareto_front(places) == {"a", "b", "d", "e"}
    assert find_pareto_front({}) == frozenset()
