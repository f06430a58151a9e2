"""Private parts of inductor: as they are expected, and put back."""

import inspect

import pytest
import torch
from torch._inductor import cpp_builder, ir
from torch._inductor.codegen import cpp_wrapper_cpu_array_ref

from hrc_learn.deploy.export import tuned_for


@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        (
            ir.FlexibleLayout.__init__,
            ["self", "device", "dtype", "size", "stride_order", "is_pinned"],
        ),
        (ir.ComputedBuffer.get_fill_order, ["self"]),
        (ir.View.create, ["x", "new_size"]),
        (cpp_builder._get_optimization_cflags, ["cpp_compiler", "min_optimize"]),
    ],
)
def test_the_installed_torch_has_the_functions_that_are_replaced(function, parameters):
    """Fails on the day that torch changes them: adapt `deploy/export.py`."""
    assert list(inspect.signature(function).parameters) == parameters


def test_the_installed_torch_has_what_the_replacements_call():
    assert list(inspect.signature(ir.is_storage_and_layout).parameters) == ["x"]
    assert callable(ir.ComputedBuffer(name=None, layout=None, data=None).freeze_layout)
    assert isinstance(cpp_wrapper_cpu_array_ref.MAX_STACK_ALLOCATION_SIZE, int)
    assert hasattr(torch._inductor.config, "post_grad_custom_post_pass")
    assert torch._inductor.config.aot_inductor.allow_stack_allocation in (True, False)


def private_parts() -> list[object]:
    return [
        vars(ir.FlexibleLayout)["__init__"],
        vars(ir.ComputedBuffer)["get_fill_order"],
        vars(ir.View)["create"],
        cpp_builder._get_optimization_cflags,
        cpp_wrapper_cpu_array_ref.MAX_STACK_ALLOCATION_SIZE,
    ]


@pytest.mark.parametrize("fails", [False, True])
def test_they_are_put_back_after_a_compilation(fails):
    before = private_parts()
    try:
        with tuned_for([4]) as options:
            assert all(a is not b for a, b in zip(private_parts(), before, strict=True))
            assert "post_grad_custom_post_pass" in options
            if fails:
                raise RuntimeError("no compiler")
    except RuntimeError:
        assert fails
    assert all(a is b for a, b in zip(private_parts(), before, strict=True))


def test_kernels_of_batches_are_compiled_without_what_breaks_gcc():
    with tuned_for([4]):
        flags, _ = cpp_builder._get_optimization_cflags("g++")
    assert "O2" in flags
    assert "O3" not in flags


def test_one_arm_needs_no_layout_of_a_batch():
    before = private_parts()
    with tuned_for([]) as options:
        assert private_parts()[:4] == before[:4]
        assert options == {"aot_inductor.allow_stack_allocation": True}
