import pytest
from pydantic import ValidationError

from torchtrack.config.describe import described
from torchtrack.config.evaluate import EvaluateConfig
from torchtrack.config.explain import dotted_keys
from torchtrack.config.load import as_yaml, load, read_yaml, typed
from torchtrack.config.merge import merged, nested
from torchtrack.config.presets import preset
from torchtrack.config.run import ObjectConfig, PoseConfig, RunConfig
from torchtrack.config.settings import CommandLineText
from torchtrack.errors import ConfigError, MissingFileError


def write(folder, text, name="config.yaml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def mistakes_of(path, settings=RunConfig, overrides=None):
    with pytest.raises(ConfigError) as caught:
        load(settings, path, overrides)
    return str(caught.value)


def test_all_mistakes_are_told_at_once_with_dotted_keys_and_the_file(tmp_path):
    path = write(
        tmp_path,
        """
        tracker: {window: {duration_us: -5, mod: time}}
        objects: [{label: a}, {label: b, meshh: b.ply}]
        overlay: {stills: many}
        """,
    )
    message = mistakes_of(path)
    assert str(path) in message
    assert "5 settings are wrong" in message
    assert "tracker.window.duration_us: input should be greater than or equal to 100, got -5" in message
    assert "tracker.window.mod: unknown setting; perhaps you meant 'tracker.window.mode'" in message
    assert "objects.1.meshh: unknown setting; perhaps you meant 'objects.1.mesh'" in message
    assert "overlay.stills: input should be a valid integer" in message and "got 'many'" in message
    assert "source: missing" in message


def test_a_setting_in_the_wrong_place_is_pointed_home(tmp_path):
    assert "duration_us: unknown setting; perhaps you meant 'tracker.window.duration_us'" in mistakes_of(
        write(tmp_path, "source: a.npz\nduration_us: 3000\n")
    )


def test_an_unknown_name_near_nothing_lists_what_is_known(tmp_path):
    assert "tracker.qqq: unknown setting; known here: window, surface" in mistakes_of(write(tmp_path, "source: a.npz\ntracker: {qqq: 1}\n"))


def test_mistakes_on_the_command_line_say_so(tmp_path):
    message = mistakes_of(write(tmp_path, "source: a.npz\n"), overrides={"tracker.window.duration_us": typed("fast")})
    assert "tracker.window.duration_us (command line): input should be a valid integer" in message


def test_unknown_preset_is_named_once(tmp_path):
    message = mistakes_of(write(tmp_path, "source: a.npz\npreset: papre\n"))
    assert "1 setting is wrong" in message
    assert "preset: input should be 'default', 'causal', 'learned', 'guided', 'paper', 'line', 'ls' or 'nns', got 'papre'" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("source: a\nsource: b\n", "the key 'source' is given twice"),
        ("tracker:\n  window: {}\n  window: {}\n", "the key 'window' is given twice"),
        ("source: [a\n", "not valid YAML"),
        ("- a\n- b\n", "got a list"),
    ],
)
def test_files_that_are_no_settings(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=r"config\.yaml") as caught:
        read_yaml(path)
    assert expected in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(MissingFileError, match=r"nowhere\.yaml"):
        load(RunConfig, tmp_path / "nowhere.yaml")


def test_empty_file_has_no_settings(tmp_path):
    assert read_yaml(write(tmp_path, "")) == {}


def test_preset_is_weaker_than_file_and_file_weaker_than_command_line(tmp_path):
    path = write(tmp_path, "source: a.npz\npreset: paper\ntracker: {window: {duration_us: 7000}, flow: {iterations: 9}}\n")
    tracker = load(RunConfig, path, {"tracker.flow.iterations": typed("11")}).tracker
    paper = preset("paper")
    assert tracker.window.duration_us == 7000
    assert tracker.flow.iterations == 11
    assert tracker.association == paper.association != preset("default").association


def test_paths_are_relative_to_the_file_or_the_working_folder(tmp_path, monkeypatch):
    here, configs = tmp_path / "here", tmp_path / "configs"
    here.mkdir(), configs.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("DATA", str(tmp_path / "data"))
    path = write(configs, "source: ../a.npz\nobjects: [{label: a, mesh: $DATA/a.ply}]\n")
    config = load(RunConfig, path)
    assert config.source == tmp_path / "a.npz"
    assert config.objects[0].mesh == tmp_path / "data" / "a.ply"
    assert config.output == here / "outputs" / "track"
    assert load(RunConfig, path, {"source": CommandLineText("b.npz")}).source == here / "b.npz"


