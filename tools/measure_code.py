"""Measure how a Python package is laid out: modules, lines of code, imports, comments, circles.

    python tools/measure_code.py hrc_learn PATH/TO/mink PATH/TO/diffrax

The same rules hold for every package, so that ours can be set beside others. Code is what is
left of a file without blank lines, comments and docstrings. Exit status 1 if the first package
has an import circle, imports inside functions counted.
"""

import argparse
import ast
import io
import json
import statistics
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

LAYOUT_TOKENS = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
"""Tokens that do not make their line a line of code."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What is measured of one package."""

    modules: int
    """Files other than `__init__.py`."""
    code: int
    """Lines of code, those of `__init__.py` counted."""
    code_per_module: float
    code_median: float
    """Of the modules."""
    import_share: float
    """Share of the code that is import statements."""
    comments_per_100: float
    """Comments on 100 lines of code."""
    functions: int
    """At the top level of a module."""
    named_once: int
    """Of them, those whose name stands in one place besides their definition."""
    shared_file_names: int
    """File names that stand in more than one folder."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """One file, parsed."""

    path: Path
    module: str
    tree: ast.Module
    tokens: list[tokenize.TokenInfo]

    @property
    def is_face(self) -> bool:
        """Whether it is a package's `__init__.py`."""
        return self.path.name == "__init__.py"

    def docstring_lines(self) -> set[int]:
        """Lines of strings that stand as a statement: docstrings, and those of attributes."""
        return {
            line
            for node in ast.walk(self.tree)
            if isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
            for line in lines_of(node)
        }

    def code_lines(self) -> set[int]:
        """Lines that hold code."""
        code = {
            line
            for token in self.tokens
            if token.type not in LAYOUT_TOKENS
            for line in range(token.start[0], token.end[0] + 1)
        }
        return code - self.docstring_lines()

    def import_lines(self) -> set[int]:
        """Lines of import statements."""
        nodes = (n for n in ast.walk(self.tree) if isinstance(n, (ast.Import, ast.ImportFrom)))
        return {line for node in nodes for line in lines_of(node)}

    def comments(self) -> int:
        """Number of lines that hold a comment."""
        return sum(token.type == tokenize.COMMENT for token in self.tokens)

    def imported(self) -> Iterator[str]:
        """Modules, or names in modules, that it imports anywhere but for type checkers."""
        for node in walk_at_run_time(self.tree):
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


def walk_at_run_time(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those under `if TYPE_CHECKING:`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from (
                x for branch in node.orelse for x in (branch, *walk_at_run_time(branch))
            )
        else:
            yield node
            yield from walk_at_run_time(node)


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
                tree=ast.parse(text, filename=str(path)),
                tokens=list(tokenize.generate_tokens(io.StringIO(text).readline)),
            )
        )
    if not sources:
        raise FileNotFoundError(f"{root}: no Python file in it")
    return sources


def measure(sources: list[Source]) -> Figures:
    """The figures of a package."""
    modules = [source for source in sources if not source.is_face]
    code = [len(source.code_lines()) for source in sources]
    names = Counter(t.string for s in sources for t in s.tokens if t.type == tokenize.NAME)
    functions = [
        node.name for s in sources for node in s.tree.body if isinstance(node, ast.FunctionDef)
    ]
    stems = Counter(source.path.name for source in modules)
    return Figures(
        modules=len(modules),
        code=sum(code),
        code_per_module=sum(code) / len(modules),
        code_median=statistics.median(len(source.code_lines()) for source in modules),
        import_share=sum(len(source.import_lines()) for source in sources) / sum(code),
        comments_per_100=100 * sum(source.comments() for source in sources) / sum(code),
        functions=len(functions),
        # The definition is one occurrence of the name itself.
        named_once=sum(names[name] == 2 for name in functions),
        shared_file_names=sum(count > 1 for count in stems.values()),
    )


def circles(sources: list[Source]) -> list[list[str]]:
    """Groups of modules that import each other in a circle, imports in functions counted.

    A package's face is no part of one: it re-exports what is below it.
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
    """Modules that can be reached from one along imports, itself only through a circle."""
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        module = waiting.pop()
        if module not in seen:
            seen.add(module)
            waiting += graph[module]
    return seen


def table(rows: dict[str, Figures]) -> str:
    """The figures as a Markdown table."""
    header = (
        "| package | code | modules | code per module (median) | import share | "
        "comments per 100 lines of code | top-level functions (named once) |"
    )
    lines = [header, "|---" * 7 + "|"]
    lines += [
        f"| {name} | {f.code} | {f.modules} | {f.code_per_module:.0f} ({f.code_median:.0f}) | "
        f"{f.import_share:.1%} | {f.comments_per_100:.1f} | {f.functions} ({f.named_once}) |"
        for name, f in rows.items()
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("packages", nargs="+", type=Path, help="folders of packages")
    parser.add_argument("--json", type=Path, help="file for the figures of the first")
    args = parser.parse_args()
    try:
        packages = {root.resolve().name: read_package(root.resolve()) for root in args.packages}
    except (FileNotFoundError, SyntaxError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = {name: measure(sources) for name, sources in packages.items()}
    print(table(rows))
    first, sources = next(iter(packages.items()))
    found = circles(sources)
    for circle in found:
        print("circle:", ", ".join(circle), file=sys.stderr)
    if args.json:
        figures = asdict(rows[first]) | {"circles": len(found)}
        args.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
