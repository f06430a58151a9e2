"""The adaptation law as the paper prints it."""

from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.small_matrices import matmul
from hrc_learn.jacobian.estimators.interface import (
    ImageJacobianEstimator,
    Measurement,
    WeightState,
    evaluate,
)
from hrc_learn.jacobian.network import RBFImageJacobian


class PaperEstimator(ImageJacobianEstimator):
    """W_dot = -[L theta s^T xi_x']^T,  s = J_s_hat^T xi_x + xi_r      (update)

    L is a multiple of the identity. The law reduces the energy |s|^2 that the command puts
    into the task; no measured image motion enters, so it cannot learn a wrong Jacobian
    right. With Table I's L = 0.25 I weights of 1e3 px/m change by parts in 1e9.
    """

    def __init__(self, network: RBFImageJacobian, gain: float = 0.25):
        """Set up the law.

        Args:
            network: Neurons and initial weights.
            gain: Diagonal of L.
        """
        super().__init__(network)
        self.gain = gain

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """One explicit Euler step of dt."""
        theta = self.network.basis(measurement.pose)
        rate = paper_rate(state.weight, theta, measurement, self.gain)
        return WeightState(weight=state.weight + measurement.dt * rate)


def paper_rate(
    weight: Float[Tensor, "*batch entries K"],
    theta: Float[Tensor, "*batch K"],
    measurement: Measurement,
    gain: float,
) -> Float[Tensor, "*batch entries K"]:
    """W_dot of the printed law.

    xi_x'^T s is the outer product of xi_x and s, row by row: so d(J_s_hat)/dt =
    -gain |theta|^2 xi_x s^T at the present pose.
    """
    xi_x = measurement.xi_x.unsqueeze(-1)
    J = evaluate(weight, theta)
    s = matmul(J.mT, xi_x).squeeze(-1) + measurement.xi_r
    push = (xi_x * s.unsqueeze(-2)).flatten(-2)  # (*batch, 12)
    return -gain * push.unsqueeze(-1) * theta.unsqueeze(-2)
