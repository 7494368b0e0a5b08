"""Maps drawn as text."""

import pytest
from hypothesis import given

import oracles
import strategies
from mapf_env import Instance, parse_instance, parse_map
from mapf_env.pixels import text

DRAWING = """
    A.#b
    B..a
"""


def test_a_drawing_is_read_as_it_looks() -> None:
    instance = parse_instance(DRAWING)
    assert instance == Instance([[0, 0, 1, 0], [0, 0, 0, 0]], [[0, 0], [1, 0]], [[1, 3], [0, 3]])
    assert (parse_map(DRAWING) == instance.grid).all()
    assert parse_instance("A@").goals.tolist() == [[0, 0]], "a robot without a goal is on it"


@given(strategies.grids())
def test_maps_are_read_back(grid: oracles.Grid) -> None:
    drawn = "\n".join("".join("#" if cell else "." for cell in row) for row in grid)
    assert (parse_map(drawn) == grid).all()


@given(strategies.instances(max_agents=5))
def test_rendered_text_is_read_back(instance: Instance) -> None:
    """Instances in which no robot stands on a goal, its own or another's."""
    if not set(oracles.cells(instance.starts)) & set(oracles.cells(instance.goals)):
        assert parse_instance(text(instance.grid, instance.starts, instance.goals)) == instance


@pytest.mark.parametrize(
    ("drawing", "message"),
    [
        ("", "no cells"),
        ("..\n.", "line 2 has 1 cells, line 1 has 2"),
        (".?", r"line 1: unknown character '\?'"),
        ("AA", r"the letter A stands at \(0, 0\) and at \(0, 1\)"),
        ("a.", "the goal a has no robot A"),
        ("A#a", "agent 0 cannot reach its goal"),
        ("..", "starts must have shape"),
    ],
)
def test_bad_drawings_are_refused(drawing: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_instance(drawing)
