"""What a traced program calls."""

import re

import torch

_LIBRARY = re.compile(
    r"aten\.(\w*mm|matmul|mv|addmv|\w*cholesky\w*|linalg_(solve|inv|qr)\w*)\."
)


def library_calls(program: torch.export.ExportedProgram) -> set[str]:
    """Calls of BLAS and LAPACK. One of them, and inductor allocates every intermediate."""
    called = {str(n.target) for n in program.graph.nodes if n.op == "call_function"}
    return {name for name in called if _LIBRARY.match(name)}
