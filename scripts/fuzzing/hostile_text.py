"""Configs, calibrations, poses and events as text: bombs of aliases, nesting, numbers without end, patterns that backtrack."""

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

Make = Callable[[Path], None]

_ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
_MERGES = "m0: &m0 {k: v}\n" + "".join(f"m{n}: &m{n} {{<<: [{', '.join([f'*m{n - 1}'] * 9)}], k{n}: v}}\n" for n in range(1, 12))
_YAML = {
    "aliases": _ALIASES,
    "merges": _MERGES,
    "merged_with_aliases": _ALIASES + "<<: *a11\n",
    "within_itself": "a: &a [*a]\n",
    "merged_with_itself": "a: &a {<<: *a}\n",
    "key_within_itself": "? &a [*a]\n: 1\n",
    "nested_lists": "source: " + "[" * 100_000,
    "nested_maps": "{a: " * 50_000,
    "nested_blocks": "".join(" " * n + "a:\n" for n in range(2000)),
    "nested_dashes": "- " * 50_000,
    "list_as_key": "[1, 2]: 3\n",
    "map_as_key": "{a: 1}: 3\n",
    "question_key": "? [a]\n: 1\n",
    "null_key": "~: 1\n",
    "number_key": "1: 2\n1.5: 3\n.nan: 4\n",
    "date_key": "2024-01-01: 2\n",
    "no_date": "source: 2024-13-45\n",
    "no_time": "source: 2001-99-99 10:61:00\n",
    "date": "source: 2001-01-01\nstart_us: 2001-01-01\n",
    "long_number": "start_us: " + "9" * 6000 + "\n",
    "long_octal": "start_us: 0" + "7" * 200_000 + "\n",
    "long_sexagesimal": "start_us: 1" + ":59" * 5000 + "\n",
    "long_float": "start_us: 1." + "9" * 500_000 + "e999999999\n",
    "infinite": "start_us: .inf\nend_us: .nan\nthreads: -.inf\n",
    "tags": "source: !!python/object/apply:os.system [echo]\n",
    "unknown_tag": "source: !x 5\n",
    "binary": "source: !!binary ====\n",
    "set": "source: !!set {a, b}\nobjects: !!omap [a: 1]\n",
    "two_documents": "source: a\n---\nsource: b\n",
    "long_key": "a" * 2000 + ": 1\n",
    "long_text": "source: " + "a" * 5000 + "\n",
    "long_path": "source: " + "/".join(["a" * 300] * 30) + "\n",
    "very_long": "# " + "x" * (9 << 20) + "\n",
    "many_keys": "".join(f"k{n}: {n}\n" for n in range(150_000)),
    "many_mistakes": "objects: [" + "{label: 1, mesh: 2, x: 3}, " * 5000 + "]\n",
    "null_character": 'source: "a\\0b"\n',
    "surrogate": 'source: "\\ud800"\n',
    "no_character": 'source: "\\U99999999"\n',
    "variable": "source: $NOT_THERE/a\n",
    "home": "source: ~nobody_of_that_name/a\n",
    "tabs": "\t- a\n",
    "blanks": "source:" + " " * 200_000 + "a\n" + " " * 200_000 + "\n",
    "quotes": "source: '" + "''" * 100_000 + "\n",
    "scalar": "just text\n",
    "list": "[1, 2, 3]\n",
    "long_label": "source: a\nobjects: [{label: " + "a" * 300_000 + "}]\n",
    "itself": "source: x.yaml\n",
    "scenes_of_itself": "scenes: [x.yaml, '*']\n",
    "many_scenes": "scenes: [" + "'**/*', " * 50 + "]\n",
    "variant_in_variant": "variants: {a: {variant: a, variants: {a: {}}}}\nobjects: [{label: a, shape: cube}]\n",
    "variants_list": "variants: [1, 2]\n",
    "methods_list": "methods: [1, 2]\n",
    "preset_list": "preset: [default]\n",
    "preset_map": "preset: {a: 1}\n",
    "tracker_text": "tracker: fast\n",
}


