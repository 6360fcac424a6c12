"""The benchmark's command: files of every part, comparison with earlier figures, what is refused."""

import json
from itertools import product

import matplotlib.image
import pytest
import torch
from tiny_sequence import write_tiny_sequence

from torchtrack.bench import flow, graphs, io, lost, peers, pipeline, presets, scaling, scene, sim, solver, stages, surface
from torchtrack.bench.clock import Clock
from torchtrack.bench.plots import Plot, draw
from torchtrack.bench.results import Report, Result, as_markdown, machine, older_medians, plain, time_result
from torchtrack.bench.setup import Setup
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.errors import ConfigError, MissingExtraError, MissingFileError

CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def short_scenes():
    """Simulated once, for all tests here."""
    scene.simulated.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "DURATION_S", 0.04)
        patch.setattr(scene, "WARM_UP_WINDOWS", 6)
        yield
    scene.simulated.cache_clear()


@pytest.fixture
def tiny(monkeypatch):
    """Every part as small as it can be."""
    small = {
        pipeline: {
            "SHAPES": ("lbracket",),
            "MANY": {"cpu": ((2, 2, 1, 15.0, True), (3, 2, 1, None, True), (2, 2, 2, None, False))},
            "MANY_OBJECTS": 3,
            "CONFIRMED_AFTER": 2,
            "MANY_DURATION_S": 0.065,
            "OUTSIDE_MEV_S": (1.0,),
            "HD": (320, 240),
            "HD_MEV_S": 4.0,
        },
        lost: {
            "SHAPES": ("lbracket", "cube"),
            "COLUMNS": 2,
            "LOST": ("lbracket",),
            "DURATION_S": 0.065,
            "HIDDEN_FROM_US": 30_000,
            "KNOWN_AFTER": 3,
            "SOON": 1,
        },
        graphs: {"SCENES": {"cpu": ((1, 1, 1), (2, 2, 1))}, "WINDOWS": 1},
        presets: {"SHAPES": ("lbracket",), "MOST": {"guided": 1.5, "nns": None}, "DURATION_S": 0.02, "WARM_UP": 1},
        stages: {"SHAPES": ("lbracket",), "MANY": ((2, 2),)},
        solver: {"TARGETS_MS": {1: 2.0, 3: None}},
        surface: {"WINDOWS": ((64, 48, 500),)},
        flow: {"CORNERS": (32, 64)},
        scaling: {"HD": (320, 240), "COLUMNS": 2, "OBJECTS": (1, 2), "STREAMS": (1, 2)},
        sim: {"_FRAMES": 3},
        io: {"TARGETS": {"evt2": 50.0}},
    }
    for module, values in small.items():
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)


def bench(part, folder, *further):
    return main(["bench", part, "-o", str(folder), "--repeats", "1", "--events", "1000", *map(str, further)])


def written(folder, part):
    return json.loads((folder / f"bench_{part}.json").read_text())


# ---- every part


@pytest.fixture
def simulator():
    pytest.importorskip("numba", reason="the simulator needs numba: pip install 'torchtrack[sim]'")


def test_pipeline(tiny, simulator, tmp_path, capsys):
    assert bench("pipeline", tmp_path) == ExitCode.DONE
    content = written(tmp_path, "pipeline")
    names = [entry["name"] for entry in content["results"]]
    assert names[:4] == ["1 object (lbracket), median", "1 object (lbracket), 95 %", "2 objects, median", "2 objects, 95 %"]
    assert names[4:8] == [f"3 objects{when}, {what}" for when in (", while poses are confirmed", "") for what in ("median", "95 %")]
    assert names[8:10] == [f"4 objects in 2 streams, nobody searched for, {what}" for what in ("median", "95 %")]
    alone = [f"{count}, without kernels, {what}" for count in ("1 object (lbracket)", "2 objects") for what in ("median", "95 %")]
    assert names[10:14] == alone
    assert names[14:] == ["1 object with 1 Mev/s outside it over none", "1 object in 320x240 at 4 Mev/s, stream over work"]
    assert all(entry["figures"][0] > 0 and len(entry["figures"]) == 1 for entry in content["results"])
    assert "100.0% of poses are TRACKING" in content["notes"][0]
    assert content["machine"]["kernels"].startswith("numba")
    assert content["machine"]["threads"] == 1 and content["machine"]["device"] == "cpu"
    assert "1 object (lbracket), median" in capsys.readouterr().out


