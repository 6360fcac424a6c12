import json

import pytest

from torchtrack.bench import sim
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main


def test_the_simulator_is_measured(monkeypatch, tmp_path, capsys):
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")
    monkeypatch.setattr(sim, "_FRAMES", 3)
    assert main(["bench", "sim", "-o", str(tmp_path), "--repeats", "1"]) == ExitCode.DONE
    written = json.loads((tmp_path / "bench_sim.json").read_text())
    names = [result["name"] for result in written["results"]]
    assert names[0] == "rendering, rasterizer"
    assert names[-2:] == ["events, default", "events, realistic"]
    assert all(figure > 0 for result in written["results"] for figure in result["figures"])
    assert "rendering, rasterizer" in capsys.readouterr().out
