"""All readers of files: sound files are read, and damaged ones are read soundly or refused with their place."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import readers
from mapf_env import parse_instance

TOKENS = [
    b"",
    b" ",
    *(
        b"-1 0 00 1 3 4 9 1.5 nan inf 1e400 0x1 99999999999 " + b"7" * 5000 + b" type octile height width map version "
        b". @ G T \t \r \0 \n \xef\xbb\xbf \xff \xd9\xa3 .. / a.map read.scen "
        + b"m"
        * 300
        + b' [ ] { } , : " null true '
        b"one: |- $ ! ' a A # "
        b"Agent 0: 1: -> (0,0)-> (1,1), (123456789,2)-> ( , ) solution= "
        b"[] [[0,0]] [[0.5,0]] [[1,2,3]] {} starts goals sha256 maps instances [[9223372036854775808,0]]"
    ).split(b" "),
]


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """The content after some edits: bytes, tokens or lines are replaced, removed, repeated or put in."""
    content = sound
    for _ in range(draw(st.integers(1, 3))):
        unit = draw(st.sampled_from([b"", b"\n", b"\t", b",", b" "]))
        parts = [content[i : i + 1] for i in range(len(content))] if not unit else content.split(unit)
        first = draw(st.integers(0, max(len(parts) - 1, 0)))
        last = first + draw(st.sampled_from([0, 1, 1, 2, 5]))
        put = draw(st.one_of(st.sampled_from(TOKENS), st.binary(max_size=3), st.just(unit.join(parts[first:last]))))
        content = unit.join([*parts[:first], *([put] * draw(st.integers(0, 2))), *parts[last:]])
    return content


@pytest.mark.parametrize("kind", sorted(readers.READERS))
@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_damaged_files_are_read_soundly_or_refused_with_their_place(
    kind: str, tmp_path: Path, data: st.DataObject
) -> None:
    content = data.draw(damaged(readers.samples(tmp_path)[kind]))
    assert readers.faults(kind, content, tmp_path) == []


@pytest.mark.parametrize("kind", sorted(readers.READERS))
def test_sound_files_are_read(kind: str, tmp_path: Path) -> None:
    content = readers.samples(tmp_path)[kind]
    (tmp_path / "a.map").write_bytes(readers.MAP)
    (tmp_path / "sound").write_bytes(content)
    assert len(readers.READERS[kind](tmp_path / "sound").grid if kind == "scen" else content) > 0


@given(st.one_of(st.text(max_size=30), st.text("ABab#@.\n ", max_size=30)))
def test_drawings_are_read_soundly_or_refused(drawing: str) -> None:
    try:
        instance = parse_instance(drawing)
    except ValueError:
        return
    assert readers.unsound(instance) == []
