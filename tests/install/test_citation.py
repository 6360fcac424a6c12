"""CITATION.cff is of schema 1.2.0, of this version, and cites the paper as the README does."""

import re

import pytest
import yaml
from places import REPOSITORY

import torchtrack

CITATION = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
# Keys of the schema, https://github.com/citation-file-format/citation-file-format; of references, those that are of use here.
REQUIRED = {"cff-version", "message", "title", "authors"}
KNOWN = REQUIRED | {
    *("abstract", "commit", "contact", "date-released", "doi", "identifiers", "keywords", "license", "license-url", "preferred-citation"),
    *("references", "repository", "repository-artifact", "repository-code", "type", "url", "version"),
}
OF_REFERENCE = {"type", "title", "authors", "year", "month", "journal", "doi", "identifiers", "url", "status", "conference", "pages", "volume"}
OF_PERSON = {"family-names", "given-names", "orcid", "affiliation"}


def test_keys_are_those_of_the_schema():
    assert set(CITATION) >= REQUIRED and set(CITATION) <= KNOWN
    assert CITATION["cff-version"] == "1.2.0" and CITATION["type"] == "software"
    reference = CITATION["preferred-citation"]
    assert {"type", "title", "authors"} <= set(reference) <= OF_REFERENCE and reference["type"] == "article"
    assert type(reference["year"]) is int


@pytest.mark.parametrize("person", CITATION["preferred-citation"]["authors"], ids=lambda person: person["family-names"])
def test_authors_are_persons(person):
    assert {"family-names", "given-names"} <= set(person) <= OF_PERSON
    digits = re.fullmatch(r"https://orcid\.org/(\d{4}-\d{4}-\d{4}-\d{3}[\dX])", person["orcid"])[1].replace("-", "")
    # ISO 7064 mod 11-2: the last one checks the others.
    total = 0
    for digit in digits[:-1]:
        total = (total + int(digit)) * 2 % 11
    assert digits[-1] == "0123456789X"[(12 - total) % 11]


def test_it_is_of_this_version_and_licence():
    assert CITATION["version"] == torchtrack.__version__ and CITATION["license"] == "Apache-2.0"


def test_the_paper_is_the_one_that_the_readme_names():
    readme = " ".join((REPOSITORY / "README.md").read_text(encoding="utf-8").split())
    paper = CITATION["preferred-citation"]
    assert paper["title"] in readme
    assert ", ".join(f"{person['given-names']} {person['family-names']}" for person in paper["authors"]) in readme
    number = paper["identifiers"][0]["value"].removeprefix("arXiv:")
    assert paper["url"].endswith(number) and paper["url"] in (REPOSITORY / "pyproject.toml").read_text()
