"""Compile a control step with PyTorch's AOTInductor, for programs with libtorch.

It takes a C++ compiler and a minute or two, and the code is slower than that of `export_step`.
`run_exported_step.py` runs the package without the library that made it.
"""

from pathlib import Path

import torch

from hrc_learn.controller import AdaptiveController, Observation
from hrc_learn.deploy.export import trace
from hrc_learn.deploy.package import PackedStep, describe


def export_torch_package(
    controller: AdaptiveController, observation: Observation, package: Path
) -> Path:
    """Compile the step of a controller.

    Args:
        controller: Controller with the step.
        observation: An example, as for `export_step`.
        package: File to write; its name ends with `.pt2`.
    """
    step = PackedStep(controller, observation)
    program = trace(step, observation)
    for node in program.graph.nodes:
        # The inductor of torch 2.11 cannot raise a constant to a power.
        if node.target is torch.ops.aten.square.default:
            node.target, node.args = torch.ops.aten.mul.Tensor, (node.args[0], node.args[0])
    with torch.no_grad():
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(package),
            inductor_configs={"aot_inductor.metadata": describe(step, observation)},
        )
    return package
