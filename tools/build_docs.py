"""Build the documentation site: docs/ and a reference made from the docstrings.

Everything is read from this checkout and nothing from the network; `hrc_learn` is parsed, not
imported. Whatever the builder warns of (a broken link or anchor, a docstring that describes
arguments there are not) makes it fail.
"""

import argparse
import ast
import importlib.util
import json
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

# Also found where a test loads this file.
sys.path.append(str(Path(__file__).resolve().parent))
import build_gallery  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "docs" / "site.yml"
PACKAGE = "hrc_learn"
# Modules of their own beside the packages that users implement or call.
PUBLIC_MODULES = ("protocols",)
SOURCE_LINK = re.compile(
    r"""(\[[^\]]+\]\(|<img [^>]*src=")(?!\w+:)([^)\s#"]+)((?:#[^)\s]*)?(?:\)|"))"""
)
LINK_TEXT = re.compile(r"\[([^\]]+)\]\(.*")
DOCSTRING_WARNING = re.compile(r"(griffe|mkdocstrings\w*|mkdocs_autorefs):")
REMOTE_SHIM = re.compile(r'src="https://[^"]*/iframe-worker/[^"]*"')
REMOTE = re.compile(r"""<(?:script|img|iframe)\b[^>]*?\bsrc=["']?(https?:[^"'>\s]+)""")
WORKER_FROM_BLOB = """\
if (location.protocol === "file:") {
  const Native = window.Worker
  const source = new Blob([SOURCE], { type: "text/javascript" })
  window.Worker = function () { return new Native(URL.createObjectURL(source)) }
}
"""
LINE_ANCHOR = re.compile(r'<a id="__codelineno-[^>]*></a>')
COLOUR = re.compile(r"\x1b\[[\d;]*m")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Export:
    """A name that a package's face lists."""

    path: str
    """The name as users import it, such as `hrc_learn.dmp.JointDMP`."""
    origin: str
    """Module that the face imports it from."""

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def source(self) -> str:
        return f"{self.origin}.{self.name}"


@dataclass(frozen=True)
class Face:
    """What a package's `__init__` re-exports by `from .x import Y as Y`."""

    name: str
    docstring: str
    exports: tuple[Export, ...]


def faces(root: Path) -> list[Face]:
    """The faces of all public packages below a folder that holds the package."""
    found = []
    for file in sorted((root / PACKAGE).rglob("__init__.py")):
        parts = file.parent.relative_to(root).parts
        if not any(part.startswith("_") for part in parts):
            found.append(read_face(root, ".".join(parts)))
    return [face for face in found if face.exports]


def read_face(root: Path, package: str) -> Face:
    tree = ast.parse((root / package.replace(".", "/") / "__init__.py").read_text("utf-8"))
    exports = []
    for node in tree.body:
        if not isinstance(node, ast.ImportFrom):
            continue
        origin = absolute(package, node)
        for alias in node.names:
            if alias.asname != alias.name or alias.name.startswith("_"):
                continue
            exports.append(Export(f"{package}.{alias.name}", origin))
    docstring = ast.get_docstring(tree) or ""
    if not docstring and exports:
        raise SystemExit(f"{package}/__init__.py has no docstring to head its page with")
    return Face(package, docstring, tuple(exports))


def absolute(package: str, node: ast.ImportFrom) -> str:
    """The module that a package's `from` statement names."""
    if not node.level:
        return node.module or ""
    above = package.split(".")[: len(package.split(".")) - node.level + 1]
    return ".".join([*above, *([node.module] if node.module else [])])


def module_file(root: Path, module: str) -> Path | None:
    """Source file of a module or package, if it is part of the checkout."""
    path = root / module.replace(".", "/")
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in files if file.exists()), None)


@cache  # a module is read once, not once for each of its names
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text("utf-8"))


def definition(root: Path, export: Export) -> ast.ClassDef | ast.FunctionDef | None:
    """Class or function behind an export, followed through imports; None for other values."""
    module, name, seen = export.origin, export.name, set()
    while module not in seen and (file := module_file(root, module)) is not None:
        seen.add(module)
        package = module if file.name == "__init__.py" else module.rpartition(".")[0]
        for node in parsed(file).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
                return node
            if isinstance(node, ast.ImportFrom) and name in imported(node):
                module = absolute(package, node)
    return None


def imported(node: ast.ImportFrom) -> set[str]:
    """Names that a statement binds."""
    return {alias.asname or alias.name for alias in node.names}