def text_inputs() -> Iterator[tuple[str, str, str, Make]]:
    """Name, kind, file, and what makes it."""
    for name, text in _YAML.items():
        for kind in ("track", "evaluate", "simulate", "demo", "calibration"):
            yield f"yaml_{name}_{kind}", kind, "x.yaml", partial(_write, text=text)
    yield "yaml_utf16", "track", "x.yaml", lambda path: path.write_bytes("source: a\n".encode("utf-16"))
    yield "yaml_latin", "track", "x.yaml", lambda path: path.write_bytes(b"source: \xe9\xff\n")
    for kind, file in (("calibration", "x.json"), ("poses", "x.json"), ("lines", "x.json")):
        yield f"json_nested_{kind}", kind, file, partial(_write, text='{"a":' * 100_000)
        yield f"json_lists_{kind}", kind, file, partial(_write, text='{"polylines":' + "[" * 100_000)
        yield f"json_long_number_{kind}", kind, file, partial(_write, text='{"polylines": [[[' + "9" * 6000 + ", 0, 0], [0, 0, 1]]]}")
        yield f"json_infinite_{kind}", kind, file, partial(_write, text='{"polylines": [[[Infinity, 0, 0], [NaN, 0, 1]]], "unit": "m"}')
        yield f"json_large_{kind}", kind, file, partial(_write, text='{"polylines": [[[1e308, 0, 0], [-1e308, 0, 1]]], "unit": "m"}')
    yield "calibration_many", "calibration", "calib.txt", partial(_write, text="1.5 " * 500_000)
    yield "calibration_huge", "calibration", "calib.txt", partial(_write, text="1e300 1e300 1e300 1e300 1e300 1e300 1e300 1e300 1e300")
    yield "calibration_strong", "calibration", "calib.txt", partial(_write, text="80 80 31 23 1e6 -1e12 1e3 1e3 1e18")
    yield "poses_many", "poses", "x.csv", _many_poses
    yield "poses_bop_many", "poses", "x.json", _bop
    yield "poses_long_line", "poses", "x.txt", partial(_write, text="0 " * 5_000_000)
    yield "poses_quotes", "poses", "x.csv", partial(_write, text='t,tx,ty,tz,qx,qy,qz,qw\n"' + "a" * 200_000 + "\n")
    yield (
        "poses_times",
        "poses",
        "x.csv",
        partial(_write, text="t_us,tx,ty,tz,qx,qy,qz,qw\n-9223372036854775808,0,0,1,0,0,0,1\n9223372036854775807,0,0,1,0,0,0,1\n"),
    )
    yield "poses_long_time", "poses", "x.csv", partial(_write, text="t_us,tx,ty,tz,qx,qy,qz,qw\n" + "9" * 5000 + ",0,0,1,0,0,0,1\n")
    yield "poses_nan", "poses", "x.csv", partial(_write, text="t_us,tx,ty,tz,qx,qy,qz,qw\n1,nan,0,1,0,0,0,1\n2,inf,0,1,0,0,0,nan\n")
    yield "poses_huge", "poses", "x.txt", partial(_write, text="1 1e308 1e308 1e308 0 0 0 1\n2 -1e308 1e308 1e308 0 0 0 1\n")
    yield "poses_exponent", "poses", "x.txt", partial(_write, text="1e999999999 0 0 1 0 0 0 1\n")
    for kind in ("csv", "txt"):
        yield f"long_line_{kind}", "events", f"x.{kind}", partial(_write, text="1," * (6 << 20))
        yield f"blank_line_{kind}", "events", f"x.{kind}", partial(_write, text=" " * (6 << 20))
        yield f"blank_lines_{kind}", "events", f"x.{kind}", partial(_write, text=_FIRST[kind] + " \n" * (3 << 20))
        yield f"comments_{kind}", "events", f"x.{kind}", partial(_write, text="#" * 60_000 + "\n" + _FIRST[kind])
        yield f"widths_{kind}", "events", f"x.{kind}", partial(_write, text="# " + "width=1 " * 7000 + "\n" + _FIRST[kind])
        yield f"wide_blanks_{kind}", "events", f"x.{kind}", partial(_write, text="# width" + " " * 60_000 + "=x\n" + _FIRST[kind])
        yield f"long_numbers_{kind}", "events", f"x.{kind}", partial(_write, text=_FIRST[kind] + _FIRST[kind].replace("1", "1" * 5000))
        yield f"exponents_{kind}", "events", f"x.{kind}", partial(_write, text=_FIRST[kind] + _FIRST[kind].replace("0.002", "1e999999999"))
        yield (
            f"infinite_{kind}",
            "events",
            f"x.{kind}",
            partial(_write, text=_FIRST[kind] + _FIRST[kind].replace("0.002", "inf").replace("1000", "nan")),
        )
        yield f"odd_lines_{kind}", "events", f"x.{kind}", partial(_write, text=_FIRST[kind] + "a b c d\n" * 200_000)


_FIRST = {"csv": "# width=64 height=48\n1000,1,2,1\n2000,3,4,0\n", "txt": "0.001 1 2 1\n0.002 3 4 0\n"}


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _many_poses(path: Path) -> None:
    """16 million poses, most of them empty lines' worth of zeros in a sparse file."""
    row = b"0,0,0,1,0,0,0,1\n"
    with path.open("wb") as stream:
        stream.write(b"t_us,tx,ty,tz,qx,qy,qz,qw\n")
        for _ in range(160):
            stream.write(row * 20_000)


def _bop(path: Path) -> None:
    entry = [{"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 1e300], "obj_id": 1}]
    path.write_text(json.dumps({"0": entry, "9" * 30: entry, "-5": entry}))
