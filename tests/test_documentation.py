"""The documentation site: what becomes a page, and what makes the build fail."""

import importlib.util
import re
from pathlib import Path

import pytest

from hrc_learn.viz.evidence import clauses

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("build_docs", ROOT / "tools" / "build_docs.py")
assert SPEC is not None
assert SPEC.loader is not None
build_docs = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(build_docs)

builder = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("zensical", "mkdocstrings")),
    reason="the extra `docs` is not installed: `make docs` installs it",
)


def test_tests_that_the_evidence_page_names_exist():
    for clause in clauses():
        assert (ROOT / clause.test).is_file(), clause.test


CHECKOUT = {
    "CHANGELOG.md": "# Changes\n",
    "CONTRIBUTING.md": "# Contributing\n\nSee [the code](hrc_learn/arm/_moving.py).\n",
    "docs/index.md": "# Robots\n\n[A guide](howto/guide.md), [its end](howto/guide.md#end).\n",
    "docs/tutorial.md": "# Tutorial\n",
    "docs/howto/guide.md": (
        "# Guide\n\n[Home](../index.md), [move][hrc_learn.arm.move]\n\n## End\n"
    ),
    "docs/howto/index.md": "# How-to\n\n[More](more.md), [guide](guide.md)\n",
    "docs/howto/more.md": "# More\n",
    "docs/concepts/index.md": "# Concepts\n",
    "docs/benchmarks/index.md": "# Benchmarks\n",
    "hrc_learn/__init__.py": '"""Robots."""\n\nfrom .arm import move as move\n',
    "hrc_learn/arm/__init__.py": (
        '"""Arms."""\n\n'
        "from ._moving import Limits as Limits\nfrom ._moving import move as move\n"
    ),
    "hrc_learn/arm/_moving.py": (
        "def move(speed: float) -> None:\n"
        '    """Move the arm.\n\n    Args:\n        speed: Tool speed [m/s].\n    """\n\n\n'
        'class Limits:\n    """Speed limits."""\n'
    ),
    "hrc_learn/_private/__init__.py": '"""Ours."""\n\nfrom .gear import gear as gear\n',
}
"""A checkout in small: one public function, described in a private module."""


def checkout(folder: Path, **changed: str) -> Path:
    for name, text in {**CHECKOUT, **changed}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_a_page_for_each_public_package_and_class(tmp_path):
    pages = build_docs.reference(checkout(tmp_path))
    assert set(pages) == {"hrc_learn", "hrc_learn.arm", "hrc_learn.arm.Limits"}
    # A class has a page of its own, which its package lists.
    assert "::: hrc_learn.arm.Limits" in pages["hrc_learn.arm.Limits"]
    assert "[`Limits`](hrc_learn.arm.Limits.md) | Speed limits. |" in pages["hrc_learn.arm"]


def test_an_object_is_described_once_and_linked_elsewhere(tmp_path):
    pages = build_docs.reference(checkout(tmp_path))
    assert "::: hrc_learn.arm.move" in pages["hrc_learn.arm"]
    assert ":::" not in pages["hrc_learn"]
    assert "[`move`][hrc_learn.arm.move]" in pages["hrc_learn"]


def test_a_function_in_a_module_of_its_name_is_meant_not_the_module(tmp_path):
    face = {"hrc_learn/arm/__init__.py": '"""Arms."""\n\nfrom .move import move as move\n'}
    root = checkout(tmp_path, **face, **{"hrc_learn/arm/move.py": "def move(): ...\n"})
    assert "::: hrc_learn.arm.move.move\n" in build_docs.reference(root)["hrc_learn.arm"]


def test_every_name_of_our_faces_is_described_or_linked():
    pages = build_docs.reference(ROOT)
    for face in build_docs.faces(ROOT):
        for export in face.exports:
            assert export.path in pages or f".{export.name}" in pages[face.name], export.path


def test_a_section_follows_the_order_of_its_index(tmp_path):
    pages = build_docs.section(checkout(tmp_path), "howto")
    assert pages == ["howto/index.md", "howto/more.md", "howto/guide.md"]


@pytest.mark.parametrize("section", ["howto", "concepts", "benchmarks"])
def test_the_index_of_a_section_links_all_of_its_pages(section):
    folder = ROOT / "docs" / section
    index = (folder / "index.md").read_text("utf-8")
    pages = {page.name for page in folder.glob("*.md")} - {"index.md"}
    assert not [name for name in sorted(pages) if f"]({name}" not in index]


def test_no_wrapped_line_of_a_list_begins_like_another_entry():
    entry, wrapped = re.compile(r"(\s*)(\d+\.|[-*+]) "), []
    for page in sorted((ROOT / "docs").rglob("*.md")):
        number = 0  # of the last entry of the current list
        for line in page.read_text("utf-8").splitlines():
            found = entry.match(line)
            if found is None:
                number = number if line.strip() else 0
            elif found[2][0].isdigit():
                # A number at the start of a wrapped line becomes an entry of its own.
                if number and int(found[2][:-1]) != number + 1:
                    wrapped.append(f"{page.name}: {line}")
                number = int(found[2][:-1])
    assert not wrapped


@builder
@pytest.mark.long
def test_the_site_opens_without_a_network(tmp_path):
    out = tmp_path / "site"
    assert build_docs.build(checkout(tmp_path / "checkout"), out) == []
    page = (out / "api" / "hrc_learn.arm.html").read_text()
    assert "Tool speed [m/s]." in page
    assert 'id="hrc_learn.arm.move"' in page
    guide = (out / "howto" / "guide.html").read_text()
    assert 'href="../api/hrc_learn.arm.html#hrc_learn.arm.move"' in guide
    for html in out.rglob("*.html"):
        assert not build_docs.REMOTE.search(html.read_text()), html
    assert not list(out.rglob("_*"))


@builder
@pytest.mark.long
def test_formulas_and_figures_are_shown_as_written(tmp_path):
    formula = "1 + rho^2/s^2, theta(r) + 1/2, J^+ (J J^+)^T, 5.1/8.4, 90th, ~0.5 to ~1, a == b"
    text = CHECKOUT["docs/howto/guide.md"] + f"\n{formula}\n"
    root = checkout(tmp_path / "checkout", **{"docs/howto/guide.md": text})
    out = tmp_path / "site"
    assert build_docs.build(root, out) == []
    assert formula in (out / "howto" / "guide.html").read_text()


@pytest.mark.long
@builder
@pytest.mark.parametrize(
    ("name", "old", "new", "complaint"),
    [
        ("docs/index.md", "howto/guide.md)", "howto/gide.md)", "gide.md"),
        ("docs/index.md", "#end", "#ends", "ends"),
        ("docs/howto/guide.md", "arm.move", "arm.moved", "hrc_learn.arm.moved"),
        ("hrc_learn/arm/_moving.py", "speed: Tool", "sped: Tool", "'sped'"),
    ],
    ids=["page", "anchor", "reference", "argument"],
)
def test_what_is_wrong_is_said_and_leaves_no_site(tmp_path, name, old, new, complaint):
    root = checkout(tmp_path / "checkout", **{name: CHECKOUT[name].replace(old, new)})
    wrong = build_docs.build(root, tmp_path / "site")
    assert complaint in "\n".join(wrong)
    assert not (tmp_path / "site").exists()
