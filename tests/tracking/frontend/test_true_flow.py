"""Flow of simulated scenes beside the true speed of contours: ``pytest -s`` prints the table of docs/method.md."""

import pytest
from true_flow import MODELS, flow_errors


@pytest.mark.parametrize("name", ["lbracket_normal", "ape_normal", "satellite_normal"])
def test_arrival_flow_is_the_speed_of_contours_across_themselves(name, data_dir):
    errors = flow_errors(data_dir / "sequences" / f"{name}.npz", 600_000)
    for model in MODELS:
        print(f"\n| {name} | {model} | {errors[model].row()} |", end="")
    low, _, high = errors["arrival"].quartiles
    assert round(low, 2) >= 0.95 and round(high, 2) <= 1.2
    assert errors["arrival"].sign_right >= 0.94
    assert errors["arrival"].known > 0.5
    # Least squares on newest events, at the same events.
    spread = [errors[model].quartiles[2] - errors[model].quartiles[0] for model in ("arrival", "irls")]
    assert spread[0] < spread[1]
