"""The tool that measures the layout, on a package whose figures can be counted by eye."""

import pytest
from programs_as_modules import load_program


@pytest.fixture(scope="module")
def tool():
    return load_program("tools/measure_code.py")


@pytest.fixture
def package(tmp_path):
    root = tmp_path / "box"
    (root / "inner").mkdir(parents=True)
    (root / "__init__.py").write_text("from box.lid import lid as lid\n")
    (root / "inner" / "__init__.py").write_text("")
    # Nine lines of code, two comments, three docstrings of which one is a fragment.
    (root / "lid.py").write_text(
        '"""The lid of a box."""\n\n'
        "from __future__ import annotations\n"
        "from typing import TYPE_CHECKING\n\n"
        "# Types alone.\n"
        "if TYPE_CHECKING:\n    from box.hinge import Hinge\n\n"
        'def lid(hinge: Hinge) -> str:\n    """Of the hinge, told twice."""\n'
        "    # A comment.\n    text = '''two\nlines'''\n    return text\n"
    )
    (root / "hinge.py").write_text(
        '"""Hinges."""\n\nclass Hinge:\n    def lid(self):\n'
        "        from box.lid import lid\n        return lid(self)\n"
    )
    long = "".join(f"    x{k} = {k}\n\n" for k in range(50))
    (root / "inner" / "lid.py").write_text(f"def fifty_one():\n{long}")
    return root


def test_figures_are_those_counted_by_eye(tool, package):
    figures = tool.measure(tool.read_package(package))
    assert figures.modules == 3
    assert figures.code == 1 + 8 + 4 + 51
    assert figures.long_functions == 1
    assert figures.shared_file_names == 1
    assert figures.fragments == pytest.approx(1 / 3)
    # One word of "the lid of a box hinges of the hinge told twice".
    assert figures.idiom == pytest.approx(1000 / 11)
    assert figures.comments_per_100 == pytest.approx(100 * 2 / figures.code)


def test_a_circle_of_a_type_and_a_lazy_import_is_found(tool, package):
    assert tool.circles(tool.read_package(package)) == [["box.hinge", "box.lid"]]


def test_a_raise_of_the_budget_needs_a_line_with_its_reason(tool):
    text = (
        "| +200 lines | multiply: object-centred primitives |\n"
        "| +100 lines, 2 modules | readers of foreign recordings |\n"
        "| +300 lines, 4 modules |  |\n"
    )
    limits = tool.budget(text)
    assert limits["code"] == tool.BUDGET["code"] + 300
    assert limits["modules"] == tool.BUDGET["modules"] + 2


def test_excesses_name_the_figure_and_its_limit(tool):
    values = dict.fromkeys(tool.BUDGET, 0) | {"modules": tool.BUDGET["modules"] + 1}
    (fault,) = tool.excesses(values, tool.BUDGET)
    limit = tool.BUDGET["modules"]
    assert f"modules: {limit + 1}, at most {limit}" in fault