def reference(root: Path) -> dict[str, str]:
    """Pages of the reference as Markdown, by the dotted name of what they describe.

    The page of a package lists its classes, each described on a page of its own, and describes
    functions and constants. An object is described once: a face that takes it over from
    another public package links there.
    """
    listed = faces(root)
    packages = {face.name for face in listed}
    home = {
        export.path: face.name
        for face in listed
        for export in face.exports
        if export.path not in packages
    }
    pages = {}
    for face in listed:
        inner = [name for name in sorted(packages) if name.rpartition(".")[0] == face.name]
        classes, other, taken_over = [], [], []
        for export in face.exports:
            if export.path in packages:
                continue
            if export.source != export.path and export.source in home:
                link = f"[`{export.name}`][{export.source}] of `{home[export.source]}`"
                taken_over.append(f"- {link}")
                continue
            # A function in a module of its name: the path of both means the module.
            described = export.source if export.origin == export.path else export.path
            node = definition(root, export)
            if isinstance(node, ast.ClassDef):
                classes.append(f"| [`{export.name}`]({export.path}.md) | {summary(node)} |")
                pages[export.path] = f"::: {described}\n    options:\n      heading_level: 1\n"
            else:
                other += ["", f"::: {described}"]
        lines = [f"# {face.name}", "", face.docstring, ""]
        if inner:
            lines += ["## Packages", "", *(f"- [`{name}`]({name}.md)" for name in inner), ""]
        if classes:
            lines += ["## Classes", "", "| class | |", "|---|---|", *classes, ""]
        if taken_over:
            lines += ["## Names", "", *taken_over, ""]
        if other:
            lines += ["## Functions and constants", ""]
        pages[face.name] = "\n".join([*lines, *other]) + "\n"
    for module in PUBLIC_MODULES:
        name = f"{PACKAGE}.{module}"
        if module_file(root, name) is not None:
            pages[name] = f"::: {name}\n    options:\n      heading_level: 1\n"
    return pages


def summary(node: ast.ClassDef) -> str:
    """First line of a class's docstring, for a cell of a table."""
    lines = (ast.get_docstring(node) or "").splitlines()
    return (lines[0] if lines else "").replace("|", "\\|")


def pages_of(root: Path) -> dict[Path, str]:
    """All pages that are written by hand: file of the checkout -> page of the site."""
    docs = root / "docs"
    pages = {page: page.relative_to(docs).as_posix() for page in sorted(docs.rglob("*.md"))}
    return pages | {
        root / "CHANGELOG.md": "changelog.md",
        root / "CONTRIBUTING.md": "contributing.md",
    }


def section(root: Path, folder: str) -> list[str]:
    """Pages of a folder of docs/: its index, pages in the order of the index, the others."""
    docs = root / "docs"
    index = docs / folder / "index.md"
    text = index.read_text("utf-8") if index.exists() else ""

    def rank(page: Path) -> tuple[bool, int, str]:
        found = text.find(f"]({page.relative_to(docs / folder).as_posix()}")
        return page != index, found if found >= 0 else len(text), page.name

    pages = sorted((docs / folder).rglob("*.md"), key=rank)
    return [page.relative_to(docs).as_posix() for page in pages]


def for_site(text: str, page: Path, pages: dict[Path, str], root: Path) -> str:
    """A page's text with its links to files turned into links between pages of the site.

    The site has no source files: a link to one becomes plain text. A broken link stays as it
    is, so that the builder reports it.
    """
    here = posixpath.dirname(pages[page])

    def relink(match: re.Match[str]) -> str:
        before, target, after = match.groups()
        file = (page.parent / target).resolve()
        if file in pages:
            return f"{before}{posixpath.relpath(pages[file], here)}{after}"
        if (root / "docs" / "images") in file.parents:
            return f"{before}{posixpath.relpath(f'images/{file.name}', here)}{after}"
        if file.exists() and root in file.parents:
            return LINK_TEXT.sub(r"\1", match[0])
        return match[0]

    pieces, start = [], 0
    for fence in FENCE.finditer(text):
        pieces += [SOURCE_LINK.sub(relink, text[start : fence.start()]), fence[0]]
        start = fence.end()
    return "".join([*pieces, SOURCE_LINK.sub(relink, text[start:])])