def test_lost(tiny, simulator, tmp_path):
    assert bench("lost", tmp_path) == ExitCode.DONE
    content = written(tmp_path, "lost")
    figures = {entry["name"]: entry["figures"][0] for entry in content["results"]}
    cases = product(("", ", searched for beside, answers after 100 ms"), (("median", 1.5), ("95 %", 2.0)), ("in the first second", "later"))
    for how, (what, most), when in cases:
        none, hidden = (f"2 objects, {who}{how}, {when}, {what}" for who in ("none lost (beside lbracket)", "lbracket lost"))
        ratio = next(entry for entry in content["results"] if entry["name"] == f"{hidden} over none lost")
        assert ratio["figures"][0] == pytest.approx(figures[hidden] / figures[none])
        assert ratio["target"] == most and ratio["lower_is_better"]
    assert [note.partition(": ")[2] for note in content["notes"]] == ["in 100% of its windows"] * 2


def test_presets(tiny, simulator, tmp_path):
    assert bench("presets", tmp_path) == ExitCode.DONE
    entries = {entry["name"]: entry for entry in written(tmp_path, "presets")["results"]}
    assert [*entries][:3] == ["lbracket, default", "lbracket, guided", "lbracket, nns"]
    ratio, plain = entries["lbracket, guided over default"], entries["lbracket, nns over default"]
    assert ratio["figures"][0] == pytest.approx(entries["lbracket, guided"]["figures"][0] / entries["lbracket, default"]["figures"][0])
    assert (ratio["target"], ratio["unit"], plain["target"]) == (1.5, "times", None)


def test_a_sequence_in_place_of_simulated_scenes(tiny, tmp_path, capsys):
    sequence = write_tiny_sequence(tmp_path, duration_us=60_000)
    for part in ("pipeline", "stages"):
        assert bench(part, tmp_path, "--sequence", sequence) == ExitCode.DONE
        assert written(tmp_path, part)["results"][0]["name"].startswith("tiny")
    short = write_tiny_sequence(tmp_path, "short", duration_us=20_000)
    assert bench("pipeline", tmp_path / "none", "--sequence", short) == ExitCode.WRONG_SETTINGS
    assert "more than 6 windows of 5000 µs are needed, and the scene lasts 19501 µs" in " ".join(capsys.readouterr().err.split())


def test_stages(tiny, simulator, tmp_path):
    assert bench("stages", tmp_path) == ExitCode.DONE
    entries = written(tmp_path, "stages")["results"]
    assert {entry["name"] for entry in entries} == {f"{run}: {stage}" for run in ("1 object (lbracket)", "2 objects") for stage in stages.STAGES}
    assert matplotlib.image.imread(tmp_path / "bench_stages_shares.png").shape[2] == 4


def test_graphs(tiny, simulator, tmp_path):
    assert bench("graphs", tmp_path) == ExitCode.DONE
    figures = {entry["name"]: entry["figures"][0] for entry in written(tmp_path, "graphs")["results"]}
    assumed = ("never_found", "lost", "index_radius(gate_scale, config)", "has(window.evidence.triggers, SEARCHED)")
    for count in ("1 objects", "2 objects"):
        shares = [figures[f"{count}: windows in which there is any {what}"] for what in assumed]
        assert shares[:2] == [0, 0] and all(0 <= share <= 100 for share in shares)
        assert figures[f"{count}: contours"] > 0
        assert sum(name.startswith(f"{count}: kernel ") for name in figures) == graphs.LONGEST


def test_solver(tiny, tmp_path):
    assert bench("solver", tmp_path) == ExitCode.DONE
    content = written(tmp_path, "solver")
    assert [(entry["name"], entry["target"], entry["lower_is_better"]) for entry in content["results"]] == [("B=1", 2.0, True), ("B=3", None, True)]
    assert (tmp_path / "bench_solver_throughput.png").is_file()
    yardstick = content["yardstick"]["quartiles"][1]
    assert [entry["over_yardstick"] for entry in content["results"]] == [entry["quartiles"][1] / yardstick for entry in content["results"]]


