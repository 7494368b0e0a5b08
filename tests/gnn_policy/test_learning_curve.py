"""The learning curve is a picture, whatever was recorded."""

from typing import Any

import pytest

from gnn_policy.learning_curve import Round, draw_learning_curve


def row(number: int = 0, **validation: Any) -> Round:
    return Round(
        round=number,
        updates=number,
        samples=100 * number,
        seconds=1.0,
        collect_seconds=0.5,
        expert_seconds=0.1,
        fit_seconds=0.5,
        loss=1.0 / (number + 1),
        accuracy=0.5,
        lr=1e-3,
        demonstrations=10,
        unlabelled=0,
        **validation,
    )


def test_merit_is_success_times_throughput_then_the_smaller_flowtime_increase():
    assert row().merit is None
    assert row(validation_success=0.5, validation_flowtime_increase=0.1).merit == (0.5, -0.1)
    assert row(validation_throughput=2.0).merit == (2.0, 0.0)
    both: dict[str, Any] = {"validation_success": 0.5, "validation_throughput": 3.0}
    assert row(**both, validation_flowtime_increase=0.2).merit == (1.5, -0.2)


@pytest.mark.parametrize("measured", [("validation_success",), ("validation_success", "validation_throughput")])
@pytest.mark.parametrize("validated", [[], [1], [0, 1, 2]])
def test_a_png_is_drawn(tmp_path, validated, measured):
    rounds = [row(i, **(dict.fromkeys(measured, 0.5) if i in validated else {})) for i in range(3)]
    draw_learning_curve(rounds, tmp_path / "draft")
    content = (tmp_path / "draft").read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    assert int.from_bytes(content[16:20], "big") > 800
