"""A record of the wrong shape is refused in one line that names the field and says what it has to be."""

import math
from typing import Annotated, Literal

import pytest
from msgspec import Meta, field

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import ABSENT, ONE_LINE, Absent, Number, Record, record_of

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class Point(Record, frozen=True):
    place: tuple[Number, Number]
    weight: Share = 1.0

    def __post_init__(self):
        if self.place == (7, 7):
            raise ArgumentError("place: is taken; choose another")
        if self.place == (8, 8):
            raise ArgumentError("lacks a neighbour")


class Round(Record, frozen=True, tag_field="by", tag="round"):
    radius: Annotated[float, Meta(ge=0.0)]


class Square(Record, frozen=True, tag_field="by", tag="square"):
    sides: tuple[int, int] = (1, 1)


class Drawing(Record, frozen=True):
    points: Annotated[tuple[Point, ...], Meta(max_length=2)]
    kind: Literal["line", "area"] = "line"
    name: Annotated[str, Meta(max_length=3, pattern=ONE_LINE)] = ""
    count: int = 0
    width: Number | Absent = ABSENT
    limit: Number | None = None
    scores: dict[str, Number] = field(default_factory=dict)
    lists: dict[str, tuple[int, ...]] = field(default_factory=dict)
    part: Round | Square | None = None
    free: float = 0.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"points": [{}]}, "in.points[0]: lacks 'place'"),
        ({"points": [{"place": [1, 2], "wieght": 1}]}, '[0]: has an unknown key "wieght"; known are place, weight'),
        ({"points": [{"place": [1]}]}, "in.points[0].place: is [1], but has to have 2 entries"),
        ({"points": [{"place": [1, math.nan]}]}, "in.points[0].place[1]: is NaN, but has to be a number, at least"),
        ({"points": [{"place": [1, math.inf]}]}, "place[1]: is Infinity, but has to be a number, at least -1e+300 and"),
        ({"points": [{"place": [1, 10**400]}]}, "but has to be a number, at least -1e+300 and at most 1e+300"),
        ({"free": 10**400}, "but has to be a number, a smaller one"),
        ({"points": [{"place": [1, 2], "weight": 2}]}, "is 2, but has to be a number, at least 0 and at most 1"),
        ({"points": [{"place": [1, 2], "weight": True}]}, "weight: is true, but has to be a number"),
        ({"points": [{"place": [7, 7]}]}, "in.points[0].place: is taken; choose another"),
        ({"points": [{"place": [8, 8]}]}, "in.points[0]: lacks a neighbour"),
        ({"points": [{"place": [1, 2]}] * 3}, "but has to have at most 2 entries"),
        ({"points": 5}, "in.points: is 5, but has to be a list"),
        ({"kind": "dot"}, 'in.kind: is "dot", but has to be one of area, line'),
        ({"name": "four"}, 'in.name: is "four", but has to have at most 3 characters'),
        ({"name": "a\n"}, "but has to be free of control characters"),
        ({"name": "\x7f"}, "but has to be free of control characters"),
        ({"count": 1.0}, "in.count: is 1.0, but has to be a whole number"),
        ({"width": None}, "in.width: is null, but has to be a number"),
        ({"limit": "1"}, 'in.limit: is "1", but has to be a number or null'),
        ({"scores": {"a": "1"}}, 'in.scores: is {"a": "1"}, but each of its values has to be a number'),
        ({"lists": {"a": ["1"]}}, 'in.lists: is {"a": ["1"]}, but each of its values has to be a list'),
        ({"part": 1}, "in.part: is 1, but has to be an object or null"),
        ({"part": {"sides": [1, 1]}}, "in.part: lacks 'by'"),
        ({"part": {"by": "oval"}}, 'in.part.by: is "oval", but has to be one of '),
        ({"part": {"by": "square", "radius": 1}}, 'has an unknown key "radius"; known are by, sides'),
        ({"part": {"by": "square", "sides": [1, "2"]}}, 'in.part.sides[1]: is "2", but has to be a whole number'),
        ({"part": {"by": "round"}}, "in.part: lacks 'radius'"),
        ({"part": {"by": "round", "radius": -1}}, "radius: is -1, but has to be a number, at least 0"),
        ({"\ud800": 1}, "in: has a name that is not Unicode text"),
    ],
)  # fmt: skip
def test_a_wrong_field_is_named(change, says):
    with pytest.raises(ArgumentError) as caught:
        record_of("in", {"points": [], **change}, Drawing)
    assert says in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 200


def test_a_record_is_read():
    found = record_of("", {"points": [{"place": [1, 2.5]}], "limit": None}, Drawing)
    assert found == Drawing((Point((1.0, 2.5)),)) and found.width is ABSENT
    with pytest.raises(ArgumentError, match=r'^is "x", but has to be an object$'):
        record_of("", "x", Drawing)
    with pytest.raises(ArgumentError, match=r"^points\[0\]: lacks 'place'$"):
        record_of("", {"points": [{}]}, Drawing)
