"""Products and solutions with matrices of a few rows, fast in eager and in compiled code.

Eagerly each call costs more than its arithmetic, so one call of BLAS or LAPACK is best. A
compiler fuses sums of products with all that surrounds them, across a batch as well, but has
to leave its loop for every such call. So what is compiled is written out.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def matmul(
    A: Float[Tensor, "*#batch m k"], B: Float[Tensor, "*#batch k n"]
) -> Float[Tensor, "*batch m n"]:
    """A B."""
    if not torch.compiler.is_compiling():
        return A @ B
    return unrolled_matmul(A, B)


def inverse_norm(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch"]:
    """Frobenius norm of A^-1, for a symmetric positive definite A."""
    if not torch.compiler.is_compiling():
        factor, _ = torch.linalg.cholesky_ex(A)
        return torch.linalg.matrix_norm(torch.cholesky_inverse(factor))
    return unrolled_inverse_norm(A)


def solve_positive(
    A: Float[Tensor, "*batch n n"], B: Float[Tensor, "*batch n k"]
) -> Float[Tensor, "*batch n k"]:
    """A^-1 B for a symmetric positive definite A."""
    if not torch.compiler.is_compiling():
        factor, _ = torch.linalg.cholesky_ex(A)
        return torch.cholesky_solve(B, factor)
    return unrolled_solve(A, B)


def unrolled_matmul(
    A: Float[Tensor, "*#batch m k"], B: Float[Tensor, "*#batch k n"]
) -> Float[Tensor, "*batch m n"]:
    """`matmul` as a sum of products."""
    return (A.unsqueeze(-1) * B.unsqueeze(-3)).sum(-2)


def unrolled_solve(
    A: Float[Tensor, "*batch n n"], B: Float[Tensor, "*batch n k"]
) -> Float[Tensor, "*batch n k"]:
    """`solve_positive` row by row from A = L D L^T, with unit lower triangular L."""
    L, inverse_d = _factors(A)
    rows = list(B.unbind(-2))
    for i in range(len(rows)):  # L y = b
        for j in range(i):
            rows[i] = rows[i] - L[i][j].unsqueeze(-1) * rows[j]
    for i in reversed(range(len(rows))):  # L^T x = D^-1 y
        rows[i] = rows[i] * inverse_d[i].unsqueeze(-1)
        for j in range(i + 1, len(rows)):
            rows[i] = rows[i] - L[j][i].unsqueeze(-1) * rows[j]
    return torch.stack(rows, dim=-2)


def unrolled_inverse_norm(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch"]:
    """`inverse_norm` from the entries of A^-1 = M^T D^-1 M with M = L^-1."""
    L, inverse_d = _factors(A)
    n = len(inverse_d)
    M: list[list[Tensor]] = [[] for _ in range(n)]
    for i in range(n):
        for j in range(i):
            M[i].append(-_sum([L[i][j], *(L[i][k] * M[k][j] for k in range(j + 1, i))]))
        M[i].append(torch.ones_like(inverse_d[i]))
    square = []
    for i in range(n):
        for j in range(i + 1):
            entry = _sum([M[k][i] * M[k][j] * inverse_d[k] for k in range(i, n)])
            square.append(entry * entry * (1 if i == j else 2))
    return _sum(square).sqrt()


def _factors(A: Tensor) -> tuple[list[list[Tensor]], list[Tensor]]:
    """L, as rows of entries left of the diagonal, and 1/D of A = L D L^T."""
    n = A.shape[-1]
    L: list[list[Tensor]] = [[] for _ in range(n)]
    inverse_d: list[Tensor] = []
    for i in range(n):
        scaled: list[Tensor] = []  # L[i][j] D[j]
        for j in range(i):
            entry = A[..., i, j]
            for k in range(j):
                entry = entry - scaled[k] * L[j][k]
            scaled.append(entry)
            L[i].append(entry * inverse_d[j])
        d = A[..., i, i]
        for k in range(i):
            d = d - scaled[k] * L[i][k]
        inverse_d.append(1 / d)
    return L, inverse_d


def _sum(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