def stage(root: Path, folder: Path) -> list:
    """Put the site's pages into an empty folder.

    Returns:
        The site's navigation, as the builder takes it.
    """
    pages = pages_of(root)
    texts = {
        name: for_site(page.read_text("utf-8"), page, pages, root)
        for page, name in pages.items()
    }
    api = reference(root)
    texts |= {f"api/{name}.md": text for name, text in api.items()}
    if (root / "docs" / "images").exists():
        texts["gallery.md"] = build_gallery.page(root)
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, "utf-8")
    if (root / "docs" / "images").exists():
        shutil.copytree(root / "docs" / "images", folder / "images")
    for name in ("site.css", "site.js"):
        if (root / "docs" / name).exists():
            shutil.copy2(root / "docs" / name, folder)
    # Pages of classes are reached from their package, by links and by search.
    packages = [
        {name.removeprefix(f"{PACKAGE}."): f"api/{name}.md"}
        for name in sorted(api)
        if not name.rpartition(".")[2][:1].isupper()
    ]
    return [
        {"Home": "index.md"},
        {"Tutorial": "tutorial.md"},
        *([{"Gallery": "gallery.md"}] if "gallery.md" in texts else []),
        {"How-to": section(root, "howto")},
        {"Concepts": section(root, "concepts")},
        {"Reference": packages},
        {"Benchmarks": section(root, "benchmarks")},
        {"Changelog": "changelog.md"},
        {"Contributing": "contributing.md"},
    ]


def search_from_disk(site: Path) -> None:
    """Let the search work in pages opened from the disk, without a script from the network.

    A browser starts no worker from a `file:` address. The builder's remedy is loaded from
    elsewhere at each view; ours gives the worker's source to the browser as a Blob.
    """
    (worker,) = (site / "assets" / "javascripts" / "workers").glob("search*.js")
    source = json.dumps(worker.read_text("utf-8"))
    script = WORKER_FROM_BLOB.replace("SOURCE", source)
    (site / "assets" / "javascripts" / "worker_from_blob.js").write_text(script, "utf-8")
    for page in site.rglob("*.html"):
        up = "../" * (len(page.relative_to(site).parts) - 1)
        ours = f'src="{up}assets/javascripts/worker_from_blob.js"'
        # The anchor of each line of code is a link without a name to keyboards and readers.
        html = LINE_ANCHOR.sub("", REMOTE_SHIM.sub(ours, page.read_text("utf-8")))
        if remote := REMOTE.search(html):
            raise SystemExit(f"{page.name} would load {remote[1]} from the network")
        page.write_text(html, "utf-8")


def build(root: Path, out: Path) -> list[str]:
    """Build the site of a checkout; a site that is complete replaces what `out` was.

    Returns:
        What is wrong, as the builder says it; empty if `out` is there.
    """
    root = root.resolve()
    with tempfile.TemporaryDirectory(prefix="hrc_learn_docs_") as name:
        # The builder asks for pages and site to lie in one folder with its configuration.
        work = Path(name)
        config = {
            "INHERIT": str(SITE),
            "docs_dir": "pages",
            "site_dir": "site",
            "nav": stage(root, work / "pages"),
            "plugins": {"mkdocstrings": {"handlers": {"python": {"paths": [str(root)]}}}},
        }
        # JSON is YAML, and needs no library to write.
        (work / "mkdocs.yml").write_text(json.dumps(config), "utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "zensical", "build", "--strict"],
            cwd=work,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            check=False,
        )
        complaints, _, _ = COLOUR.sub("", done.stdout).partition("Traceback")
        lines = complaints.splitlines()
        # `--strict` is about links; what the reader of docstrings warns of fails here.
        if done.returncode or any(DOCSTRING_WARNING.match(line) for line in lines):
            return lines
        search_from_disk(work / "site")
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(work / "site", out)
    return []


def main() -> int:
    parser = argparse.ArgumentParser(description="Build the documentation site.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "outputs" / "docs", help="folder of the site"
    )
    out = parser.parse_args().out.resolve()
    # A site lists what it describes in objects.inv; anything else is not ours to replace.
    if out.exists() and any(out.iterdir()) and not (out / "objects.inv").exists():
        print(f"{out} is no documentation site; name another --out", file=sys.stderr)
        return 2
    if importlib.util.find_spec("zensical") is None:
        print("Missing: the extra `docs` (pip install -e '.[docs]').", file=sys.stderr)
        return 2
    if wrong := build(ROOT, out):
        print("\n".join(wrong), file=sys.stderr)
        return 1
    print(out / "index.html")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
