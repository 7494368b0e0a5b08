"""The English of code, messages and pages: phrases that CONTRIBUTING.md rules out do not come back."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("mapf_env", "experts", "gnn_policy", "benchmarks", "tests")
CODE = sorted(
    path
    for folder in FOLDERS
    for path in (ROOT / folder).rglob("*")
    if path.suffix in {".py", ".cpp", ".hpp"} and path != Path(__file__)
)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "gnn_policy").rglob("*.md")])
PHRASES = {
    r"(?<![Tt]here )\b(is|are|was|were) no (?!longer\b|more\b|less\b|worse\b)": '"is not a"',
    r"\banew\b": '"again"',
    r"\bfor ever\b": '"forever"',
    r"\bheed(s|ed)?\b": '"ignore", negated',
    r"\bseldom\b": '"rarely"',
    r"\bin (the )?place of\b": '"instead of"',
    r"\bbut for\b": '"except for"',
    r"\bone's own\b": '"your own"',
    r"\bbeside\b": '"next to" or "compared with"',
}
STARTS = ("Of", "Who", "What", "Whether", "How", "Where")


def words_of(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a file; of Python those with docstrings, other strings or comments."""
    lines = path.read_text(encoding="utf-8").splitlines()
    if path.suffix != ".py":
        yield from enumerate(lines, 1)
        return
    texts = {number for number, line in enumerate(lines, 1) if "#" in line}
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    yield from ((number, lines[number - 1]) for number in sorted(texts))


def openings(path: Path) -> Iterator[tuple[int, str]]:
    """The first words of docstrings, and of comments that stand for one in C++."""
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for each in getattr(node, "body", []) if isinstance(getattr(node, "body", None), list) else []:
                if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant):
                    text = each.value.value
                    if isinstance(text, str) and text.strip():
                        yield each.lineno, text.split()[0]
        return
    before = ""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        found = re.match(r"\s*// (\w+)", line)
        if found and not before.strip().startswith("//"):
            yield number, found[1]
        before = line


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_phrases_of_the_list_do_not_occur(folder: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}  -> {better}"
        for path in CODE
        if path.relative_to(ROOT).parts[0] == folder
        for number, line in words_of(path)
        for phrase, better in PHRASES.items()
        if re.search(phrase, line)
    ]
    assert not found, "\n".join(found)


def prose_of(page: Path) -> Iterator[tuple[int, str]]:
    """The paragraphs of a page in one line each, with their line numbers; without the examples of CONTRIBUTING.md."""
    text = page.read_text(encoding="utf-8")
    for paragraph in re.finditer(r"\S(?:.|\n(?!\n))*", text):
        if not (page.name == "CONTRIBUTING.md" and paragraph[0].startswith("1. Use plain")):
            yield text.count("\n", 0, paragraph.start()) + 1, " ".join(paragraph[0].split())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_phrases_of_the_list_do_not_occur_on_pages(page: Path) -> None:
    found = [
        f"{page.relative_to(ROOT)}:{number}: ... {text[max(match.start() - 40, 0) : match.end() + 40]} ...  -> {better}"
        for number, text in prose_of(page)
        for phrase, better in PHRASES.items()
        for match in re.finditer(phrase, text, re.IGNORECASE)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("folder", FOLDERS)
def test_docstrings_begin_with_a_verb_or_the_name_of_a_thing(folder: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: begins with {word!r}"
        for path in CODE
        if path.relative_to(ROOT).parts[0] == folder
        for number, word in openings(path)
        if word in STARTS
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("phrase", PHRASES)
def test_each_phrase_is_one_that_the_check_would_find(phrase: str) -> None:
    bad = "a seed is no integer, begun anew for ever; heed no rule, seldom, in place of one's own but for beside"
    assert re.search(phrase, bad)
