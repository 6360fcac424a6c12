"""YAML within limits: what is read, and that every fault is an error of YAML."""

import pytest
import yaml

from torchtrack.core.limits import Limits
from torchtrack.core.yaml_text import load_document, load_documents

MULTIPLYING = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9))
MERGING = "a0: &a0 {k: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}\n" for n in range(1, 9))


def test_plain_values_aliases_and_merges():
    text = "base: &b {x: 1, y: [2.5, true, null]}\nother: {<<: *b, x: 'text', when: 2001-12-14}\nagain: *b\n"
    read = load_document(text)
    assert read == yaml.safe_load(text)
    assert read["other"]["x"] == "text"


def test_documents():
    assert load_documents("a: 1\n---\nb: 2\n") == [{"a": 1}, {"b": 2}]
    assert load_document("") is None
    with pytest.raises(yaml.YAMLError, match="2 documents, where one is expected"):
        load_document("a: 1\n---\nb: 2\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 2001-99-99", "'2001-99-99' is no timestamp"),
        ("a: !!int x", "'x' is no int"),
        ("a: !!float x", "'x' is no float"),
        ("a: !!bool x", "'x' is no bool"),
        ("a: !!timestamp x", "'x' is no timestamp"),
        ("a: 0b_", "is no int"),
        ("a: " + "9" * 5000, "is no int"),
        ("? [1, 2]\n: 3", "unhashable"),
        ("? {a: 1}\n: 3", "unhashable"),
        ("{a: 1, a: 2}", "the key 'a' is given twice"),
        ("a: &a [*a]", "'a' stands within itself"),
        ("a: &a {b: *a}", "'a' stands within itself"),
        ("a: *b", "undefined alias"),
        ('a: "\\ud800"', "is no str"),
        ('a: "\\0"', "zero character"),
        ('a: "\\UFFFFFFFF"', "chr|too large|range"),
        ("a: !!python/object:os.system x", "could not determine a constructor"),
        ("[" * (Limits().text_depth + 1), "nested more than"),
        ("[" * 100_000, "nested more than"),
        ("".join(" " * n + "a:\n" for n in range(200)), "nested more than"),
        (MULTIPLYING, "more than 100000 values, with aliases written out"),
        (MERGING, "more than 100000 values, with aliases written out"),
        ("x" * (Limits().text_bytes + 1), "characters are more than"),
        ("a: [", "expected"),
        ("\x00", "special characters"),
        ("{!!set {a, b}: 1}", "unhashable"),
        ("!!map x", "expected a mapping"),
        ("<<: 1", "expected a mapping"),
    ],
    ids=range(28),
)
def test_every_fault_is_an_error_of_yaml(text, message):
    with pytest.raises(yaml.YAMLError, match=message):
        load_document(text)


def test_many_values_are_read_up_to_the_limit():
    assert len(load_document("[" + "1," * 5000 + "]")) == 5000
    assert Limits().text_nodes >= 100_000