def test_surface(tiny, tmp_path):
    assert bench("surface", tmp_path) == ExitCode.DONE
    entries = written(tmp_path, "surface")["results"]
    assert [entry["name"] for entry in entries] == [
        "newest times, 64x48, 500 events",
        "surface, 64x48, 208x208 px of it",
        "surface, 64x48, 64x48 px of it",
    ]
    assert entries[0]["target"] == 300 and not entries[0]["lower_is_better"]


def test_flow(tiny, tmp_path):
    assert bench("flow", tmp_path) == ExitCode.DONE
    content = written(tmp_path, "flow")
    assert [entry["name"] for entry in content["results"]] == ["32 corners, irls", "32 corners, arrival", "64 corners, irls", "64 corners, arrival"]
    for note in content["notes"]:
        assert "100% have a flow" in note
        assert float(note.split("median error ")[1].split("%")[0]) < 5


def test_scaling(tiny, simulator, tmp_path):
    assert bench("scaling", tmp_path) == ExitCode.DONE
    content = written(tmp_path, "scaling")
    names = [entry["name"] for entry in content["results"]]
    assert names[:4] == ["1 objects in one stream", "2 objects in one stream", "1 streams of one object", "2 streams of one object"]
    assert names[4:] == ["a further one of 2 objects over the first", "a further one of 2 streams over the first"]
    assert (tmp_path / "bench_scaling_latency.png").is_file() and (tmp_path / "bench_scaling_throughput.png").is_file()


def test_all_parts_but_those_whose_libraries_are_missing(tiny, simulator, tmp_path, monkeypatch, capsys):
    def without(setup):
        raise MissingExtraError("numba", "sim", "the simulator")

    for part in (pipeline, presets, lost, graphs, scaling, peers):
        monkeypatch.setattr(part, "measure", without)
    assert bench("all", tmp_path) == ExitCode.DONE
    assert {path.name for path in tmp_path.glob("*.json")} == {f"bench_{part}.json" for part in ("stages", "solver", "surface", "flow", "io", "sim")}
    assert "left out: pipeline: the simulator needs the library 'numba'" in capsys.readouterr().err
    assert bench("pipeline", tmp_path) == ExitCode.FAILED
    assert bench("all", tmp_path, "--compare", tmp_path / "bench_io.json") == ExitCode.WRONG_SETTINGS


# ---- figures


def test_times_are_to_be_low_and_rates_high():
    assert time_result("x", [0.003], 4.0).reached
    assert time_result("x", [0.005], 4.0).reached is False
    assert time_result("x", [0.005]).reached is None
    assert time_result("x", [0.002]).speed_up(4.0) == pytest.approx(2.0)
    assert Result("x", "Mev/s", (2.0,)).speed_up(4.0) == pytest.approx(0.5)
    assert Result("x", "ms", (0.0,), lower_is_better=True).speed_up(1.0) == float("inf")


@pytest.mark.parametrize(("value", "text"), [(123.456, "123.5"), (10.0, "10.0"), (3.14159, "3.14"), (0.01234, "0.0123"), (0.0, "0")])
def test_figures_have_the_digits_that_tell_something(value, text):
    assert plain(value) == text


def test_lines_and_bars_are_drawn(tmp_path):
    lines = Plot("a", "title", "x", "y", {"one": ((1.0, 2.0), (2.0, 3.0)), "two": ((1.0, 1.0),)})
    bars = Plot("b", "title", "x", "y", {"one": ((0.0, 60.0), (1.0, 30.0)), "two": ((0.0, 40.0), (1.0, 70.0))}, "bars", ("a", "b"))
    for plot in (lines, bars):
        draw(plot, tmp_path / "plot.png")
        image = matplotlib.image.imread(tmp_path / "plot.png")
        assert image.std() > 0.05


def test_the_clock_times_one_run():
    done = []
    seconds = Clock(CPU).seconds(lambda: done.append(sum(range(20_000))), 3)
    assert len(seconds) == 3 and all(value > 0 for value in seconds)
    assert len(done) > 5
    assert Clock(CPU).meaning != Clock(CPU, 2).meaning
    assert len(Clock(CPU, 2).seconds(lambda: None, 2)) == 2


# ---- comparison


