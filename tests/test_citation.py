"""CITATION.cff: the fields of the Citation File Format 1.2.0 that it uses, checked strictly."""

from __future__ import annotations

from importlib.metadata import metadata
from pathlib import Path
from typing import Annotated, Literal

import pytest
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.report.markup import entries

ROOT = Path(__file__).parents[1]

# The patterns are those of the format's schema, doi:10.5281/zenodo.5171937.
type Doi = Annotated[str, Field(pattern=r"^10\.\d{4,9}(\.\d+)?/[A-Za-z0-9:/_;\-\.\(\)\[\]\\]+$")]
type Text = Annotated[str, Field(min_length=1)]


class Strict(BaseModel):
    model_config = ConfigDict(
        extra="forbid", strict=True, alias_generator=lambda s: s.replace("_", "-")
    )


class Person(Strict):
    family_names: Text
    given_names: Text


class Entity(Strict):
    name: Text


class Article(Strict):
    type: Literal["article"]
    authors: list[Person] = Field(min_length=1)
    title: Text
    journal: Text
    year: int
    volume: int
    start: int
    end: int
    issn: Annotated[str, Field(pattern=r"^\d{4}-\d{3}[\dxX]$")]
    doi: Doi


class Citation(Strict):
    cff_version: Annotated[str, Field(pattern=r"^1\.2\.0$")]
    message: Text
    title: Text
    abstract: Text
    type: Literal["software", "dataset"]
    authors: list[Entity | Person] = Field(min_length=1)
    version: Text
    license: Literal["MIT"]
    keywords: list[Text] = Field(min_length=1)
    references: list[Article]


@pytest.fixture(scope="module")
def citation() -> Citation:
    return Citation.model_validate(yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8")))


def test_it_is_about_this_package(citation):
    # Of the last release; what is installed here may be some commits further.
    assert f"\n## {citation.version}\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert citation.license == metadata("terracalib")["License-Expression"]
    assert citation.title.partition(":")[0] == "calib"


def test_the_paper_is_cited_as_in_reports(citation):
    (paper,) = citation.references
    entry = entries()["He_2019"]
    assert paper.doi == entry["doi"]
    assert (str(paper.year), str(paper.volume)) == (entry["year"], entry["volume"])
    assert f"{paper.start}--{paper.end}" == entry["pages"]
    people = [f"{p.family_names}, {p.given_names}" for p in paper.authors]
    assert " and ".join(people) == entry["author"]
    title = entry["title"].replace("{", "").replace("}", "").replace("--", "\N{EN DASH}")
    assert paper.title == title


@pytest.mark.parametrize(
    "change", [{"doi": "doi:10.1016/x"}, {"year": "2019"}, {"pages": "77-88"}, {"issn": "00224898"}]
)
def test_a_mistake_would_be_found(citation, change):
    paper = citation.references[0].model_dump(by_alias=True) | change
    with pytest.raises(ValidationError):
        Article.model_validate(paper)
