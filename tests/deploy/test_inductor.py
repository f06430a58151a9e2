"""Private parts of inductor: as they are expected, or left alone."""

import inspect
import warnings

import pytest
import torch
from step_equality import assert_equal_steps, controller_and_observation
from torch._inductor import ir
from torch._inductor.codegen import cpp_wrapper_cpu_array_ref
from unchecked import shapes_unchecked

from hrc_learn.deploy import _inductor, export_step
from hrc_learn.deploy._inductor import tuned_for, unexpected_names
from hrc_learn.deploy.package import load
from hrc_learn.kinematics import panda


@pytest.fixture(autouse=True)
def _warn_again():
    """A warning that one test has seen is not kept from the next."""
    _inductor._warn_of.cache_clear()


def test_the_installed_torch_has_the_names_that_are_replaced():
    """Fails on the day that torch changes them: adapt `_inductor.py`, or batches are slow."""
    assert unexpected_names() == []
    # What the replacements call besides.
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


def test_one_arm_needs_no_layout_of_a_batch():
    before = private_parts()
    with tuned_for([]) as options:
        assert private_parts()[:3] == before[:3]
        assert options == {"aot_inductor.allow_stack_allocation": True}


def within(tuning):
    """A private part during a compilation, and its options."""
    with tuning as options:
        return ir.FlexibleLayout.__init__, options


def changed_create(x, new_size, order):
    raise AssertionError


@pytest.fixture(params=["renamed", "another parameter"])
def later_torch(request, monkeypatch):
    """A torch whose private parts are not those that we know."""
    if request.param == "renamed":
        monkeypatch.delattr(ir.ComputedBuffer, "get_fill_order")
        # Something else goes by a default of the base class.
        monkeypatch.setattr(ir.Buffer, "get_fill_order", None, raising=False)
        return "ComputedBuffer.get_fill_order"
    monkeypatch.setattr(ir.View, "create", staticmethod(changed_create))
    return "View.create"


def test_a_later_torch_is_left_alone_and_warned_of_once(later_torch):
    assert unexpected_names() == [later_torch]
    layout = ir.FlexibleLayout.__init__
    with pytest.warns(UserWarning, match=later_torch):
        seen, options = within(tuned_for([4]))
    assert seen is layout
    assert "post_grad_custom_post_pass" not in options
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        within(tuned_for([4]))


def test_without_the_stack_size_the_layout_goes_as_well(monkeypatch):
    monkeypatch.delattr(cpp_wrapper_cpu_array_ref, "MAX_STACK_ALLOCATION_SIZE")
    with pytest.warns(UserWarning, match="MAX_STACK_ALLOCATION_SIZE"):
        _, options = within(tuned_for([]))
    assert options == {"aot_inductor.allow_stack_allocation": True}
    assert not hasattr(cpp_wrapper_cpu_array_ref, "MAX_STACK_ALLOCATION_SIZE")


@pytest.mark.slow
def test_what_is_compiled_without_the_change_is_right(tmp_path, monkeypatch):
    monkeypatch.setattr(_inductor, "unexpected_names", lambda: ["View.create"])
    with shapes_unchecked():
        controller, observation = controller_and_observation(panda.ready.expand(4, 7))
        with pytest.warns(UserWarning, match=r"View\.create"):
            package = export_step(controller, observation, tmp_path)
        assert_equal_steps(controller, observation, load(package).run, 50)