def test_home_and_unset_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("NOT_SET", raising=False)
    assert load(RunConfig, None, {"source": typed("~/a.npz")}).source == tmp_path / "a.npz"
    with pytest.raises(ConfigError, match="source.*environment variable NOT_SET is not set"):
        load(RunConfig, None, {"source": typed("$NOT_SET/a.npz")})


def test_resolved_settings_read_back_to_the_same(tmp_path):
    config = load(RunConfig, None, {"source": "a.npz", "preset": "paper", "tracker.window.duration_us": 3000, "objects": [{"label": "a"}]})
    assert load(RunConfig, write(tmp_path, as_yaml(config))) == config


def test_settings_are_frozen():
    config = RunConfig(source="a.npz")
    with pytest.raises(ValidationError, match="frozen"):
        config.device = "cuda"


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, "got none"),
        ({"matrix": [[1, 0, 0, 0]] * 4, "translation_m": [0, 0, 1]}, "got matrix and translation_m"),
    ],
)
def test_a_pose_is_given_in_exactly_one_way(values, expected):
    with pytest.raises(ValidationError, match=expected):
        PoseConfig(**values)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"objects": [{"label": "a"}, {"label": "a"}]}, "labels must differ; a given more than once"),
        ({"start_us": 5, "end_us": 5}, "end_us must be after start_us"),
        ({"objects": [{"label": "a", "mesh": "a.ply", "polylines": "a.txt"}]}, "mesh or polylines, not both"),
        ({"objects": [{"label": "a/b"}]}, "objects.0.label"),
        ({"camera": {"fx": 100, "fy": 100}}, "cx, cy, width, height missing"),
        ({"camera": {"calibration": "calib.txt", "fx": 100}}, "not both"),
        ({"device": "gpu"}, "device"),
        ({"tracker": {"association": {"max_events": 0}}}, "nothing would be observed: .* set association.max_events"),
    ],
)
def test_settings_that_contradict_themselves(values, expected):
    with pytest.raises(ConfigError, match=expected):
        load(RunConfig, None, {"source": "a.npz", **values})


def test_an_object_without_a_model_is_fine_where_a_sequence_brings_it():
    assert ObjectConfig(label="a").mesh is None


def test_methods_of_an_evaluation_start_from_their_presets():
    config = load(
        EvaluateConfig, None, {"methods": {"ours": {}, "theirs": {"preset": "paper"}, "long": {"tracker": {"window": {"duration_us": 9000}}}}}
    )
    assert config.methods["ours"].tracker == preset("default")
    assert config.methods["theirs"].tracker == preset("paper")
    assert config.methods["long"].tracker.window.duration_us == 9000


def test_typo_inside_a_method_is_found(tmp_path):
    message = mistakes_of(write(tmp_path, "methods: {mine: {tracker: {windw: {}}}}\n"), EvaluateConfig)
    assert "methods.mine.tracker.windw: unknown setting; perhaps you meant 'methods.mine.tracker.window'" in message


@pytest.mark.parametrize(("text", "value"), [("3", 3), ("0.5", 0.5), ("true", True), ("null", None), ("[1, 2]", [1, 2]), ("a b", "a b"), ("[", "[")])
def test_values_of_the_command_line(text, value):
    assert typed(text) == value


def test_merging_goes_into_mappings_and_replaces_the_rest():
    assert merged({"a": {"b": 1, "c": [1]}, "d": 1}, {"a": {"c": [2]}, "e": 3}) == {"a": {"b": 1, "c": [2]}, "d": 1, "e": 3}
    assert nested({"a.b": 1, "a.c": 2, "d": 3}) == {"a": {"b": 1, "c": 2}, "d": 3}


@pytest.mark.parametrize("settings", [RunConfig, EvaluateConfig])
def test_every_setting_says_what_it_is(settings):
    rows = list(described(settings))
    assert len(rows) == len(list(dotted_keys(settings)))
    assert [key for key, _, _, meaning in rows if not meaning.strip()] == []