def test_figures_are_compared_with_earlier_ones(tiny, tmp_path, capsys):
    old, new = tmp_path / "old", tmp_path / "new"
    assert bench("solver", old) == ExitCode.DONE
    path = old / "bench_solver.json"
    content = json.loads(path.read_text())
    content["results"][0]["quartiles"][1] *= 10
    old_median = content["results"][0]["quartiles"][1]
    del content["results"][1]
    path.write_text(json.dumps(content))
    for given in (path, old):
        assert bench("solver", new, "--compare", given) == ExitCode.DONE
        entries = written(new, "solver")["results"]
        assert entries[0]["speed_up"] == pytest.approx(old_median / entries[0]["quartiles"][1])
        assert entries[1]["speed_up"] is None
    table = (new / "bench_solver.md").read_text()
    assert "against before" in table and "new |" in table
    assert "against before" in capsys.readouterr().out
    assert "against" not in (old / "bench_solver.md").read_text()


def test_what_cannot_be_compared_with_is_refused(tmp_path):
    with pytest.raises(MissingFileError, match=r"no '.*bench_solver.json' to compare with"):
        older_medians(tmp_path, "solver")
    for text in ("{", "[1, 2]", '{"part": "solver"}', '{"part": "solver", "results": [{"name": "x", "quartiles": [1]}]}'):
        (tmp_path / "bench_solver.json").write_text(text)
        with pytest.raises(ConfigError, match="is not a file that `torchtrack bench solver` wrote"):
            older_medians(tmp_path, "solver")
    (tmp_path / "other.json").write_text('{"part": "io", "results": []}')
    with pytest.raises(ConfigError, match="figures of the part 'io', and 'solver' is measured"):
        older_medians(tmp_path / "other.json", "solver")


def test_the_table_says_what_it_was_measured_on():
    text = as_markdown(Report("solver", "Title", (time_result("B=1", [0.003], 2.0),), ("a note",)), machine(CPU), {"B=1": 6.0})
    assert "# Title" in text and "- a note" in text and "processor" in text
    assert "| B=1 | 3.00 ms | 3.00 … 3.00 |  | ≤ 2 | missed | 2.00x |" in text


def test_times_are_told_as_multiples_of_the_yardstick_too():
    results = (time_result("B=1", [0.003], 2.0), Result("rate", "Mev/s", (5.0,)))
    report = Report("solver", "Title", results, yardstick=time_result("fixed work", [0.002, 0.0015, 0.001]))
    text = as_markdown(report, machine(CPU))
    assert "| B=1 | 3.00 ms | 3.00 … 3.00 | 2.00 | ≤ 2 | missed |" in text
    assert "| rate | 5.00 Mev/s | 5.00 … 5.00 |  | – |  |" in text
    assert "- The yardstick took 1.50 ms (1.25 … 1.75): fixed work" in text


# ---- what is refused


@pytest.mark.parametrize(
    ("part", "further", "message"),
    [
        ("solver", ("--repeats", 0), "at least 1, got 0"),
        ("solver", ("--threads", 0), "at least 1"),
        ("io", ("--events", 0), "at least 1"),
        ("solver", ("--device", "tpu"), "must be cpu, cuda or cuda:N, got 'tpu'"),
        ("solver", ("--device", "meta"), "must be cpu, cuda or cuda:N, got 'meta'"),
        ("solver", ("--device", "cuda:99"), "GPUs here. Measure on the CPU"),
        ("solver", ("--tracker.window.duration_us", 3), "takes no settings"),
    ],
)
def test_wrong_options_are_refused(part, further, message, tmp_path, capsys):
    assert bench(part, tmp_path / "out", *further) == ExitCode.WRONG_SETTINGS
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_what_is_not_there_is_told(tiny, tmp_path, capsys):
    assert bench("solver", tmp_path, "--compare", tmp_path / "none.json") == ExitCode.FAILED
    assert "to compare with" in capsys.readouterr().err
    assert bench("pipeline", tmp_path, "--sequence", tmp_path / "none.npz") == ExitCode.FAILED


def test_an_unknown_part_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench("wheels", tmp_path)
    assert "wheels" in capsys.readouterr().err


def test_targets_of_a_cpu_are_none_of_a_gpu():
    assert Setup().cpu_target(2.0) == 2.0
    assert Setup(device=torch.device("cuda")).cpu_target(2.0) is None
    assert set(pipeline.MANY) == set(pipeline.ONE_OBJECT_MS) == {"cpu", "cuda"}


def test_a_setup_measures_on_one_thread_unless_told():
    assert Setup().clock == Clock(CPU, 1)
    Setup().show("nothing")
