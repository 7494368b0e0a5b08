"""The learning curve is a picture, whatever was recorded."""

import pytest

from gnn_policy.learning_curve import Round, draw_learning_curve


@pytest.mark.parametrize("validated", [[], [1], [0, 1, 2]])
def test_a_png_is_drawn(tmp_path, validated):
    rounds = [
        Round(
            round=i,
            updates=i,
            samples=100 * i,
            seconds=1.0,
            collect_seconds=0.5,
            expert_seconds=0.1,
            fit_seconds=0.5,
            loss=1.0 / (i + 1),
            accuracy=0.5,
            lr=1e-3,
            demonstrations=10,
            unlabelled=0,
            validation_success=0.5 if i in validated else None,
        )
        for i in range(3)
    ]
    draw_learning_curve(rounds, tmp_path / "draft")
    content = (tmp_path / "draft").read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    assert int.from_bytes(content[16:20], "big") > 800
