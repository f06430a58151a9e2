"""Measure how a Python package is laid out and written, and hold it to a budget.

    python tools/measure_code.py hrc_learn PATH/TO/mink PATH/TO/diffrax
    python tools/measure_code.py hrc_learn --check     # exit status 1 beyond the budget
    python tools/measure_code.py hrc_learn --update    # writes the table in CONTRIBUTING.md

The same rules hold for every package, so that ours can be compared with others. Code is what
remains of a file without blank lines, comments and docstrings.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import statistics
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"

LAYOUT_TOKENS = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
"""Tokens that do not make their line a line of code."""


FRAGMENT_STARTS = {
    *("Of", "What", "How", "Whether", "Where", "From", "By", "As", "Which", "When", "Who"),
    *("With", "At", "Likewise", "For", "To"),
}
"""First words of docstrings that are neither a noun phrase nor a sentence."""

IDIOM = {"who", "nobody", "somebody", "share", "told", "beside"}
"""Words that comparable packages write at most 0.1 times in 1,000 words of docstrings."""

LONG_FUNCTION = 50
"""Lines, without docstring, comments and blanks, beyond which a function counts as long."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one package."""

    modules: int
    """Files other than `__init__.py`."""
    code: int
    """Lines of code, those of `__init__.py` included."""
    code_per_module: float
    """Mean number of code lines in a module."""
    code_median: float
    """Median number of code lines in a module."""
    import_fraction: float
    """Fraction of the code lines that import."""
    comments_per_100: float
    """Lines with a comment per 100 lines of code."""
    functions: int
    """Functions at the top level of a module."""
    named_once: int
    """Top-level functions whose name occurs once outside their definition."""
    long_functions: int
    """Functions and methods of more than 50 lines."""
    shared_file_names: int
    """File names that occur in more than one folder."""
    circles: int
    """Import circles; imports in functions and for type checkers count."""
    fragments: float
    """Fraction of the docstrings that begin as a fragment."""
    idiom: float
    """Occurrences of private idiom per 1,000 words of docstrings."""


BUDGET: dict[str, float] = {
    "code": 45_000,
    "modules": 235,
    "long_functions": 20,
    "shared_file_names": 0,
    "circles": 0,
    "fragments": 0.03,
    "idiom": 0.3,
    "docs_words": 35_000,
}
"""Largest allowed figures. Nothing raises them but the rows that CONTRIBUTING.md lists for code
and modules. For scale: BoTorch has 34.7k lines of code in 172 modules."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """One file, parsed."""

    path: Path
    module: str
    text: str
    tree: ast.Module

    @cached_property
    def tokens(self) -> list[tokenize.TokenInfo]:
        """All tokens of the file."""
        return list(tokenize.generate_tokens(io.StringIO(self.text).readline))

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of the tree."""
        return list(ast.walk(self.tree))

    @property
    def is_face(self) -> bool:
        """True for a package's `__init__.py`."""
        return self.path.name == "__init__.py"

    @cached_property
    def docstring_lines(self) -> set[int]:
        """Lines of docstrings: those of modules, classes, functions and attributes."""
        return {line for node in only_docstrings(self.nodes) for line in lines_of(node)}

    def docstrings(self) -> list[str]:
        """Texts of all docstrings."""
        nodes = only_docstrings(self.nodes)
        return [node.value.value.strip() for node in nodes]  # pyright: ignore

    @cached_property
    def code_lines(self) -> set[int]:
        """Lines that hold code."""
        code = {
            line
            for token in self.tokens
            if token.type not in LAYOUT_TOKENS
            for line in range(token.start[0], token.end[0] + 1)
        }
        return code - self.docstring_lines

    def import_lines(self) -> set[int]:
        """Lines of import statements."""
        nodes = (n for n in self.nodes if isinstance(n, (ast.Import, ast.ImportFrom)))
        return {line for node in nodes for line in lines_of(node)}

    def comments(self) -> int:
        """Number of lines that hold a comment."""
        return sum(token.type == tokenize.COMMENT for token in self.tokens)

    def long_functions(self) -> int:
        """Number of functions longer than `LONG_FUNCTION`."""
        lines, prose = self.text.splitlines(), self.docstring_lines
        functions = (
            node
            for node in self.nodes
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        )
        return sum(
            sum(
                line not in prose and bool(text := lines[line - 1].strip()) and text[0] != "#"
                for line in lines_of(node)
            )
            > LONG_FUNCTION
            for node in functions
        )

    def imported(self) -> Iterator[str]:
        """Modules, or names in modules, that it imports anywhere."""
        for node in self.nodes:
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = self._absolute(node)
                yield from (f"{base}.{alias.name}" for alias in node.names)

    def _absolute(self, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        # A package's own name is one level above its __init__.py.
        parents = self.module.split(".")[: None if self.is_face else -1]
        parents = parents[: len(parents) - (node.level - 1)]
        return ".".join([*parents, *([node.module] if node.module else [])])


def lines_of(node: ast.stmt) -> range:
    """Lines that a statement covers."""
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def only_docstrings(nodes: Iterable[ast.AST]) -> Iterator[ast.Expr]:
    """Strings that stand as a statement of their own."""
    for node in nodes:
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node


def read_package(root: Path) -> list[Source]:
    """Parse all files of a package.

    Args:
        root: Folder of the package, named as it is imported.

    Raises:
        FileNotFoundError: There is no Python file.
    """
    sources = []
    for path in sorted(root.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        parts = [root.name, *path.relative_to(root).with_suffix("").parts]
        sources.append(
            Source(
                path=path,
                module=".".join(parts[:-1] if parts[-1] == "__init__" else parts),
                text=text,
                tree=ast.parse(text, filename=str(path)),
            )
        )
    if not sources:
        raise FileNotFoundError(f"{root}: no Python file in it")
    return sources


def measure(sources: list[Source]) -> Figures:
    """Measure one package."""
    modules = [source for source in sources if not source.is_face]
    code = [len(source.code_lines) for source in sources]
    names = Counter(t.string for s in sources for t in s.tokens if t.type == tokenize.NAME)
    functions = [
        node.name for s in sources for node in s.tree.body if isinstance(node, ast.FunctionDef)
    ]
    stems = Counter(source.path.name for source in modules)
    docstrings = [text for source in sources for text in source.docstrings()]
    words = [word for text in docstrings for word in re.findall(r"[a-z]+", text.lower())]
    fragments = sum(re.split(r"\W", text)[0] in FRAGMENT_STARTS for text in docstrings)
    return Figures(
        modules=len(modules),
        code=sum(code),
        code_per_module=sum(code) / len(modules),
        code_median=statistics.median(len(source.code_lines) for source in modules),
        import_fraction=sum(len(source.import_lines()) for source in sources) / sum(code),
        comments_per_100=100 * sum(source.comments() for source in sources) / sum(code),
        functions=len(functions),
        # The definition is one occurrence of the name itself.
        named_once=sum(names[name] == 2 for name in functions),
        long_functions=sum(source.long_functions() for source in sources),
        shared_file_names=sum(count > 1 for count in stems.values()),
        circles=len(circles(sources)),
        fragments=fragments / max(1, len(docstrings)),
        idiom=1000 * sum(word in IDIOM for word in words) / max(1, len(words)),
    )


def circles(sources: list[Source]) -> list[list[str]]:
    """Groups of modules that import each other in a circle.

    Imports in functions and for type checkers count. A package's `__init__` is left out: it
    re-exports what stands below it.
    """
    known = {source.module for source in sources if not source.is_face}
    graph: dict[str, set[str]] = {}
    for source in sources:
        if source.is_face:
            continue
        # What is imported is a module, or a name in one.
        targets = {
            module
            for name in source.imported()
            for module in (name, name.rpartition(".")[0])
            if module in known
        }
        graph[source.module] = targets - {source.module}
    reach = {module: reachable(module, graph) for module in graph}
    groups = {
        frozenset(other for other in reach[module] if module in reach[other])
        for module in graph
        if module in reach[module]
    }
    return sorted(sorted(group) for group in groups)


def reachable(start: str, graph: dict[str, set[str]]) -> set[str]:
    """Modules reachable from one along imports; the module itself only through a circle."""
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        module = waiting.pop()
        if module not in seen:
            seen.add(module)
            waiting += graph[module]
    return seen


def comparison(rows: dict[str, Figures]) -> str:
    """Figures of several packages as a Markdown table."""
    header = (
        "| package | code | modules | a module (median) | imports | comments per 100 | "
        "long functions | fragments | idiom per 1,000 words |"
    )
    lines = [header, "|---" * 9 + "|"]
    lines += [
        f"| {name} | {f.code} | {f.modules} | {f.code_per_module:.0f} ({f.code_median:.0f}) | "
        f"{f.import_fraction:.1%} | {f.comments_per_100:.1f} | {f.long_functions} | "
        f"{f.fragments:.1%} | {f.idiom:.2f} |"
        for name, f in rows.items()
    ]
    return "\n".join(lines)


# Rows of the table in CONTRIBUTING.md: figure, words, format.
ROWS = {
    "code": ("lines of code", "{:,.0f}"),
    "modules": ("modules", "{:.0f}"),
    "long_functions": ("functions of more than 50 lines", "{:.0f}"),
    "shared_file_names": ("file names used twice or more", "{:.0f}"),
    "circles": ("import circles, type-only imports included", "{:.0f}"),
    "fragments": ("docstrings that are fragments", "{:.1%}"),
    "idiom": ("private idiom per 1,000 words of docstrings", "{:.2f}"),
    "docs_words": ("words in docs/", "{:,.0f}"),
}
TABLE = re.compile(r"(<!-- house:begin -->\n).*?(<!-- house:end -->)", re.DOTALL)
RAISE = re.compile(r"^\| \+(\d+) lines(?:, (\d+) modules?)? \| .+? \|$", re.MULTILINE)


def docs_words(root: Path) -> int:
    """Words in the Markdown pages below a folder."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in root.rglob("*.md"))


def budget(contributing: str) -> dict[str, float]:
    """The budget, its code and modules raised by the rows of CONTRIBUTING.md with a reason."""
    raises = RAISE.findall(contributing)
    return BUDGET | {
        "code": BUDGET["code"] + sum(int(lines) for lines, _ in raises),
        "modules": BUDGET["modules"] + sum(int(modules or 0) for _, modules in raises),
    }


def budget_table(values: dict[str, float], limits: dict[str, float]) -> str:
    """Figures with their budgets as a Markdown table. Code is rounded to 100 lines, words to
    500, so that the table does not change with every commit.
    """
    rounded = values | {
        "code": round(values["code"], -2),
        "docs_words": 500 * round(values["docs_words"] / 500),
    }
    lines = ["| figure | now | at most | without raises |", "|---|---|---|---|"]
    lines += [
        f"| {words} | {shape.format(rounded[key])} | {shape.format(limits[key])} | "
        f"{shape.format(BUDGET[key])} |"
        for key, (words, shape) in ROWS.items()
    ]
    return "\n".join(lines) + "\n"


def excesses(values: dict[str, float], limits: dict[str, float]) -> list[str]:
    """One line for each figure beyond its budget."""
    return [
        f"{ROWS[key][0]}: {values[key]:.4g}, at most {limit:.4g} allowed"
        for key, limit in limits.items()
        if values[key] > limit
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("packages", nargs="+", type=Path, help="folders of packages")
    parser.add_argument("--json", type=Path, help="file for the figures of the first package")
    parser.add_argument("--check", action="store_true", help="fail beyond the budget")
    parser.add_argument("--update", action="store_true", help="write CONTRIBUTING.md's table")
    args = parser.parse_args()
    try:
        packages = {root.resolve().name: read_package(root.resolve()) for root in args.packages}
    except (FileNotFoundError, SyntaxError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = {name: measure(sources) for name, sources in packages.items()}
    print(comparison(rows))
    first, sources = next(iter(packages.items()))
    values = asdict(rows[first]) | {"docs_words": docs_words(ROOT / "docs")}
    for circle in circles(sources):
        print("circle:", ", ".join(circle), file=sys.stderr)
    if args.json:
        args.json.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    text = CONTRIBUTING.read_text(encoding="utf-8")
    limits = budget(text)
    table = budget_table(values, limits)
    current = TABLE.sub(lambda match: match[1] + table + match[2], text)
    if args.update:
        CONTRIBUTING.write_text(current, encoding="utf-8")
    if not args.check:
        return 0
    faults = excesses(values, limits)
    if current != text and not args.update:
        faults.append("the table in CONTRIBUTING.md is out of date: `make format` writes it")
    for fault in faults:
        print(f"error: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
